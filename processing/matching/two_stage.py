"""Matching in two stages: some positions by search, the others from where those predict them.

The search is the costlier half of a match. A tenth of a pair's positions, spread over all of it, is
searched as `processing.matching.patches` does; a plane through their shifts predicts the others,
which least squares alone confirms. What it does not confirm is searched as well, so that a shifted
band, a moving object or a frame that lies elsewhere is found as if all had been searched.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.matching.patches import INTERPOLATION, match_patches, refine_patches

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Frame = NDArray[Any]

SEARCHED_SHARE: Final = 0.1
MIN_SEARCHED: Final = 60
"""Positions of a pair that are searched at least."""
MIN_AGREEING: Final = 30
"""Matches that a prediction needs; a plane has six unknowns."""
MAX_SCATTER_PX: Final = 0.2
"""Robust standard deviation of the shifts about their plane; beyond it nothing is predicted."""
_GOLDEN: Final = 0.6180339887498949
_ROUNDS: Final = 4
_BOUND_SIGMAS: Final = 3.0
_LEAST_BOUND_PX: Final = 0.05


@dataclass(frozen=True)
class MatchLimits:
    """What a match must reach: pixels of b, correlation, height of the peak over the next."""

    max_sigma_px: float
    min_correlation: float
    min_peak_margin: float


@dataclass(frozen=True)
class Positions:
    """Where one pair of frames is matched.

    `at_a`, `at_b` (n, 2) int64 are as in `match_patches`; `expected_b` (n, 2) is the place in b,
    not rounded, of the centre of a's box at `at_a`.
    """

    at_a: Indices
    at_b: Indices
    expected_b: Array


def match_positions(
    frame_a: Frame,
    frame_b: Frame,
    positions: Positions,
    limits_b: Indices,
    *,
    ratio: int,
    window_px: int,
    search_px: int,
    limits: MatchLimits,
) -> Array:
    """Match the positions of one pair of frames.

    Args:
        frame_a: (h, w), uint16 Level-1 words or float32; the finer frame.
        frame_b: (h, w), same type.
        positions: where.
        limits_b: first and last usable column, first and last usable row of frame b, (4,).
        ratio: pixels of a per pixel of b.
        window_px: side of the window, px of b, odd.
        search_px: offsets tried around `at_b`, px of b.
        limits: what a match must reach.

    Returns:
        The rows of `match_patches` that reach the limits, in the order of the positions. Where
        nothing was searched the height of the peak is 1.

    Source: docs/explanation/mathematics/matching.md#two-stages.
    """
    result, reached = match_and_mark(
        frame_a,
        frame_b,
        positions,
        limits_b,
        ratio=ratio,
        window_px=window_px,
        search_px=search_px,
        limits=limits,
    )
    return result[reached]


def match_and_mark(
    frame_a: Frame,
    frame_b: Frame,
    positions: Positions,
    limits_b: Indices,
    *,
    ratio: int,
    window_px: int,
    search_px: int,
    limits: MatchLimits,
) -> tuple[Array, NDArray[np.bool_]]:
    """Match the positions of one pair of frames, and mark those that reach the limits.

    Args:
        frame_a: (h, w), uint16 Level-1 words or float32; the finer frame.
        frame_b: (h, w), same type.
        positions: where.
        limits_b: first and last usable column, first and last usable row of frame b, (4,).
        ratio: pixels of a per pixel of b.
        window_px: side of the window, px of b, odd.
        search_px: offsets tried around `at_b`, px of b.
        limits: what a match must reach.

    Returns:
        A row of `match_patches` for each position, and whether it reaches the limits, (n,).
    """
    half, is_uint16 = window_px // 2, frame_a.dtype == np.uint16
    result = np.zeros((len(positions.at_a), 8))

    def search(rows: Indices) -> None:
        result[rows] = match_patches(
            frame_a,
            frame_b,
            positions.at_a[rows],
            positions.at_b[rows],
            limits_b,
            ratio,
            half,
            search_px,
            is_uint16,
            INTERPOLATION,
        )

    first = spread_positions(len(result))
    search(np.flatnonzero(first))
    middle = (ratio - 1) / 2.0
    accepted = first & _reached(result, limits)
    moved = (result[:, :2] - positions.at_a - middle) / ratio
    shift = result[:, 2:4] - positions.expected_b - moved
    rest = np.flatnonzero(~first)
    plane = shift_plane(positions.expected_b[accepted], shift[accepted])
    if plane is not None and len(rest):
        result[rest] = refine_patches(
            frame_a,
            frame_b,
            positions.at_a[rest],
            positions.expected_b[rest] + plane_at(plane, positions.expected_b[rest]),
            limits_b,
            ratio,
            half,
            is_uint16,
            INTERPOLATION,
        )
        confirmed = _reached(result[rest], limits)
        # A bad pixel in the window is in every search of it, too.
        rest = rest[~confirmed & (result[rest, 7] >= 0.0)]
    search(rest)
    return result, _reached(result, limits)


def spread_positions(count: int) -> NDArray[np.bool_]:
    """Which of so many positions are searched first: evenly spread, whatever the rows of a grid.

    Args:
        count: positions of a pair.

    Returns:
        True for those, (count,); all where there are few.

    Example:
        >>> int(spread_positions(1000).sum()), bool(spread_positions(50).all())
        (100, True)
    """
    share = max(SEARCHED_SHARE, MIN_SEARCHED / max(count, 1))
    return np.asarray(np.arange(count) * _GOLDEN % 1.0 < share)


def shift_plane(at: Array, shift: Array) -> Array | None:
    """The plane through shifts, outliers left out.

    Args:
        at: column and row, (n, 2), px.
        shift: in x and in y there, (n, 2), px.

    Returns:
        Constant, change per column and per row of both, (3, 2); None where too few shifts agree.

    Example:
        >>> at = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), axis=-1).reshape(-1, 2)
        >>> plane = shift_plane(at, np.column_stack([1.0 + 0.5 * at[:, 0], 0.25 * at[:, 1]]))
        >>> plane_at(plane, np.array([[2.0, 4.0]])).round(6)
        array([[2., 1.]])
    """
    if len(at) < MIN_AGREEING:
        return None
    design = np.column_stack([np.ones(len(at)), at])
    off = shift - np.median(shift, axis=0)
    keep = np.zeros(len(at), np.bool_)
    plane = np.zeros((3, 2))
    scatter = np.inf
    for _ in range(_ROUNDS):
        length = np.abs(off).max(axis=1)
        scatter = 1.4826 * float(np.median(np.abs(off)))
        earlier, keep = keep, length <= max(_BOUND_SIGMAS * scatter, _LEAST_BOUND_PX)
        if np.count_nonzero(keep) < MIN_AGREEING:
            return None
        if np.array_equal(keep, earlier):
            break  # and so would be all that follows
        plane, *_ = np.linalg.lstsq(design[keep], shift[keep], rcond=None)
        off = shift - design @ plane
    return plane if scatter <= MAX_SCATTER_PX else None


def plane_at(plane: Array, at: Array) -> Array:
    """Shifts of a plane.

    Args:
        plane: from `shift_plane`, (3, 2).
        at: column and row, (n, 2), px.

    Returns:
        Shift in x and in y, (n, 2), px.
    """
    return np.asarray(plane[0] + at @ plane[1:])


def _reached(result: Array, limits: MatchLimits) -> NDArray[np.bool_]:
    return np.asarray(
        (result[:, 7] > 0.0)
        & (result[:, 4] <= limits.max_sigma_px)
        & (result[:, 5] >= limits.min_correlation)
        & (result[:, 6] >= limits.min_peak_margin)
    )
