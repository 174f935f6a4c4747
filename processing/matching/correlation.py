"""Correlation search: where in a patch the window of another looks most alike, to a whole pixel.

Compiled kernels; refining the place is done in `processing.matching.least_squares`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]


@njit(cache=True, fastmath=True)
def correlate(
    a: Array,
    b: Array,
    half: int,
    margin: int,
    reach: Array,
    scratch: tuple[Array, Array, Array],
    surface: Array,
) -> None:
    """Normalised cross correlation of a's window with b at all offsets; -2 where not tried.

    `reach` holds the first and last column offset and the first and last row offset to be tried.
    `scratch` is a flat template, as long as b, and two rows of sums, as long as b is wide.
    """
    template, sums, squares = scratch
    side = 2 * half + 1
    n = side * side
    search = (surface.shape[1] - 1) // 2
    wide = b.shape[1]
    mean = np.float32(0.0)
    for r in range(side):
        for c in range(side):
            mean += a[r + margin, c + margin]
    mean /= np.float32(n)
    # The template has the stride of b, so that a window is one run of memory; zeros between rows.
    flat = b.reshape(-1)
    length = (side - 1) * wide + side
    template[:length] = np.float32(0.0)
    energy = 0.0
    for r in range(side):
        for c in range(side):
            value = a[r + margin, c + margin] - mean
            template[r * wide + c] = value
            energy += value * value
    surface[:] = np.float32(-2.0)
    sums[:] = 0.0
    squares[:] = 0.0
    first = margin + search + reach[2]
    for r in range(first, first + side):
        for j in range(wide):
            value = float(b[r, j])
            sums[j] += value
            squares[j] += value * value
    for dr in range(reach[2], reach[3] + 1):
        top = margin + search + dr
        left = margin + search + reach[0]
        total = square = 0.0
        for j in range(left, left + side):
            total += sums[j]
            square += squares[j]
        for dc in range(reach[0], reach[1] + 1):
            at = margin + search + dc
            start = top * wide + at
            window = flat[start : start + length]
            product = np.float32(0.0)
            for k in range(length):
                product += template[k] * window[k]
            spread = (square - total * total / n) * energy
            if spread > 1e-6:
                surface[search + dr, search + dc] = product / np.sqrt(spread)
            if dc < reach[1]:
                total += sums[at + side] - sums[at]
                square += squares[at + side] - squares[at]
        if dr < reach[3]:
            for j in range(wide):
                leaving = float(b[top, j])
                coming = float(b[top + side, j])
                sums[j] += coming - leaving
                squares[j] += coming * coming - leaving * leaving


@njit(cache=True)
def peak(surface: Array, reach: Array, found: Array) -> bool:
    """Best offset, its sub-pixel part by parabola, its height and that of the next maximum.

    False where the peak lies on the edge of what was searched.
    """
    search = (surface.shape[0] - 1) // 2
    best, row, col = -2.0, 0, 0
    for dr in range(reach[2], reach[3] + 1):
        for dc in range(reach[0], reach[1] + 1):
            if surface[search + dr, search + dc] > best:
                best = surface[search + dr, search + dc]
                row, col = dr, dc
    if best <= 0.0 or row == reach[2] or row == reach[3] or col == reach[0] or col == reach[1]:
        return False
    second = -1.0
    for dr in range(reach[2], reach[3] + 1):
        for dc in range(reach[0], reach[1] + 1):
            value = surface[search + dr, search + dc]
            if value <= second or (abs(dr - row) <= 1 and abs(dc - col) <= 1):
                continue
            highest = True
            for i in range(max(dr - 1, reach[2]), min(dr + 1, reach[3]) + 1):
                for j in range(max(dc - 1, reach[0]), min(dc + 1, reach[1]) + 1):
                    if surface[search + i, search + j] > value:
                        highest = False
            if highest:
                second = value
    r, c = search + row, search + col
    found[0] = col
    found[1] = row
    found[2] = _vertex(surface[r, c - 1], surface[r, c], surface[r, c + 1])
    found[3] = _vertex(surface[r - 1, c], surface[r, c], surface[r + 1, c])
    found[4] = best
    found[5] = second
    return True


@njit(cache=True)
def _vertex(before: float, at: float, after: float) -> float:
    curvature = before - 2.0 * at + after
    if curvature >= 0.0:
        return 0.0
    return min(0.5, max(-0.5, 0.5 * (before - after) / curvature))
