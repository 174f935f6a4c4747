"""Earth curvature and refraction against rays traced on a sphere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.adjust import adjust
from processing.bundle.curvature_refraction import (
    MEAN_EARTH_RADIUS_M,
    RayModel,
    corrected_rays,
    refraction_coefficient,
)
from processing.bundle.equations import equations
from processing.bundle.unknowns import apply_corrections, initial_values, layout_of
from tests.processing.bundle.simulated_networks import aerial


def on_sphere(map_m: np.ndarray) -> np.ndarray:
    """Cartesian coordinates, origin on the sphere, of map coordinates (arcs) and heights."""
    r = MEAN_EARTH_RADIUS_M
    arc = np.hypot(map_m[:, 0], map_m[:, 1])
    angle, direction = arc / r, map_m[:, :2] / np.where(arc == 0.0, 1.0, arc)[:, None]
    out = (r + map_m[:, 2]) * np.sin(angle)
    up = (r + map_m[:, 2]) * np.cos(angle) - r
    return np.column_stack([direction * out[:, None], up])


def test_curvature_carries_map_coordinates_to_the_sphere() -> None:
    random = np.random.default_rng(1)
    points = np.column_stack([random.uniform(-3000, 3000, (40, 2)), random.uniform(0, 200, 40)])
    camera = np.array([[0.0, 0.0, 4000.0]])
    true = on_sphere(points) - on_sphere(camera)
    height = np.full(40, 4000.0)
    bowed, _, _ = corrected_rays(points - camera, height, RayModel(MEAN_EARTH_RADIUS_M))
    plain = points - camera
    tangent = [v[:, :2] / v[:, 2:] for v in (true, bowed, plain)]
    assert np.abs(tangent[1] - tangent[0]).max() < 2e-6
    assert np.abs(tangent[2] - tangent[0]).max() > 1e-4


def test_refraction_is_that_of_the_handbooks() -> None:
    # 2410 H / (H^2 - 6 H + 250) microradians over sea level, H in km.
    assert refraction_coefficient(np.array([1000.0]), 0.0)[0] == pytest.approx(9.837e-6, rel=1e-3)
    assert refraction_coefficient(np.array([9000.0]), 0.0)[0] == pytest.approx(78.3e-6, rel=1e-2)
    ray = np.array([[1000.0, 0.0, -1000.0], [0.0, 0.0, -1000.0]])
    seen, _, _ = corrected_rays(ray, np.full(2, 1000.0), RayModel(refraction=True))
    off = np.arctan2(seen[0, 0], -seen[0, 2]) - np.pi / 4.0
    assert off == pytest.approx(9.837e-6, rel=1e-3), "seen farther out, by K tan 45"
    assert np.array_equal(seen[1], ray[1])


def test_derivatives_of_bent_rays_agree_with_differences() -> None:
    network = replace(aerial().network, rays=RayModel(100_000.0, refraction=True, ground_m=10.0))
    layout = layout_of(network, np.zeros(60, dtype=bool))
    state, weight = initial_values(network), np.ones(len(network.image_points.image))
    rows = equations(network, layout, state, weight)
    design = rows.reduced.toarray()
    none = np.zeros((60, 3))
    for column in range(0, layout.columns, 5):
        size = float(np.abs(design[:, column]).max())
        dx = np.zeros(layout.columns)
        dx[column] = 1.0 / size
        up = equations(network, layout, apply_corrections(state, layout, dx, none), weight)
        down = equations(network, layout, apply_corrections(state, layout, -dx, none), weight)
        numeric = -(up.misclosure - down.misclosure) / (2.0 * dx[column])
        # K itself changes with the station's height; that is a millionth of the height's effect.
        assert np.abs(numeric - design[:, column]).max() < 2e-5 * size


def test_a_block_in_map_coordinates_takes_curvature_to_come_out_right() -> None:
    simulated = aerial(
        seed=3, sigma_mm=1e-3, lines=2, along=30, points=300, control=0, disturb=0.5, relief_m=30.0
    )
    network, r = simulated.network, MEAN_EARTH_RADIUS_M
    # The block is Cartesian; its map coordinates are those of the sphere it stands on.
    middle = simulated.points.mean(axis=0) * [1, 1, 0]

    def on_map(xyz: np.ndarray) -> np.ndarray:
        local = xyz - middle
        out = np.hypot(local[:, 0], local[:, 1])
        arc = r * np.arctan2(out, r + local[:, 2])
        height = np.hypot(out, r + local[:, 2]) - r
        return np.column_stack([local[:, :2] * (arc / out)[:, None], height])

    sigma = np.full((300, 3), np.nan)
    ends = np.argsort(simulated.points[:, 0])
    control = np.concatenate([ends[:6], ends[-6:]])
    sigma[control] = 0.005
    mapped = on_map(simulated.points)
    xyz = mapped + np.random.default_rng(2).normal(0.0, 0.5, mapped.shape)
    xyz[control] = mapped[control]
    network = replace(
        network,
        points=replace(network.points, xyz_m=xyz, sigma_m=sigma),
        stations=replace(network.stations, position_m=on_map(network.stations.position_m)),
    )
    curved = adjust(replace(network, rays=RayModel(r)))
    flat = adjust(network)

    def height_error(result) -> float:
        """Mean over the middle of the strips, m: where a bow shows."""
        good = np.isfinite(result.point_cofactor).all(axis=(1, 2))
        good &= np.abs(simulated.points[:, 0] - middle[0]) < 900.0
        return float((result.state.points - mapped)[good, 2].mean())

    assert curved.sigma0 == pytest.approx(1.0, abs=0.06)
    assert abs(height_error(curved)) < 0.1
    assert abs(height_error(flat)) > 0.25
