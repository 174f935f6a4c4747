"""Means of bundles of pixels along every row and every column of a frame."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array = NDArray[Any]

BUNDLE_PX: Final = 32
BUNDLES: Final = 39
"""So many bundles of pixels of a line are averaged, or as many as fit in it."""


def line_means(frame: Array) -> tuple[Array, Array]:
    """Average bundles of pixels along every row and along every column.

    Args:
        frame: (h, w) uint16.

    Returns:
        Means (bundles, h) along rows and (bundles, w) along columns, float32; no bundles where the
        frame is smaller than one.
    """
    height, width = frame.shape
    by_row = np.zeros((height, min(BUNDLES, width // BUNDLE_PX)), np.float32)
    by_column = np.zeros((min(BUNDLES, height // BUNDLE_PX), width), np.float32)
    if by_row.size and by_column.size:
        _sum_lines(frame, by_row, by_column)
    return by_row.T / BUNDLE_PX, by_column / BUNDLE_PX


@njit(cache=True, parallel=True, nogil=True)
def _sum_lines(frame, by_row, by_column):
    height, width = frame.shape
    blocks, bundles = by_column.shape[0], by_row.shape[1]
    tall, wide = height // blocks, width // bundles
    for block in prange(blocks):
        first = block * tall
        last = height if block == blocks - 1 else first + tall
        sums = by_column[block]
        for r in range(first, last):
            line = frame[r]
            for k in range(bundles):
                total = np.int64(0)
                for c in range(k * wide, k * wide + BUNDLE_PX):
                    total += line[c]
                by_row[r, k] = total
            if r < first + BUNDLE_PX:
                for c in range(width):
                    sums[c] += np.float32(line[c])
