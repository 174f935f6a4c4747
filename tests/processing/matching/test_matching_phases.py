"""Matching over sub-pixel phases in x and y, with photon noise and images of unequal sharpness."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.matching_phases import RATIO, Case, run

CASES = {
    "PAN in half light": Case(1, 0.5, 0.15, 0.3, 0.0),
    "PAN, one lens softer": Case(1, 0.2, 0.15, 0.3, 0.4),
    "PAN to green": Case(RATIO, 0.5, 0.15, 0.3, 0.0),
    "PAN to green, green soft": Case(RATIO, 0.5, 0.15, 0.3, 0.6),
    "PAN to green, dim and soft": Case(RATIO, 0.05, 0.15, 0.12, 0.3),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_no_phase_draws_matches_and_the_sigma_is_the_true_one(case: Case) -> None:
    found = run(case, phases=3, size=640 if case.ratio == 1 else 1100)
    chance = 3.5 * found.noise_of_means
    assert found.largest_mean < 0.01
    assert found.largest_mean < chance + 0.004
    assert found.predicted_sigma / found.true_sigma == pytest.approx(1.0, abs=0.2)
    assert found.inside_3 > 0.985
    assert found.accepted > 0.9


def test_sharpness_costs_next_to_nothing_where_nothing_of_it_is_lost() -> None:
    """Green that is softer by half of its pixel has twice the position error, not ten times."""
    equal_sharpness, soft = (
        run(Case(RATIO, 0.5, 0.15, 0.3, blur), phases=2, size=800) for blur in (0.0, 0.6)
    )
    assert soft.true_sigma < 2.0 * equal_sharpness.true_sigma
    assert np.abs(soft.means).max() < 0.005
