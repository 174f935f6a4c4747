"""Bins of residuals along an axis: the same as numpy's own functions give, step by step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.mosaic.slip_bins import (
    MEDIAN_EFFICIENCY_FACTOR,
    bin_residuals,
    level_of,
    order_along,
    points_of_frame,
    shifted_runs,
)

Array = NDArray[Any]
PER = 7


@pytest.mark.parametrize("seed", range(5))
def test_the_order_is_that_of_a_stable_sort(seed: int) -> None:
    random = np.random.default_rng(seed)
    at = np.round(random.uniform(-3.0, 103.0, 700), seed % 3)
    assert np.array_equal(order_along(at, 100), np.argsort(at, kind="stable"))


def test_residuals_are_seen_from_the_frame_that_is_searched() -> None:
    a, b = np.array([0, 1, 2, 0]), np.array([1, 0, 1, 2])
    raw_a, raw_b = np.arange(8.0).reshape(4, 2), 10.0 + np.arange(8.0).reshape(4, 2)
    residuals = np.ones((4, 2))
    usable = np.array([True, True, True, False])
    rows, raw, own = points_of_frame(a, b, raw_a, raw_b, residuals, usable, 0)
    assert rows.tolist() == [0, 1]
    assert raw.tolist() == [raw_a[0].tolist(), raw_b[1].tolist()]
    assert own.tolist() == [[1.0, 1.0], [-1.0, -1.0]]


def test_bins_have_medians_and_running_sums() -> None:
    residuals, sigma = _residuals(40)
    shuffled = np.random.default_rng(5).permutation(len(sigma))
    order = np.argsort(shuffled)
    medians, sums, weight = bin_residuals(residuals[shuffled], sigma[shuffled], order, PER)
    level = level_of(medians)
    information = np.sum(1.0 / sigma.reshape(-1, PER) ** 2, axis=1)
    assert np.array_equal(medians, np.median(residuals.reshape(-1, PER, 2), axis=1))
    assert np.array_equal(level, np.median(medians, axis=0))
    assert np.array_equal(weight[1:], np.cumsum(information)) and weight[0] == 0.0
    assert np.array_equal(sums[1:], np.cumsum(medians * information[:, None], axis=0))


@pytest.mark.parametrize("bins", [2, 3, 4, 9, 40, 351])
def test_the_most_shifted_run_of_each_width_is_found(bins: int) -> None:
    residuals, sigma = _residuals(bins)
    residuals[: bins * PER // 3] += 0.4
    medians, sums, weight = bin_residuals(residuals, sigma, np.arange(len(sigma)), PER)
    level = level_of(medians)
    found = shifted_runs(sums, weight, level, 2.0)
    assert found == pytest.approx(np.array(_expected(sums, weight, level, 2.0)).reshape(-1, 3))
    assert len(found) > 0 or bins == 2


def _residuals(bins: int) -> tuple[Array, Array]:
    random = np.random.default_rng(bins)
    return random.normal(0.0, 0.1, (bins * PER, 2)), random.uniform(0.05, 0.2, bins * PER)


def _expected(sums: Array, weight: Array, level: Array, limit: float) -> list[list[float]]:
    """First bin, width and score, one array operation for each width."""
    bins = len(weight) - 1
    widths = [2] if bins > 2 else []
    while widths and (width := max(widths[-1] + 1, math.ceil(widths[-1] * 1.2))) <= (bins + 1) // 2:
        widths.append(width)
    runs = []
    for width in widths:
        held = weight[width:] - weight[:-width]
        inside = sums[width:] - sums[:-width]
        mean = inside / held[:, None]
        rest = (sums[-1] - inside) / (weight[-1] - held)[:, None]
        reach = np.maximum(np.abs(mean - level), np.abs(mean - rest)).max(axis=1)
        scores = reach * np.sqrt(held) / MEDIAN_EFFICIENCY_FACTOR
        if scores.max() > limit:
            runs.append([float(np.argmax(scores)), float(width), float(scores.max())])
    return runs
