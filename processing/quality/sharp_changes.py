"""Changes between two lines of pixels that are sharper than a lens can draw them.

The change from one line to the next less half of those before and after it is a step as it is, and
little of an edge that is spread over several lines.

Source: docs/explanation/mathematics/quality.md#rectangles-with-another-offset.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

WINDOW: Final = 5
SHARP_BUNDLES: Final = 4
"""So many of neighbouring bundles have a change of one sign that is sharp."""
SHARP: Final = 1.6
"""Over the standard deviation of the curvature around."""
BLOCK: Final = 32


@compiled_kernel()
def runs_of_sharp(
    sizes: Array, has_run: Array, least: float, window: int, enough: int
) -> tuple[Array, Array]:
    """Runs of bundles with sharp changes of one sign, where windows with enough of them touch.

    Args:
        sizes: by `sizes_at`, (bundles, places).
        has_run: whether enough bundles rise, and fall, (2, places).
        least: size from which on a change is sharp.
        window: neighbouring bundles.
        enough: of these.

    Returns:
        Of each run its sign, the number of its place, its first bundle and the one after its last,
        (n, 4) int64; and its mean size times the square root of its length.
    """
    bundles, found = len(sizes), 0
    # Runs are at least a bundle apart.
    runs = np.empty((has_run.size * bundles, 4), np.int64)
    mean_sizes = np.empty(len(runs))
    for k in range(2):
        sign = np.float32(1.0 - 2.0 * k)
        for at in np.flatnonzero(has_run[k]):
            begin = end = -1
            for j in range(bundles - window + 2):
                hits = 0
                if j <= bundles - window:
                    for i in range(j, j + window):
                        hits += sign * sizes[i, at] > least
                is_near = hits >= enough
                if begin >= 0 and (j > bundles - window or (is_near and j - end > window)):
                    start, stop = begin, end + window
                    while not sign * sizes[start, at] > least:
                        start += 1
                    while not sign * sizes[stop - 1, at] > least:
                        stop -= 1
                    total = 0.0
                    for i in range(start, stop):
                        total += sign * sizes[i, at]
                    runs[found] = np.array([1 - 2 * k, at, start, stop])
                    mean_sizes[found] = total / math.sqrt(stop - start)
                    found += 1
                    begin = -1
                if is_near:
                    if begin < 0:
                        begin = j
                    end = j
    return runs[:found], mean_sizes[:found]


@compiled_kernel(fastmath={"reassoc", "contract"})
def sharp_lines(means: Array, least: float, window: int, enough: int) -> tuple[Array, Array]:
    """One over the usual change (bundles, blocks), and where enough neighbouring bundles change.

    The change from one line to the next less half of those before and after it, which is a step as
    it is, is compared with its mean size over the block of lines it is in and those next to it.

    Args:
        means: of bundles along lines, (bundles, lines) float32.
        least: size from which on a change is sharp.
        window: neighbouring bundles.
        enough: of these.

    Returns:
        Over the usual change, and whether so many of `window` bundles rise, and fall, (2, lines).
    """
    bundles, lines = means.shape
    blocks = -(-lines // BLOCK)
    over = np.empty((bundles, blocks), np.float32)
    usual = np.zeros(blocks + 2, np.float32)
    size = np.zeros(lines, np.float32)
    # Bytes, of which vectors hold many.
    rises = np.zeros((window, lines), np.uint8)
    falls = np.zeros((window, lines), np.uint8)
    hits = np.zeros((2, lines), np.uint8)
    places = np.zeros((2, lines), np.uint8)
    limit, some = np.float32(least), np.uint8(enough)
    for k in range(bundles):
        _curve(means[k], size)
        for b in range(blocks):
            # Parts begin at 0: places that might be negative are not added up in vectors.
            part = size[b * BLOCK : b * BLOCK + BLOCK]
            total: Any = np.float32(0.0)
            for i in range(len(part)):
                total += abs(part[i])
            usual[b + 1] = total / np.float32(len(part))
        usual[0], usual[blocks + 1] = usual[1], usual[blocks]
        rise, fall = rises[k % window], falls[k % window]
        up, down = hits[0], hits[1]
        for i in range(lines):
            up[i] -= rise[i]
            down[i] -= fall[i]
        for b in range(blocks):
            # Of normally distributed changes, a standard deviation is 1.25 times their mean size.
            sigma = (usual[b] + usual[b + 1] + usual[b + 2]) * np.float32(1.2533 / 3.0)
            over[k, b] = np.float32(1.0) / (sigma + np.float32(0.25))
            allowed = limit * (sigma + np.float32(0.25))
            part = size[b * BLOCK : b * BLOCK + BLOCK]
            rise_there, fall_there = rise[b * BLOCK :], fall[b * BLOCK :]
            for i in range(len(part)):
                rise_there[i] = part[i] > allowed
                fall_there[i] = part[i] < -allowed
        some_rise, some_fall = places[0], places[1]
        for i in range(lines):
            up[i] += rise[i]
            down[i] += fall[i]
            some_rise[i] |= up[i] >= some
            some_fall[i] |= down[i] >= some
    return over, places != 0


@compiled_kernel()
def _curve(row: Array, size: Array) -> None:
    """Change to the next line less half of those before and after it, 0 at the ends."""
    before, here, after, last = row[:-3], row[1:-2], row[2:-1], row[3:]
    inner = size[1:-2]
    for i in range(len(inner)):
        sharp = np.float32(1.5) * (after[i] - here[i])
        inner[i] = sharp - np.float32(0.5) * (last[i] - before[i])


@compiled_kernel()
def sizes_at(means: Array, over: Array, places: Array) -> Array:
    """The changes of all bundles at some lines over the usual one.

    Args:
        means: of bundles along lines, (bundles, lines) float32.
        over: one over the usual change, by `sharp_lines`.
        places: the lines, (places,).

    Returns:
        (bundles, places) float32.
    """
    bundles, lines = means.shape
    sizes = np.zeros((bundles, len(places)), np.float32)
    for j in range(len(places)):
        i = places[j]
        if i < 1 or i > lines - 3:
            continue
        for k in range(bundles):
            change = np.float32(1.5) * (means[k, i + 1] - means[k, i])
            change -= np.float32(0.5) * (means[k, i + 2] - means[k, i - 1])
            sizes[k, j] = change * over[k, i // BLOCK]
    return sizes
