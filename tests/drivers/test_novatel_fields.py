"""Every field of a NovAtel log in the record it becomes, and each limit on and beyond it."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from drivers.contract import EventMark, NavSample
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.timescales.gps_time import WEEK_NS
from tests.drivers.test_novatel import WEEK, decode, log, marks, pva

SECOND_NS = 10**9


def bestpos(
    seconds: float, *, status: int = 0, kind: int = 16, latitude: float = 47.5,
    longitude: float = 8.5,
) -> bytes:  # fmt: skip
    body = struct.pack("<II3df4x3f4x2fBB6x", status, kind, latitude, longitude, 950.0, 50.0, 3.0,
                       4.0, 0.9, 0.0, 0.0, 20, 17)  # fmt: skip
    return log(42, body, ms=round(seconds * 1000))


def bestvel(seconds: float, *, status: int = 0, track: float = 30.0) -> bytes:
    body = struct.pack("<II2f3d4x", status, 8, 0.0, 0.0, 60.0, track, 1.0)
    return log(99, body, ms=round(seconds * 1000))


def inspvax(seconds: float, status: int = 3) -> bytes:
    body = struct.pack("<II3df6d9fIH", status, 56, 47.5, 8.5, 950.0, 50.0, 60.0, 3.0, 1.0, 1.5,
                       -2.0, 359.0, 0.3, 0.4, 0.9, 0.1, 0.2, 0.2, 0.0, 0.0, 0.0, 0, 0)  # fmt: skip
    return log(1465, body, ms=round(seconds * 1000))


def mark_time(
    identity: int, seconds: float, *, offset: float = 0.0, sigma: float = 3e-9, status: int = 0
) -> bytes:
    return log(identity, struct.pack("<I4dI", WEEK, seconds, offset, sigma, -18.0, status))


def samples(data: bytes) -> list[NavSample]:
    return [r for r in decode(data)[1] if isinstance(r, NavSample)]


def pva_at(place: tuple[float, float], week: int = WEEK, seconds: float = 9.0) -> bytes:
    body = struct.pack("<I10dI", week, seconds, *place, 0, 0, 0, 0, 0, 0, 0, 3)
    return log(507, body)


@pytest.mark.parametrize(
    ("identity", "channel"),
    [(1130, 1), (616, 2), (1075, 3), (1076, 4), (1067, 1), (1068, 2), (1118, 3), (1119, 4)],
)
def test_each_input_has_its_logs(identity: int, channel: int) -> None:
    is_pva = identity in (1067, 1068, 1118, 1119)
    (mark,) = marks(pva(identity, 9.0) if is_pva else mark_time(identity, 9.0))
    assert (mark.channel, mark.gps_ns) == (channel, WEEK * WEEK_NS + 9 * SECOND_NS)
    assert (mark.count, mark.count_bits, mark.accuracy_ns, mark.mono_ns) == (1, 0, 100, 77)


@pytest.mark.parametrize(
    ("status", "kind", "fix", "height_m", "vertical_m"),
    [
        (0, 16, "3d", 1000.0, 0.9),
        (0, 2, "2d", None, None),
        (0, 1, "time", None, None),
        (0, 0, "3d", 1000.0, 0.9),
        (1, 16, "none", None, None),
        (2, 16, "none", None, None),
    ],
)
def test_solution_status_and_position_type_are_the_fix(
    status: int, kind: int, fix: str, height_m: float | None, vertical_m: float | None
) -> None:
    (sample,) = samples(bestpos(9.0, status=status, kind=kind))
    assert (sample.fix, sample.height_m) == (fix, height_m)
    assert sample.vertical_sigma_m == (None if vertical_m is None else pytest.approx(vertical_m))
    has_position = fix in ("2d", "3d")
    assert sample.latitude_deg == (47.5 if has_position else None)
    assert sample.longitude_deg == (8.5 if has_position else None)
    assert sample.horizontal_sigma_m == (5.0 if has_position else None)
    assert sample.sigma_source == ("receiver" if has_position else "none")
    assert (sample.satellites, sample.roll_rad, sample.gps_ns) == (
        *(17, None, WEEK * WEEK_NS + 9 * SECOND_NS),
    )


@pytest.mark.parametrize(("later_s", "is_known"), [(0.0, True), (0.999, True), (1.0, False)])
def test_a_velocity_is_that_of_a_position_less_than_1_s_away(
    later_s: float, is_known: bool
) -> None:
    (sample,) = samples(bestvel(9.0) + bestpos(9.0 + later_s))
    expected = (60.0 * math.cos(math.radians(30)), 60.0 * math.sin(math.radians(30)), -1.0)
    assert sample.velocity_ned_mps == (pytest.approx(expected) if is_known else None)
    assert samples(bestvel(9.0, status=1) + bestpos(9.0))[0].velocity_ned_mps is None


@pytest.mark.parametrize(("later_s", "count"), [(9.999, 0), (10.0, 1)])
@pytest.mark.parametrize(("status", "hinders"), [(3, True), (2, True), (1, False)])
def test_a_position_is_a_sample_10_s_after_the_last_inertial_one(
    later_s: float, count: int, status: int, hinders: bool
) -> None:
    data = inspvax(9.0, status) + bestpos(9.0 + later_s)
    assert len(samples(data)) == 1 + (count if hinders else 1)


@pytest.mark.parametrize(
    ("status", "fix"),
    [(0, "none"), (1, "none"), (2, "dead-reckoning"), (3, "3d"), (6, "dead-reckoning"),
     (7, "3d"), (8, "none")],
)  # fmt: skip
def test_the_inertial_status_is_the_fix(status: int, fix: str) -> None:
    assert samples(pva(507, 9.0, status=status))[0].fix == fix


def test_an_inertial_solution_with_sigmas_comes_out_in_si_units() -> None:
    (sample,) = samples(inspvax(9.25))
    assert sample.gps_ns == WEEK * WEEK_NS + 9_250_000_000
    assert (sample.latitude_deg, sample.longitude_deg, sample.height_m) == (47.5, 8.5, 1000.0)
    assert sample.velocity_ned_mps == (60.0, 3.0, -1.0)
    assert sample.horizontal_sigma_m == pytest.approx(0.5)
    assert sample.vertical_sigma_m == pytest.approx(0.9)
    assert sample.speed_sigma_mps == pytest.approx(0.3)
    assert (sample.roll_rad, sample.pitch_rad, sample.heading_rad) == (
        math.radians(1.5), math.radians(-2.0), math.radians(359.0),
    )  # fmt: skip
    decoder, records = decode(pva(507, 9.0) + pva(508, 9.0) + pva(508, 9.1))
    assert (len(records), decoder.counters["samples"]) == (2, 2)
    assert dict(decoder.seen) == {"INSPVA": 3}


@pytest.mark.parametrize(
    ("place", "is_one"),
    [
        ((90.0, 0.0), True),
        ((-90.0, 0.0), True),
        ((90.001, 0.0), False),
        ((0.0, 360.0), True),
        ((0.0, -360.0), True),
        ((0.0, 360.001), False),
    ],
)
def test_a_place_lies_between_the_poles_and_within_360_degrees(
    place: tuple[float, float], is_one: bool
) -> None:
    decoder, records = decode(pva_at(place))
    assert (len(records), decoder.bad_messages) == ((1, 0) if is_one else (0, 1))


@pytest.mark.parametrize(
    ("week", "seconds", "is_one"),
    [(65_535, 0.0, True), (65_536, 0.0, False), (WEEK, 604_800.0, True),
     (WEEK, 604_800.1, False), (WEEK, 0.0, True), (WEEK, -0.1, False), (0, 9.0, True)],
)  # fmt: skip
def test_a_time_lies_within_its_week(week: int, seconds: float, is_one: bool) -> None:
    _, records = decode(pva_at((47.5, 8.5), week, seconds))
    assert len(records) == is_one


@pytest.mark.parametrize(("week", "is_valid"), [(0, False), (1, True)])
def test_a_time_is_valid_from_the_first_week_on(week: int, is_valid: bool) -> None:
    (sample,) = samples(pva_at((47.5, 8.5), week, 0.0))
    assert sample.time_valid is is_valid
    (mark,) = marks(log(1130, struct.pack("<I4dI", week, 0.0, 0.0, 0.0, 0.0, 0)))
    assert mark.time_valid is is_valid


@pytest.mark.parametrize(("status", "is_good"), [(119, False), (120, True), (180, True)])
def test_a_time_is_good_from_coarse_steering_on(status: int, is_good: bool) -> None:
    body = struct.pack("<I4dI", WEEK, 9.0, 0.0, 0.0, -18.0, 0)
    assert [m.time_valid for m in marks(log(1130, body, status=status))] == [is_good]


@pytest.mark.parametrize(("status", "is_valid"), [(0, True), (1, True), (2, False)])
def test_a_mark_time_needs_a_valid_clock_model(status: int, is_valid: bool) -> None:
    assert [m.time_valid for m in marks(mark_time(1130, 9.0, status=status))] == [is_valid]


@pytest.mark.parametrize(
    ("sigma", "accuracy_ns"),
    [(0.0, 100), (1e-7, 100), (2e-7, 200), (-2e-7, 200), (0.9, 900_000_000), (5.0, SECOND_NS)],
)
def test_a_mark_is_as_accurate_as_its_clock_offset(sigma: float, accuracy_ns: int) -> None:
    (mark,) = marks(mark_time(1130, 9.0, sigma=sigma, offset=0.25))
    assert (mark.accuracy_ns, mark.gps_ns) == (accuracy_ns, WEEK * WEEK_NS + 8_750_000_000)


@pytest.mark.parametrize(("apart_s", "count"), [(1e-6, 1), (1.001e-6, 2)])
def test_logs_of_one_edge_lie_within_a_microsecond(apart_s: float, count: int) -> None:
    decoder, records = decode(mark_time(1130, 9.0) + pva(1067, 9.0 + apart_s))
    assert len(records) == decoder.counters["marks"] == count
    assert decoder.counters["marks_duplicate"] == 2 - count
    other_input, both = decode(mark_time(1130, 9.0) + mark_time(616, 9.0))
    assert [r.count for r in both if isinstance(r, EventMark)] == [1, 1]
    assert other_input.counters["marks_duplicate"] == 0


def test_the_last_16_marks_of_an_input_are_known() -> None:
    first = b"".join(mark_time(1130, float(n)) for n in range(16))
    assert len(decode(first + mark_time(1130, 0.0))[1]) == 16
    assert len(decode(first + mark_time(1130, 16.0) + mark_time(1130, 0.0))[1]) == 18


def test_leap_seconds_are_rounded_and_a_warning_of_utc_is_none() -> None:
    def time(offset_s: float, status: int) -> bytes:
        body: tuple[Any, ...] = (0, 0.0, 0.0, offset_s, 2026, 11, 21, 9, 0, 0, status)
        return log(101, struct.pack("<I3dIBBBBII", *body))

    assert decode(time(-17.6, 1))[0].leap_seconds == 18
    assert decode(time(-18.0, 2))[0].leap_seconds is None
    plain = NovatelDecoder("span")
    assert (plain.leap_seconds, plain.counters["samples"]) == (None, 0)
