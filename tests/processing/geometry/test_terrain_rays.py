"""Rays meet a height model where they meet the emulator's own terrain."""

from __future__ import annotations

import numpy as np
import pytest

from processing.bundle.curvature_refraction import MEAN_EARTH_RADIUS_M
from processing.geometry.terrain_rays import HeightModel, on_terrain
from sim_hw.world.terrain import mild_relief


def model_of(height, *, half_m: float = 3000.0, step_m: float = 10.0) -> HeightModel:
    axis = np.arange(-half_m, half_m + 1, step_m)
    x, y = np.meshgrid(axis, axis[::-1])
    return HeightModel(height(x, y), -half_m, half_m, step_m, -step_m)


def test_oblique_rays_meet_the_ground_of_the_emulator() -> None:
    terrain = mild_relief(3, flying_height_m=1000.0, relative_relief=0.03)
    model = model_of(terrain.height_m)
    centre = np.array([120.0, -80.0, 1000.0])
    angles = np.radians(np.linspace(0.0, 58.0, 30))
    azimuth = np.radians(np.linspace(0.0, 350.0, 30))
    rays = np.stack(
        [np.sin(angles) * np.sin(azimuth), np.sin(angles) * np.cos(azimuth), -np.cos(angles)],
        axis=1,
    )
    found = on_terrain(centre, rays, model, earth_radius_m=None)
    truth = terrain.intersect(centre, rays)
    # Heights between grid points of 10 m are bilinear: centimetres of these waves.
    assert np.abs(found - truth).max() < 0.1


def test_the_first_ridge_along_a_ray_counts() -> None:
    wall = model_of(lambda x, y: np.where(np.abs(x - 500.0) < 60.0, 300.0, 0.0))
    ray = np.array([[1.0, 0.0, -1.0]])
    found = on_terrain(np.array([0.0, 0.0, 700.0]), ray, wall, earth_radius_m=None)
    assert found[0, 0] == pytest.approx(448.4, abs=0.1), "the wall, not the ground behind it"
    over = on_terrain(np.array([0.0, 0.0, 1000.0]), ray, wall, earth_radius_m=None)
    assert over[0] == pytest.approx([1000.0, 0.0, 0.0], abs=0.1), "behind the wall"


def test_the_earth_falls_away_below_a_far_ray() -> None:
    flat = model_of(lambda x, y: np.zeros_like(x))
    ray = np.array([[2.0, 0.0, -1.0]])
    (found,) = on_terrain(np.array([0.0, 0.0, 1000.0]), ray, flat)
    farther = 2.0 * 2000.0**2 / (2.0 * MEAN_EARTH_RADIUS_M)
    assert found[0] == pytest.approx(2000.0 + farther, rel=1e-5)
    assert found[2] == pytest.approx(0.0, abs=1e-3)


def test_rays_that_leave_the_model_or_the_earth_have_no_ground() -> None:
    flat = model_of(lambda x, y: np.zeros_like(x), half_m=500.0)
    rays = np.array([[0.0, 0.0, -1.0], [3.0, 0.0, -1.0], [1.0, 0.0, 0.2]])
    found = on_terrain(np.array([0.0, 0.0, 400.0]), rays, flat)
    assert found[0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    assert np.isnan(found[1:]).all()


# Three rows by four columns; the corner in the north-east is unknown.
SMALL = HeightModel(
    np.array([[10.0, 12.0, 16.0, np.nan], [20.0, 26.0, 30.0, 36.0], [34.0, 40.0, 50.0, 54.0]]),
    x_m=100.0,
    y_m=500.0,
    step_x_m=2.0,
    step_y_m=-5.0,
)


@pytest.mark.parametrize(
    ("x_m", "y_m", "height_m"),
    [
        (100.0, 500.0, 10.0),
        (106.0, 490.0, 54.0),
        (100.0, 490.0, 34.0),
        (106.0, 495.0, 36.0),
        (101.0, 500.0, 11.0),
        (100.0, 497.5, 15.0),
        (105.5, 491.0, 50.0 * 0.25 * 0.8 + 54.0 * 0.75 * 0.8 + 30.0 * 0.05 + 36.0 * 0.15),
        (102.5, 499.0, 12.0 * 0.75 * 0.8 + 16.0 * 0.25 * 0.8 + 26.0 * 0.15 + 30.0 * 0.05),
        (104.5, 499.0, np.nan),
        (99.99, 495.0, np.nan),
        (106.01, 492.0, np.nan),
        (102.0, 500.01, np.nan),
        (102.0, 489.99, np.nan),
        (108.0, 492.0, np.nan),
        (102.0, 485.0, np.nan),
        (np.nan, 495.0, np.nan),
    ],
)
def test_heights_are_bilinear_within_the_model_and_unknown_outside(
    x_m: float, y_m: float, height_m: float
) -> None:
    found = SMALL.at(np.array([[x_m, y_m]]))
    assert found == pytest.approx([height_m], nan_ok=True)


@pytest.mark.parametrize("earth_radius_m", [None, MEAN_EARTH_RADIUS_M])
def test_rays_meet_a_tilted_plane_where_algebra_states(earth_radius_m: float | None) -> None:
    plane = model_of(lambda x, y: 40.0 + 0.1 * x - 0.2 * y, half_m=600.0)
    centre = np.array([20.0, -30.0, 500.3])
    rays = np.array([[0.0, 0.0, -1.0], [0.6, 0.2, -1.0], [-0.3, 0.5, -2.0], [0.0, 0.9, -1.0]])
    found = on_terrain(centre, rays, plane, earth_radius_m=earth_radius_m)
    # z + k t = 40 + 0.1 x - 0.2 y along centre + t ray; the sphere changes less than 3 cm here.
    above = centre[2] - 40.0 - 0.1 * centre[0] + 0.2 * centre[1]
    t = above / (-rays[:, 2] + 0.1 * rays[:, 0] - 0.2 * rays[:, 1])
    tolerance = 1e-5 if earth_radius_m is None else 0.05
    np.testing.assert_allclose(found, centre + t[:, None] * rays, atol=tolerance)
    on_plane = 40.0 + 0.1 * found[:, 0] - 0.2 * found[:, 1]
    np.testing.assert_allclose(found[:, 2], on_plane, atol=1e-5)


def test_a_ray_from_below_the_highest_ground_is_followed_from_the_camera() -> None:
    peak = model_of(lambda x, y: np.maximum(0.0, 400.0 - np.hypot(x - 900.0, y)), half_m=1500.0)
    for height_m in (0.4, 100.0):
        centre = np.array([0.0, 0.0, height_m])
        rays = np.array([[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [0.0, 0.5, -1.0]])
        found = on_terrain(centre, rays, peak)
        np.testing.assert_allclose(found, centre + height_m * rays, atol=1e-3)


def test_a_narrow_ridge_is_not_stepped_over() -> None:
    ridge = model_of(lambda x, y: np.where(x == 300.0, 200.0, 0.0), half_m=1000.0)
    centre = np.array([9.0, 0.0, 500.0])
    # The ridge is 20 m wide at its foot, half as wide where the ray meets it.
    (found,) = on_terrain(centre, np.array([[300.0, 0.0, -400.0]]), ridge, earth_radius_m=None)
    # 500 - 4/3 (x - 9) = 200 - 20 (300 - x)
    assert found[0] == pytest.approx(6312.0 / (20.0 + 4.0 / 3.0), abs=1e-4)


def test_far_rays_are_followed_until_the_sphere_has_fallen_away_by_a_hundred_metres() -> None:
    axis = np.arange(-1000.0, 60_000.0, 500.0)
    strip = HeightModel(np.zeros((2, len(axis))), -1000.0, 50.0, 500.0, -100.0)
    centre = np.array([0.0, 0.0, 1000.0])

    def reach_m(fall_m: float) -> tuple[float, float]:
        across_m = np.sqrt(2.0 * MEAN_EARTH_RADIUS_M * fall_m)
        ray = np.array([[across_m, 0.0, -1000.0 - fall_m]])
        return float(on_terrain(centre, ray, strip)[0, 0]), float(across_m)

    found_m, across_m = reach_m(100.0)
    assert found_m == pytest.approx(across_m, abs=5.0)
    assert np.isnan(reach_m(190.0)[0])
