"""Feature-rich positions: where in an even grid of cells a patch can be found again best.

One compiled kernel; what is matched there is decided in `processing.matching.tie_points` and
`processing.image.colour`. A cell's samples lie flat in memory, row after row, so that all sums are
long loops over shifted copies.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

_BLOCK: Final = 16
"""Cells that share one scratch memory."""
_MATHEMATICS: Final = {"contract", "reassoc"}
"""Not a number must stay one: it marks what cannot be used."""


@compiled_kernel(parallel=True)
def select_features(
    frame: Array, cells: Array, half_window: int, stride: int, is_uint16: bool
) -> Array:
    """The most feature-rich position of each cell: the structure tensor's smaller eigenvalue peaks.

    Args:
        frame: (h, w), uint16 Level-1 words or float32.
        cells: (n, 4) int64: first and last column, first and last row a window centre may take. The
            window and one pixel around it must lie in the frame.
        half_window: half of the window's side, px.
        stride: candidates and gradients are looked at every so many pixels, 1 or 2.
        is_uint16: the frame holds Level-1 words.

    Returns:
        (n, 3) float64: column, row, eigenvalue (mean squared gradient per pixel along the weaker
        direction, halved step); eigenvalue -1 where bad pixels leave no candidate.

    Source: docs/explanation/mathematics/matching.md#positions.
    """
    count = len(cells)
    result = np.empty((count, 3))
    widest = tallest = np.int64(0)
    for i in range(count):
        widest = max(widest, (cells[i, 1] - cells[i, 0] + 2 * half_window) // stride + 1)
        tallest = max(tallest, (cells[i, 3] - cells[i, 2] + 2 * half_window) // stride + 1)
    reach = 2 * half_window // stride + 1
    # The right neighbour of a sample is the left one of the sample two pixels on.
    two = 2 // stride
    size = (tallest + two) * (widest + two)
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        sides = np.zeros(size, frame.dtype)
        heres = np.zeros(size, frame.dtype)
        uppers = np.zeros(size, frame.dtype)
        planes = np.zeros((4, size), np.float32)
        spare = np.zeros(size, np.float32)
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            columns = (cells[i, 1] - cells[i, 0] + 2 * half_window) // stride + 1
            rows = (cells[i, 3] - cells[i, 2] + 2 * half_window) // stride + 1
            _load(
                frame,
                cells[i, 2] - half_window,
                cells[i, 0] - half_window,
                stride,
                rows,
                columns,
                sides,
                heres,
                uppers,
            )
            wide = columns + two
            n = rows * wide
            unusable = _products(sides, heres, uppers, two, wide, n, is_uint16, planes)
            for k in range(4 if unusable else 3):
                _box_sums(planes[k], wide, n, reach, spare)
            if not unusable:
                planes[3, :n] = np.float32(0.0)
            best, place = _best(planes, wide, rows - reach + 1, columns - reach + 1)
            result[i, 0] = cells[i, 0] + place % wide * stride
            result[i, 1] = cells[i, 2] + place // wide * stride
            result[i, 2] = best / (reach * reach) if best > 0.0 else best
    return result


@compiled_kernel()
def _load(frame, row, column, stride, rows, columns, sides, heres, uppers):
    """Samples of a cell, their left and their upper neighbours, and those of the next samples."""
    two = 2 // stride
    wide = columns + two
    for r in range(rows + two):
        target = uppers[r * wide : (r + 1) * wide]
        above = frame[row + r * stride - 1, column:]
        for c in range(columns):
            target[c] = above[c * stride]
        if r >= rows:
            continue
        side = sides[r * wide : (r + 1) * wide]
        here = heres[r * wide : (r + 1) * wide]
        line = frame[row + r * stride, column - 1 :]
        for c in range(columns):
            side[c] = line[c * stride]
            here[c] = line[c * stride + 1]
        for c in range(columns, wide):
            side[c] = line[c * stride]
            here[c] = here[columns - 1]
            target[c] = target[columns - 1]


@compiled_kernel(fastmath=_MATHEMATICS)
def _products(sides, heres, uppers, two, wide, n, is_uint16, planes):
    """Products of the gradients xx, xy, yy, and where they cannot be used; whether that is any.

    What lies beyond the last sample of a row is filled somehow and never looked at.
    """
    size = n - two
    left = sides[:size]
    right = sides[two : two + size]
    up = uppers[:size]
    down = uppers[two * wide : two * wide + size]
    xx, xy, yy, bad = planes[0], planes[1], planes[2], planes[3]
    for p in range(size):
        dx = np.float32(right[p]) - np.float32(left[p])
        dy = np.float32(down[p]) - np.float32(up[p])
        xx[p] = dx * dx
        xy[p] = dx * dy
        yy[p] = dy * dy
    for p in range(size, n):
        xx[p] = xy[p] = yy[p] = bad[p] = np.float32(0.0)
    some = np.int32(0)
    if is_uint16:
        for p in range(size):
            a, b = np.int32(left[p]), np.int32(right[p])
            c, d = np.int32(up[p]), np.int32(down[p])
            e = np.int32(heres[p])
            least = min(min(min(a, b), min(c, d)), e)
            broken = ((a | b | c | d | e) & np.int32(1)) | np.int32(least == 0)
            bad[p] = np.float32(broken)
            some |= broken
    else:
        for p in range(size):
            broken = np.int32(not np.isfinite(xx[p] + yy[p]))
            bad[p] = np.float32(broken)
            some |= broken
    if some == 0:
        return False
    for p in range(size):
        if bad[p] > np.float32(0.0):
            xx[p] = xy[p] = yy[p] = np.float32(0.0)
    return True


@compiled_kernel(fastmath=_MATHEMATICS)
def _box_sums(plane, wide, n, reach, spare):
    """Each sample becomes the sum of the reach x reach ones right of it and below, in place."""
    along = n - reach + 1
    out = spare[:along]
    # Loops: numba compiles the messages of array assignments, which takes seconds.
    for p in range(along):
        out[p] = plane[p]
    for k in range(1, reach):
        part = plane[k : k + along]
        for p in range(along):
            out[p] += part[p]
    down = along - (reach - 1) * wide
    total = plane[:down]
    for p in range(down):
        total[p] = spare[p]
    for k in range(1, reach):
        part = spare[k * wide : k * wide + down]
        for p in range(down):
            total[p] += part[p]


@compiled_kernel(fastmath=_MATHEMATICS)
def _best(planes, wide, rows, columns):
    """The largest smaller eigenvalue among whole windows, -1 where there is none, and its place."""
    n = (rows - 1) * wide + columns
    xx, xy, yy, bad = planes[0], planes[1], planes[2], planes[3]
    for p in range(n):
        half_trace = np.float32(0.5) * (xx[p] + yy[p])
        half_difference = np.float32(0.5) * (xx[p] - yy[p])
        root = np.sqrt(half_difference * half_difference + xy[p] * xy[p])
        # Determinant over the larger eigenvalue: their difference would lose its digits.
        determinant = max(xx[p] * yy[p] - xy[p] * xy[p], np.float32(0.0))
        weaker = determinant / max(half_trace + root, np.float32(1e-30))
        xx[p] = weaker if bad[p] == np.float32(0.0) else np.float32(-1.0)
    best = np.float32(-1.0)
    place = np.int64(0)
    for r in range(rows):
        line = xx[r * wide : r * wide + columns]
        most = np.float32(-1.0)
        for c in range(columns):
            most = max(most, line[c])
        if most > best:
            best = most
            for c in range(columns):
                if line[c] == most:
                    place = r * wide + c
                    break
    return np.float64(best), place
