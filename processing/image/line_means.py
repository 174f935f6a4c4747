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
    by_row = np.zeros((min(BUNDLES, width // BUNDLE_PX), height), np.uint32)
    by_column = np.zeros((min(BUNDLES, height // BUNDLE_PX), width), np.uint32)
    if by_row.size and by_column.size:
        _sum_lines(frame, by_row, by_column)
    share = np.float32(1.0 / BUNDLE_PX)  # a power of two: exact
    return by_row.astype(np.float32) * share, by_column.astype(np.float32) * share


@njit(cache=True, parallel=True, nogil=True)
def _sum_lines(frame, by_row, by_column):
    height, width = frame.shape
    blocks, bundles = by_column.shape[0], by_row.shape[0]
    tall, wide = height // blocks, width // bundles
    for block in prange(blocks):
        first = block * tall
        last = height if block == blocks - 1 else first + tall
        sums = by_column[block]
        # Sums in elements of 32 bits: numba's scalars would be of 64, and half as many at a time.
        total = np.zeros(1, np.uint32)
        for r in range(first, last):
            line = frame[r]
            for k in range(bundles):
                total[0] = 0
                part = line[k * wide : k * wide + BUNDLE_PX]
                for c in range(BUNDLE_PX):
                    total[0] += part[c]
                by_row[k, r] = total[0]
        for r in range(first, first + BUNDLE_PX, 4):
            one, two, three, four = frame[r], frame[r + 1], frame[r + 2], frame[r + 3]
            for c in range(width):
                sums[c] += np.uint32(one[c]) + two[c] + three[c] + four[c]
