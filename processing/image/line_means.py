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
    by_row, by_column = line_sums(last + 1 - first, frame.shape[1])
    if by_row.size and by_column.size:
        _sum_lines(frame[first : last + 1], by_row, by_column)
    return means_of_sums(by_row, by_column, first)


def line_sums(height: int, width: int) -> tuple[Array, Array]:
    """Zeros for the sums of bundles.

    Args:
        height: rows, px.
        width: columns, px.

    Returns:
        Sums along rows (height, bundles) and along columns (bundles, width), uint32.
    """
    # The bundles of a row lie side by side: one row is written at a time.
    by_row = np.zeros((height, min(BUNDLES, width // BUNDLE_PX)), np.uint32)
    by_column = np.zeros((min(BUNDLES, height // BUNDLE_PX), width), np.uint32)
    return by_row, by_column


def means_of_sums(by_row: Array, by_column: Array, first_row: int) -> LineMeans:
    """Means of bundles from their sums.

    Args:
        by_row: sums along rows, (rows, bundles) uint32.
        by_column: sums along columns, (bundles, columns) uint32.
        first_row: row of the frame with which `by_row` begins.

    Returns:
        Means, float32.
    """
    share = np.float32(1.0 / BUNDLE_PX)  # a power of two: exact
    means = LineMeans(
        np.empty(by_row.shape[::-1], np.float32), np.empty(by_column.shape, np.float32), first_row
    )
    _divide_sums(by_row, by_column, share, means.by_row, means.by_column)
    return means


@compiled_kernel()
def _divide_sums(by_row, by_column, share, means_by_row, means_by_column):
    rows, bundles = by_row.shape
    for first in range(0, rows, _TILE_ROWS):
        last = min(first + _TILE_ROWS, rows)
        for k in range(bundles):
            for r in range(first, last):
                means_by_row[k, r] = np.float32(by_row[r, k]) * share
    for k in range(len(by_column)):
        sums, means = by_column[k], means_by_column[k]
        for c in range(len(sums)):
            means[c] = np.float32(sums[c]) * share


@compiled_kernel(parallel=True)
def _sum_lines(frame, by_row, by_column):
    height = len(frame)
    blocks = len(by_column)
    tall = height // blocks
    for block in prange(blocks):
        first = block * tall
        last = height if block == blocks - 1 else first + tall
        for r in range(first, last):
            add_line(frame[r], r - first, by_row[r], by_column[block])


@compiled_kernel()
def add_line(line, row_of_block, of_row, by_column):
    """Sum the bundles of one line, and add it to those of the columns.

    Args:
        line: (w,) uint16.
        row_of_block: its place within the block of rows that a bundle of each column is of.
        of_row: (bundles,) uint32, overwritten.
        by_column: (w,) uint32, sums of this block's bundle; without columns nothing is added.
    """
    bundles = len(of_row)
    wide = len(line) // max(bundles, 1)
    for k in range(bundles):
        # Sums stay 32 bits wide, so that vectors hold eight of them and not four.
        total = np.uint32(0)
        part = line[k * wide : k * wide + BUNDLE_PX]
        for c in range(BUNDLE_PX):
            total = np.uint32(total + part[c])
        of_row[k] = total
    if row_of_block < BUNDLE_PX:
        for c in range(len(by_column)):
            by_column[c] += line[c]


@compiled_kernel()
def add_pixels(frame, places, first_row, sign, by_row, by_column):
    """Add some pixels to the sums of bundles, or subtract them.

    Args:
        frame: (h, w) uint16.
        places: row and column in the frame, (n, 2).
        first_row: row of the frame with which `by_row` begins.
        sign: 1 adds, -1 subtracts.
        by_row: sums along rows, changed in place, (rows, bundles) uint32.
        by_column: sums along columns, changed in place, (bundles, columns) uint32.
    """
    height, bundles = by_row.shape
    blocks = len(by_column)
    if bundles == 0 or blocks == 0:
        return
    wide, tall = frame.shape[1] // bundles, height // blocks
    for i in range(len(places)):
        row, column = places[i, 0], places[i, 1]
        r = row - first_row
        if r < 0 or r >= height:
            continue
        # Sums of unsigned words wrap, so that taking off and adding leaves them exact.
        value = np.uint32(sign * np.int64(frame[row, column]))
        k, block = column // wide, r // tall
        if k < bundles and column - k * wide < BUNDLE_PX:
            by_row[r, k] += value
        if block < blocks and r - block * tall < BUNDLE_PX:
            by_column[block, column] += value
