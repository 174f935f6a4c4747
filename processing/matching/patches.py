"""Area-based matching of small patches: correlation search, then least-squares matching.

Compiled kernels over many points; which points, in which frames, and what the positions mean is in
`processing.matching.tie_points`. A bad pixel makes its patch unusable: for uint16 frames a Level-1
word that is no data or saturated, for float32 frames one that is not finite.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.matching.correlation import (
    MARGIN_PX,
    correlate,
    correlation_scratch,
    peak,
)
from processing.matching.features import select_features
from processing.matching.least_squares import (
    INTERPOLATION,
    PATCH_SLACK,
    refine,
    refinement_scratch,
)
from processing.matching.prefetch import fetch_ahead

__all__ = ["INTERPOLATION", "MARGIN_PX", "match_patches", "refine_patches", "select_features"]

Array = NDArray[Any]

_BLOCK: Final = 32

_AGREEMENT_PX: Final = 0.5
"""How far from its prediction least squares may find a point that is not searched."""


@compiled_kernel()
def _load(frame: Array, col: int, row: int, ratio: int, is_uint16: bool, patch: Array) -> bool:
    """Fill a patch with box means of ratio x ratio pixels, the first box beginning at (col, row).

    The patch is left with a mean near zero, so that single precision suffices. False: bad pixels.
    """
    height, width = patch.shape
    n = width * ratio
    share = np.float32(1.0 / (ratio * ratio))
    origin = frame[row + ratio * (height // 2), col + ratio * (width // 2)]
    line = np.empty(n, np.float32)
    bad = np.int32(0)
    for r in range(height):
        first = row + r * ratio
        if is_uint16 and ratio == 1:
            bad = _load_row(frame[first, col : col + n], np.int32(origin), patch[r])
        elif is_uint16 and ratio == 3:
            bad = _load_row_sums(
                frame[first, col : col + n],
                frame[first + 1, col : col + n],
                frame[first + 2, col : col + n],
                np.int32(3) * np.int32(origin),
                line,
            )
            for c in range(width):
                patch[r, c] = (line[3 * c] + line[3 * c + 1] + line[3 * c + 2]) * share
        else:
            line[:] = np.float32(0.0)
            for i in range(ratio):
                source = frame[first + i, col : col + n]
                if is_uint16:
                    for k in range(n):
                        value = np.int32(source[k])
                        bad |= (value & 1) | np.int32(value == 0)
                for k in range(n):
                    line[k] += np.float32(source[k]) - np.float32(origin)
            for c in range(width):
                total = np.float32(0.0)
                for j in range(ratio):
                    total += line[c * ratio + j]
                patch[r, c] = total * share
        if bad:
            return False
    return True


@compiled_kernel()
def _load_row(source: Array, origin: Any, line: Array) -> Any:
    """A row of words less the origin; not zero where one is bad."""
    bad = np.int32(0)
    for k in range(len(line)):
        value = np.int32(source[k])
        bad |= (value & np.int32(1)) | np.int32(value == 0)
        line[k] = np.float32(np.int32(value - origin))
    return bad


@compiled_kernel()
def _load_row_sums(upper: Array, middle: Array, lower: Array, origin: Any, line: Array) -> Any:
    """Sums of three rows of words less the origin; not zero where one is bad."""
    bad = np.int32(0)
    for k in range(len(line)):
        a, b, c = np.int32(upper[k]), np.int32(middle[k]), np.int32(lower[k])
        bad |= ((a | b | c) & np.int32(1)) | np.int32(min(min(a, b), c) == 0)
        line[k] = np.float32(np.int32(a + b + c - origin))
    return bad


@compiled_kernel()
def _all_finite(patch: Array) -> bool:
    total = np.float32(0.0)
    for r in range(patch.shape[0]):
        for c in range(patch.shape[1]):
            total += patch[r, c] * np.float32(0.0)
    return bool(total == 0.0)


@compiled_kernel(parallel=True)
def match_patches(
    frame_a: Array,
    frame_b: Array,
    at_a: Array,
    at_b: Array,
    limits_b: Array,
    ratio: int,
    half_window: int,
    search: int,
    is_uint16: bool,
    table: Array,
) -> Array:
    """Find windows of frame a, reduced by `ratio`, in frame b.

    Args:
        frame_a: (h, w), uint16 Level-1 words or float32; the finer frame.
        frame_b: (h, w), same type.
        at_a: (n, 2) int64, first pixel (column, row) of the centre box of ratio x ratio pixels.
        at_b: (n, 2) int64, predicted pixel of frame b, rounded.
        limits_b: (4,) int64, first and last usable column, first and last usable row of frame b.
        ratio: pixels of a per pixel of b along each axis.
        half_window: the window has 2 * half_window + 1 pixels of b.
        search: offsets tried around the prediction, px of b.
        is_uint16: the frames hold Level-1 words.
        table: `INTERPOLATION`.

    Returns:
        (n, 8) float64: column and row in a, column and row in b of the same ground, sigma of their
        difference (px of b, per coordinate), correlation after refinement, height of the
        correlation peak over the next maximum, and 1 where matched (the rest of the row is
        undefined otherwise).
    """
    count = len(at_a)
    result = np.zeros((count, 8))
    side = 2 * half_window + 1
    margin = MARGIN_PX
    size_a, size_b = side + 2 * margin, side + 2 * margin + 2 * search
    blocks = (count + _BLOCK - 1) // _BLOCK
    for block in prange(blocks):
        flat_a = np.zeros(size_a * size_a + PATCH_SLACK, np.float32)
        flat_b = np.zeros(size_b * size_b + PATCH_SLACK, np.float32)
        a = flat_a[: size_a * size_a].reshape(size_a, size_a)
        b = flat_b[: size_b * size_b].reshape(size_b, size_b)
        width = 2 * search + 1
        surface = np.empty((width, width), np.float32)
        correlation = correlation_scratch(side, search)
        scratch = refinement_scratch(side)
        best = np.empty(6)
        found = np.empty(4)
        reach = np.empty(4, np.int64)
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            col_b, row_b = at_b[i, 0], at_b[i, 1]
            margin_px = half_window + margin
            if i + 1 < count:
                fetch_ahead(
                    frame_a,
                    at_a[i + 1, 0] - ratio * margin_px,
                    at_a[i + 1, 1] - ratio * margin_px,
                    ratio * size_a,
                    ratio * size_a,
                )
                fetch_ahead(
                    frame_b,
                    at_b[i + 1, 0] - margin_px - search,
                    at_b[i + 1, 1] - margin_px - search,
                    size_b,
                    size_b,
                )
            reach[0] = max(-search, limits_b[0] + margin_px - col_b)
            reach[1] = min(search, limits_b[1] - margin_px - col_b)
            reach[2] = max(-search, limits_b[2] + margin_px - row_b)
            reach[3] = min(search, limits_b[3] - margin_px - row_b)
            if reach[1] - reach[0] < 2 or reach[3] - reach[2] < 2:
                continue
            col_a = at_a[i, 0] - ratio * margin_px
            row_a = at_a[i, 1] - ratio * margin_px
            if not _load(frame_a, col_a, row_a, ratio, is_uint16, a) or not (
                is_uint16 or _all_finite(a)
            ):
                continue
            # Only what lies in the frame is loaded; the rest of b is never looked at.
            rows_b = 2 * margin_px + 1 + reach[3] - reach[2]
            cols_b = 2 * margin_px + 1 + reach[1] - reach[0]
            part = b[
                search + reach[2] : search + reach[2] + rows_b,
                search + reach[0] : search + reach[0] + cols_b,
            ]
            first_col, first_row = col_b - margin_px + reach[0], row_b - margin_px + reach[2]
            if not _load(frame_b, first_col, first_row, 1, is_uint16, part) or not (
                is_uint16 or _all_finite(part)
            ):
                continue
            correlate(a, b, half_window, reach, correlation, surface)
            if not peak(surface, reach, best):
                continue
            moved_col = moved_row = 0
            shift = (best[2], best[3])
            if ratio > 1:
                # Reduced pixels in phase with b's: what is finer than b's pixels folds over alike.
                moved_col = -int(np.round(best[2] * ratio))
                moved_row = -int(np.round(best[3] * ratio))
                if moved_col != 0 or moved_row != 0:
                    col, row = col_a + moved_col, row_a + moved_row
                    if (
                        col < 0
                        or row < 0
                        or col + ratio * size_a > frame_a.shape[1]
                        or row + ratio * size_a > frame_a.shape[0]
                    ):
                        continue
                    if not _load(frame_a, col, row, ratio, is_uint16, a) or not (
                        is_uint16 or _all_finite(a)
                    ):
                        continue
                shift = (best[2] + moved_col / ratio, best[3] + moved_row / ratio)
            offset = (search + int(best[0]), search + int(best[1]))
            if not refine(
                (flat_a, flat_b),
                (size_a, size_b),
                offset,
                shift,
                half_window,
                margin,
                ratio * ratio,
                table,
                scratch,
                found,
            ):
                continue
            middle = (ratio - 1) / 2.0
            result[i, 0] = at_a[i, 0] + moved_col + middle - 0.5 * found[0] * ratio
            result[i, 1] = at_a[i, 1] + moved_row + middle - 0.5 * found[1] * ratio
            result[i, 2] = col_b + best[0] + 0.5 * found[0]
            result[i, 3] = row_b + best[1] + 0.5 * found[1]
            result[i, 4] = found[2]
            result[i, 5] = found[3]
            result[i, 6] = best[4] - best[5]
            result[i, 7] = 1.0
    return result


@compiled_kernel(parallel=True)
def refine_patches(
    frame_a: Array,
    frame_b: Array,
    at_a: Array,
    predicted_b: Array,
    limits_b: Array,
    ratio: int,
    half_window: int,
    is_uint16: bool,
    table: Array,
) -> Array:
    """As `match_patches` where places in b are predicted to a part of a pixel: without a search.

    Args:
        frame_a: (h, w), uint16 Level-1 words or float32; the finer frame.
        frame_b: (h, w), same type.
        at_a: (n, 2) int64, first pixel (column, row) of the centre box of ratio x ratio pixels.
        predicted_b: (n, 2), where the centre of that box is in frame b, px.
        limits_b: (4,) int64, first and last usable column, first and last usable row of frame b.
        ratio: pixels of a per pixel of b along each axis.
        half_window: the window has 2 * half_window + 1 pixels of b.
        is_uint16: the frames hold Level-1 words.
        table: `INTERPOLATION`.

    Returns:
        (n, 8) as of `match_patches`, with 1 for the height of the peak. The last is 1 where least
        squares converges within half a pixel of the prediction, -1 where a window holds bad pixels,
        else 0.
    """
    count = len(at_a)
    result = np.zeros((count, 8))
    side = 2 * half_window + 1
    margin_px = half_window + MARGIN_PX
    size = side + 2 * MARGIN_PX
    middle = (ratio - 1) / 2.0
    blocks = (count + _BLOCK - 1) // _BLOCK
    for block in prange(blocks):
        flat_a = np.zeros(size * size + PATCH_SLACK, np.float32)
        flat_b = np.zeros(size * size + PATCH_SLACK, np.float32)
        a = flat_a[: size * size].reshape(size, size)
        b = flat_b[: size * size].reshape(size, size)
        scratch = refinement_scratch(side)
        found = np.empty(4)
        # `prange` counts in uint64: without this, each callee is compiled for uint64 as well.
        first = np.int64(block * _BLOCK)
        last = min(first + _BLOCK, np.int64(count))
        here = _predicted_corners(at_a, predicted_b, first, ratio, margin_px)
        for i in range(first, last):
            col_a, row_a, col_b, row_b = here
            if i + 1 < last:
                here = _predicted_corners(at_a, predicted_b, i + 1, ratio, margin_px)
                fetch_ahead(frame_a, here[0], here[1], ratio * size, ratio * size)
                fetch_ahead(frame_b, here[2], here[3], size, size)
            if (
                col_a < 0
                or row_a < 0
                or col_a + ratio * size > frame_a.shape[1]
                or row_a + ratio * size > frame_a.shape[0]
                or col_b < limits_b[0]
                or row_b < limits_b[2]
                or col_b + size > limits_b[1] + 1
                or row_b + size > limits_b[3] + 1
            ):
                continue
            if (
                not _load(frame_a, col_a, row_a, ratio, is_uint16, a)
                or not _load(frame_b, col_b, row_b, 1, is_uint16, b)
                or not (is_uint16 or (_all_finite(a) and _all_finite(b)))
            ):
                result[i, 7] = -1.0
                continue
            moved_col = col_a + ratio * margin_px - at_a[i, 0]
            moved_row = row_a + ratio * margin_px - at_a[i, 1]
            whole_col, whole_row = col_b + margin_px, row_b + margin_px
            shift = (
                predicted_b[i, 0] - whole_col + moved_col / ratio,
                predicted_b[i, 1] - whole_row + moved_row / ratio,
            )
            if not refine(
                (flat_a, flat_b),
                (size, size),
                (0, 0),
                shift,
                half_window,
                MARGIN_PX,
                ratio * ratio,
                table,
                scratch,
                found,
            ):
                continue
            if max(abs(found[0] - shift[0]), abs(found[1] - shift[1])) > _AGREEMENT_PX:
                continue
            result[i, 0] = at_a[i, 0] + moved_col + middle - 0.5 * found[0] * ratio
            result[i, 1] = at_a[i, 1] + moved_row + middle - 0.5 * found[1] * ratio
            result[i, 2] = whole_col + 0.5 * found[0]
            result[i, 3] = whole_row + 0.5 * found[1]
            result[i, 4] = found[2]
            result[i, 5] = found[3]
            result[i, 6] = 1.0
            result[i, 7] = 1.0
    return result


@compiled_kernel()
def _predicted_corners(
    at_a: Array, predicted_b: Array, i: int, ratio: int, margin_px: int
) -> tuple[int, int, int, int]:
    """First column and row of both patches, a's in phase with b's pixels (see `match_patches`)."""
    whole_col = int(np.round(predicted_b[i, 0]))
    whole_row = int(np.round(predicted_b[i, 1]))
    moved_col = moved_row = 0
    if ratio > 1:
        moved_col = -int(np.round((predicted_b[i, 0] - whole_col) * ratio))
        moved_row = -int(np.round((predicted_b[i, 1] - whole_row) * ratio))
    return (
        at_a[i, 0] + moved_col - ratio * margin_px,
        at_a[i, 1] + moved_row - ratio * margin_px,
        whole_col - margin_px,
        whole_row - margin_px,
    )
