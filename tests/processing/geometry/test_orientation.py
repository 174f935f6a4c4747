"""Roll, pitch and heading become omega, phi and kappa through the matrix, never by renaming."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from processing.geometry.orientation import (
    BODY_FROM_CAMERA,
    grid_from_camera,
    grid_from_enu,
    on_level_ground,
)
from processing.geometry.rotation import (
    level_from_body,
    omega_phi_kappa,
)
from sim_hw.world import flight, true_camera

ANGLE = st.floats(-math.pi, math.pi)
HALF_ANGLE = st.floats(-1.5, 1.5)
ALIGNED = np.eye(3)


def looking(roll_deg: float, pitch_deg: float, heading_deg: float, north_deg: float = 0.0):
    return grid_from_camera(
        level_from_imu=level_from_body(*np.radians([roll_deg, pitch_deg, heading_deg])),
        imu_from_body=ALIGNED,
        body_from_camera=BODY_FROM_CAMERA,
        azimuth_of_north_rad=math.radians(north_deg),
    )


@given(HALF_ANGLE, HALF_ANGLE, ANGLE)
def test_the_emulated_aircraft_agrees(roll: float, pitch: float, heading: float) -> None:
    ours = grid_from_camera(
        level_from_imu=level_from_body(roll, pitch, heading),
        imu_from_body=ALIGNED,
        body_from_camera=BODY_FROM_CAMERA,
        azimuth_of_north_rad=0.0,
    )
    theirs = flight.enu_from_body(roll, pitch, heading) @ true_camera.BODY_FROM_CAMERA
    assert ours == pytest.approx(theirs, abs=1e-12)


def test_level_and_northbound_all_angles_are_zero() -> None:
    assert omega_phi_kappa(looking(0, 0, 0)) == pytest.approx((0, 0, 0), abs=1e-15)


def test_eastbound_the_image_is_rotated_clockwise() -> None:
    assert np.degrees(omega_phi_kappa(looking(0, 0, 90))) == pytest.approx([0, 0, -90])


def test_right_wing_down_northbound_is_seen_to_the_left() -> None:
    # A camera fixed to the body looks away from the wing that goes down.
    axis = looking(10, 0, 0) @ np.array([0.0, 0.0, -1.0])
    assert axis[0] == pytest.approx(-math.sin(math.radians(10)))
    assert np.degrees(omega_phi_kappa(looking(10, 0, 0))) == pytest.approx([0, 10, 0])


def test_nose_up_points_ahead() -> None:
    axis = looking(0, 5, 0) @ np.array([0.0, 0.0, -1.0])
    assert axis[1] == pytest.approx(math.sin(math.radians(5)))
    assert np.degrees(omega_phi_kappa(looking(0, 5, 0))) == pytest.approx([5, 0, 0])


def test_a_grid_whose_north_lies_west_of_true_north_rotates_kappa() -> None:
    # True north at azimuth +1.5 deg of the grid: flying true north is flying 1.5 deg in the grid.
    assert np.degrees(omega_phi_kappa(looking(0, 0, 0, 1.5))) == pytest.approx([0, 0, -1.5])
    assert grid_from_enu(0.1) @ np.array([0, 1, 0]) == pytest.approx(
        [math.sin(0.1), math.cos(0.1), 0]
    )


def test_rays_meet_level_ground_and_those_above_the_horizon_do_not() -> None:
    centre = np.array([100.0, 200.0, 1100.0])
    image = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, -20.0]])
    ground = on_level_ground(centre, np.eye(3), image, 100.0, 100.0)
    assert ground == pytest.approx(np.array([[100, 200, 100], [200, 200, 100], [100, 0, 100]]))
    up = on_level_ground(centre, looking(0, 95, 0), np.zeros((1, 2)), 100.0, 100.0)
    assert np.isnan(up).all()


def test_rays_just_below_the_horizon_and_just_above_the_ground_meet_it() -> None:
    centre = np.array([0.0, 0.0, 1000.5])
    rays = np.array([[50.0, 0.0]])
    # Half a metre above the ground, a principal distance of 0.9 mm: the reach is 0.5 / 0.9.
    ground = on_level_ground(centre, np.eye(3), rays, 0.9, 1000.0)
    assert ground[0] == pytest.approx([50.0 * 0.5 / 0.9, 0.0, 1000.0])
    below = on_level_ground(centre, np.eye(3), rays, 0.9, 1001.0)
    assert np.isnan(below).all(), "the plane lies above the camera"


def test_upward_rays_have_no_level_ground_even_below_the_plane() -> None:
    centre = np.zeros(3)
    upward = looking(0, 180, 0)
    assert np.isnan(on_level_ground(centre, upward, np.zeros((1, 2)), 0.9, 100.0)).all()
    steep = on_level_ground(centre, upward, np.zeros((1, 2)), 0.5, 100.0)
    assert np.isnan(steep).all()


def test_east_points_to_the_south_of_a_grid_whose_north_is_rotated() -> None:
    assert grid_from_enu(0.3) @ grid_from_enu(0.3).T == pytest.approx(np.eye(3))
    east = grid_from_enu(0.1) @ np.array([1.0, 0.0, 0.0])
    assert east == pytest.approx([math.cos(0.1), -math.sin(0.1), 0.0])
