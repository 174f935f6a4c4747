"""Rays meet a height model where they meet the emulator's own terrain."""

from __future__ import annotations

import numpy as np
import pytest

from processing.bundle.bent_rays import MEAN_EARTH_RADIUS_M
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
    turn = np.radians(np.linspace(0.0, 350.0, 30))
    rays = np.stack(
        [np.sin(angles) * np.sin(turn), np.sin(angles) * np.cos(turn), -np.cos(angles)], axis=1
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
