"""Which exposures of a flight are left out, and which cones are judged, by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import chi2

from processing.mosaic.flight_series import ContrastSeries, variance_factor
from processing.mosaic.flight_validity import FlightSettings, _without_outliers, evaluate_flight
from processing.rig import find_rig

SETTINGS = FlightSettings()
MINI = find_rig("ultracam-x-mini")


def series(y: list[float], variance: float = 1.0) -> ContrastSeries:
    count = len(y)
    covariance = np.full((count, 1, 1), variance)
    return ContrastSeries(
        tuple(range(count)), np.array(y)[:, None], covariance, np.arange(float(count))
    )


def limit(neighbours: int) -> float:
    """How far an exposure may be from the median of so many neighbours on one side."""
    spread = 1.0 + math.pi / 2.0 / neighbours
    return math.sqrt(float(chi2.isf(SETTINGS.outlier_alpha, 1)) * spread)


@pytest.mark.parametrize(("share", "dropped"), [(0.99, ()), (1.01, (10,))])
def test_an_exposure_is_as_far_from_its_neighbours_as_the_median_of_them_allows(
    share: float, dropped: tuple[int, ...]
) -> None:
    y = [0.0] * 21
    y[10] = share * limit(SETTINGS.neighbours)
    contrast_series = series(y)
    assert variance_factor(contrast_series) == 1.0
    retained, found = _without_outliers(contrast_series, SETTINGS)
    assert found == dropped
    assert retained.numbers == tuple(n for n in range(21) if n not in dropped)
    assert retained.y.ravel().tolist() == [y[n] for n in retained.numbers]
    assert retained.dc_k.tolist() == [float(n) for n in retained.numbers]
    assert retained.covariance.shape == (len(retained.numbers), 1, 1)


@pytest.mark.parametrize("at", [0, 1, 19, 20])
@pytest.mark.parametrize(("share", "out"), [(0.99, False), (1.01, True)])
def test_at_an_end_one_side_decides(at: int, share: float, out: bool) -> None:
    """One neighbour alone is not asked."""
    y = [0.0] * 21
    y[at] = share * limit(SETTINGS.neighbours)
    _, found = _without_outliers(series(y), SETTINGS)
    assert found == ((at,) if out else ())


def test_a_step_leaves_no_exposure_out() -> None:
    _, found = _without_outliers(series([0.0] * 10 + [50.0] * 10), SETTINGS)
    assert found == ()


def test_two_exposures_are_too_few_to_evaluate_each_other() -> None:
    _, found = _without_outliers(series([0.0, 100.0]), SETTINGS)
    assert found == ()


def test_a_noisy_flight_has_a_wider_limit() -> None:
    rng = np.random.default_rng(2)
    y = rng.normal(0.0, 10.0, 40)
    retained, _ = _without_outliers(series(y.tolist()), SETTINGS)
    assert len(retained.numbers) > 36


@pytest.mark.parametrize(
    ("sensors", "cones"), [(4, {"0", "1", "2"}), (3, {"0", "1", "2"}), (2, {"1", "2"})]
)
def test_three_sensors_of_the_master_and_two_of_others_are_evaluated(
    sensors: int, cones: set[str]
) -> None:
    master = dataclasses.replace(MINI.cone("0"), sensors=MINI.cone("0").sensors[:sensors])
    rig = dataclasses.replace(MINI, cones=tuple(master if c.name == "0" else c for c in MINI.cones))
    assert set(evaluate_flight(rig, {}).exposures) == cones
