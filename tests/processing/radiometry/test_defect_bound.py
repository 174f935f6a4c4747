"""The least error of any linear prediction: through the spectrum as by elimination."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.defect_bound import KINDS, bounds

SIDE = 8
MISSING = {
    "single": [(3, 4)],
    "column": [(row, 4) for row in range(SIDE)],
    "3 x 3": [(2 + k // 3, 3 + k % 3) for k in range(9)],
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_bound_is_what_eliminating_all_other_pixels_leaves(kind: str) -> None:
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(SIDE, 1.0 / SIDE)] * 2))
    spectrum = 60.0 / (1.0 + frequency) ** 2
    spectrum[1, :] *= 0.3  # rows are not columns
    spectrum[-1, :] *= 0.3
    by_lag = np.fft.ifft2(spectrum + 1.0).real
    places = [divmod(k, SIDE) for k in range(SIDE * SIDE)]
    covariance = np.array([[by_lag[a - c, b - d] for c, d in places] for a, b in places])
    missing = np.array([places.index(place) for place in MISSING[kind]])
    rest = np.setdiff1d(np.arange(len(places)), missing)
    across = covariance[np.ix_(missing, rest)]
    predicted = across @ np.linalg.solve(covariance[np.ix_(rest, rest)], across.T)
    left = np.mean(np.diag(covariance[np.ix_(missing, missing)] - predicted)) - 1.0
    assert bounds(spectrum)[kind] == pytest.approx(math.sqrt(left), rel=1e-9)


def test_light_without_any_detail_leaves_nothing_and_detail_without_neighbours_all() -> None:
    even = np.zeros((SIDE, SIDE))
    even[0, 0] = 1e9
    assert bounds(even)["single"] < 0.2
    assert bounds(np.full((SIDE, SIDE), 4.0)) == pytest.approx(dict.fromkeys(KINDS, 2.0))
