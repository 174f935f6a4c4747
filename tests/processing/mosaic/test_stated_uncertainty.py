"""Stated accuracy against the emulator's truth, with errors of matching measured on renderings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import uncertainty_consistency
from benchmarks.stitching_samples import MatchingErrors, StitchedSample, tie_point_errors
from processing.matching.tie_points import PAN_TO_PAN

ERRORS = Path(__file__).parent / "matching_errors.npz"
"""Of two rendered exposures: `python -m benchmarks.uncertainty_consistency --save-errors` writes
it."""
EXPOSURES = 16

pytestmark = pytest.mark.timeout(600)

Pairs = list[tuple[StitchedSample, StitchedSample]]
Pools = dict[str, list[uncertainty_consistency.NormalizedErrors]]


@pytest.fixture(scope="module")
def stitched() -> Pairs:
    errors = MatchingErrors.load(ERRORS)
    return [uncertainty_consistency.draw(errors, k) for k in range(EXPOSURES)]


@pytest.fixture(scope="module")
def held(stitched: Pairs) -> Pools:
    return uncertainty_consistency.normalize_samples([noisy for noisy, _ in stitched])


@pytest.mark.parametrize("what", ["check points, inner", "check points, absolute"])
def test_errors_of_image_points_are_as_large_as_stated(held: Pools, what: str) -> None:
    pool = uncertainty_consistency.pooled(held[what])
    assert pool.rank == (44 if what.endswith("inner") else 48)
    assert pool.low < pool.mean_square < pool.high
    assert pool.inside_3 > 0.99
    assert pool.largest < 5.0


def test_all_unknowns_are_as_good_as_their_covariance_states(stitched: Pairs) -> None:
    pool = uncertainty_consistency.pooled(
        [uncertainty_consistency.parameters(*pair) for pair in stitched]
    )
    assert pool.rank == 52
    assert pool.low < pool.mean_square < pool.high
    assert pool.inside_3 > 0.99


def test_the_truth_is_taken_from_the_emulator_and_not_from_the_stitching(stitched: Pairs) -> None:
    """The drawn points carry the measured errors, and nothing besides, against the true camera."""
    noisy, quiet = stitched[0]
    pan = noisy.tie_points.kind == PAN_TO_PAN
    large, small = (
        float(np.median(np.abs(tie_point_errors(sample)[pan]))) for sample in (noisy, quiet)
    )
    assert 0.005 < large < 0.05
    assert small == pytest.approx(uncertainty_consistency.REFERENCE_SHARE * large, rel=0.01)


def test_a_covariance_that_is_half_of_what_it_should_be_is_found_out(held: Pools) -> None:
    boastful = [
        uncertainty_consistency.NormalizedErrors(
            h.whitened * 2**0.5, h.normalised, h.error_px, h.sigma_px
        )
        for h in held["check points, inner"]
    ]
    assert not uncertainty_consistency.pooled(boastful).is_consistent
