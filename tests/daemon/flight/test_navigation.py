"""Navigation between two samples follows position, velocity and attitude."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from daemon.flight.navigation import Track, metres_per_degree
from drivers.contract import NavSample

NS = 1_000_000_000
GPS_NS = 1_400_000_000 * NS
LATITUDE, LONGITUDE, HEIGHT = 48.0, 11.0, 3500.0


def sample(t_s: float, heading_deg: float = 0.0, roll_deg: float | None = 1.0) -> NavSample:
    """An aircraft that accelerates northward: north = 50 t + t^2."""
    north_m, _ = metres_per_degree(LATITUDE, HEIGHT)
    return NavSample(
        receiver="gnss",
        gps_ns=GPS_NS + round(t_s * NS),
        mono_ns=round(t_s * NS),
        fix="3d",
        satellites=12,
        latitude_deg=LATITUDE + (50.0 * t_s + t_s * t_s) / north_m,
        longitude_deg=LONGITUDE,
        height_m=HEIGHT,
        horizontal_sigma_m=0.5,
        vertical_sigma_m=0.9,
        velocity_ned_mps=(50.0 + 2.0 * t_s, 0.0, 0.0),
        speed_sigma_mps=0.05,
        roll_rad=None if roll_deg is None else math.radians(roll_deg),
        pitch_rad=0.0,
        heading_rad=math.radians(heading_deg) % (2 * math.pi),
        leap_seconds=18,
        time_valid=True,
    )


def test_position_between_samples_follows_the_acceleration_to_a_millimetre() -> None:
    track = Track()
    for k in range(6):
        track.add(sample(0.2 * k))
    record = track.at(GPS_NS + 537_000_000)
    assert record is not None and record.method == "interpolated"
    north_m, _ = metres_per_degree(LATITUDE, HEIGHT)
    flown_m = (record.latitude_deg - LATITUDE) * north_m
    assert flown_m == pytest.approx(50.0 * 0.537 + 0.537**2, abs=1e-3)
    assert record.velocity_ned_mps[0] == pytest.approx(50.0 + 2 * 0.537, abs=1e-6)


def test_heading_is_interpolated_across_north() -> None:
    track = Track()
    track.add(sample(0.0, heading_deg=358.0))
    track.add(sample(0.2, heading_deg=4.0))
    record = track.at(GPS_NS + 100_000_000)
    assert record is not None and record.heading_rad is not None
    assert math.degrees(record.heading_rad) == pytest.approx(1.0, abs=0.01)
    assert record.roll_rad == pytest.approx(math.radians(1.0), abs=1e-4)


def test_shortly_after_the_last_sample_it_is_extrapolated_and_says_so() -> None:
    track = Track()
    track.add(sample(0.0))
    assert not track.reaches(GPS_NS + NS)
    record = track.at(GPS_NS + NS)
    assert record is not None and record.method == "extrapolated" and record.gap_ns == NS


def test_long_after_the_last_sample_nothing_is_told() -> None:
    track = Track()
    track.add(sample(0.0))
    assert track.at(GPS_NS + 3 * NS) is None


def test_a_sample_that_is_not_newer_is_dropped() -> None:
    track = Track()
    track.add(sample(1.0))
    track.add(sample(0.5))
    assert track.last is not None and track.last.gps_ns == GPS_NS + NS


def stepped(flown: NavSample, by_s: float) -> NavSample:
    """The same place and host time, by a receiver clock that has stepped."""
    return replace(flown, gps_ns=flown.gps_ns + round(by_s * NS))


def test_between_two_times_of_one_receiver_there_is_no_position() -> None:
    track = Track()
    track.add(sample(0.0))
    track.add(stepped(sample(0.6), -0.4))
    track.add(stepped(sample(0.8), -0.4))
    assert track.at(GPS_NS + 100_000_000, 500_000_000) is None
    record = track.at(GPS_NS + 300_000_000, 700_000_000)
    assert record is not None
    north_m, _ = metres_per_degree(LATITUDE, HEIGHT)
    flown_m = (record.latitude_deg - LATITUDE) * north_m
    assert flown_m == pytest.approx(50.0 * 0.7 + 0.7**2, abs=0.01)


def test_one_position_beside_the_track_is_passed_over() -> None:
    track = Track()
    for tenth in (0, 2, 4):
        track.add(sample(tenth / 10))
    track.add(replace(sample(0.6), latitude_deg=LATITUDE + 0.01))
    track.add(sample(0.8))
    record = track.at(GPS_NS + 600_000_000, 600_000_000)
    assert record is not None
    north_m, _ = metres_per_degree(LATITUDE, HEIGHT)
    assert (record.latitude_deg - LATITUDE) * north_m == pytest.approx(30.0 + 0.36, abs=0.01)


def test_a_receiver_whose_time_steps_back_is_followed_and_a_late_message_is_not() -> None:
    track = Track()
    for tenth in range(0, 50, 2):
        track.add(sample(tenth / 10))
    track.add(sample(3.0))
    assert track.last == sample(4.8)
    for tenth in range(50, 58, 2):
        track.add(stepped(sample(tenth / 10), -3.0))
    record = track.at(GPS_NS + round(2.1 * NS))
    assert record is not None
    north_m, _ = metres_per_degree(LATITUDE, HEIGHT)
    flown_m = (record.latitude_deg - LATITUDE) * north_m
    assert flown_m == pytest.approx(50.0 * 5.1 + 5.1**2, abs=0.01)
