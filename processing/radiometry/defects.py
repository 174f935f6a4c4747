"""Defect pixels of Level-1 frames: filled from good neighbours along the least gradient.

Source: docs/explanation/mathematics/radiometry.md#defects; Heier et al. (2002), 5.2.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

_REACH_PX: Final = 8
_NEAR_TAP: Final = 0.65
"""Weight of each of the two nearest pixels; those behind them have a half less that."""
_DIAGONAL: Final = 2**0.5
_EVEN_COUNTS: Final = 32.0
"""Level-1 counts (4 DN of 12 bits), a half of the noise: gradients this small are alike."""


def spread_defects(
    defects: Array, shape: tuple[int, int], shifts: int, sign: int
) -> tuple[Array, Array]:
    """The defects after so many TDI shifts, as a map of bits and as places.

    Args:
        defects: (row, column) of the sensor's defects, (m, 2).
        shape: height and width of the frame.
        shifts: TDI shifts.
        sign: `tdi_row_sign` of the sensor.

    Returns:
        The map, (h, ceil(w / 8)) uint8: bit c % 8 of byte c // 8 marks column c. (row, column) of
        its defects, row by row, (n, 2) int32.

    Example:
        Two shifts towards higher rows: a defect in row 0 spoils rows 0 to 2.

        >>> mask, places = spread_defects(np.array([[0, 1]]), (4, 3), 2, 1)
        >>> mask.ravel(), places.tolist()
        (array([2, 2, 2, 0], dtype=uint8), [[0, 1], [1, 1], [2, 1]])
    """
    height, width = shape
    rows = defects[:, :1].astype(np.int64) + sign * np.arange(shifts + 1)
    spoilt = np.sort((rows * width + defects[:, 1:])[(rows >= 0) & (rows < height)])
    row, column = np.divmod(spoilt[np.diff(spoilt, prepend=-1) > 0], width)
    mask = np.zeros((height, -(-width // 8)), np.uint8)
    np.bitwise_or.at(mask, (row, column // 8), np.uint8(1) << (column % 8).astype(np.uint8))
    return mask, np.stack([row, column]).astype(np.int32).T


@compiled_kernel(inline="always")
def _is_marked(mask, row, column):
    return (mask[row, column >> 3] >> (column & 7)) & 1 != 0


@compiled_kernel(parallel=True)
def interpolate_defects(level1, mask, places, period, changes):
    """Fill each defect from the nearest good pixels on both sides, along the least gradient.

    Directions of nearly the least gradient share, for their noise is not the same. Where two good
    pixels lie on either side, all four are taken: a line through two cuts off every crest.

    The gradient of a direction is the mean of what the pixels of a 5 x 5 neighbourhood differ from
    their neighbour in that direction, good ones only: many chords, so that noise does not choose.
    Only good pixels are read, so the order of the work does not matter.

    Args:
        level1: Level-1 words, shape (h, w), uint16; filled in place, 0 where nothing is in reach.
        mask: defects, bits as of `spread_defects`.
        places: (row, column) of the defects, shape (n, 2), int32.
        period: pixels so far apart in row or column are of one colour; no others are compared.
        changes: takes by how much each word was changed, (n,) int32.

    Source: docs/explanation/mathematics/radiometry.md#defects.
    """
    height, width = level1.shape
    for index in prange(places.shape[0]):
        row = places[index, 0]
        column = places[index, 1]
        best = 1e30
        marked = 0
        total = weights = 0.0
        for direction in range(4):
            step_row = np.int64(0) if direction == 0 else np.int64(period)
            step_column = np.int64(period)
            if direction == 1:
                step_column = np.int64(0)
            elif direction == 3:
                step_column = np.int64(-period)
            # Two numbers each: an array would be asked of the heap for every defect.
            before = after = 0.0
            to_before = to_after = 0.0
            saturated = 0
            for side in range(2):
                way = 2 * side - 1
                for reach in range(1, _REACH_PX + 1):
                    r = row + way * reach * step_row
                    c = column + way * reach * step_column
                    if r < 0 or c < 0 or r >= height or c >= width:
                        break
                    if not _is_marked(mask, r, c) and level1[r, c] != 0:
                        value = np.float64(level1[r, c] & 0xFFFE)
                        saturated |= level1[r, c] & 1
                        if side == 0:
                            before, to_before = value, np.float64(reach)
                        else:
                            after, to_after = value, np.float64(reach)
                        break
            if to_before == 0.0 or to_after == 0.0:
                continue
            gradient = abs(after - before) / (to_before + to_after)
            chords = 1
            for r in range(max(row - 2, 0), min(row + 3, height)):
                for c in range(max(column - 2, 0), min(column + 3, width)):
                    r2 = r + step_row
                    c2 = c + step_column
                    if r2 >= height or c2 < 0 or c2 >= width:
                        continue
                    if _is_marked(mask, r, c) or _is_marked(mask, r2, c2):
                        continue
                    if level1[r, c] == 0 or level1[r2, c2] == 0:
                        continue
                    gradient += abs(np.float64(level1[r, c]) - np.float64(level1[r2, c2]))
                    chords += 1
            error = gradient / chords * (to_before + to_after)
            if step_row != 0 and step_column != 0:
                error *= _DIAGONAL
            filled = before + (after - before) * to_before / (to_before + to_after)
            r, c = row - 2 * step_row, column - 2 * step_column
            r2, c2 = row + 2 * step_row, column + 2 * step_column
            if (
                to_before + to_after == 2.0
                and r >= 0
                and r2 < height
                and min(c, c2) >= 0
                and max(c, c2) < width
                and not (_is_marked(mask, r, c) or _is_marked(mask, r2, c2))
                and not (level1[r, c] == 0 or level1[r2, c2] == 0)
            ):
                outer = np.float64(level1[r, c] & 0xFFFE) + np.float64(level1[r2, c2] & 0xFFFE)
                filled = _NEAR_TAP * (before + after) + (0.5 - _NEAR_TAP) * outer
            share = 1.0 / (error + _EVEN_COUNTS) ** 4
            total += share * filled
            weights += share
            if error < best:
                best = error
                marked = saturated
        found = 0
        if weights > 0.0:
            # Half of the word and its doubling leave the lowest bit to the saturation mark.
            half = int(0.5 * total / weights + 0.5)
            found = 2 * min(max(half, 1), 32767) + marked
        changes[index] = np.int32(found) - np.int32(level1[row, column])
        level1[row, column] = found
