"""How much exposures of a flight differ from their neighbours, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from processing.mosaic.flight_series import ContrastSeries, variance_factor


def series(count: int, scale: float = 1.0) -> ContrastSeries:
    """Steps of 3, 4, 5, ... between exposures of variances 1, 2, 3, ..."""
    y = scale * np.cumsum([0.0, *np.arange(3.0, 2.0 + count)])[:, None]
    variances = np.arange(1.0, count + 1.0)[:, None, None]
    return ContrastSeries(tuple(range(count)), y, variances, np.zeros(count))


def test_the_factor_is_the_median_square_of_steps_over_the_variances_of_both_exposures() -> None:
    # 9 / 3, 16 / 5, 25 / 7, 36 / 9
    expected = (16 / 5 + 25 / 7) / 2.0 / chi2.ppf(0.5, 1)
    assert variance_factor(series(5)) == pytest.approx(expected)
    # 9 / 3, 16 / 5, 25 / 7
    assert variance_factor(series(4)) == pytest.approx(16 / 5 / chi2.ppf(0.5, 1))


def test_the_factor_is_at_least_one_and_needs_four_exposures() -> None:
    assert variance_factor(series(5, 0.01)) == 1.0
    assert variance_factor(series(3)) == 1.0
