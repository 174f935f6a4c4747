"""How small a displaced master sensor is found, rightly named, and how seldom a healthy one is."""

from __future__ import annotations

import pytest

from benchmarks.displacement_power import Outcomes, ideal
from benchmarks.stitching_samples import MatchingErrors
from processing.rig import find_rig
from tests.processing.mosaic.test_stated_uncertainty import ERRORS

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def outcomes() -> Outcomes:
    return Outcomes(MatchingErrors.load(ERRORS))


def test_error_free_exposures_name_a_sensor_in_two_of_a_thousand_at_most(
    outcomes: Outcomes,
) -> None:
    assert outcomes.false_alarms(3000) <= 6


def test_fifteen_hundredths_of_a_pixel_are_found_with_the_power_of_the_design(
    outcomes: Outcomes,
) -> None:
    """At the temperature of calibration: the sigma of the drift coefficients grows with dC."""
    power = outcomes.power(dc_k=0.0, length_px=0.15, exposures=1000)
    assert power.found > 0.8
    assert power.found > power.ideal_found - 0.1


@pytest.mark.parametrize("dc_k", [0.0, 10.0])
def test_at_twice_that_the_right_sensor_is_named(outcomes: Outcomes, dc_k: float) -> None:
    power = outcomes.power(dc_k=dc_k, length_px=0.30, exposures=400)
    assert power.named > 0.95


@pytest.mark.parametrize("off_k", [4.0, 16.0])
def test_no_sensor_is_named_for_the_bias_of_a_probe(outcomes: Outcomes, off_k: float) -> None:
    rates = outcomes.probe_bias(0.0, off_k, exposures=300, flights=2)
    assert rates.misattributed + rates.either <= 0.01 and rates.flights_misattributed == 0.0
    assert rates.named > (0.1 if off_k < 10.0 else 0.95)


def test_the_best_test_there_is_finds_little_more() -> None:
    found, named = ideal(find_rig("ultracam-x"), dc_k=0.0, length_px=0.15)
    assert 0.9 < found < 0.96
    assert 0.84 < named < 0.9
