"""Balance between heads and seams, on node means with a known truth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.image.balance import NOT_COVERED, UNUSABLE, balance_gains
from processing.image.resampling import WEIGHT_STEP_PX, WEIGHT_UNIT
from processing.image.seams import seam_labels, seam_weights, sensor_rows

ROWS, COLUMNS = 90, 130
# Three by three sensors, overlapping by 12 nodes.
STARTS_R, STARTS_C = (0, 26, 52), (0, 40, 80)
HIGH, WIDE = 38, 50
NAMES = tuple("ABCDEFGHI")


def node_means(gains: NDArray[np.float64] | None = None, seed: int = 1) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    ground = 6000 + 2000 * np.sin(np.indices((ROWS, COLUMNS)).sum(axis=0) / 7)
    means = np.full((9, ROWS, COLUMNS), NOT_COVERED, np.float32)
    for k in range(9):
        r, c = STARTS_R[k // 3], STARTS_C[k % 3]
        seen = ground[r : r + HIGH, c : c + WIDE]
        factor = 1.0 if gains is None else 1.0 / gains[k]
        means[k, r : r + HIGH, c : c + WIDE] = seen * factor + rng.normal(0, 15, seen.shape)
    return means


def middles() -> NDArray[np.float64]:
    return np.array(
        [
            [(STARTS_C[k % 3] + WIDE / 2) * 8.0, (STARTS_R[k // 3] + HIGH / 2) * 8.0]
            for k in range(9)
        ]
    )


def test_gains_come_back_from_the_overlaps_to_a_thousandth() -> None:
    truth = np.array([1.0, 1.08, 0.95, 1.02, 0.9, 1.1, 1.0, 0.97, 1.01])
    balance = balance_gains(NAMES, node_means(truth))
    found = np.array([balance.gains[name] for name in NAMES])
    expected = truth / np.exp(np.mean(np.log(truth)))
    assert np.abs(found / expected - 1).max() < 1e-3
    assert np.mean(np.log(found)) == pytest.approx(0.0, abs=1e-9)
    assert len(balance.pairs) == 20  # 12 strips and the diagonals of four corners


def test_cars_and_saturated_roofs_do_not_pull_the_balance() -> None:
    means = node_means(np.ones(9))
    means[1, 5:20, 40:44] *= 3.0
    means[4, 27:36, 40:60] = UNUSABLE
    balance = balance_gains(NAMES, means)
    assert all(abs(gain - 1) < 2e-3 for gain in balance.gains.values())


def test_where_light_and_dark_differ_strongly_gain_and_offset_are_separated() -> None:
    """Black has drifted by up to 2 DN (16 counts), and gains by a few per cent."""
    gains = np.array([1.0, 1.03, 0.98, 1.01, 0.97, 1.02, 1.0, 0.99, 1.01])
    black = np.array([0.0, 16.0, -12.0, 8.0, -16.0, 4.0, 10.0, -6.0, -4.0])
    rng = np.random.default_rng(4)
    rows, columns = np.indices((ROWS, COLUMNS))
    ground = 6000 * np.exp(1.3 * np.sin(rows / 3.0) * np.cos(columns / 4.0))
    means = np.full((9, ROWS, COLUMNS), NOT_COVERED, np.float32)
    for k in range(9):
        r, c = STARTS_R[k // 3], STARTS_C[k % 3]
        seen = ground[r : r + HIGH, c : c + WIDE]
        means[k, r : r + HIGH, c : c + WIDE] = (
            seen / gains[k] + black[k] + rng.normal(0, 8, seen.shape)
        )
    balance = balance_gains(NAMES, means)
    assert min(pair.span for pair in balance.pairs if pair.samples > 100) > 4.0
    for level in (1500.0, 6000.0, 20000.0):
        # What the heads make of the same light, against each other.
        balanced = [
            balance.gains[name] * (level / gains[k] + black[k]) + balance.offsets[name]
            for k, name in enumerate(NAMES)
        ]
        assert max(balanced) / min(balanced) - 1 < 2e-3
    assert np.mean(list(balance.offsets.values())) == pytest.approx(0.0, abs=1e-6)


def test_an_even_scene_does_not_separate_offset_from_gain() -> None:
    balance = balance_gains(NAMES, node_means(np.linspace(0.9, 1.1, 9)))
    assert max(pair.span for pair in balance.pairs) < 4.0
    assert set(balance.offsets.values()) == {0.0}


def test_a_sensor_without_overlap_keeps_the_mean_gain() -> None:
    means = node_means(np.array([1.0, 1.2, 1, 1, 1, 1, 1, 1, 1]))
    means[0] = NOT_COVERED
    balance = balance_gains(NAMES, means)
    assert balance.gains["A"] == pytest.approx(1.0, abs=0.02)
    assert balance.gains["B"] / balance.gains["C"] == pytest.approx(1.2, rel=2e-3)


def test_no_frames_at_all_give_gains_of_one() -> None:
    balance = balance_gains(NAMES, np.full((9, 5, 5), NOT_COVERED, np.float32))
    assert all(gain == pytest.approx(1.0) for gain in balance.gains.values())
    assert balance.spread == pytest.approx(0.0, abs=1e-9)


def test_every_node_goes_to_a_sensor_that_covers_it() -> None:
    means = node_means()
    labels = seam_labels(middles(), means, np.ones(9), 16)
    owned = np.take_along_axis(means, labels[None].astype(np.intp), axis=0)[0]
    assert np.all(owned != NOT_COVERED)
    assert len(np.unique(labels)) == 9


def test_seams_stay_off_the_borders_of_the_overlap_for_the_feather() -> None:
    labels = seam_labels(middles(), node_means(), np.ones(9), 32)
    # The overlap of A and B is columns 40 to 49; A's row ends where D begins to serve.
    ends = [int(np.flatnonzero(labels[row] == 0)[-1]) for row in range(3, 25)]
    assert min(ends) >= 42 and max(ends) <= 47


def test_a_seam_goes_around_what_moved_between_the_exposures() -> None:
    means = node_means()
    means[1, 8:16, 43:48] += 2500.0
    labels = seam_labels(middles(), means, np.ones(9), 16)
    for row in range(8, 16):
        end = int(np.flatnonzero(labels[row] == 0)[-1])
        assert end < 43 or end >= 47


@pytest.mark.parametrize("missing", [(0,), (4,), (1, 7), (0, 4, 8), tuple(range(8))])
def test_a_missing_sensor_leaves_a_hole_and_nothing_worse(missing: tuple[int, ...]) -> None:
    means = node_means()
    for k in missing:
        means[k] = NOT_COVERED
    labels = seam_labels(middles(), means, np.ones(9), 16)
    covered = (means != NOT_COVERED).any(axis=0)
    owned = np.take_along_axis(means, labels[None].astype(np.intp), axis=0)[0]
    assert np.array_equal(owned != NOT_COVERED, covered)


def test_sensors_are_sorted_into_rows_from_above_and_left() -> None:
    order = [4, 0, 8, 2, 6, 1, 3, 7, 5]
    rows = sensor_rows(middles()[order], (ROWS, COLUMNS))
    assert [[order[k] for k in row] for row in rows] == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    side_by_side = sensor_rows(np.array([[300.0, 100.0], [90.0, 104.0]]), (26, 50))
    assert side_by_side == [[1, 0]]


@pytest.mark.parametrize("feather_px", [8, 16, 24, 40])
def test_weights_fade_over_the_feather_and_sum_to_one(feather_px: int) -> None:
    labels = np.zeros((20, 60), np.int8)
    labels[:, 30:] = 1
    out = np.zeros((2, 20, 60), np.uint8)
    seam_weights(labels, feather_px, out)
    total = out.astype(int).sum(axis=0)
    assert np.all(np.abs(total - WEIGHT_UNIT) <= 1)
    row = out[0, 10].astype(float) / WEIGHT_UNIT
    assert np.all(np.diff(row) <= 0)
    # The steepest step between nodes is that of a ramp of the feather's width.
    assert np.max(-np.diff(row)) == pytest.approx(min(WEIGHT_STEP_PX / feather_px, 1.0), abs=0.01)
    assert np.count_nonzero((row > 0) & (row < 1)) <= feather_px // WEIGHT_STEP_PX
