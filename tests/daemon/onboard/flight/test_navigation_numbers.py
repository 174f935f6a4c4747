"""Navigation at an instant in numbers worked out by hand, and each limit on and beyond it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from daemon.orientation.geodesy import metres_per_degree
from daemon.orientation.navigation import Track, _Segment, navigation_at
from drivers.contract import NavSample
from tests.daemon.onboard.flight.test_navigation import GPS_NS, HEIGHT, LATITUDE, LONGITUDE, NS

NORTH_M, EAST_M = metres_per_degree(LATITUDE, HEIGHT)
MS = 1_000_000


def sample(t_s: float, **changes: Any) -> NavSample:
    """40 m/s north, 30 m/s east, 2 m/s up."""
    made = NavSample(
        receiver="gnss",
        gps_ns=GPS_NS + round(t_s * NS),
        mono_ns=round(t_s * NS),
        fix="3d",
        satellites=12,
        latitude_deg=LATITUDE + 40.0 * t_s / NORTH_M,
        longitude_deg=LONGITUDE + 30.0 * t_s / EAST_M,
        height_m=HEIGHT + 2.0 * t_s,
        horizontal_sigma_m=0.5,
        vertical_sigma_m=0.9,
        velocity_ned_mps=(40.0, 30.0, -2.0),
        speed_sigma_mps=0.2,
        roll_rad=0.1,
        pitch_rad=0.2,
        heading_rad=0.3,
        leap_seconds=18,
        time_valid=True,
    )
    return replace(made, **changes)


@pytest.mark.parametrize(
    ("latitude_deg", "height_m", "north_m", "east_m"),
    [
        (0.0, 0.0, 110_574.28, 111_319.49),
        (45.0, 0.0, 111_131.78, 78_846.835),
        (90.0, 0.0, 111_693.98, 0.0),
        (0.0, 1000.0, 110_591.73, 111_336.94),
    ],
)
def test_a_degree_is_as_long_as_on_the_ellipsoid(
    latitude_deg: float, height_m: float, north_m: float, east_m: float
) -> None:
    assert metres_per_degree(latitude_deg, height_m) == pytest.approx((north_m, east_m), abs=0.02)


@pytest.mark.parametrize("elapsed_s", [0.5, -0.5, 2.0])
def test_a_sample_is_carried_on_by_its_velocity(elapsed_s: float) -> None:
    record = navigation_at([sample(0.0)], GPS_NS + round(elapsed_s * NS))
    assert record is not None
    assert (record.latitude_deg - LATITUDE) * NORTH_M == pytest.approx(40.0 * elapsed_s, abs=1e-6)
    assert (record.longitude_deg - LONGITUDE) * EAST_M == pytest.approx(30.0 * elapsed_s, abs=1e-6)
    assert record.height_m == pytest.approx(HEIGHT + 2.0 * elapsed_s)
    manoeuvre_m = 2.0 * elapsed_s**2 / 2
    assert record.horizontal_sigma_m == pytest.approx(math.hypot(0.5, 0.2 * elapsed_s, manoeuvre_m))
    assert record.vertical_sigma_m == pytest.approx(math.hypot(0.9, 0.2 * elapsed_s, manoeuvre_m))
    assert (record.method, record.gap_ns) == ("extrapolated", round(abs(elapsed_s) * NS))
    assert (record.roll_rad, record.pitch_rad, record.heading_rad) == (0.1, 0.2, 0.3)


def test_what_the_receiver_does_not_send_is_not_made_up() -> None:
    at_ns = GPS_NS + NS
    still = navigation_at([sample(0.0, velocity_ned_mps=None)], at_ns)
    assert still is not None
    assert (still.method, still.latitude_deg, still.horizontal_sigma_m) == (
        "nearest",
        LATITUDE,
        None,
    )
    assert (still.height_m, still.sigma_source) == (HEIGHT, "none")
    assert still.vertical_sigma_m == pytest.approx(math.hypot(0.9, 3.0, 1.0))
    level = navigation_at([sample(0.0, velocity_ned_mps=(40.0, 30.0, None))], at_ns)
    assert level is not None and level.height_m == HEIGHT
    assert level.vertical_sigma_m == pytest.approx(math.hypot(0.9, 3.0, 1.0))
    for unknown in ("speed_sigma_mps", "horizontal_sigma_m"):
        record = navigation_at([sample(0.0, **{unknown: None})], at_ns)
        assert record is not None and record.horizontal_sigma_m is None
    there = navigation_at([sample(0.0, speed_sigma_mps=None)], GPS_NS)
    assert there is not None
    assert (there.horizontal_sigma_m, there.vertical_sigma_m) == (0.5, 0.9)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.75])
def test_between_two_samples_every_axis_is_on_the_way(share: float) -> None:
    record = navigation_at([sample(0.0), sample(1.0)], GPS_NS + round(share * NS))
    assert record is not None
    assert (record.latitude_deg - LATITUDE) * NORTH_M == pytest.approx(40.0 * share, abs=1e-4)
    assert (record.longitude_deg - LONGITUDE) * EAST_M == pytest.approx(30.0 * share, abs=1e-4)
    assert record.height_m == pytest.approx(HEIGHT + 2.0 * share, abs=1e-6)
    assert record.velocity_ned_mps == pytest.approx((40.0, 30.0, -2.0))
    assert (record.method, record.gap_ns, record.speed_sigma_mps) == ("interpolated", NS, 0.2)
    assert (record.roll_rad, record.pitch_rad, record.heading_rad) == pytest.approx((0.1, 0.2, 0.3))


def test_velocity_and_angles_are_shared_out_between_both_ends() -> None:
    turned = sample(1.0, velocity_ned_mps=(44.0, 26.0, 0.0), roll_rad=None, heading_rad=-0.1)
    record = navigation_at([sample(0.0), turned], GPS_NS + NS // 4)
    assert record is not None
    assert record.velocity_ned_mps == pytest.approx((41.0, 29.0, -1.5))
    assert (record.roll_rad, record.pitch_rad) == (None, pytest.approx(0.2))
    assert record.heading_rad == pytest.approx(0.2)
    level = replace(turned, velocity_ned_mps=(44.0, 26.0, None))
    record = navigation_at([sample(0.0), level], GPS_NS + NS // 4)
    assert record is not None and record.velocity_ned_mps == pytest.approx((41.0, 29.0, None))


def test_a_cubic_passes_both_ends_with_their_speeds() -> None:
    """From rest to 6 m/s over 2 s and 5 m: x(u) = (-2 u^3 + 3 u^2) 5 + (u^3 - u^2) 12."""
    for u in (0.0, 0.25, 0.5, 1.0):
        offset_m, sigma_m = _Segment(2.0, u).carry(5.0, (0.0, 6.0), (None, None), (None, None))
        assert offset_m == pytest.approx((-2 * u**3 + 3 * u**2) * 5.0 + (u**3 - u**2) * 12.0)
        assert sigma_m is None
    quarter = _Segment(2.0, 0.25).carry(5.0, (4.0, 0.0), (None, None), (None, None))[0]
    # (2/64 - 3/16 + 1) * 0 + (1/64 - 2/16 + 1/4) * 8 + (-2/64 + 3/16) * 5
    assert quarter == pytest.approx(0.140625 * 8.0 + 0.15625 * 5.0)


def test_without_speeds_the_way_is_straight_and_bends_by_an_acceleration() -> None:
    offset_m, sigma_m = _Segment(2.0, 0.25).carry(8.0, None, (0.3, 0.4), (None, None))
    # The bend of 2 m/s^2 over 2 s at a quarter: 2 * 4 * 0.25 * 0.75 / 2 = 0.75 m.
    assert (offset_m, sigma_m) == (2.0, pytest.approx(math.hypot(0.4, 0.75)))
    assert _Segment(2.0, 0.25).carry(8.0, None, (0.3, None), (0.1, 0.1)) == (2.0, None)
    with_speeds = _Segment(2.0, 0.25).carry(8.0, (4.0, 4.0), (0.3, 0.4), (None, 0.1))
    assert with_speeds == (pytest.approx(2.0), pytest.approx(math.hypot(0.4, 0.75)))


def test_ends_that_contradict_their_speeds_move_by_their_variances() -> None:
    """A way of 9 m at 4 m/s over 2 s: 1 m too far for sigmas of 0.3 and 0.4 m."""
    flown = (0.1 * 2.0) ** 2 / 2 + (2.0 * 4.0 / 8) ** 2
    gain = 1.0 / (0.3**2 + 0.4**2 + flown)
    start, end = _Segment(2.0, 0.0), _Segment(2.0, 1.0)
    settings = (9.0, (4.0, 4.0), (0.3, 0.4), (0.05, 0.1))
    assert start.carry(*settings)[0] == pytest.approx(gain * 0.3**2)
    assert end.carry(*settings)[0] == pytest.approx(9.0 - gain * 0.4**2)
    _, sigma_m = _Segment(2.0, 0.25).carry(*settings)
    by_speeds_m = 0.1 * 2.0 * math.hypot(0.140625, -0.046875)
    assert sigma_m == pytest.approx(math.hypot(0.4, by_speeds_m, 0.75 * 0.1875))


@pytest.mark.parametrize(
    ("gap_ns", "method"), [(2 * NS, "interpolated"), (2 * NS + 1, "extrapolated")]
)
def test_samples_are_bridged_over_2_s(gap_ns: int, method: str) -> None:
    later = replace(sample(2.0), gps_ns=GPS_NS + gap_ns)
    record = navigation_at([sample(0.0), later], GPS_NS + NS)
    assert record is not None and record.method == method


@pytest.mark.parametrize("side", [-1, 1])
def test_a_sample_is_used_up_to_2_s_away(side: int) -> None:
    assert navigation_at([sample(0.0)], GPS_NS + side * 2 * NS) is not None
    assert navigation_at([sample(0.0)], GPS_NS + side * (2 * NS + 1)) is None


@pytest.mark.parametrize(
    ("latency_ms", "is_timely"), [(-100, True), (-101, False), (800, True), (801, False)]
)
def test_a_sample_came_when_one_of_its_time_may_come(latency_ms: int, is_timely: bool) -> None:
    track = Track()
    track.add(sample(0.0))
    record = track.at(GPS_NS + NS, NS - latency_ms * MS)
    assert (record is not None) is is_timely


def test_samples_of_the_last_two_minutes_are_known() -> None:
    track = Track()
    for t_s in (0.0, 60.0, 120.0):
        track.add(sample(t_s))
    assert track.at(GPS_NS) is not None
    track.add(replace(sample(120.0), gps_ns=GPS_NS + 120 * NS + 1))
    assert track.at(GPS_NS) is None
    assert track.at(GPS_NS + 60 * NS) is not None


@pytest.mark.parametrize(
    ("beyond_m", "is_used"), [(-0.01, True), (0.01, False)], ids=["within", "beyond"]
)
@pytest.mark.parametrize("axis", ["north", "east"])
def test_a_way_may_differ_from_its_velocities_by_so_much(
    axis: str, beyond_m: float, is_used: bool
) -> None:
    """After 1 s: 1 m, 2 m of acceleration and five sigmas of both places and both speeds."""
    allowed_m = 1.0 + 2.0 + 5.0 * math.hypot(0.5, 0.5, 0.2, 0.2) + beyond_m
    north_m, east_m = (allowed_m, 0.0) if axis == "north" else (0.0, allowed_m)
    second = sample(1.0)
    assert second.latitude_deg is not None and second.longitude_deg is not None
    off = replace(
        second,
        latitude_deg=second.latitude_deg + north_m / NORTH_M,
        longitude_deg=second.longitude_deg + east_m / EAST_M,
    )
    track = Track()
    track.add(sample(0.0))
    track.add(off)
    record = track.at(GPS_NS + NS // 2)
    assert (record is not None and record.method == "interpolated") is is_used


def test_a_record_is_as_good_as_the_worse_of_its_supports() -> None:
    worse = sample(1.0, fix="dead-reckoning", satellites=5, sigma_source="dop",
                   leap_source="table", horizontal_sigma_m=0.7)  # fmt: skip
    record = navigation_at([sample(0.0), worse], GPS_NS + NS // 4)
    assert record is not None
    assert (record.fix, record.satellites, record.sigma_source, record.leap_source) == (
        *("dead-reckoning", 5, "dop", "table"),
    )
    assert record.horizontal_sigma_m is not None and record.horizontal_sigma_m >= 0.7
    unknown = navigation_at(
        [sample(0.0, satellites=None), sample(1.0, satellites=None)], GPS_NS + 1
    )
    assert unknown is not None and unknown.satellites is None
