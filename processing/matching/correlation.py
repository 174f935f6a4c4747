"""Correlation search: the best match of a window in another patch, to a whole pixel.

Compiled kernels; refining the place is done in `processing.matching.least_squares`.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

MARGIN_PX: Final = 4
"""Pixels a patch needs around its window: four taps and the largest half shift."""


_TAPS: Final = 8
"""Pixels of the template that are taken at once."""


@compiled_kernel()
def correlation_scratch(side: int, search: int) -> tuple[Array, Array, Array, Array, Array]:
    """Memory for `correlate`.

    Args:
        side: side of the window, px, odd.
        search: largest offset of `correlate`, px.

    Returns:
        Template (side, side), products at all offsets (2 search + 1, 2 search + 1), spreads of a
        row of them, and two rows of sums of b. Rows of the first two come in whole vectors of
        eight.
    """
    wide = side + 2 * MARGIN_PX + 2 * search
    return (
        np.zeros((side, (side + _TAPS - 1) // _TAPS * _TAPS), np.float32),
        np.empty((2 * search + 1, (2 * search + 8) // 8 * 8), np.float32),
        np.empty(2 * search + 1, np.float32),
        np.empty(wide),
        np.empty(wide),
    )


@compiled_kernel(fastmath=True)
def correlate(
    a: Array,
    b: Array,
    half: int,
    reach: Array,
    scratch: tuple[Array, Array, Array, Array, Array],
    surface: Array,
) -> None:
    """Normalised cross correlation of a's window with b at all offsets.

    Args:
        a: patch, (2 half + 1 + 2 `MARGIN_PX`) squared, with the window in its middle.
        b: patch, wider by twice the search range.
        half: half of the window's side, px.
        reach: first and last column offset, first and last row offset to be tried, (4,) int64, px.
        scratch: from `correlation_scratch`.
        surface: receives the coefficients, (2 search + 1, 2 search + 1), row and column offset; -2
            where not tried or without contrast.

    Source: docs/explanation/mathematics/matching.md#correlation.
    """
    template, products, spreads, sums, squares = scratch
    side = 2 * half + 1
    n = side * side
    search = (surface.shape[1] - 1) // 2
    wide = b.shape[1]
    mean = np.float32(0.0)
    for r in range(side):
        for c in range(side):
            mean += a[r + MARGIN_PX, c + MARGIN_PX]
    mean /= np.float32(n)
    energy = 0.0
    for r in range(side):
        for c in range(side):
            value = a[r + MARGIN_PX, c + MARGIN_PX] - mean
            template[r, c] = value
            energy += value * value
    surface[:] = np.float32(-2.0)
    sums[:] = 0.0
    squares[:] = 0.0
    first = MARGIN_PX + search + reach[2]
    for r in range(first, first + side):
        for j in range(wide):
            value = float(b[r, j])
            sums[j] += value
            squares[j] += value * value
    left = MARGIN_PX + search + reach[0]
    count = reach[1] - reach[0] + 1
    products = products[: reach[3] - reach[2] + 1]
    _products(b.reshape(-1), first * wide + left, wide, template, products)
    for dr in range(reach[2], reach[3] + 1):
        top = MARGIN_PX + search + dr
        total = square = 0.0
        for j in range(left, left + side):
            total += sums[j]
            square += squares[j]
        for k in range(count):
            spreads[k] = (square - total * total / n) * energy
            total += sums[left + k + side] - sums[left + k]
            square += squares[left + k + side] - squares[left + k]
        product = products[dr - reach[2]]
        line = surface[search + dr, search + reach[0] : search + reach[1] + 1]
        for k in range(count):
            steep = spreads[k] > np.float32(1e-6)
            found = product[k] / np.sqrt(spreads[k] if steep else np.float32(1.0))
            line[k] = found if steep else np.float32(-2.0)
        if dr < reach[3]:
            for j in range(wide):
                leaving = float(b[top, j])
                coming = float(b[top + side, j])
                sums[j] += coming - leaving
                squares[j] += coming * coming - leaving * leaving


@compiled_kernel(fastmath=True)
def _products(flat: Array, first: int, wide: int, template: Array, products: Array) -> None:
    """Sums of template times window for all offsets, the first window beginning at word `first`.

    Vectors hold neighbouring offsets, so nothing is summed across them, and rows of offsets take
    turns, so that no sum waits for itself. What is read beyond a window stays within the patch:
    it has a margin below.
    """
    products[:] = np.float32(0.0)
    count, vector_count = products.shape
    for r in range(template.shape[0]):
        for c in range(0, template.shape[1], _TAPS):
            t = template[r, c : c + _TAPS]
            taps = (t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7])
            for k in range(count):
                start = first + (r + k) * wide + c
                source = flat[start : start + vector_count + _TAPS - 1]
                # A count known to the compiler: two vectors and nothing left over.
                if vector_count == 16:
                    _add_taps(source, taps, products[k], 16)
                else:
                    _add_taps(source, taps, products[k], vector_count)


@compiled_kernel(fastmath=True, inline="always")
def _add_taps(s: Array, w: tuple[Any, ...], o: Array, count: int) -> None:
    w0, w1, w2, w3, w4, w5, w6, w7 = w
    for j in range(count):
        o[j] += (
            w0 * s[j]
            + w1 * s[j + 1]
            + w2 * s[j + 2]
            + w3 * s[j + 3]
            + w4 * s[j + 4]
            + w5 * s[j + 5]
            + w6 * s[j + 6]
            + w7 * s[j + 7]
        )


@compiled_kernel()
def peak(surface: Array, reach: Array, found: Array) -> bool:
    """Find the highest coefficient and the next local maximum.

    Args:
        surface: coefficients from `correlate`, (2 search + 1, 2 search + 1).
        reach: as of `correlate`.
        found: receives column offset and row offset, px; their parts below a pixel by a parabola,
            -0.5 to 0.5 px; height of the peak; height of the next maximum, -1 without one; (6,).

    Returns:
        False where the peak is on the edge of the search range or not above zero.

    Source: docs/explanation/mathematics/matching.md#correlation.
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
                        break
                if not highest:
                    break
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


@compiled_kernel()
def _vertex(before: float, at: float, after: float) -> float:
    curvature = before - 2.0 * at + after
    if curvature >= 0.0:
        return 0.0
    return min(0.5, max(-0.5, 0.5 * (before - after) / curvature))
