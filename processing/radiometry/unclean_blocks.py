"""Blocks of a Level-1 frame that hold saturated pixels or pixels without data.

The radiometric pass marks them while it holds the pixels, so that resampling need not read a whole
frame once more to find them.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

BLOCK_PX: Final = 64
"""Side of a block."""


def unknown_blocks(height: int, width: int) -> Array:
    """Marks of a frame of which nothing is known: every block may hold such pixels.

    Args:
        height: of the frame, px.
        width: of the frame, px.

    Returns:
        Ones, (rows, columns) of blocks, uint8.

    Example:
        >>> unknown_blocks(65, 64).tolist()
        [[1], [1]]
    """
    return np.ones((-(-height // BLOCK_PX), -(-width // BLOCK_PX)), np.uint8)


def begin_marks(unclean: Array, height: int, rows: tuple[int, int]) -> None:
    """Mark what the unexposed rows of a frame touch, and nothing else.

    Args:
        unclean: marks, (rows, columns) of blocks, uint8; overwritten.
        height: of the frame, px.
        rows: first and last exposed row; the others hold no data.
    """
    first, end = rows[0], rows[1] + 1
    unclean[:] = 0
    unclean[: -(-first // BLOCK_PX)] = 1
    if end < height:
        unclean[end // BLOCK_PX :] = 1


@compiled_kernel()
def mark_line(line, row, unclean):
    """Mark the blocks in which a line holds saturated pixels.

    Args:
        line: Level-1 words, (w,) uint16.
        row: of the frame.
        unclean: marks, (rows, columns) of blocks, uint8; nothing is marked where it has no rows.
    """
    if len(unclean) == 0:
        return
    for j in range(unclean.shape[1]):
        odd_bits = np.uint16(0)
        for k in range(j * BLOCK_PX, min((j + 1) * BLOCK_PX, len(line))):
            odd_bits |= line[k]
        if odd_bits & np.uint16(1):
            unclean[row // BLOCK_PX, j] = np.uint8(1)


@compiled_kernel()
def mark_pixels(frame, places, unclean):
    """Mark the blocks of those pixels that are saturated or without data.

    Args:
        frame: Level-1 words, (h, w) uint16.
        places: row and column in the frame, (n, 2) int32.
        unclean: marks, (rows, columns) of blocks, uint8.
    """
    for i in range(len(places)):
        row, column = places[i, 0], places[i, 1]
        word = frame[row, column]
        if word == 0 or word & np.uint16(1):
            unclean[row // BLOCK_PX, column // BLOCK_PX] = np.uint8(1)
