"""Constrained least squares on a levelling net small enough to check by hand."""

from __future__ import annotations

import numpy as np
import pytest

from processing.mosaic.adjustment import (
    ObservationBlock,
    normal_equations,
    redundancy_numbers,
    solve,
)

ALL = np.arange(3, dtype=np.int64)
# Heights a, b, c; measured b - a = 1.0, c - b = 2.0, c - a = 3.3.
LOOP = ObservationBlock(
    columns=ALL,
    design=np.array([[-1.0, 0.0, -1.0], [1.0, -1.0, 0.0], [0.0, 1.0, 1.0]]),
    misclosure=np.array([1.0, 2.0, 3.3]),
    weight=np.ones(3),
)


def test_a_free_levelling_loop_shares_its_misclosure_and_centres_on_the_datum() -> None:
    normal, right = normal_equations([LOOP], 3)
    found = solve(
        normal, right, np.ones((1, 3)), np.zeros(1), fixed_at=np.zeros(3), min_information=1e-6
    )
    # The misclosure of 0.3 goes in thirds: b - a = 1.1, c - b = 2.1, c - a = 3.2.
    assert found.dp == pytest.approx((-4.3 / 3, -1.0 / 3, 5.3 / 3))
    assert found.dp.sum() == pytest.approx(0.0, abs=1e-12)
    assert (found.rank, found.constrained_rank) == (2, 3)
    assert found.undetermined.shape == (3, 0)
    # Three observations, two unknowns: a third of redundancy each.
    assert redundancy_numbers(LOOP, found.cofactor) == pytest.approx((1 / 3, 1 / 3, 1 / 3))


def test_an_unobserved_unknown_is_held_and_the_others_do_not_notice() -> None:
    normal, right = normal_equations([LOOP], 4)
    constraint = np.array([[1.0, 1.0, 1.0, 0.0]])
    found = solve(
        normal, right, constraint, np.zeros(1), fixed_at=np.full(4, 7.0), min_information=0.04
    )
    assert found.dp[:3] == pytest.approx((-4.3 / 3, -1.0 / 3, 5.3 / 3))
    assert found.dp[3] == pytest.approx(7.0)
    assert found.cofactor[3, 3] == pytest.approx(25.0)
    assert np.abs(found.undetermined[3]) == pytest.approx((1.0,))


def test_constraints_that_repeat_each_other_are_refused() -> None:
    normal, right = normal_equations([LOOP], 3)
    with pytest.raises(ValueError, match="each condition once"):
        solve(
            normal,
            right,
            np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]]),
            np.zeros(2),
            fixed_at=np.zeros(3),
            min_information=1e-6,
        )
