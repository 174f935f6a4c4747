"""Matching in two stages against the search of every position, on textures moved exactly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.matching.patches import INTERPOLATION, match_patches
from processing.matching.two_stage import (
    MatchLimits,
    Positions,
    match_positions,
    shift_plane,
    spread_positions,
)
from tests.processing.textures import Texture, box_means

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
SIZE_PX = 600
SHIFT_PX = (1.3, -2.4)
LIMITS = MatchLimits(0.3, 0.6, 0.05)


def grid(first: int, last: int, step: int) -> Indices:
    at = np.arange(first, last, step)
    return np.array([(c, r) for r in at for c in at], dtype=np.int64)


def frames(noise: float = 20.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(7)
    texture = Texture(SIZE_PX, rng)
    a, b = texture.moved(0.0, 0.0), texture.moved(*SHIFT_PX)
    return a + rng.normal(0.0, noise, a.shape), b + rng.normal(0.0, noise, b.shape)


def in_two_stages(a: Array, b: Array, positions: Positions, *, ratio: int = 1) -> Array:
    limits = np.array([0, b.shape[1] - 1, 0, b.shape[0] - 1], dtype=np.int64)
    return match_positions(
        a.astype(np.float32),
        b.astype(np.float32),
        positions,
        limits,
        ratio=ratio,
        window_px=19 if ratio == 1 else 15,
        search_px=6 if ratio == 1 else 3,
        limits=LIMITS,
    )


def by_search(a: Array, b: Array, positions: Positions) -> Array:
    limits = np.array([0, b.shape[1] - 1, 0, b.shape[0] - 1], dtype=np.int64)
    found = match_patches(
        a.astype(np.float32),
        b.astype(np.float32),
        positions.at_a,
        positions.at_b,
        limits,
        1,
        9,
        6,
        False,
        INTERPOLATION,
    )
    good = (found[:, 7] > 0) & (found[:, 4] <= 0.3) & (found[:, 5] >= 0.6) & (found[:, 6] >= 0.05)
    return np.asarray(found[good])


def at_same_place(at: Indices) -> Positions:
    return Positions(at, at, at.astype(np.float64))


def test_predicted_points_are_those_that_a_search_finds() -> None:
    a, b = frames()
    positions = at_same_place(grid(30, SIZE_PX - 30, 13))
    found, searched = in_two_stages(a, b, positions), by_search(a, b, positions)
    difference = found[:, 2:4] - found[:, :2] - SHIFT_PX
    assert len(found) >= len(searched) > 0.95 * len(positions.at_a)
    assert np.abs(difference.mean(axis=0)).max() < 0.003
    assert np.abs(difference).max() < 6.0 * found[:, 4].max()
    assert np.mean(found[:, 6] == 1.0) > 0.8
    middle = np.rint(0.5 * (found[:, :2] + found[:, 2:4] - SHIFT_PX)).astype(int)
    place = {tuple(at): k for k, at in enumerate(middle.tolist())}
    other = np.rint(0.5 * (searched[:, :2] + searched[:, 2:4] - SHIFT_PX)).astype(int)
    pairs = [(place[tuple(at)], k) for k, at in enumerate(other.tolist()) if tuple(at) in place]
    assert len(pairs) > 0.95 * len(searched)
    i, j = np.array(pairs).T
    shifts = [rows[:, 2:4] - rows[:, :2] for rows in (found[i], searched[j])]
    changed = np.abs(shifts[0] - shifts[1]).max(axis=1)
    assert np.quantile(changed, 0.98) < 0.001
    assert (changed < found[i, 4]).all()


def test_a_band_of_rows_that_lies_elsewhere_is_found_where_it_lies() -> None:
    a, b = frames()
    b[300:400] = np.roll(b[300:400], 3, axis=1)
    found = in_two_stages(a, b, at_same_place(grid(30, SIZE_PX - 30, 13)))
    inside = (found[:, 3] > 315) & (found[:, 3] < 385)
    shift = found[:, 2:4] - found[:, :2]
    assert inside.sum() > 150
    assert np.abs(np.median(shift[inside], axis=0) - (SHIFT_PX[0] + 3.0, SHIFT_PX[1])).max() < 0.01
    assert np.abs(np.median(shift[~inside], axis=0) - SHIFT_PX).max() < 0.01


def test_green_is_matched_with_boxes_in_phase_with_its_pixels() -> None:
    rng = np.random.default_rng(3)
    texture = Texture(3 * SIZE_PX, rng, cutoff=0.1)
    dx, dy = 1.7, -2.6
    a, b = texture.moved(0.0, 0.0), box_means(texture.moved(dx, dy), 3)
    at_b = grid(30, SIZE_PX - 30, 17)
    positions = Positions(3 * at_b, at_b, at_b.astype(np.float64))
    found = in_two_stages(a + rng.normal(0.0, 20.0, a.shape), b, positions, ratio=3)
    error = found[:, 2:4] - (found[:, :2] + (dx - 1.0, dy - 1.0)) / 3.0
    assert len(found) > 0.95 * len(at_b)
    assert np.mean(found[:, 6] == 1.0) > 0.8
    assert np.abs(error.mean(axis=0)).max() < 0.003
    assert np.abs(error).max() < 0.2


def test_where_nothing_agrees_all_is_searched_and_nothing_is_found() -> None:
    a, _ = frames()
    _, b = frames()
    found = in_two_stages(a, np.flipud(b).copy(), at_same_place(grid(30, SIZE_PX - 30, 13)))
    assert len(found) < 20
    assert not (found[:, 6] == 1.0).any()


def test_few_positions_are_all_searched() -> None:
    a, b = frames()
    positions = at_same_place(grid(100, 195, 14))
    assert len(positions.at_a) < 60
    assert np.array_equal(in_two_stages(a, b, positions), by_search(a, b, positions))


def test_searched_positions_are_spread_over_rows_and_columns_of_any_grid() -> None:
    for columns in (10, 20, 37, 40):
        chosen = spread_positions(40 * columns).reshape(40, columns)
        by_band = chosen.reshape(8, 5, columns).sum(axis=(1, 2))
        assert by_band.min() > 0
        assert np.count_nonzero(chosen.any(axis=0)) > 0.8 * columns


@pytest.mark.parametrize(("scatter_px", "predicts"), [(0.05, True), (0.4, False)])
def test_a_plane_predicts_only_where_shifts_agree(scatter_px: float, predicts: bool) -> None:
    rng = np.random.default_rng(1)
    at = rng.uniform(0.0, 4000.0, (200, 2))
    shift = (1.0, -2.0) + at @ np.array([[1e-4, 0.0], [0.0, -2e-4]])
    shift += rng.normal(0.0, scatter_px, shift.shape)
    shift[:20] += 4.0
    plane = shift_plane(at, shift)
    assert (plane is not None) == predicts
    if plane is not None:
        assert np.abs(plane[0] - (1.0, -2.0)).max() < 0.03
        assert np.abs(plane[1:] - [[1e-4, 0.0], [0.0, -2e-4]]).max() < 1e-5
