"""Tie points on vehicles: what the rejected ones state of those that were not rejected."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic import moving_objects
from processing.mosaic.adjustment import ObservationBlock
from processing.mosaic.free_mosaic import Mosaic, free_mosaic
from processing.mosaic.moving_objects import one_sided_shifts, shifted_cofactor
from processing.mosaic.weights import MosaicSettings, TiePointGroup
from processing.rig import find_rig
from tests.processing.synthetic import make_truth, tie_points_of

Array = NDArray[np.float64]
MINI = find_rig("ultracam-x-mini")
SETTINGS = MosaicSettings()
ROADS = (0, 2, 4, 6)
"""Pairs of PAN sensors whose overlap is a motorway."""
COUNTS = {"per_overlap": 120, "per_sensor": 200}


def group_of(across: Array, along: Array) -> TiePointGroup:
    """A pair of sensors whose points are off by so many sigmas in x and y."""
    difference = 0.5 * np.column_stack([across, along])
    count = len(difference)
    return TiePointGroup(
        a="A",
        b="B",
        kind=PAN_TO_PAN,
        rows=np.arange(count),
        corrected_a=np.column_stack([np.arange(count) % 2, np.arange(count) // 2 % 2]) * 4.0,
        corrected_b=np.zeros((count, 2)),
        sigma=np.full(count, 0.5),
        difference=difference,
        redundancy=np.ones((count, 2)),
        factor=(np.abs(along) <= SETTINGS.outlier_limit).astype(np.float64),
    )


def alternating(count: int) -> Array:
    """Residuals of healthy points: their median size is that of a standard deviation of one."""
    return np.where(np.arange(count) % 2, 1.0, -1.0) / 1.4826


def test_rejected_points_of_one_sign_show_how_many_were_not_rejected() -> None:
    rejected = np.array([5.0] * 8 + [7.0] * 7 + [20.0] * 9)
    along = np.concatenate([alternating(200), rejected])
    road = group_of(alternating(224), along)
    healthy = group_of(alternating(200), alternating(200))
    found, nothing = one_sided_shifts([road, healthy], SETTINGS)
    # 15 points in 4 sigmas; 4 sigmas within the limit have a mean of 2; 200 points are in use.
    assert found == pytest.approx([0.0, 1.5 * 15.0 / 4.0 * 4.0 * 2.0 / 200.0])
    assert nothing == pytest.approx([0.0, 0.0])
    opposite = group_of(alternating(224), -along)
    assert one_sided_shifts([opposite], SETTINGS)[0] == pytest.approx(found)


def test_blunders_of_both_signs_and_few_ones_shift_nothing() -> None:
    both = np.concatenate([alternating(200), [5.0] * 12, [-6.0] * 12])
    few = np.concatenate([alternating(200), [5.0] * 8])
    for along in (both, few):
        group = group_of(alternating(len(along)), along)
        assert one_sided_shifts([group], SETTINGS)[0] == pytest.approx([0.0, 0.0])


def test_a_common_shift_goes_through_the_adjustment() -> None:
    group = group_of(alternating(8), alternating(8))
    rng = np.random.default_rng(3)
    design, root = rng.standard_normal((2, 16)), rng.standard_normal((3, 3))
    block = ObservationBlock(np.array([0, 2]), design, np.zeros(16), np.ones(16))
    cofactor = root @ root.T
    shift = np.array([0.0, 0.7])
    found = shifted_cofactor([group], [block], cofactor, np.array([2.0]), [shift])
    expected = np.zeros((3, 3))
    full = np.zeros((3, 16))
    full[[0, 2]] = design
    signs = np.where(group.corrected_a > 0.0, 1.0, -1.0)
    for pattern in (np.ones(8), signs[:, 0], signs[:, 1]):
        # Sigmas are 0.5 times 2; a shift of 0.7 sigmas weighs 0.7 over the sigma.
        moved = cofactor @ full @ np.concatenate([np.zeros(8), 0.7 * pattern])
        expected += np.outer(moved, moved)
    np.testing.assert_allclose(found, expected)
    nothing = shifted_cofactor([group], [block], cofactor, np.array([2.0]), [np.zeros(2)])
    assert not nothing.any()


def test_over_motorways_errors_are_as_large_as_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    stated, without = [], []
    for seed in range(6):
        rng = np.random.default_rng([seed, 5])
        truth = make_truth(MINI, rng)
        points = with_traffic(tie_points_of(truth, rng, **COUNTS, sigma_pp_px=0.02), rng)
        exact = tie_points_of(truth, rng, **COUNTS, sigma_pp_px=1e-7, sigma_pc_px=1e-7)
        reference = free_mosaic(MINI, truth.start, exact)
        stated.append(normalised_square(free_mosaic(MINI, truth.start, points), reference))
        with monkeypatch.context() as patch:
            patch.setattr(moving_objects, "PARTLY_COVERED", 0.0)
            without.append(normalised_square(free_mosaic(MINI, truth.start, points), reference))
    assert 0.5 < np.mean(stated) < 1.2, stated
    assert np.mean(without) > 2.0 * np.mean(stated), without


def normalised_square(mosaic: Mosaic, reference: Mosaic) -> float:
    """Mean square of the errors of the unknowns against their stated covariance."""
    units = mosaic.model.units
    error = (mosaic.values - reference.values) / units
    eigenvalues, directions = np.linalg.eigh(mosaic.covariance / np.outer(units, units))
    good = eigenvalues > 1e-9 * eigenvalues[-1]
    return float(np.mean((directions[:, good].T @ error) ** 2 / eigenvalues[good]))


def with_traffic(points: TiePoints, rng: np.random.Generator) -> TiePoints:
    """Of points of motorways 60 % are off along the flight, from nothing to 0.5 px."""
    raw = points.raw_b.copy()
    for pair in ROADS:
        rows = np.flatnonzero(points.overlap == pair)
        rows = rows[rng.uniform(size=len(rows)) < 0.6]
        raw[rows, 1] += rng.uniform(0.0, 0.5, len(rows)) * np.where(pair % 4, 1.0, -1.0)
    return dataclasses.replace(points, raw_b=raw)
