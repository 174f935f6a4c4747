"""Patterns of stitching: derivatives, reduction of a covariance, true sigmas of a block."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.equations import equations
from processing.bundle.frame_patterns import FramePatterns, monomials, patterns_of
from processing.bundle.network import Network, NetworkError
from processing.bundle.unknowns import apply_corrections, initial_values, layout_of
from processing.geometry.placement import vip_mm_from_raw
from processing.mosaic.precision import placed_covariance_px
from processing.mosaic.stitching_patterns import (
    patterns_from_json,
    patterns_json,
    stitching_patterns,
)
from tests.processing.bundle.simulated_networks import PARTS, aerial, with_everything
from tests.processing.mosaic.test_precision import mosaic_of

HALF_MM = 30.0


def _patterns(count: int, seed: int = 1) -> FramePatterns:
    coefficients = np.random.default_rng(seed).normal(0.0, 2e-3, (count, 2, 6, 2))
    return FramePatterns(PARTS, coefficients, HALF_MM, 1.0)


def test_derivatives_by_amplitudes_agree_with_differences() -> None:
    network = with_everything().network
    images = len(network.images.names)
    patterns = tuple(None if k == 2 else _patterns(1 + k % 3, k) for k in range(images))
    network = replace(network, patterns=patterns)
    layout = layout_of(network, np.zeros(len(network.points.names), dtype=bool))
    assert (layout.pattern[2] == -1).all() and layout.pattern.shape == (images, 3)
    state, weight = initial_values(network), np.ones(len(network.image_points.image))
    design = equations(network, layout, state, weight).reduced.toarray()
    none = np.zeros((len(layout.eliminated_points), 3))
    for column in layout.pattern[:4][layout.pattern[:4] >= 0]:
        dx = np.zeros(layout.columns)
        dx[column] = 1.0
        up = equations(network, layout, apply_corrections(state, layout, dx, none), weight)
        down = equations(network, layout, apply_corrections(state, layout, -dx, none), weight)
        numeric = -(up.misclosure - down.misclosure) / 2.0
        assert np.abs(design[:, column]).max() > 0.1
        assert numeric == pytest.approx(design[:, column], abs=1e-8)


def test_the_fewest_patterns_that_hold_99_percent_are_taken() -> None:
    random = np.random.default_rng(3)
    xy = random.uniform(-1.0, 1.0, (80, 2)) * [29.0, 19.0]
    part = (xy[:, 0] > 0.0).astype(np.int64)
    powers = monomials(xy / HALF_MM)
    fields = np.zeros((3, 80, 2))
    # Three patterns of the right half, the last far below one percent of the variance.
    for k, (power, size) in enumerate(((0, 3e-3), (3, 2e-3), (5, 1e-5))):
        fields[k, part == 1, k % 2] = size * powers[part == 1, power]
    flat = fields.reshape(3, -1)
    covariance = flat.T @ flat
    found = patterns_of(PARTS, part, xy, flat.T, HALF_MM)
    assert found.count == 2 and 0.99 < found.share < 1.0
    again = found.at(xy).reshape(160, 2)
    assert again @ again.T == pytest.approx(covariance, abs=2e-10)
    assert patterns_of(PARTS, part, xy, np.zeros((160, 4)), HALF_MM).count == 0
    many = patterns_of(PARTS, part, xy, np.eye(160) * 1e-3, HALF_MM)
    assert many.count == 8 and many.share == pytest.approx(8 / 160)


@pytest.mark.parametrize("rig_name", ["ultracam-x-mini", "ultracam-l-mini"])
def test_patterns_hold_the_covariance_of_a_mosaic(rig_name: str) -> None:
    rig, mosaic = mosaic_of(rig_name)
    patterns = stitching_patterns(rig, mosaic)
    assert 1 <= patterns.count <= 8
    again = patterns_from_json(json.loads(json.dumps(patterns_json(patterns))))
    assert again.parts == patterns.parts and again.share == pytest.approx(patterns.share)
    assert again.coefficients == pytest.approx(patterns.coefficients, rel=1e-6)
    name = rig.pan_cones[1].sensors[0].name
    sensor = next(s for s in rig.sensors if s.name == name)
    own = np.array([[0.3, 0.4], [0.6, 0.7]]) * [sensor.width_px, sensor.height_px]
    stated, _ = placed_covariance_px(rig, mosaic, {name: own}, {})
    stated = stated * mosaic.model.pitch_mm**2
    rows = patterns.at(vip_mm_from_raw(mosaic.placements[name], own)).reshape(4, -1)
    assert np.abs(rows @ rows.T - stated).max() < 0.25 * np.abs(stated).max()


def test_patterns_of_another_number_of_images_are_refused() -> None:
    network = with_everything().network
    with pytest.raises(NetworkError, match="1 patterns of stitching; one for each of"):
        adjust(replace(network, patterns=(_patterns(1),)))


def _stitched(seed: int) -> tuple[Network, np.ndarray]:
    """A block whose right image halves are displaced by shift and scale, frame by frame."""
    simulated = aerial(seed=seed, lines=2, along=5, points=220, sigma_mm=1e-3, disturb=0.5)
    random = np.random.default_rng([seed, 1])
    table = simulated.network.image_points
    shift = random.normal(0.0, 4e-3, (len(simulated.network.images.names), 2))
    stretch = random.normal(0.0, 3e-3, len(shift))
    xy = table.xy_mm.copy()
    right = xy[:, 0] > 0.0
    frame = table.image[right]
    xy[right] += shift[frame]
    xy[right, 0] += stretch[frame] * (table.xy_mm[right, 0] / HALF_MM) ** 2
    network = replace(simulated.network, image_points=replace(table, xy_mm=xy))
    return network, simulated.points


def _planted_patterns(images: int) -> tuple[FramePatterns, ...]:
    coefficients = np.zeros((3, 2, 6, 2))
    coefficients[0, 1, 0, 0] = coefficients[1, 1, 0, 1] = 4e-3
    coefficients[2, 1, 3, 0] = 3e-3
    return (FramePatterns(PARTS, coefficients, HALF_MM, 1.0),) * images


def _squares(network: Network, truth: np.ndarray) -> tuple[float, int]:
    rays = np.bincount(network.image_points.point, minlength=len(truth))
    free = np.isnan(network.points.sigma_m).all(axis=1)
    points = np.flatnonzero((rays >= 3) & free)[:60]
    names = tuple(network.points.names[k] for k in points)
    result = adjust(network, AdjustmentSettings(test="baarda", retained=names))
    points = points[~result.left_out[points]]
    columns = result.layout.retained_points[points].ravel()
    error = (result.state.points - truth)[points].ravel()
    covariance = result.cofactor[np.ix_(columns, columns)]
    return float(error @ np.linalg.solve(covariance, error)), len(error)


def test_points_of_stitched_images_err_as_stated_with_their_patterns_only() -> None:
    with_patterns, without, rank = 0.0, 0.0, 0
    for seed in (1, 2, 3):
        network, truth = _stitched(seed)
        own, count = _squares(
            replace(network, patterns=_planted_patterns(len(network.images.names))), truth
        )
        with_patterns, rank = with_patterns + own, rank + count
        without += _squares(network, truth)[0]
    low, high = chi2.ppf([0.0005, 0.9995], rank)
    assert low < with_patterns < high
    assert without > 2.0 * high
