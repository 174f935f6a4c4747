"""Navigation between two samples follows position, velocity and attitude."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from daemon.orientation.geodesy import metres_per_degree
from daemon.orientation.navigation import Track, navigation_at
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


def test_shortly_after_the_last_sample_it_is_extrapolated_and_marked_so() -> None:
    track = Track()
    track.add(sample(0.0))
    assert not track.covers(GPS_NS + NS)
    record = track.at(GPS_NS + NS)
    assert record is not None and record.method == "extrapolated" and record.gap_ns == NS


def test_long_after_the_last_sample_there_is_no_position() -> None:
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


def test_one_position_off_the_track_is_ignored() -> None:
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


def flat(t_s: float) -> NavSample:
    """A sample of a fix in two dimensions."""
    return replace(
        sample(t_s), fix="2d", height_m=None, vertical_sigma_m=None, horizontal_sigma_m=None
    )


@pytest.mark.trust
def test_a_height_that_was_not_received_is_taken_from_samples_that_have_one() -> None:
    track = Track()
    for tenth in range(0, 20, 2):
        track.add(sample(tenth / 10) if tenth % 6 == 0 else flat(tenth / 10))
    for hundredth in range(5, 175, 10):
        record = track.at(GPS_NS + hundredth * 10_000_000)
        assert record is not None
        assert (record.height_m, record.fix) == (HEIGHT, "3d")


@pytest.mark.trust
def test_without_any_height_the_record_has_none_and_the_fix_is_2d() -> None:
    track = Track()
    for tenth in range(0, 20, 2):
        track.add(flat(tenth / 10))
    record = track.at(GPS_NS + 500_000_000)
    assert record is not None
    assert (record.height_m, record.vertical_sigma_m, record.fix) == (None, None, "2d")
    assert (record.horizontal_sigma_m, record.sigma_source) == (None, "none")


@pytest.mark.trust
def test_a_sample_without_a_position_is_no_support() -> None:
    track = Track()
    track.add(sample(0.0))
    track.add(replace(sample(0.2), fix="none", latitude_deg=None, longitude_deg=None))
    track.add(replace(sample(0.4), fix="none"))
    track.add(replace(sample(0.6), fix="time"))
    assert track.last == sample(0.0)


@pytest.mark.trust
@pytest.mark.parametrize("u", [0.0, 0.1, 0.5, 0.9])
def test_a_record_is_never_better_than_its_worse_support(u: float) -> None:
    good = replace(sample(0.0), horizontal_sigma_m=0.02, vertical_sigma_m=0.03, satellites=18)
    for bad in (
        replace(sample(0.2), fix="dead-reckoning", horizontal_sigma_m=9.0, vertical_sigma_m=20.0),
        replace(sample(-0.2), fix="dead-reckoning", horizontal_sigma_m=9.0, vertical_sigma_m=20.0),
    ):
        before, after = sorted((good, bad), key=lambda s: s.gps_ns)
        record = navigation_at((before, after), before.gps_ns + round(u * 200_000_000))
        assert record is not None
        assert record.horizontal_sigma_m is not None and record.horizontal_sigma_m >= 9.0
        assert record.vertical_sigma_m is not None and record.vertical_sigma_m >= 20.0
        assert (record.fix, record.satellites) == ("dead-reckoning", 12)
    unknown = navigation_at((good, replace(sample(0.2), horizontal_sigma_m=None)), GPS_NS + 1000)
    assert unknown is not None and unknown.horizontal_sigma_m is None


@pytest.mark.trust
def test_a_position_counts_by_its_sigma() -> None:
    north_m, _ = metres_per_degree(LATITUDE, HEIGHT)
    good = replace(sample(0.0), horizontal_sigma_m=0.02, vertical_sigma_m=0.03)
    moved = replace(sample(0.2), horizontal_sigma_m=10.0, vertical_sigma_m=10.0)
    assert moved.latitude_deg is not None
    moved = replace(moved, latitude_deg=moved.latitude_deg + 8.0 / north_m, height_m=HEIGHT + 7.0)
    record = navigation_at((good, moved), GPS_NS + 190_000_000)
    assert record is not None and record.height_m is not None
    flown_m = (record.latitude_deg - LATITUDE) * north_m
    assert flown_m == pytest.approx(50.0 * 0.19 + 0.19**2, abs=0.02)
    assert record.height_m == pytest.approx(HEIGHT, abs=0.02)


@pytest.mark.trust
def test_the_sigma_of_an_extrapolated_position_grows_with_the_way() -> None:
    track = Track()
    track.add(sample(0.0))
    sigmas = []
    for tenths in (0, 5, 10, 19):
        record = track.at(GPS_NS + tenths * 100_000_000)
        assert record is not None and record.horizontal_sigma_m is not None
        sigmas.append(record.horizontal_sigma_m)
    assert sigmas[0] == 0.5 and sigmas == sorted(set(sigmas)) and sigmas[-1] > 2.0
    still = Track()
    still.add(replace(sample(0.0), velocity_ned_mps=None))
    record = still.at(GPS_NS + NS)
    assert record is not None and (record.method, record.horizontal_sigma_m) == ("nearest", None)


@pytest.mark.trust
def test_a_sample_with_a_height_is_waited_for_two_seconds_at_most() -> None:
    track = Track()
    track.add(sample(0.0))
    track.add(flat(0.5))
    assert not track.covers(GPS_NS + 300_000_000)
    track.add(flat(2.2))
    assert not track.covers(GPS_NS + 300_000_000)
    track.add(flat(2.4))
    assert track.covers(GPS_NS + 300_000_000)
    bare = Track()
    bare.add(flat(0.0))
    bare.add(flat(0.5))
    assert bare.covers(GPS_NS + 300_000_000)


@pytest.mark.trust
def test_a_height_that_no_aircraft_could_have_climbed_is_passed_over() -> None:
    track = Track()
    for tenth in range(0, 10, 2):
        velocity = (50.0 + tenth / 5, 0.0, None)
        height = HEIGHT + (1500.0 if tenth == 4 else 0.0)
        track.add(replace(sample(tenth / 10), velocity_ned_mps=velocity, height_m=height))
    for tenth in range(1, 8):
        record = track.at(GPS_NS + tenth * 100_000_000)
        assert record is not None and record.height_m == pytest.approx(HEIGHT)


@pytest.mark.trust
def test_a_heading_known_at_one_end_only_is_not_carried_on() -> None:
    track = Track()
    track.add(replace(sample(0.0), roll_rad=None, pitch_rad=None, heading_rad=6.2))
    track.add(replace(sample(0.2), roll_rad=None, pitch_rad=None, heading_rad=0.1))
    track.add(replace(sample(0.4), roll_rad=None, pitch_rad=None, heading_rad=None))
    between_both, after = track.at(GPS_NS + 100_000_000), track.at(GPS_NS + 300_000_000)
    assert between_both is not None and after is not None
    assert between_both.heading_rad == pytest.approx(0.5 * (6.2 + 0.1 + 2 * math.pi) % math.tau)
    assert after.heading_rad is None


@pytest.mark.trust
def test_at_the_instant_of_a_sample_the_record_has_its_height() -> None:
    track = Track()
    for tenth, height in ((0, HEIGHT), (2, HEIGHT + 3.0), (4, HEIGHT)):
        track.add(replace(sample(tenth / 10), height_m=height, vertical_sigma_m=9.0))
    for tenth, height in ((0, HEIGHT), (2, HEIGHT + 3.0), (4, HEIGHT)):
        velocity = (50.0, 0.0, None)
        bare = [replace(s, velocity_ned_mps=velocity) for s in track._samples]
        record = navigation_at(bare, GPS_NS + tenth * NS // 10)
        assert record is not None
        assert (record.height_m, record.vertical_sigma_m) == (pytest.approx(height), 9.0)


@pytest.mark.trust
def test_samples_exactly_two_seconds_apart_are_still_bridged() -> None:
    record = navigation_at((sample(0.0), sample(2.0)), GPS_NS + NS)
    assert record is not None and (record.method, record.gap_ns) == ("interpolated", 2 * NS)
    late = navigation_at((sample(0.0), sample(2.001)), GPS_NS + NS)
    assert late is not None and late.method == "extrapolated"


@pytest.mark.trust
def test_positions_without_velocities_contradict_nothing() -> None:
    track = Track()
    for tenth in range(0, 10, 2):
        track.add(replace(sample(tenth / 10), velocity_ned_mps=None))
    record = track.at(GPS_NS + 100_000_000, 100_000_000)
    assert record is not None and record.method == "interpolated"
    north_m, _ = metres_per_degree(LATITUDE, HEIGHT)
    assert (record.latitude_deg - LATITUDE) * north_m == pytest.approx(5.01, abs=0.05)
