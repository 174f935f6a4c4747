"""Subsets of a block whose images are 0.3 degrees apart, seen from the points: nothing stops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.adjustment_results import narrow_points
from processing.bundle.initial_values import completed
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    NetworkError,
    Points,
    Stations,
)
from processing.bundle.step_control import points_in_front
from processing.bundle.unknowns import initial_values
from processing.geometry.rotation import rotations_from_vectors

NOISE_MM = 1.5e-3
CONTROL = 6


def _looking(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    z = -direction / np.linalg.norm(direction)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _subset(seed: int, images: int, angle_deg: float, depth_error: float = 0.0) -> Network:
    """Images at 34 m from 80 points, `angle_deg` apart; points given, or intersected from rays."""
    random = np.random.default_rng(seed)
    angle = np.radians(angle_deg) * np.arange(images)
    station = np.column_stack([34 * np.cos(angle), 34 * np.sin(angle), np.full(images, 4.0)])
    points = np.column_stack(
        [random.normal(0, 4, 80), random.uniform(-8, 8, 80), random.uniform(0, 16, 80)]
    )
    rotation = np.array([_looking(np.array([0.0, 0.0, 8.0]) - s) for s in station])
    ray = np.einsum("knj,kjl->knl", points[None] - station[:, None], rotation)
    seen = -24.0 * ray[..., :2] / ray[..., 2:]
    image, point = np.nonzero((np.abs(seen) < (18.0, 14.0)).all(axis=2))
    factor = np.exp(random.normal(0, depth_error, 80))[:, None]
    start = station[0] + (points - station[0]) * factor
    if not depth_error:
        start = np.full_like(points, np.nan)
    start[:CONTROL] = points[:CONTROL]
    sigma = np.full_like(points, np.nan)
    sigma[:CONTROL] = 0.01
    names = tuple(f"i{k}" for k in range(images))
    every, none = np.arange(images), np.zeros(images, dtype=bool)
    near = station + random.normal(0, 0.05, station.shape)
    turned = rotation @ rotations_from_vectors(random.normal(0, 3e-3, (images, 3)))
    return Network(
        cameras=(CameraModel("c", 24.0, pixel_mm=5e-3),),
        stations=Stations(names, near, none),
        attitudes=Attitudes(names, turned, none),
        images=Images(names, every, every, np.zeros_like(every), np.full_like(every, -1)),
        points=Points(tuple(f"p{k}" for k in range(80)), start, sigma, np.zeros(80, dtype=bool)),
        image_points=ImagePoints(
            image,
            point,
            seen[image, point] + random.normal(0, NOISE_MM, (len(image), 2)),
            np.full((len(image), 2), NOISE_MM),
        ),
    )


@pytest.mark.parametrize("images", [2, 3, 8])
@pytest.mark.parametrize("depth_error", [0.0, 0.3])
@pytest.mark.parametrize("free", [False, True])
def test_images_0_3_degrees_apart_are_adjusted_whatever_the_first_depths(
    images, depth_error, free
) -> None:
    network = _subset(3, images, 0.3, depth_error)
    if free:
        nothing = np.full_like(network.points.sigma_m, np.nan)
        network = replace(network, points=replace(network.points, sigma_m=nothing))
    result = adjust(completed(network), AdjustmentSettings(minimum_norm=free))
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    assert result.left_out.sum() <= 2
    named = narrow_points(result)
    if images == 2:
        assert len(named) > 60
        assert named[0][1] < 0.35
        assert list(named) == sorted(named, key=lambda item: item[1])
    if images == 8:
        assert not narrow_points(result, below_deg=0.1)


def test_depths_do_not_depend_on_where_they_began() -> None:
    network = _subset(4, 3, 0.3, depth_error=0.05)
    far = _subset(4, 3, 0.3, depth_error=0.4)
    far = replace(network, points=replace(network.points, xyz_m=far.points.xyz_m))
    one, other = adjust(network), adjust(far)
    assert other.sigma0 == pytest.approx(one.sigma0, rel=1e-6)
    used = ~(one.left_out | other.left_out)
    assert np.abs((one.state.points - other.state.points)[used]).max() < 1e-3


def test_points_that_begin_behind_the_cameras_are_put_in_front() -> None:
    network = _subset(5, 3, 0.3, depth_error=0.05)
    xyz = network.points.xyz_m.copy()
    centre = network.stations.position_m.mean(axis=0)
    xyz[20:60] = centre - 0.5 * (xyz[20:60] - centre)
    state = points_in_front(network, initial_values(replace(network, points=replace(
        network.points, xyz_m=xyz))))  # fmt: skip
    assert (state.points[:20] == xyz[:20]).all()
    table = network.image_points
    ray = state.points[table.point] - network.stations.position_m[table.image]
    along = np.einsum("nji,nj->ni", network.attitudes.rotation[table.image], ray)[:, 2]
    assert (along < 0.0).all()
    result = adjust(replace(network, points=replace(network.points, xyz_m=xyz)))
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    assert result.left_out.sum() <= 2


def test_points_without_a_parallax_are_set_aside_by_name_and_a_block_of_them_is_refused() -> None:
    network = _subset(6, 3, 3.0, depth_error=0.05)
    table = network.image_points
    xy = table.xy_mm.copy()
    # Rays that diverge: no place in front of the cameras.
    own = np.isin(table.point, range(70, 75))
    xy[own & (table.image == 0), 0] -= 6.0
    xy[own & (table.image == 2), 0] += 6.0
    wrong = replace(network, image_points=replace(table, xy_mm=xy))
    result = adjust(wrong)
    assert set(np.flatnonzero(result.left_out)) == set(range(70, 75)) & set(table.point)
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    xy = table.xy_mm.copy()
    xy[(table.image == 0) & (table.point >= CONTROL), 0] -= 6.0
    xy[(table.image == 2) & (table.point >= CONTROL), 0] += 6.0
    with pytest.raises(NetworkError, match=r"nearly parallel|no convergence"):
        adjust(replace(network, image_points=replace(table, xy_mm=xy)))


def test_a_point_that_is_given_and_seen_from_one_place_only_keeps_its_depth() -> None:
    network = _subset(1, 3, 20.0, 0.1)
    own = network.image_points
    single = CONTROL + 1
    sigma = network.points.sigma_m.copy()
    sigma[single] = 0.05
    start = network.points.xyz_m.copy()
    kept = (own.point != single) | (own.image == 0)
    table = ImagePoints(own.image[kept], own.point[kept], own.xy_mm[kept], own.sigma_mm[kept])
    points = replace(network.points, sigma_m=sigma)
    result = adjust(replace(network, points=points, image_points=table), AdjustmentSettings())
    assert np.linalg.norm(result.state.points[single] - start[single]) < 0.1


@pytest.mark.parametrize(
    ("function", "angle_deg", "seed"), [("huber", 0.1, 0), ("tukey", 0.05, 1), ("tukey", 0.1, 0)]
)
def test_robust_weights_set_weak_points_aside_or_refuse_the_block(
    function, angle_deg, seed
) -> None:
    network = _subset(seed, 8, angle_deg, 0.3 if seed else 0.0)
    table, random = network.image_points, np.random.default_rng(seed + 100)
    chosen = random.choice(np.arange(CONTROL, 80), 3, replace=False)
    wrong = np.isin(table.point, chosen) & (random.random(len(table.point)) < 0.5)
    xy = table.xy_mm.copy()
    xy[wrong] += random.normal(0.0, 0.5, (int(wrong.sum()), 2))
    network = completed(replace(network, image_points=replace(table, xy_mm=xy)))
    reported: list[str] = []
    settings = AdjustmentSettings(robust=True, weight_function=function)
    try:
        result = adjust(network, settings, progress=lambda what, *_: reported.append(what))
    except NetworkError as error:
        assert "nearly parallel" in str(error)
    else:
        assert result.sigma0 < 1.5
        assert result.left_out.sum() < 0.7 * len(network.points.names)
        # No blunder takes part.
        taken = wrong & ~result.rejected & ~result.left_out[table.point]
        assert not taken.any()
    assert any(what.startswith("weak points set aside") for what in reported)
