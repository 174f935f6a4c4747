"""NMEA 0183: epochs and event marks at their GPS time, through midnight, leap second and damage."""

from __future__ import annotations

import math
import re
from functools import reduce
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pynmeagps import NMEAReader

from drivers.contract import DeviceError, EventMark, NavSample
from drivers.receivers.message_decoder import Nav
from drivers.receivers.nmea.decoder import NmeaDecoder
from drivers.receivers.nmea.navigator import NmeaNavigator
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.timescales.gps_time import WEEK_NS
from tests.drivers.fakes import FakeClock, FakePort

NAV = Path(__file__).parent / "data"
EXCERPT = Path(__file__).parent / "data" / "ublox-zed-f9r-excerpt.nmea"
EVENT = b"$PTNL,EVT,131007.999785,2,460,2181,5,18*72\r\n"
SECOND_NS = 10**9


def sentence(body: str) -> bytes:
    total = reduce(lambda a, b: a ^ b, body.encode())
    return f"${body}*{total:02X}\r\n".encode()


def epoch(time: str, date: str = "211126", *, heading: float | None = None) -> bytes:
    text = sentence(f"GNRMC,{time},A,4730.000000,N,00830.000000,E,100.0,90.0,{date},,,A")
    text += sentence(f"GNGGA,{time},4730.000000,N,00830.000000,E,4,17,0.8,952.5,M,47.5,M,,")
    text += sentence(f"GNGST,{time},1.0,,,,0.03,0.04,0.09")
    return text + (b"" if heading is None else sentence(f"GNHDT,{heading},T"))


def decode(data: bytes, piece: int = 0) -> tuple[NmeaDecoder, list[Nav]]:
    decoder = NmeaDecoder("gnss")
    records = []
    for at in range(0, len(data), piece or len(data) or 1):
        records += decoder.feed(data[at : at + (piece or len(data))], 77)
    return decoder, records


def samples(data: bytes) -> list[NavSample]:
    return [r for r in decode(data)[1] if isinstance(r, NavSample)]


def test_an_epoch_comes_out_in_si_units_at_its_gps_time() -> None:
    first, second = samples(epoch("100000.00", heading=271.5) + epoch("100000.20", heading=272))
    assert first.gps_ns == 2445 * WEEK_NS + (6 * 86_400 + 36_018) * SECOND_NS
    assert second.gps_ns - first.gps_ns == 200_000_000
    assert (first.latitude_deg, first.longitude_deg, first.height_m) == (47.5, 8.5, 1000.0)
    assert first.velocity_ned_mps is not None
    assert first.velocity_ned_mps[:2] == pytest.approx((0, 51.4444), abs=1e-3)
    assert first.velocity_ned_mps[2] is None
    assert first.horizontal_sigma_m == pytest.approx(0.05)
    assert (first.vertical_sigma_m, first.fix, first.satellites) == (0.09, "3d", 17)
    assert first.heading_rad == pytest.approx(math.radians(271.5))
    assert (first.leap_seconds, first.time_valid) == (18, True)


def test_from_the_second_epoch_on_a_sample_waits_for_nothing() -> None:
    decoder = NmeaDecoder("gnss")
    assert decoder.feed(epoch("100000.00"), 0) == []
    assert len(decoder.feed(epoch("100001.00"), 1)) == 1 + 1


def test_a_lost_sentence_costs_its_own_epoch_only() -> None:
    lost = epoch("100002.00").split(b"\r\n", 1)[1]  # without its RMC, so without its date
    times = [
        s.gps_ns
        for s in samples(
            epoch("100000.00") + epoch("100001.00") + lost + epoch("100003.00") + epoch("100004.00")
        )
    ]
    assert [t - times[0] for t in times] == [n * SECOND_NS for n in range(5)]


def test_midnight_and_the_week_pass_evenly_with_and_without_a_date() -> None:
    gga = sentence("GNGGA,000000.00,4730.0,N,00830.0,E,4,17,0.8,952.5,M,47.5,M,,")
    got = samples(epoch("235958.00") + epoch("235959.00") + gga + epoch("000001.00", "221126"))
    assert [s.gps_ns - got[0].gps_ns for s in got] == [n * SECOND_NS for n in range(4)]
    assert all(s.time_valid for s in got)


def test_time_goes_on_evenly_through_a_leap_second() -> None:
    stamps = [("235959.00", "311216"), ("235960.00", "311216"), ("000000.00", "010117")]
    got = samples(b"".join(epoch(*stamp) for stamp in stamps) + epoch("000001.00", "010117"))
    assert [s.gps_ns - 1930 * WEEK_NS for s in got] == [n * SECOND_NS for n in (16, 17, 18, 19)]
    assert [s.leap_seconds for s in got] == [17, 17, 18, 18]


def test_without_any_date_or_without_a_fix_there_is_no_sample() -> None:
    gga = "GNGGA,{},4730.0,N,00830.0,E,1,5,2.0,952.5,M,47.5,M,,"
    decoder, records = decode(sentence(gga.format("100000")) + sentence(gga.format("100001")))
    assert (records, decoder.counters["samples_without_date"]) == ([], 2)
    void = "GNRMC,{},V,4730.0,N,00830.0,E,,,211126,,,N"
    decoder, records = decode(sentence(void.format("100000")) + sentence(void.format("100001")))
    assert (records, decoder.fix, decoder.leap_seconds) == ([], "none", None)


def test_sentences_without_a_time_are_counted_once() -> None:
    decoder, _ = decode(2 * sentence("GNGGA,,,,,,0,00,99.9,,,,,,"))
    assert decoder.seen["GGA"] == 2


@pytest.mark.parametrize(("time", "is_valid"), [("100009.99", True), ("100010.00", False)])
def test_a_time_without_a_date_is_believed_less_than_ten_seconds_on(
    time: str, is_valid: bool
) -> None:
    gga = sentence(f"GNGGA,{time},4730.0,N,00830.0,E,4,17,0.8,952.5,M,47.5,M,,")
    far = sentence("GNGGA,113000.00,4730.0,N,00830.0,E,4,17,0.8,952.5,M,47.5,M,,")
    dated, later, *_ = samples(epoch("100000.00") + gga + far)
    assert (dated.time_valid, later.time_valid) == (True, is_valid)


def test_the_published_event_is_a_mark_at_its_gps_time() -> None:
    (mark,) = decode(EVENT)[1]
    assert isinstance(mark, EventMark)
    # 2021-10-29, a Friday, 13:10:07.999785 UTC.
    assert mark.gps_ns == 2181 * WEEK_NS + (5 * 86_400 + 47_425) * SECOND_NS + 999_785_000
    assert (mark.channel, mark.count, mark.time_valid) == (2, 460, True)


@pytest.mark.parametrize("week_day", ["2445,6", "2446,0"])
def test_an_event_in_the_last_seconds_of_the_utc_day_is_placed_by_navigation(week_day: str) -> None:
    event = sentence(f"PTNL,EVT,235950.500000,1,7,{week_day},18")
    marks = [
        r
        for r in decode(epoch("235950.00") + epoch("235951.00") + event)[1]
        if isinstance(r, EventMark)
    ]
    assert [(m.gps_ns, m.time_valid) for m in marks] == [(2446 * WEEK_NS + 8_500_000_000, True)]
    assert not any(r.time_valid for r in decode(event)[1] if isinstance(r, EventMark))


def test_an_event_of_a_rolled_over_week_is_not_valid() -> None:
    event = sentence("PTNL,EVT,100000.500000,1,7,1421,6,18")
    decoder, records = decode(epoch("100000.00") + epoch("100001.00") + event)
    assert [r.time_valid for r in records if isinstance(r, EventMark)] == [False]
    assert decoder.counters["marks_far"] == 1


def test_the_count_of_events_wraps_and_late_and_duplicate_ones_come_as_they_are() -> None:
    def event(count: int) -> bytes:
        return sentence(f"PTNL,EVT,100000.5,1,{count},2445,6,18")

    marks = decode(event(65_535) + event(65_536) + event(65_535))[1]
    assert [m.count for m in marks if isinstance(m, EventMark)] == [65_535, 0, 65_535]


@pytest.mark.parametrize("body", [
    "GNRMC,1e5,A,4730.0,N,00830.0,E,1,2,211126,,,A", "GNRMC", "GNGGA,100000,nan,N,1,E,1,,,,,,,,",
    "GNRMC,250000,A,4730.0,N,00830.0,E,1,2,211126,,,A", "PTNL,EVT,1,2", "PTNL",
    "GNZDA,100000,99,99,0,,",
    "GNRMC,100000,A,9130.0,N,00830.0,E,1,2,211126,,,A", "", ",,,", "PTNL,EVT,100000,1,1,-3,9,18",
])  # fmt: skip
def test_a_sentence_of_nonsense_raises_nothing(body: str) -> None:
    line = f"${body}*00".encode() if not body else sentence(body)
    assert decode(line + EVENT)[1][-1].gps_ns > 0


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_damage_and_noise_raise_nothing_and_cost_no_later_message(data: st.DataObject) -> None:
    stream = bytearray(b"".join(epoch(f"10000{n}.00") for n in range(4)))
    for _ in range(data.draw(st.integers(0, 8))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    noise = data.draw(st.binary(max_size=300))
    # The first sentence behind noise may be swallowed by its last line; the next is not.
    decoder_whole, records = decode(bytes(stream) + noise + EVENT + EVENT)
    assert sum(isinstance(r, EventMark) for r in records) >= 1
    pieces, same = decode(bytes(stream) + noise + EVENT + EVENT, data.draw(st.integers(1, 40)))
    assert same == records
    assert (pieces.frames, pieces.bad_bytes) == (decoder_whole.frames, decoder_whole.bad_bytes)
    assert decoder_whole._framer.pending <= 256


@pytest.mark.parametrize("path", [EXCERPT, NAV / "gpsd" / "ublox-zed-f9r.log"])
def test_every_recorded_sentence_is_that_of_pynmeagps_and_its_time_that_of_ubx(path: Path) -> None:
    recorded = path.read_bytes()
    decoder, records = decode(recorded)
    got = [r for r in records if isinstance(r, NavSample)]
    sentences = re.findall(rb"\$GN(?:GGA|RMC),[ -~]*\r\n", recorded)
    lines = [NMEAReader.parse(line) for line in sentences]
    ggas = [m for m in lines if m.msgID == "GGA"]
    assert decoder.seen["GGA"] == len(ggas)
    assert decoder.seen["RMC"] == sum(m.msgID == "RMC" for m in lines)
    # Whether the last epoch is emitted depends on where the recording ends.
    assert len(ggas) - 1 <= len(got) <= len(ggas)
    for sample, gga in zip(got, ggas, strict=False):
        assert sample.latitude_deg == pytest.approx(gga.lat, abs=2e-9)
        assert sample.longitude_deg == pytest.approx(gga.lon, abs=2e-9)
        assert sample.height_m == pytest.approx(gga.alt + gga.sep)
        assert sample.satellites == gga.numSV
    ubx = [r.gps_ns for r in UbxDecoder("f9r").feed(recorded, 0)]
    for sample in got if ubx else []:
        assert min(abs(sample.gps_ns - at) for at in ubx) < 10_000_000, "no 18 s between them"


def test_binding_states_what_was_received_or_what_to_switch_on() -> None:
    clock = FakeClock()

    def bind(received: bytes) -> str:
        def answer(_: FakePort) -> bytes:
            clock.now_ns += 10**8 if received else 0
            return received

        port = FakePort(clock, answer)
        navigator = NmeaNavigator("n", {"port": "x"}, clock=clock, open_port=lambda *_: port)
        return navigator.bind()["messages"]

    assert bind(epoch("100000.00")) == "GGA, GST, RMC"
    with pytest.raises(DeviceError, match="sent no RMC or GGA"):
        bind(sentence("GNTXT,01,01,02,hello"))
    with pytest.raises(DeviceError, match="is no NMEA 0183"):
        bind(b"\xb5\x62\x00")
    with pytest.raises(DeviceError, match="nothing came"):
        bind(b"")


@pytest.mark.parametrize(
    ("week", "day", "leap", "is_read"),
    [
        (0, 0, 0, True),
        (65_535, 6, 99, True),
        (-1, 0, 0, False),
        (65_536, 0, 0, False),
        (2181, -1, 18, False),
        (2181, 7, 18, False),
        (2181, 5, -1, False),
        (2181, 5, 100, False),
    ],
)
def test_an_event_beyond_week_day_or_leap_seconds_is_left_out(
    week: int, day: int, leap: int, is_read: bool
) -> None:
    event = sentence(f"PTNL,EVT,100000.500000,1,7,{week},{day},{leap}")
    gps_ns = [record.gps_ns for record in decode(event)[1] if isinstance(record, EventMark)]
    at_ns = week * WEEK_NS + (day * 86_400 + 36_000 + leap) * SECOND_NS + SECOND_NS // 2
    assert gps_ns == ([at_ns] if is_read else [])
