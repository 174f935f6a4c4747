"""SBF blocks: solutions and marks at GPS time, checked by pysbf2 block by block."""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pysbf2 import SBFReader

from drivers.contract import DeviceError, EventMark, NavSample
from drivers.receivers.message_decoder import Nav
from drivers.receivers.septentrio.blocks import crc
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.receivers.septentrio.navigator import SeptentrioNavigator
from drivers.timescales.gps_time import WEEK_NS
from tests.drivers.fakes import FakeClock, FakePort

WEEK = 2445
UNKNOWN = -2e10
MS = 1_000_000


def block(
    number: int, body: bytes, *, tow_ms: int = 100_000, week: int = WEEK, revision: int = 0
) -> bytes:
    stream_bytes = struct.pack("<IH", tow_ms, week) + body
    stream_bytes += bytes(-len(stream_bytes) % 4)
    stream_bytes = struct.pack("<HH", number | revision << 13, len(stream_bytes) + 8) + stream_bytes
    return b"$@" + struct.pack("<H", crc(stream_bytes)) + stream_bytes


def pvt(
    tow_ms: int = 100_000, *, week: int = WEEK, mode: int = 4, error: int = 0,
    latitude: float = math.radians(47.5), height: float = 1000.0, bias_ms: float = 0.25,
    accuracies: tuple[int, int] = (4, 6), number: int = 4007, revision: int = 2,
) -> bytes:  # fmt: skip
    body = struct.pack("<BB3d5fdf4BHHIB", mode, error, latitude, math.radians(8.5), height, 47.5,
                       60.0, 3.0, 1.0, 2.9, bias_ms, 0.1, 0, 0, 17, 0, 0, 0, 0, 0)  # fmt: skip
    if revision >= 1:
        body += struct.pack("<BH", 1, 0)
    if revision >= 2:
        body += struct.pack("<HHHB", 150, *accuracies, 0)
    return block(number, body, tow_ms=tow_ms, week=week, revision=revision)


def position_covariance(tow_ms: int = 100_000) -> bytes:
    return block(5906, struct.pack("<BB10f", 4, 0, 9e-4, 16e-4, 81e-4, *[0] * 7), tow_ms=tow_ms)


def velocity_covariance(tow_ms: int = 100_000) -> bytes:
    return block(5908, struct.pack("<BB10f", 4, 0, 4e-4, 4e-4, 1e-4, *[0] * 7), tow_ms=tow_ms)


def attitude(
    tow_ms: int = 100_000, *, roll: float = 1.5, pitch: float = -2.0, heading: float = 359.0
) -> bytes:
    body = struct.pack("<BBHBB6f", 17, 0, 4, 0, 0, heading, pitch, roll, *[UNKNOWN] * 3)
    return block(5938, body, tow_ms=tow_ms)


def event(
    tow_ms: int = 100_000, offset_s: float = 2.5e-4, bias_s: float = 0.0, *, source: int = 1,
    polarity: int = 0, age_s: int = 0, week: int = WEEK, revision: int = 1,
) -> bytes:  # fmt: skip
    body = struct.pack("<BBfd", source, polarity, offset_s, bias_s)
    body += struct.pack("<H", age_s) if revision else b""
    return block(5924, body, tow_ms=tow_ms, week=week, revision=revision)


def receiver_time(*, leap: int = 18, level: int = 7) -> bytes:
    return block(5914, struct.pack("<7bB", 26, 11, 21, 9, 0, 0, leap, level))


def decode(data: bytes, piece: int = 0) -> tuple[SbfDecoder, list[Nav]]:
    decoder = SbfDecoder("sept", mark_accuracy_ns=50)
    records: list[Nav] = []
    for at in range(0, len(data), piece or len(data) or 1):
        records += decoder.feed(data[at : at + (piece or len(data))], 77)
    return decoder, records


def samples(data: bytes) -> list[NavSample]:
    return [r for r in decode(data)[1] if isinstance(r, NavSample)]


def marks(data: bytes) -> list[EventMark]:
    return [r for r in decode(data)[1] if isinstance(r, EventMark)]


def theirs(data: bytes) -> list[Any]:
    return [parsed for _, parsed in SBFReader(io.BytesIO(data), quitonerror=2)]


def epoch(tow_ms: int) -> bytes:
    return (
        pvt(tow_ms) + position_covariance(tow_ms) + velocity_covariance(tow_ms) + attitude(tow_ms)
    )


def test_the_blocks_of_an_epoch_become_one_sample_in_si_units() -> None:
    sample, _ = samples(epoch(100_000) + epoch(100_200))
    assert sample.gps_ns == WEEK * WEEK_NS + 100_000 * MS - 250_000
    assert (sample.latitude_deg, sample.longitude_deg) == pytest.approx((47.5, 8.5), abs=1e-12)
    assert (sample.height_m, sample.satellites, sample.fix) == (1000.0, 17, "3d")
    assert sample.velocity_ned_mps == (60.0, 3.0, -1.0)
    assert sample.horizontal_sigma_m == pytest.approx(0.05, rel=1e-6)
    assert sample.vertical_sigma_m == pytest.approx(0.09, rel=1e-6)
    assert sample.speed_sigma_mps == pytest.approx(0.03, rel=1e-6)
    assert (sample.roll_rad, sample.pitch_rad) == (math.radians(1.5), math.radians(-2.0))
    assert sample.heading_rad == math.radians(359.0)


def test_every_value_is_that_of_pysbf2() -> None:
    data = epoch(100_000) + epoch(100_200) + event(100_300, 1.23e-4, 4e-5)
    their_pvt, covariance, _, angles = theirs(data)[:4]
    sample = samples(data)[0]
    assert sample.latitude_deg == math.degrees(their_pvt.Latitude)
    assert sample.height_m == their_pvt.Height
    assert sample.velocity_ned_mps == (their_pvt.Vn, their_pvt.Ve, -their_pvt.Vu)
    assert sample.satellites == their_pvt.NrSV
    assert sample.horizontal_sigma_m == math.sqrt(covariance.Cov_latlat + covariance.Cov_lonlon)
    assert sample.roll_rad == math.radians(angles.Roll)
    (mark,) = marks(data)
    their_event = theirs(data)[-1]
    exact = 100.3 + their_event.Offset - their_event.RxClkBias
    assert mark.gps_ns - WEEK * WEEK_NS == pytest.approx(exact * 1e9, abs=1)
    assert (their_event.WNc, their_event.Source, their_event.Polarity) == (WEEK, 1, 0)


def test_the_framers_checksum_is_the_published_one() -> None:
    assert crc(b"123456789") == 0x31C3


def test_from_the_second_epoch_on_a_sample_waits_for_nothing() -> None:
    decoder = SbfDecoder("sept")
    assert decoder.feed(epoch(100_000), 0) == []
    assert len(decoder.feed(epoch(100_200), 1)) == 1 + 1


def test_without_covariances_sigma_is_half_of_what_the_solution_itself_states() -> None:
    # The guide: 2DRMS and two sigma.
    (sample,) = samples(pvt(1000, accuracies=(4, 6)) + pvt(1200))[:1]
    assert (sample.horizontal_sigma_m, sample.vertical_sigma_m) == (0.02, 0.03)
    dop = block(4001, struct.pack("<BB4H2f", 17, 0, 150, 60, 80, 120, 0.0, 0.0), tow_ms=1000)
    without = pvt(1000, accuracies=(0xFFFF, 0xFFFF)) + dop + pvt(1200)
    assert samples(without)[0].horizontal_sigma_m == pytest.approx(4.0)
    assert samples(pvt(1000, revision=0) + pvt(1200))[0].horizontal_sigma_m is None


def test_what_is_not_to_be_used_is_not_used() -> None:
    stream_bytes = pvt(1000, error=1, latitude=UNKNOWN, height=UNKNOWN, bias_ms=UNKNOWN) + pvt(1200)
    none = samples(stream_bytes)[0]
    assert (none.fix, none.time_valid, none.latitude_deg) == ("none", False, None)
    single_baseline = pvt(1000) + attitude(1000, roll=UNKNOWN) + pvt(1200)
    leaning = samples(single_baseline)[0]
    assert leaning.roll_rad is None
    assert leaning.heading_rad == math.radians(359.0)
    decoder, records = decode(pvt(0xFFFFFFFF) + pvt(1000, week=0xFFFF) + event(0xFFFFFFFF))
    assert records == []
    assert decoder.counters["blocks_without_time"] == 3
    assert decoder.counters["marks_without_time"] == 1


def test_a_mark_without_clock_bias_or_of_an_old_solution_reports_it() -> None:
    assert [m.time_valid for m in marks(event(bias_s=UNKNOWN))] == [False]
    (recent, old, early) = marks(event(age_s=0) + event(age_s=30) + event(revision=0))
    assert (recent.accuracy_ns, old.accuracy_ns, early.accuracy_ns) == (50, 3050, 50)


def test_a_mark_of_the_week_before_keeps_its_own_week() -> None:
    data = pvt(500, week=WEEK + 1) + pvt(700, week=WEEK + 1) + event(604_799_750, 0.0)
    (mark,) = marks(data)
    assert mark.gps_ns == (WEEK + 1) * WEEK_NS - 250_000_000
    assert mark.time_valid


def test_a_rolled_over_week_and_an_unset_clock_are_not_valid() -> None:
    epochs = pvt(100_000) + pvt(100_200)
    decoder, records = decode(epochs + event(week=WEEK - 1024))
    assert [r.time_valid for r in records if isinstance(r, EventMark)] == [False]
    assert decoder.counters["marks_far"] == 1
    assert [m.time_valid for m in marks(epochs + receiver_time(level=1) + event())] == [False]
    assert [m.time_valid for m in marks(epochs + receiver_time(level=3) + event())] == [True]


def test_leap_seconds_come_from_receiver_time_once_known() -> None:
    assert decode(receiver_time())[0].leap_seconds == 18
    assert decode(receiver_time(leap=-128))[0].leap_seconds is None
    assert decode(receiver_time(level=0))[0].leap_seconds is None


def test_only_rising_edges_are_marks_and_inputs_are_channels() -> None:
    decoder, _ = decode(event() + event(100_001, polarity=1) + event(100_002, source=2))
    assert [(m.channel, m.count) for m in marks(event() + event(100_002, source=2))] == [
        (1, 1),
        (2, 1),
    ]
    assert decoder.counters["marks_other_edge"] == 1


def test_a_position_of_an_event_without_its_event_is_a_lost_mark_and_a_gap_in_the_count() -> None:
    def position(tow_ms: int) -> bytes:
        return pvt(tow_ms, number=4038)

    lost = event(1000) + position(1000) + position(2000) + event(3000) + position(3000)
    decoder, _ = decode(lost)
    assert [m.count for m in marks(lost)] == [1, 3]
    assert decoder.counters["marks_lost"] == 1


def test_an_inertial_solution_has_its_parts_by_their_bits_and_stands_alone() -> None:
    latitude, longitude = math.radians(47.5), math.radians(8.5)

    def inertial(tow_ms: int, parts: int, values: tuple[float, ...], mode: int = 4) -> bytes:
        head = struct.pack("<BBHHdddfHHBBH", mode, 0, 0, 0, latitude, longitude, 1000.0, 47.5,
                           30, 10, 0, 0, parts)  # fmt: skip
        body = head + struct.pack(f"<{len(values)}f", *values)
        return block(4226, body, tow_ms=tow_ms)

    every = (0.03, 0.04, 0.09, 359.0, -2.0, 1.5, 0.1, 0.1, 0.1, 3.0, 60.0, 1.0, 0.02, 0.02, 0.01)
    data = pvt(100_000) + inertial(100_000, 0b11111, every) + pvt(100_200) + attitude(100_200)
    (sample,) = samples(data)
    assert sample.gps_ns == WEEK * WEEK_NS + 100_000 * MS - 250_000
    assert sample.velocity_ned_mps == (60.0, 3.0, -1.0)
    assert sample.horizontal_sigma_m == pytest.approx(0.05)
    assert sample.speed_sigma_mps == pytest.approx(0.03)
    assert (sample.roll_rad, sample.heading_rad) == (math.radians(1.5), math.radians(359.0))
    (bare,) = samples(inertial(100_000, 0b1000, (3.0, 60.0, 1.0), mode=0))
    assert (bare.fix, bare.roll_rad, bare.horizontal_sigma_m) == ("dead-reckoning", None, 0.3)


@pytest.mark.parametrize("damage", [
    lambda: block(4007, b"\x00" * 8), lambda: pvt(604_800_000), lambda: block(5924, b""),
    lambda: pvt(height=math.nan), lambda: pvt(bias_ms=math.inf), lambda: pvt(latitude=3.0) * 2,
    lambda: block(4226, b"\x00" * 40 + b"\xff\x00"),
])  # fmt: skip
def test_a_checked_block_of_nonsense_raises_nothing(damage: Callable[[], bytes]) -> None:
    decoder, records = decode(damage() + pvt(1200) + event(5000))
    assert decoder.bad_messages >= 1
    assert isinstance(records[-1], EventMark)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_damage_and_noise_raise_nothing_and_cost_no_later_message(data: st.DataObject) -> None:
    stream = bytearray(epoch(1000) + event(1100) + epoch(1200))
    for _ in range(data.draw(st.integers(0, 8))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    stream_bytes = bytes(stream) + data.draw(st.binary(max_size=200)) + event(5000) + event(6000)
    decoder_whole, records = decode(stream_bytes)
    assert [r.gps_ns - WEEK * WEEK_NS for r in records[-1:]] == [6000 * MS + 250_000]
    pieces, same = decode(stream_bytes, data.draw(st.integers(1, 60)))
    assert same == records
    assert (pieces.frames, pieces.bad_bytes) == (decoder_whole.frames, decoder_whole.bad_bytes)
    assert decoder_whole.pending <= 16_384


def test_binding_states_what_was_received_or_what_to_switch_on() -> None:
    clock = FakeClock()

    def bind(stream_bytes: bytes) -> str:
        def answer(_: FakePort) -> bytes:
            clock.now_ns += 10**8 if stream_bytes else 0
            return stream_bytes

        port = FakePort(clock, answer)
        navigator = SeptentrioNavigator("s", {"port": "x"}, clock=clock, open_port=lambda *_: port)
        return navigator.bind()["messages"]

    assert bind(epoch(1000)) == "AttEuler, PVTGeodetic, PosCovGeodetic, VelCovGeodetic"
    with pytest.raises(DeviceError, match="sent no PVTGeodetic or INSNavGeod"):
        bind(receiver_time())
    with pytest.raises(DeviceError, match="is no SBF"):
        bind(b"$GNTXT,01,01,02,hello*00\r\n")
