"""One resampling from raw geometry to a target raster, fused with gain, seams and validity.

Inverse mapping: each target pixel is fetched from the sensor position that the lattice gives for
it. Which sensor serves which pixel is decided in `processing.image.seams`, the lattice comes from
`processing.image.lattice`.

Words are Level-1 words (`processing.radiometry.level1`) on the way in; on the way out 0 is no data,
every other value is signal.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement
from processing.image.cells import (
    MAX_CELL_PX,
    fetch_cell,
    fetch_straight,
    fetch_straight_values,
    straight_taps,
)
from processing.image.compiled_kernel import compiled_kernel
from processing.image.kernels import KERNELS, Interpolation
from processing.image.lattice import OUTSIDE
from processing.image.taps import LINE_LENGTH, MISSING
from processing.radiometry.unclean_blocks import unknown_blocks

Array = NDArray[Any]

WEIGHT_STEP_PX: Final = 8
"""Seam weights are given at every eighth target pixel."""
WEIGHT_UNIT: Final = 255
SATURATED_SOURCE: Final = 0x80
SUPPORT_MARGIN_PX: Final = 2
"""Raw pixels lost at each side, so that six taps never leave the exposed rows."""

_STRIP_ROWS: Final = 16
"""Rows that are fetched side by side: their scratch stays in the nearest cache, and a core keeps
the addresses of about so many pages it writes to at hand. Twice as many take 1.7 times as long."""


def resample(
    frames: Array,
    valid: Array,
    lattices: Array,
    cell_px: int,
    weights: Array,
    gains: Array,
    *,
    offsets: Array | None = None,
    interpolation: Interpolation,
    out: Array,
    source: Array,
    unclean: Array | None = None,
) -> None:
    """Fetch every target pixel from the frames.

    Args:
        frames: (n, rows, columns) uint16, Level-1 words.
        valid: (n, 4) float64: first and last usable raw column, first and last usable raw row.
        lattices: (n, rows, columns, 2) float64, one per frame.
        cell_px: lattice spacing, a multiple of `WEIGHT_STEP_PX`.
        weights: (n, rows, columns) uint8 at every `WEIGHT_STEP_PX`-th target pixel.
        gains: (n,) float32, applied to the signal.
        offsets: (n,) float32, added after the gain; None adds nothing.
        interpolation: name of the kernel.
        out: (height, width) uint16; 0 is no data.
        source: (height, width) uint8: 0 no data, else 1 + index of the frame of greatest weight,
            with `SATURATED_SOURCE` set where one of the four nearest raw pixels was saturated.
        unclean: marks of the frames' blocks (`processing.radiometry.unclean_blocks`), (n, rows,
            columns) uint8; None looks at all pixels.

    Raises:
        ValueError: a cell that is no multiple of the weight step, or larger than `MAX_CELL_PX`.

    Source: docs/explanation/mathematics/resampling.md#evaluation and #saturation-and-holes.
    """
    if cell_px % WEIGHT_STEP_PX or not 0 < cell_px <= MAX_CELL_PX:
        raise ValueError(
            f"cell of {cell_px} px; it is a multiple of {WEIGHT_STEP_PX}, at most {MAX_CELL_PX}"
        )
    kernel = KERNELS[interpolation]
    if unclean is None:
        one = unknown_blocks(*frames.shape[1:])
        unclean = np.ones((len(frames), *one.shape), np.uint8)
    _resample(
        frames,
        valid,
        lattices,
        cell_px,
        weights,
        gains,
        np.zeros(len(gains), np.float32) if offsets is None else offsets,
        kernel.table,
        kernel.reach,
        out,
        source,
        unclean,
    )


def usable_area(placement: SensorPlacement, rows: tuple[int, int]) -> Sequence[float]:
    """Raw pixels of a sensor that the widest kernel may be centred on.

    Args:
        placement: of the sensor.
        rows: first and last fully exposed row (`processing.radiometry.level1`).

    Returns:
        First and last usable raw column, first and last usable raw row.
    """
    margin = SUPPORT_MARGIN_PX
    return (
        float(margin),
        float(placement.sensor.width_px - 1 - margin) - 1e-3,
        float(rows[0] + margin),
        float(rows[1] - margin) - 1e-3,
    )


@compiled_kernel(fastmath=True)
def _weights_along(weights, y, x0, n, line):
    """Weights of n pixels of a target row, bilinear between their nodes."""
    i = y // WEIGHT_STEP_PX
    f = np.float32(y - i * WEIGHT_STEP_PX) / np.float32(WEIGHT_STEP_PX)
    upper = np.float32(1.0) - f
    for first in range(0, n, WEIGHT_STEP_PX):
        j = (x0 + first) // WEIGHT_STEP_PX
        left = upper * np.float32(weights[i, j]) + f * np.float32(weights[i + 1, j])
        right = upper * np.float32(weights[i, j + 1]) + f * np.float32(weights[i + 1, j + 1])
        step = (right - left) / np.float32(WEIGHT_STEP_PX)
        for d in range(WEIGHT_STEP_PX):
            line[first + d] = left + step * np.float32(np.int32(d))


@compiled_kernel(fastmath=True)
def _add_share(
    weights, y0, x0, rows, n, name, gain, offset, values, flags, line, total, weight, best, mark
):
    """Add one frame's weighted values of a cell."""
    zero = np.float32(0.0)
    for y in range(rows):
        _weights_along(weights, y0 + y, x0, n, line)
        flag = flags[y]
        value = values[y]
        sums = total[y]
        total_weight = weight[y]
        highest = best[y]
        source_index = mark[y]
        for k in range(n):
            there = flag[k] < MISSING
            w = line[k] if there else zero
            v = value[k] if there else zero
            sums[k] += w * (gain * v + offset)
            total_weight[k] += w
            leads = w > highest[k]
            full = np.int32(flag[k] & 1) * np.int32(w > zero) * np.int32(SATURATED_SOURCE)
            source_flags = source_index[k] | full
            source_index[k] = (
                ((source_flags & np.int32(SATURATED_SOURCE)) | name) if leads else source_flags
            )
            highest[k] = w if leads else highest[k]


@compiled_kernel(fastmath=True)
def _finish_single(values, flags, gain, offset, name, out, source, y0, x0, rows, n):
    """Write a cell that one frame fills alone."""
    rise = offset + np.float32(0.5)
    floor = np.float32(1.0)
    ceiling = np.float32(65535.0)
    for y in range(rows):
        line = out[y0 + y, x0 : x0 + n]
        source_index = source[y0 + y, x0 : x0 + n]
        for k in range(n):
            there = flags[y, k] < MISSING
            v = values[y, k] if there else floor
            v = min(max(v * gain + rise, floor), ceiling)
            line[k] = np.uint16(np.int32(v)) if there else np.uint16(0)
            seen = name | np.uint8(np.uint8(flags[y, k] & 1) << np.uint8(7))
            source_index[k] = seen if there else np.uint8(0)


@compiled_kernel()
def _serving(lattices, weights, band, column, nodes, chosen):
    """Indices of the frames with weight in a cell; returns how many."""
    found = 0
    for s in range(lattices.shape[0]):
        if (
            lattices[s, band, column, 0] == OUTSIDE
            or lattices[s, band, column + 1, 0] == OUTSIDE
            or lattices[s, band + 1, column, 0] == OUTSIDE
            or lattices[s, band + 1, column + 1, 0] == OUTSIDE
        ):
            continue
        some = False
        for i in range(band * nodes, min((band + 1) * nodes + 1, weights.shape[1])):
            for j in range(column * nodes, min((column + 1) * nodes + 1, weights.shape[2])):
                some |= weights[s, i, j] != 0
        if some:
            chosen[found] = s
            found += 1
    return found


@compiled_kernel(fastmath={"contract", "nnan", "ninf", "nsz"})
def _finish_blend(total, weight, mark, out, source, y0, x0, rows, n):
    """Write a cell that several frames share, or none fills.

    Divided exactly: an approximate reciprocal depends on how the loop was compiled.
    """
    half = np.float32(0.5)
    floor = np.float32(1.0)
    ceiling = np.float32(65535.0)
    for y in range(rows):
        line = out[y0 + y, x0 : x0 + n]
        source_index = source[y0 + y, x0 : x0 + n]
        sums = total[y]
        total_weight = weight[y]
        marks = mark[y]
        for k in range(n):
            there = total_weight[k] > np.float32(0.0)
            v = sums[k] / (total_weight[k] if there else floor) + half
            v = min(max(v, floor), ceiling)
            line[k] = np.uint16(np.int32(v)) if there else np.uint16(0)
            source_index[k] = np.uint8(marks[k]) if there else np.uint8(0)


@compiled_kernel()
def _mixed_cell(
    frames,
    valid,
    lattices,
    weights,
    gains,
    offsets,
    band,
    column,
    cell,
    table,
    reach,
    unclean,
    chosen,
    lines,
    phases,
    steps,
    spare,
    values,
    flags,
    total,
    weight,
    best,
    mark,
    out,
    source,
):
    """A cell that frames share, none fills, or one fills in the general way."""
    y0 = band * cell
    x0 = column * cell
    rows = min(cell, out.shape[0] - y0)
    n = min(cell, out.shape[1] - x0)
    found = len(chosen)
    line = lines[:LINE_LENGTH]
    if found != 1:
        total[:] = 0.0
        weight[:] = 0.0
        best[:] = 0.0
        mark[:] = 0
    for s in chosen:
        left = np.int64(-1)
        top = left
        if found != 1:
            left, top = straight_taps(
                frames[s], valid[s], lattices[s], band, column, cell, reach, unclean[s]
            )
        if left >= 0:
            flags[:rows] = 0
            fetch_straight_values(
                frames[s],
                lattices[s],
                band,
                column,
                cell,
                rows,
                n,
                table,
                left,
                top,
                lines,
                phases,
                steps,
                values,
            )
        else:
            fetch_cell(
                frames[s],
                valid[s],
                lattices[s],
                band,
                column,
                cell,
                rows,
                n,
                table,
                reach,
                line,
                spare,
                values,
                flags,
            )
        if found == 1:
            _finish_single(
                values, flags, gains[s], offsets[s], np.uint8(s + 1), out, source, y0, x0, rows, n
            )
        else:
            _add_share(
                weights[s],
                y0,
                x0,
                rows,
                n,
                np.int32(s + 1),
                gains[s],
                offsets[s],
                values,
                flags,
                line,
                total,
                weight,
                best,
                mark,
            )
    if found != 1:
        _finish_blend(total, weight, mark, out, source, y0, x0, rows, n)


@compiled_kernel(parallel=True, fastmath=True)
def _resample(
    frames, valid, lattices, cell, weights, gains, offsets, table, reach, out, source, unclean
):
    height, width = out.shape
    nodes = cell // WEIGHT_STEP_PX
    columns = (width + cell - 1) // cell
    for index in prange((height + cell - 1) // cell):
        # `prange` counts in uint64: without this, each callee is compiled for uint64 as well.
        band = np.int64(index)
        values = np.zeros((cell, cell), np.float32)
        flags = np.zeros((cell, cell), np.uint8)
        lines = np.zeros((_STRIP_ROWS + 1) * LINE_LENGTH, np.float32)
        phases = np.empty((2, _STRIP_ROWS), np.float32)
        steps = np.empty((2, _STRIP_ROWS), np.float32)
        spare = np.empty((2, LINE_LENGTH), np.uint16)
        total = np.empty((cell, cell), np.float32)
        weight = np.empty((cell, cell), np.float32)
        best = np.empty((cell, cell), np.float32)
        mark = np.empty((cell, cell), np.int32)
        chosen = np.empty(frames.shape[0], np.int64)
        # Frame, left and top of the cells that one frame fills by straight taps.
        straight = np.full((columns, 3), -1, np.int64)
        for column in range(columns):
            found = _serving(lattices, weights, band, column, nodes, chosen)
            if found == 1:
                s = chosen[0]
                left, top = straight_taps(
                    frames[s], valid[s], lattices[s], band, column, cell, reach, unclean[s]
                )
                if left >= 0:
                    straight[column, 0] = s
                    straight[column, 1] = left
                    straight[column, 2] = top
                    continue
            _mixed_cell(
                frames,
                valid,
                lattices,
                weights,
                gains,
                offsets,
                band,
                column,
                cell,
                table,
                reach,
                unclean,
                chosen[:found],
                lines,
                phases,
                steps,
                spare,
                values,
                flags,
                total,
                weight,
                best,
                mark,
                out,
                source,
            )
        # Strip by strip over the whole width: memory is read and written in long rows.
        rows = min(cell, height - band * cell)
        for first in range(0, rows, _STRIP_ROWS):
            last = min(first + _STRIP_ROWS, rows)
            for column in range(columns):
                s = straight[column, 0]
                if s < 0:
                    continue
                x0 = column * cell
                n = min(cell, width - x0)
                fetch_straight(
                    frames[s],
                    lattices[s],
                    band,
                    column,
                    cell,
                    table,
                    straight[column, 1],
                    straight[column, 2],
                    first,
                    last,
                    gains[s],
                    offsets[s],
                    lines,
                    phases,
                    steps,
                    out,
                    x0,
                    n,
                )
        # By itself, so that rows of both rasters are never written side by side.
        begin = np.int64(0)
        while begin < columns:
            end = begin + 1
            while end < columns and straight[end, 0] == straight[begin, 0]:
                end += 1
            if straight[begin, 0] >= 0:
                name = np.uint8(straight[begin, 0] + 1)
                for y in range(band * cell, band * cell + rows):
                    source[y, begin * cell : end * cell] = name
            begin = end
