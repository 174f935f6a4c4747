"""Data snooping: blunders of every kind are found to the end, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.postflight.importers.dbat import import_dbat
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.data_snooping import names_of
from processing.bundle.initial_values import completed
from processing.bundle.network import Distances, ImagePoints, Network
from tests.processing.bundle.simulated_networks import aerial, with_everything

CAMCAL = Path(__file__).parent / "data" / "dbat-camcal" / "camcaldemo.xml"
DELTA = 4.0 + 0.8416
"""Limit 4, found with a probability of 80 %."""


@pytest.fixture(scope="module")
def strip() -> Network:
    """Nine images with GNSS positions."""
    return aerial(seed=1, sigma_mm=2e-3, lines=3, along=4, points=160, gnss_sigma_m=0.05).network


def spoiled(
    network: Network, size_mm: float, seed: int, share: float = 0.02
) -> tuple[Network, NDArray[np.float64]]:
    """A share of the image points displaced by one length in any direction, and the
    displacements."""
    random = np.random.default_rng(seed)
    table = network.image_points
    count = len(table.image)
    error = np.zeros((count, 2))
    wrong = random.choice(count, round(share * count), replace=False)
    angle = random.uniform(0.0, 2.0 * np.pi, len(wrong))
    error[wrong] = size_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return replace(network, image_points=replace(table, xy_mm=table.xy_mm + error)), error


def controllable(clean: Adjustment, error: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Blunders above 1.5 times what can be detected, in points of three rays or more."""
    network, rows = clean.network, clean.equations
    detectable = np.full(error.shape, np.inf)
    for axis in range(2):
        own = rows.group == axis
        share = np.sqrt(np.clip(clean.redundancy_number[own], 1e-9, None))
        detectable[rows.source[own], axis] = DELTA * clean.sigma0 * rows.sigma[own] / share
    rays = np.bincount(network.image_points.point, minlength=len(network.points.names))
    large = (np.abs(error) > 1.5 * detectable).any(axis=1)
    return np.asarray(large & (rays[network.image_points.point] >= 3))


@pytest.mark.parametrize("robust", [False, True])
def test_blunders_of_50_pixels_in_two_percent_are_found_in_few_rounds(strip, robust) -> None:
    clean = adjust(strip)
    for seed in range(3):
        network, error = spoiled(strip, 0.3, seed)
        wanted = controllable(clean, error)
        result = adjust(network, AdjustmentSettings(robust=robust, reject_beyond=4.0))
        assert wanted.sum() > 5
        assert result.rejected[wanted].all()
        assert not result.problems
        assert result.rounds <= 15
        rays = np.bincount(strip.image_points.point)[strip.image_points.point]
        innocent = (error == 0.0).all(axis=1) & (rays >= 3)
        # Huber weights may take two rays of three: what is left cannot be compared any more.
        assert result.rejected[innocent].sum() <= (3 if robust else 1)
        assert result.excluded.others == 0
        assert result.sigma0 == pytest.approx(clean.sigma0, abs=0.05)


def test_blunders_in_a_published_calibration_are_found() -> None:
    network = completed(import_dbat(CAMCAL).network)
    clean = adjust(network)
    spoilt, error = spoiled(network, 50.0 * 0.0033, 1)
    result = adjust(spoilt, AdjustmentSettings(reject_beyond=5.0))
    wanted = controllable(clean, error)
    assert result.rejected[wanted].mean() >= 0.99
    assert not result.problems


def test_a_limit_of_rounds_is_a_stated_problem(strip) -> None:
    network, _ = spoiled(strip, 0.3, 1, share=0.1)
    result = adjust(network, AdjustmentSettings(reject_beyond=4.0, max_rounds=1))
    (problem,) = result.problems
    assert problem.startswith("data snooping ended after 1 rounds with ")


def test_a_control_point_off_by_ten_metres_is_named_and_no_image_point(strip) -> None:
    xyz = strip.points.xyz_m.copy()
    xyz[3, 0] += 10.0
    network = replace(strip, points=replace(strip.points, xyz_m=xyz))
    result = adjust(network, AdjustmentSettings(reject_beyond=4.0))
    assert names_of(network, result.excluded) == ("control point p3 X",)
    assert not result.rejected.any()
    assert result.sigma0 == pytest.approx(adjust(strip).sigma0, abs=0.03)


@pytest.fixture(scope="module")
def noisy() -> Network:
    """Two heads with GNSS, attitudes and distances, all of them noisy."""
    network = with_everything().network
    random = np.random.default_rng(5)
    table, gnss = network.image_points, network.gnss
    tied = np.array([[20, 30], [40, 1], [2, 3], [4, 5], [6, 7]])
    xyz = with_everything().points
    length = np.linalg.norm(xyz[tied[:, 0]] - xyz[tied[:, 1]], axis=1)
    distances = Distances(
        tied[:, 0], tied[:, 1], length + random.normal(0, 0.01, 5), np.full(5, 0.01)
    )
    return replace(
        network,
        image_points=replace(table, xy_mm=table.xy_mm + random.normal(0, 1e-3, table.xy_mm.shape)),
        gnss=replace(gnss, position_m=gnss.position_m + random.normal(0, 0.05, (9, 3))),
        distances=distances,
    )


def test_a_gnss_position_an_attitude_and_a_distance_are_named(noisy) -> None:
    settings = AdjustmentSettings(reject_beyond=4.5)
    assert adjust(noisy, settings).excluded.count == 0
    position = noisy.gnss.position_m.copy()
    position[4, 2] += 5.0
    wrong = replace(noisy, gnss=replace(noisy.gnss, position_m=position))
    assert names_of(noisy, adjust(wrong, settings).excluded) == ("GNSS position of e4 Z",)
    length = noisy.distances.distance_m.copy()
    length[2] += 1.0
    wrong = replace(noisy, distances=replace(noisy.distances, distance_m=length))
    assert names_of(noisy, adjust(wrong, settings).excluded) == ("distance p2 to p3",)
    turn = np.array([[1.0, -0.05, 0.0], [0.05, 1.0, 0.0], [0.0, 0.0, 1.0]])
    rotation = noisy.measured_attitudes.rotation.copy()
    rotation[6] = rotation[6] @ turn
    measured = replace(noisy.measured_attitudes, rotation=rotation)
    found = adjust(replace(noisy, measured_attitudes=measured), settings).excluded
    assert names_of(noisy, found) == ("attitude of e6 about z",)


@pytest.mark.parametrize("robust", [False, True])
def test_ends_of_distances_without_rays_left_do_not_stop_the_block(robust) -> None:
    block = aerial(seed=4, sigma_mm=1e-3, points=80, control=10)
    network, table = block.network, block.network.image_points
    rays = np.bincount(table.point, minlength=80)
    seen_twice = int(np.flatnonzero((rays == 2) & (np.arange(80) >= 10))[0])
    once = int(np.flatnonzero((rays >= 3) & (np.arange(80) >= 10))[0])
    others = np.flatnonzero((rays >= 4) & (np.arange(80) >= 10))[-2:]
    ends = np.array([[seen_twice, others[0]], [once, others[1]], [others[0], others[1]]])
    length = np.linalg.norm(block.points[ends[:, 0]] - block.points[ends[:, 1]], axis=1)
    xy = table.xy_mm.copy()
    # A parallax across the base: no place fits both rays, and it cannot be decided which is wrong.
    xy[np.flatnonzero(table.point == seen_twice)[0], 1] += 1.0
    taken = (table.point != once) | (np.cumsum(table.point == once) == 1)
    network = replace(
        network,
        image_points=ImagePoints(
            table.image[taken], table.point[taken], xy[taken], table.sigma_mm[taken]
        ),
        distances=Distances(ends[:, 0], ends[:, 1], length, np.full(3, 0.02)),
    )
    # One ray and one distance intersect: with the distance left out the point has no place.
    unused = replace(network.distances, sigma_m=np.array([0.02, np.inf, 0.02]))
    alone = replace(network, distances=unused)
    result = adjust(alone, AdjustmentSettings(reject_beyond=4.5, robust=robust))
    assert result.sigma0 == pytest.approx(1.0, abs=0.3)
    assert set(np.flatnonzero(result.left_out)) >= {seen_twice, once}
    assert not result.left_out[others].any()
    kept = next(g for g in result.groups if g.name == "distance")
    assert kept.count == 1
    assert adjust(network, AdjustmentSettings(reject_beyond=4.5, robust=robust)).redundancy > 0
