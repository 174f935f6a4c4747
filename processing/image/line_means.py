"""Means of bundles of pixels along every row and every column of a frame.

The radiometric pass takes the sums while it holds the pixels (`processing.radiometry.level1`); here
they are taken of a frame that is in memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

BUNDLE_PX: Final = 32
BUNDLES: Final = 39
"""So many bundles of pixels of a line are averaged, or as many as fit in it."""
SHARE: Final = np.float32(1.0 / BUNDLE_PX)
"""Of one pixel in the mean of a bundle: a power of two, so that products are exact."""
_AT_ONCE: Final = 8
"""Rows that are added to the sums of the columns at once."""
_TILE_ROWS: Final = 16
"""Rows that are transposed at once: their words of one bundle fill a line of cache."""


@dataclass(frozen=True)
class LineMeans:
    """Means of bundles of pixels along every line of a frame, float32.

    `by_row` (bundles, rows) begins with row `first_row`, `by_column` is (bundles, columns); no
    bundles where the frame is smaller than one.
    """

    by_row: Array
    by_column: Array
    first_row: int


def line_means(frame: Array, rows: tuple[int, int]) -> LineMeans:
    """Average bundles of pixels along every row and along every column.

    Args:
        frame: (h, w) uint16.
        rows: first and last row looked at.

    Returns:
        Means in the unit of the frame; no bundles where it is smaller than one.
    """
    first, last = rows
    by_row, by_column = line_buffers(last + 1 - first, frame.shape[1])
    if by_row.size and by_column.size:
        _average_lines(frame[first : last + 1], by_row, by_column)
    return means_of(by_row, by_column, first)


def line_buffers(height: int, width: int) -> tuple[Array, Array]:
    """Zeros for the means of bundles.

    Args:
        height: rows, px.
        width: columns, px.

    Returns:
        Means along rows (height, bundles) and along columns (bundles, width), float32.
    """
    # The bundles of a row lie side by side: one row is written at a time.
    by_row = np.zeros((height, min(BUNDLES, width // BUNDLE_PX)), np.float32)
    by_column = np.zeros((min(BUNDLES, height // BUNDLE_PX), width), np.float32)
    return by_row, by_column


def means_of(by_row: Array, by_column: Array, first_row: int) -> LineMeans:
    """The means that `add_line` made of every row.

    Args:
        by_row: means along rows, (rows, bundles) float32.
        by_column: means along columns, (bundles, columns) float32; shared.
        first_row: row of the frame with which `by_row` begins.

    Returns:
        Both with one line after the other.
    """
    along_rows = np.empty(by_row.shape[::-1], np.float32)
    _transpose(by_row, along_rows)
    return LineMeans(along_rows, by_column, first_row)


@compiled_kernel()
def _transpose(by_row, along_rows):
    rows, bundles = by_row.shape
    for first in range(0, rows, _TILE_ROWS):
        last = min(first + _TILE_ROWS, rows)
        for k in range(bundles):
            for r in range(first, last):
                along_rows[k, r] = by_row[r, k]


@compiled_kernel(parallel=True)
def _average_lines(frame, by_row, by_column):
    height = len(frame)
    blocks = len(by_column)
    tall = height // blocks
    for block in prange(blocks):
        first = block * tall
        last = height if block == blocks - 1 else first + tall
        for r in range(first, last):
            add_line(frame, r, r - first, by_row[r], by_column[block])


@compiled_kernel()
def add_line(frame, row, row_of_block, of_row, by_column):
    """Average the bundles of one line, and add it to those of the columns.

    All sums are exact: of a bundle of words they have less than 24 bits.

    Args:
        frame: (h, w) uint16; of a block every row, from its first on.
        row: of the line.
        row_of_block: its place within the block of rows that a bundle of each column is of.
        of_row: (bundles,) float32, overwritten.
        by_column: (w,) float32, means of this block's bundle; without columns nothing is added.
    """
    line = frame[row]
    bundles = len(of_row)
    wide = np.uint64(len(line) // max(bundles, 1))
    for k in range(bundles):
        # Sums stay 32 bits wide, so that vectors hold eight of them and not four.
        total = np.int32(0)
        # Unsigned places are not looked at for negative ones.
        first = np.uint64(k) * wide
        for c in range(BUNDLE_PX):
            total = np.int32(total + line[first + np.uint64(c)])
        of_row[k] = np.float32(total) * SHARE
    if row_of_block < BUNDLE_PX and row_of_block % _AT_ONCE == _AT_ONCE - 1 and len(by_column):
        one, two, three, four = frame[row - 7], frame[row - 6], frame[row - 5], frame[row - 4]
        five, six, seven = frame[row - 3], frame[row - 2], frame[row - 1]
        for c in range(len(by_column)):
            total = np.int32(np.int32(one[c]) + np.int32(two[c]))
            total = np.int32(total + np.int32(np.int32(three[c]) + np.int32(four[c])))
            total = np.int32(total + np.int32(np.int32(five[c]) + np.int32(six[c])))
            total = np.int32(total + np.int32(np.int32(seven[c]) + np.int32(line[c])))
            by_column[c] += np.float32(total) * SHARE


@compiled_kernel()
def add_changes(changes, places, width, first_row, by_row, by_column):
    """Add what some pixels of a frame were changed by to the means of bundles.

    Args:
        changes: of their words, (n,) int32.
        places: their row and column in the frame, (n, 2).
        width: of the frame, px.
        first_row: row of the frame with which `by_row` begins.
        by_row: means along rows, changed in place, (rows, bundles) float32.
        by_column: means along columns, changed in place, (bundles, columns) float32.
    """
    height, bundles = by_row.shape
    blocks = len(by_column)
    if bundles == 0 or blocks == 0:
        return
    # Tables instead of two divisions for every pixel.
    of_column = _bundles_of(width, width // bundles, bundles)
    of_row = _bundles_of(height, height // blocks, blocks)
    for i in range(len(places)):
        r, column = places[i, 0] - first_row, places[i, 1]
        if r < 0 or r >= height:
            continue
        change = np.float32(changes[i]) * SHARE
        k, block = of_column[column], of_row[r]
        if k >= 0:
            by_row[r, k] += change
        if block >= 0:
            by_column[block, column] += change


@compiled_kernel()
def _bundles_of(length, pace, bundles):
    """The bundle that each pixel of a line is of, -1 for none."""
    found = np.full(length, -1, np.int16)
    for k in range(bundles):
        found[k * pace : k * pace + BUNDLE_PX] = k
    return found
