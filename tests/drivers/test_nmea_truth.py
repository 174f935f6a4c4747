"""NMEA: what a receiver did not send is absent, whatever is lost, damaged or mixed."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from daemon.mission.exposure import NavigationRecord
from daemon.orientation.navigation import Track
from drivers.contract import NavSample
from drivers.receivers.nmea.decoder import NmeaDecoder
from tests.drivers.test_nmea import SECOND_NS, sentence

pytestmark = pytest.mark.trust

HEIGHT_M = 3000.0
SPEED_KNOTS = 120.0


def clock(tenths: int) -> str:
    seconds, tenth = divmod(36_000 * 10 + tenths, 10)
    return f"{seconds // 3600:02d}{seconds // 60 % 60:02d}{seconds % 60:02d}.{tenth}0"


def latitude(tenths: int) -> str:
    """47 degrees 30 minutes and what an aircraft flies northward at 120 knots: 2' in a minute."""
    return f"47{30 + SPEED_KNOTS / 3600 * tenths / 10:011.8f}"


def rmc(tenths: int, status: str = "A", mode: str = "A", version: str = "") -> str:
    place = f"{latitude(tenths)},N,00830.00000000,E"
    return f"GNRMC,{clock(tenths)},{status},{place},{SPEED_KNOTS},0.0,211126,,,{mode}{version}"


def gga(tenths: int, quality: int = 1, place: str | None = None, height: str = "") -> str:
    where = f"{latitude(tenths)},N,00830.00000000,E" if place is None else place
    height = height or f"{HEIGHT_M - 47.5},M,47.5,M"
    return f"GNGGA,{clock(tenths)},{where},{quality},12,0.8,{height},,"


def gst(tenths: int) -> str:
    return f"GNGST,{clock(tenths)},1.0,,,,0.03,0.04,0.09"


def decode(*bodies: str, **settings: float) -> list[NavSample]:
    # Settings by name, as a configuration has them.
    decoder = NmeaDecoder("gnss", **settings)  # type: ignore[arg-type]
    stream = b"".join(map(sentence, bodies))
    return [s for s in decoder.feed(stream, 0) if isinstance(s, NavSample)]


def at(samples: list[NavSample], tenths: float) -> NavigationRecord | None:
    """The navigation of an exposure so many tenths of a second after ten o'clock."""
    track = Track()
    for sample in samples:
        track.add(sample)
    start = min(s.gps_ns for s in samples) // (60 * SECOND_NS) * 60 * SECOND_NS + 18 * SECOND_NS
    return track.at(start + round(tenths * SECOND_NS / 10))


def test_positions_alone_have_no_height_and_no_sigma() -> None:
    (first, *_) = decode(rmc(0), rmc(10), rmc(20))
    assert (first.fix, first.height_m, first.satellites) == ("2d", None, None)
    assert (first.horizontal_sigma_m, first.sigma_source) == (None, "none")
    assert first.velocity_ned_mps == (pytest.approx(SPEED_KNOTS * 1852 / 3600), 0.0, None)


def test_rmc_at_ten_hertz_with_gga_once_a_second_loses_no_height() -> None:
    bodies = []
    for tenths in range(61):
        # The receiver sends RMC first: the epoch has to wait for the GGA that may come.
        bodies += [rmc(tenths), *([gga(tenths)] if tenths % 10 == 0 else [])]
    samples = decode(*bodies)
    assert sum(s.height_m is not None for s in samples) >= 6
    assert {s.height_m for s in samples} == {None, HEIGHT_M}
    for tenths in range(1, 45):
        record = at(samples, tenths + 0.5)
        assert record is not None and record.height_m == pytest.approx(HEIGHT_M)
        assert record.fix == "3d"


def test_one_flipped_bit_moves_no_exposure() -> None:
    random.seed(12)
    clean = [sentence(body) for tenths in range(0, 60, 2) for body in (rmc(tenths), gga(tenths))]
    for _ in range(150):
        lines = list(clean)
        place = random.randrange(20, 40)
        line = bytearray(lines[place])
        line[random.randrange(len(line))] ^= 1 << random.randrange(8)
        lines[place] = bytes(line)
        decoder = NmeaDecoder("gnss")
        samples = [s for s in decoder.feed(b"".join(lines), 0) if isinstance(s, NavSample)]
        assert all(s.height_m in (None, HEIGHT_M) for s in samples)
        for tenths in range(15, 45, 3):
            record = at(samples, tenths)
            assert record is not None and record.height_m == pytest.approx(HEIGHT_M, abs=1e-6)
            north_m = (record.latitude_deg - 47.5 - SPEED_KNOTS * tenths / 36_000 / 60) * 111_200
            assert abs(north_m) < 0.03


def test_a_flipped_digit_with_a_fitting_checksum_is_noticed_in_place_and_height() -> None:
    bodies = [body for tenths in range(0, 60, 2) for body in (rmc(tenths), gga(tenths))]
    moved = gga(30).replace("4730.1", "4730.3")
    assert moved != gga(30)
    samples = decode(*(moved if body == gga(30) else body for body in bodies))
    assert len(samples) == 29 and all(abs(s.latitude_deg or 0) < 47.55 for s in samples)
    raised = gga(30, height=f"{HEIGHT_M + 1500},M,47.5,M")
    samples = decode(*(raised if body == gga(30) else body for body in bodies))
    for tenths in (29.5, 30, 30.5):
        record = at(samples, tenths)
        assert record is not None and record.height_m == pytest.approx(HEIGHT_M)


def test_a_damaged_gga_at_one_hertz_is_bridged_by_its_neighbours() -> None:
    bodies = [body for tenths in range(0, 60, 10) for body in (rmc(tenths), gga(tenths))]
    bodies.remove(gga(30))
    samples = decode(*bodies)
    assert [s.height_m for s in samples].count(None) == 1
    for tenths in range(21, 40):
        record = at(samples, tenths)
        assert record is not None and record.height_m == pytest.approx(HEIGHT_M)
        assert record.gap_ns == 2 * SECOND_NS


def test_sigma_comes_from_the_receiver_or_states_that_it_is_computed_from_dop() -> None:
    with_gst, without = decode(rmc(0), gga(0), gst(0), rmc(10), gga(10), rmc(20), gga(20))[:2]
    assert (with_gst.sigma_source, with_gst.horizontal_sigma_m) == ("receiver", 0.05)
    assert without.sigma_source == "dop"
    assert (without.horizontal_sigma_m, without.vertical_sigma_m) == (4.0, 8.0)
    zeros = gst(0).replace("0.03,0.04,0.09", "0.0,0.0,0.0")
    assert decode(rmc(0), gga(0), zeros, rmc(10))[0].sigma_source == "dop"
    unknown = gga(0).replace(",0.8,", ",99.99,")
    assert decode(rmc(0), unknown, rmc(10))[0].horizontal_sigma_m is None
    record = at(decode(rmc(0), gga(0), gst(0), rmc(10), gga(10), rmc(20)), 5)
    assert record is not None and record.sigma_source == "dop"
    assert record.horizontal_sigma_m is not None and record.horizontal_sigma_m >= 4.0


def test_over_midnight_the_height_and_the_day_stay() -> None:
    def at_night(body: str, time: str, date: str = "211126") -> str:
        return body.replace("100000.00", time).replace("211126", date)

    samples = decode(
        at_night(rmc(0), "235959.00"), at_night(gga(0), "235959.00"),
        at_night(gga(0), "000000.00"), at_night(rmc(0), "000001.00", "221126"),
        at_night(gga(0), "000001.00"), at_night(rmc(0), "000002.00", "221126"),
    )  # fmt: skip
    assert [b.gps_ns - a.gps_ns for a, b in itertools.pairwise(samples)] == [SECOND_NS] * 2
    assert [s.height_m for s in samples] == [HEIGHT_M] * 3


def test_sentences_of_different_times_are_not_mixed() -> None:
    samples = decode(*(b for t in range(0, 50, 10) for b in (rmc(t), gga(t + 5))))
    for sample in samples:
        tenths = sample.gps_ns % (60 * SECOND_NS) / SECOND_NS * 10 - 180
        if sample.height_m is None:
            assert tenths % 10 == 0 and sample.velocity_ned_mps is not None
        else:
            assert tenths % 10 == 5 and sample.velocity_ned_mps is None
        wanted = 47.5 + SPEED_KNOTS * tenths / 36_000 / 60
        assert sample.latitude_deg == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(
    ("bodies", "fix"),
    [
        ((rmc(0, mode="E"), gga(0, 6)), "dead-reckoning"),
        ((rmc(0), gga(0, 6)), "dead-reckoning"),
        ((rmc(0, mode="S"), gga(0, 8)), None),
        ((rmc(0), gga(0, 8)), None),
        ((rmc(0), gga(0, 7)), None),
        ((rmc(0, mode="M"), gga(0)), None),
        ((rmc(0, status="V", mode="N"), gga(0, 0)), None),
        ((rmc(0, status="V"), gga(0)), None),
        ((rmc(0), gga(0, place=",,,")), "3d"),
        ((gga(0, place=",,,"), rmc(10)), None),
        ((rmc(0, mode="N"), gga(0)), None),
        ((rmc(0, mode="A", version=",V"), gga(0)), "3d"),
        ((rmc(0), gga(0, height=",M,,M")), "2d"),
        ((rmc(0), gga(0, height="952.5,M,,M")), "2d"),
        ((rmc(0), "GNGSA,A,2,01,02,,,,,,,,,,,1.5,0.8,1.2", gga(0)), "2d"),
    ],
)
def test_the_fix_is_the_worst_that_any_sentence_states(
    bodies: tuple[str, ...], fix: str | None
) -> None:
    first = [s for s in decode(rmc(-10), gga(-10), *bodies, rmc(50)) if s.gps_ns % SECOND_NS == 0]
    after = first[1:2] if len(first) > 2 or fix else []
    assert [s.fix for s in after] == ([] if fix is None else [fix])
    for sample in after:
        assert (sample.height_m is None) == (fix == "2d")
        assert sample.latitude_deg == pytest.approx(47.5)


def test_a_height_above_the_geoid_alone_needs_the_configured_undulation() -> None:
    bodies = (rmc(0), gga(0, height="952.5,M,,M"), rmc(10))
    assert decode(*bodies)[0].height_m is None
    assert decode(*bodies, undulation_m=47.5)[0].height_m == 1000.0


def test_a_speed_without_a_course_is_no_velocity() -> None:
    still = rmc(0).replace(f"{SPEED_KNOTS},0.0", "0.02,")
    assert decode(still, gga(0), rmc(10))[0].velocity_ned_mps is None
    assert decode(still.replace("0.02,", "0.0,"), rmc(10))[0].velocity_ned_mps == (0.0, 0.0, None)


def test_a_rolled_over_week_is_corrected_only_where_a_date_cannot_be() -> None:
    old = rmc(0).replace("211126", "070407")  # 1024 weeks before 21 November 2026
    decoder = NmeaDecoder("gnss", not_before_day=15_000)
    (sample, *_) = decoder.feed(sentence(old) + sentence(rmc(10)) + sentence(rmc(20)), 0)
    assert isinstance(sample, NavSample)
    assert decoder.counters["dates_rolled_over"] == 1
    assert sample.gps_ns == decode(rmc(0), rmc(10))[0].gps_ns
    assert decode(old, rmc(10))[0].gps_ns < sample.gps_ns


def test_a_sentence_that_lost_its_checksum_is_damaged_and_a_receiver_without_any_is_read() -> None:
    bare = [f"${body}\r\n".encode() for t in range(0, 200, 10) for body in (rmc(t), gga(t))]
    decoder = NmeaDecoder("gnss")
    samples = decoder.feed(b"".join(bare), 0)
    assert len(samples) >= 12
    decoder = NmeaDecoder("gnss")
    decoder.feed(sentence(rmc(0)), 0)
    assert decoder.feed(b"".join(bare), 0) == []
    assert decoder.counters["bad_sentences"] == len(bare)


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r"])
def test_every_line_end_and_binary_between_the_lines_is_read(end: bytes) -> None:
    noise = bytes([0xB5, 0x62, 0x01, 0x24, 0x00, 0xFF, 0x07])
    lines = [sentence(b)[:-2] + end for t in range(0, 50, 10) for b in (rmc(t), gga(t))]
    for stream in (b"".join(lines), noise.join(lines), noise + noise.join(lines) + noise):
        decoder = NmeaDecoder("gnss")
        samples = [s for i in range(len(stream)) for s in decoder.feed(stream[i : i + 1], 0)]
        # A CR may be followed by an LF: the last line is complete with the next byte.
        sentence_count = 4 if end == b"\r" and stream.endswith(end) else 5
        assert [s.height_m for s in samples if isinstance(s, NavSample)] == [
            HEIGHT_M
        ] * sentence_count


def test_other_sentences_say_the_same_as_gga() -> None:
    place = "4730.00000,N,00830.00000,E"
    gns = f"GNGNS,100000.00,{place},AAN,12,0.8,952.5,47.5,,,V"
    pubx = f"PUBX,00,100000.00,{place},1000.0,G3,2.1,3.0,36.0,90.0,0.5,,0.8,1.2,1.0,12,0,0"
    ggk = "PTNL,GGK,100000.00,112126,4730.00000,N,00830.00000,E,3,12,1.0,EHT1000.0,M"
    gll = f"GNGLL,{place},100000.00,A,A"
    zda = "GNZDA,100000.00,21,11,2026,00,00"
    for body in (gns, pubx, ggk):
        (sample, *_) = decode(zda, body, rmc(10))
        assert (sample.height_m, sample.fix, sample.satellites) == (1000.0, "3d", 12), body
        assert (sample.latitude_deg, sample.longitude_deg) == (47.5, 8.5)
    (flat, *_) = decode(zda, gll, rmc(10))
    assert (flat.fix, flat.height_m) == ("2d", None)
    (own, *_) = decode(zda, pubx, rmc(10))
    assert own.velocity_ned_mps is not None
    assert own.velocity_ned_mps == pytest.approx((0.0, 10.0, 0.5), abs=1e-9)
    assert (own.horizontal_sigma_m, own.vertical_sigma_m) == (2.1, 3.0)
    (garmin, *_) = decode(zda, gns, "PGRME,3.0,M,6.745,M,7.0,M", rmc(10))
    assert garmin.horizontal_sigma_m == pytest.approx(3.0 / math.sqrt(math.log(2)))
    assert garmin.vertical_sigma_m == pytest.approx(10.0, rel=1e-4)


def test_a_ggk_without_a_fix_is_none_whatever_its_satellites() -> None:
    ggk = "PTNL,GGK,100000.00,112126,4730.00000,N,00830.00000,E,{},12,1.0,EHT1000.0,M"
    assert decode(ggk.format(0), ggk.format(0).replace("100000", "100001")) == []
    assert len(decode(ggk.format(3), ggk.format(3).replace("100000", "100001"))) == 2


def test_both_sides_of_the_date_line_are_one_place() -> None:
    east = gga(0, place="4730.00000000,N,18000.00000000,E")
    west = rmc(0).replace("00830.00000000,E", "17959.99999990,W")
    (sample, *_) = decode(west, east, rmc(10))
    assert sample.longitude_deg == 180.0


def test_gbs_gives_sigmas_where_no_gst_came() -> None:
    gbs = "GNGBS,100000.00,3.0,4.0,9.0,,,,"
    (sample, *_) = decode(rmc(0), gga(0), gbs, rmc(10))
    assert (sample.horizontal_sigma_m, sample.vertical_sigma_m) == (5.0, 9.0)
    assert sample.sigma_source == "receiver"
    (sample, *_) = decode(rmc(0), gga(0), gst(0), gbs, rmc(10))
    assert (sample.horizontal_sigma_m, sample.vertical_sigma_m) == (0.05, 0.09)
