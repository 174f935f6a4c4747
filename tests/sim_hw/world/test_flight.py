"""The emulated flight is smooth, follows its plan, and vibrates with the configured amplitude."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim_hw.world.ellipsoid import ecef_from_geodetic, geodetic_from_ecef, geodetic_from_enu
from sim_hw.world.flight import (
    FlightPlan,
    SimulatedFlight,
    enu_from_body,
    path_point,
    random_attitude_motion,
)
from sim_hw.world.seeding import random_stream
from sim_hw.world.terrain import mild_relief

EPOCH = 1_400_000_000_000_000_000
SECOND = 1_000_000_000
PLAN = FlightPlan(
    height_m=3000.0, ground_speed_mps=55.0, line_length_m=2500.0, line_spacing_m=520.0
)


def test_the_same_seed_flies_the_same_flight_and_another_does_not() -> None:
    one, same, other = (SimulatedFlight(PLAN, seed, EPOCH) for seed in (3, 3, 4))
    at = EPOCH + 12_345_678_901
    assert np.array_equal(one.pose(at).enu_from_body, same.pose(at).enu_from_body)
    assert not np.allclose(one.pose(at).enu_from_body, other.pose(at).enu_from_body, atol=1e-5)


def test_velocity_is_the_derivative_of_position_on_lines_and_in_turns() -> None:
    flight = SimulatedFlight(PLAN, 1, EPOCH)
    for second in np.arange(-30, 400, 1.7):
        at = EPOCH + round(second * SECOND)
        step = 1_000_000
        before, after = flight.pose(at - step), flight.pose(at + step)
        derived = (after.position_enu_m - before.position_enu_m) / (2 * step * 1e-9)
        assert derived == pytest.approx(flight.pose(at).velocity_enu_mps, abs=0.01)


def test_the_aircraft_comes_back_on_the_next_line() -> None:
    points = [path_point(PLAN, s) for s in np.arange(0, 24000, 10.0)]
    south = [p for p in points if p[2] == pytest.approx(math.pi) and p[3] == 0.0]
    assert {round(p[0]) for p in south} == {520}
    assert min(p[1] for p in south) < 12.0
    assert max(p[1] for p in south) >= PLAN.line_length_m
    north_again = [p for p in points if p[0] == pytest.approx(1040) and p[3] == 0.0]
    assert north_again
    assert all(math.cos(p[2]) == pytest.approx(1.0) for p in north_again)


def test_a_line_may_begin_anywhere_without_a_jump() -> None:
    flight = SimulatedFlight(PLAN, 1, EPOCH)
    at = EPOCH + 200 * SECOND
    begun = flight.beginning_first_line_at(flight.distance_flown_m(at))
    straight = begun.pose(at - SECOND).position_enu_m
    assert straight[1] == pytest.approx(55.0 * 199, abs=5)
    assert np.linalg.norm(begun.pose(at + 1000).position_enu_m - begun.pose(at).position_enu_m) < 1
    assert begun.pose(at + 45 * SECOND).heading_rad % (2 * math.pi) == pytest.approx(
        0.0, abs=math.radians(3)
    ) or begun.pose(at + 45 * SECOND).heading_rad == pytest.approx(2 * math.pi, abs=math.radians(3))


def test_attitude_trembles_with_the_angle_and_the_rate_that_were_requested() -> None:
    tremor = random_attitude_motion(random_stream(5, "roll"), rms=0.0035, rate_rms=0.0052)
    t = np.arange(0, 4000, 0.05)
    angle = np.array([tremor.value(x) for x in t])
    assert angle.std() == pytest.approx(0.0035, rel=0.05)
    assert np.diff(angle).std() / 0.05 == pytest.approx(0.0052, rel=0.05)
    assert tremor.rms == pytest.approx(0.0035, rel=1e-6)
    assert tremor.rate_rms == pytest.approx(0.0052, rel=0.03)


def test_body_axes_rotate_with_heading_pitch_and_roll() -> None:
    east_bound = enu_from_body(0.0, 0.0, math.pi / 2)
    assert east_bound @ [1, 0, 0] == pytest.approx([1, 0, 0], abs=1e-12)
    assert east_bound @ [0, 1, 0] == pytest.approx([0, -1, 0], abs=1e-12)
    assert enu_from_body(0, 0.1, 0) @ [1, 0, 0] == pytest.approx([0, math.cos(0.1), math.sin(0.1)])
    right_wing_down = enu_from_body(0.1, 0, 0) @ [0, 1, 0]
    assert right_wing_down == pytest.approx([math.cos(0.1), 0, -math.sin(0.1)])


def test_wind_from_the_left_leaves_the_camera_crabbed_to_the_left() -> None:
    calm = {"attitude_rms_deg": 0.0, "rate_rms_dps": 0.0, "track_deviation_rms_m": 0.0}
    plan = FlightPlan(
        3000.0, 50.0, 1000.0, 500.0, wind_across_mps=5.0, drift_correction=0.0, **calm
    )
    pose = SimulatedFlight(plan, 1, EPOCH).pose(EPOCH)
    assert pose.heading_rad == pytest.approx(2 * math.pi - math.atan2(5, 50))
    assert pose.velocity_enu_mps == pytest.approx([0, 50, 0], abs=1e-9)


def test_geodetic_coordinates_agree_with_published_and_with_themselves() -> None:
    assert ecef_from_geodetic(0.0, 90.0, 0.0) == pytest.approx([0, 6378137.0, 0], abs=1e-6)
    # The polar radius of WGS 84, NIMA TR8350.2, table 3.3.
    assert ecef_from_geodetic(90.0, 0.0, 0.0) == pytest.approx([0, 0, 6356752.3142], abs=1e-4)
    there = ecef_from_geodetic(48.0, 11.0, 500.0)
    assert geodetic_from_ecef(there) == pytest.approx((48.0, 11.0, 500.0), abs=1e-9)
    latitude, longitude, height = geodetic_from_enu(np.array([0.0, 1000.0, 0.0]), 47.0, 15.0, 400.0)
    # 1000 m north at 47 deg N with M = 6 369 500 m + 400 m, and the earth falls away by d^2 / 2 R.
    assert (latitude - 47.0) * math.pi / 180 * 6_369_900 == pytest.approx(1000.0, abs=0.1)
    assert longitude == pytest.approx(15.0, abs=1e-12)
    assert height == pytest.approx(400.0 + 1000.0**2 / (2 * 6_369_900), abs=1e-3)


def test_rays_end_on_the_relief() -> None:
    terrain = mild_relief(2, flying_height_m=3000.0, relative_relief=0.003)
    random = np.random.default_rng(0)
    rays = np.column_stack([random.uniform(-0.2, 0.2, (500, 2)), -np.ones(500)])
    ground = terrain.intersect(np.array([100.0, 200.0, 3000.0]), rays)
    assert ground[:, 2] == pytest.approx(terrain.height_m(ground[:, 0], ground[:, 1]), abs=1e-6)
    along = (ground - [100.0, 200.0, 3000.0]) / rays
    assert along[:, 0] == pytest.approx(along[:, 2], rel=1e-12)
    assert np.abs(ground[:, 2]).max() < 9.0
    assert ground[:, 2].std() > 1.0


def test_an_inertial_unit_is_level_where_it_is_and_not_where_the_flight_began() -> None:
    still = FlightPlan(
        height_m=1000.0,
        ground_speed_mps=60.0,
        line_length_m=20_000.0,
        line_spacing_m=500.0,
        attitude_rms_deg=0.0,
        rate_rms_dps=0.0,
        track_deviation_rms_m=0.0,
    )
    flown = SimulatedFlight(still, seed=1, epoch_gps_ns=0)
    pose = flown.pose(150 * 10**9)  # 9 km north of the origin
    roll, pitch, heading = flown.attitude_rad(pose)
    # The mount is level in the plane of the origin, so the nose is up against the level there.
    assert pitch == pytest.approx(9000.0 / 6_376_000.0, rel=5e-3)
    assert roll == pytest.approx(0.0, abs=5e-5)  # a little, by the crab
    assert heading == pytest.approx(pose.heading_rad, abs=5e-5)
