"""Relative orientations of a block err as their covariance predicts, averaged or as parameters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.midas_block import network_of
from benchmarks.rig_calibration import EVERY, error_of, evaluate
from processing.bundle.adjust import adjust
from processing.calibration.relative_orientation import average_rotations, relative_orientations
from processing.geometry.rotation import rotations_from_vectors
from sim_hw.blocks.oblique import NADIR, TABLE_2_GRAD, simulate_oblique_block

GRAD = 200.0 / np.pi


@pytest.fixture(scope="module")
def runs():
    return [evaluate(seed) for seed in (1, 2)]


def test_errors_are_as_large_as_their_covariance_states(runs) -> None:
    squares, rank = sum(r[2] for r in runs), sum(3 * len(r[0].heads) for r in runs)
    low, high = chi2.ppf([0.0005, 0.9995], rank)
    assert low < squares < high
    for found, error, _ in runs:
        sigma = np.array([found.sigma_rad(k) for k in range(4)])
        assert (np.abs(error) < 4.0 * sigma).all()
        assert found.squares == pytest.approx(1.0, abs=0.5), "the rig did not move"


def test_the_table_of_the_paper_comes_back_in_grads_with_phi_first(runs) -> None:
    for found, _, _ in runs:
        assert {head.head for head in found.heads} == set(TABLE_2_GRAD)
        for k, head in enumerate(found.heads):
            angles, sigma = found.angles(k)
            off = angles * GRAD - np.array(TABLE_2_GRAD[head.head])
            assert (np.abs(off) < 4.5 * sigma * GRAD).all(), head.head
            assert 8 <= head.exposures <= 12


def test_heads_as_parameters_give_the_same_within_their_sigmas(runs) -> None:
    averages, _, _ = runs[0]
    block = simulate_oblique_block(1)
    found = relative_orientations(adjust(network_of(block, EVERY, own=False)), NADIR)
    assert np.isnan(found.squares) and len(found.heads) == 4
    error = error_of(found, block)
    squares = error.ravel() @ np.linalg.solve(found.covariance, error.ravel())
    assert squares < chi2.ppf(0.9995, 12)
    for k, head in enumerate(found.heads):
        other = [h.head for h in averages.heads].index(head.head)
        # One attitude less for each image: no less certain than averages.
        assert (found.sigma_rad(k) < 1.05 * averages.sigma_rad(other)).all()


def test_a_head_that_moved_within_the_block_shows() -> None:
    random = np.random.default_rng(1)
    n, sigma = 10, 1e-4
    rotation = rotations_from_vectors(random.normal(0.0, 0.3, (n, 3)))
    mounted = rotations_from_vectors(np.array([[0.7, 0.1, -0.2]]))[0]
    shaken = rotations_from_vectors(random.normal(0.0, sigma, (n, 3)))
    head = np.zeros(n, dtype=np.int64)
    covariance = np.kron(np.eye(n), np.diag([1e-14] * 3 + [sigma**2] * 3))
    still, own, off = average_rotations(rotation, rotation @ mounted @ shaken, head, covariance, 1)
    assert np.abs(still[0] - mounted).max() < 4.0 * sigma / np.sqrt(n)
    assert np.sqrt(np.diag(own)) == pytest.approx(sigma / np.sqrt(n), rel=1e-3)
    assert off.std() < 1.5 * sigma
    step = np.where(np.arange(n)[:, None] < n // 2, 0.0, 10.0 * sigma) * [1.0, 0.0, 0.0]
    moved = rotation @ mounted @ rotations_from_vectors(step) @ shaken
    _, _, off = average_rotations(rotation, moved, head, covariance, 1)
    assert np.mean(off**2) / sigma**2 > 4.0


def test_a_camera_that_is_not_there_is_named() -> None:
    result = adjust(network_of(simulate_oblique_block(1), (0,), own=False))
    with pytest.raises(ValueError, match="no camera 'zenith'; there are nadir"):
        relative_orientations(result, "zenith")
    with pytest.raises(ValueError, match="no exposure has an image of the reference camera"):
        relative_orientations(result, NADIR)
