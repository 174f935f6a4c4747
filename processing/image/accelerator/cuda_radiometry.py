"""The radiometric pass on a CUDA device: the same bits as `processing.radiometry.level1`.

A thread corrects one column of some rows. Sums are integers, so the order in which threads add to
them does not matter; floating-point steps round where those of the processor do, which fuses each
product with the sum it goes into. Defects are filled by the processor.
"""

from __future__ import annotations

import weakref
from typing import Any, Final

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from processing.image.accelerator.cuda_kernel import (
    cuda_compiled_kernel,
    difference,
    fused,
    quotient,
    whole,
)
from processing.image.line_means import BUNDLE_PX, SHARE
from processing.radiometry.level1 import UNREAD_STEP_PX
from processing.radiometry.unclean_blocks import BLOCK_PX

Array = NDArray[Any]

_ROWS: Final = 32
"""Rows of a thread: the sums over the rows that its first charge visited are taken once for all."""
_THREADS: Final = 128
"""Threads of a block, side by side along a row."""

_held: dict[int, tuple[weakref.ref[Array], Any]] = {}
"""Calibration maps on the device, by the identity of those in memory, for as long as these live."""


def flat_pass(
    raw: Array,
    offset: np.float32,
    factor: np.float32,
    full_scale: int,
    least: int,
    first_row: int,
    out: Array,
    sums: Array,
    by_row: Array,
    by_column: Array,
    unclean: Array,
) -> None:
    """The pass where one offset and one gain hold for all pixels.

    Args:
        raw: (h, w) uint16, DN.
        offset: black, DN, float32.
        factor: half a Level-1 count per DN, float32.
        full_scale: word from which on a pixel counts as saturated, DN.
        least: word below which a pixel was not read out, DN.
        first_row: first row that is corrected; as many follow as `by_row` has.
        out: (h, w) uint16, these rows are overwritten.
        sums: (bands, 3) int64, zeros: halved words, saturated and unread pixels are added.
        by_row: means of bundles along rows, (rows, bundles) float32, overwritten.
        by_column: means of bundles along columns, (bundles, w) float32, overwritten.
        unclean: marks of the blocks, (rows, columns) uint8.
    """
    rows, width = len(by_row), raw.shape[1]
    if not rows or not width:
        return
    words = cuda.to_device(np.ascontiguousarray(raw))
    target = cuda.device_array((rows, width), np.uint16)
    totals = cuda.to_device(np.zeros(3, np.int64))
    marks = cuda.to_device(np.zeros((max(len(unclean), 1), -(-width // BLOCK_PX)), np.uint8))
    _correct_flat[_grid(width, rows)](
        words, offset, factor, full_scale, least, first_row, target, totals, marks
    )
    _finish(target, totals, marks, first_row, out, sums, by_row, by_column, unclean)


def map_pass(*given: Any) -> None:
    """The pass with maps; arguments as of `processing.radiometry.level1._map_pass`.

    Args:
        given: raw, bias, dark, response, their units, base, factor, shifts, back, and the rest as
            of `flat_pass`.
    """
    raw, bias, dark, response, bias_unit, dark_unit, base, factor, shifts, back = given[:10]
    full_scale, least, first_row, out, sums, by_row, by_column, unclean = given[10:]
    rows, width = len(by_row), raw.shape[1]
    if not rows or not width:
        return
    target = cuda.device_array((rows, width), np.uint16)
    totals = cuda.to_device(np.zeros(3, np.int64))
    marks = cuda.to_device(np.zeros((max(len(unclean), 1), -(-width // BLOCK_PX)), np.uint8))
    _correct_maps[_grid(width, rows)](
        cuda.to_device(np.ascontiguousarray(raw)),
        _on_device(bias),
        _on_device(dark),
        _on_device(response),
        bias_unit,
        dark_unit,
        base,
        factor,
        shifts,
        back,
        full_scale,
        least,
        first_row,
        target,
        totals,
        marks,
    )
    _finish(target, totals, marks, first_row, out, sums, by_row, by_column, unclean)


def _grid(width: int, rows: int) -> tuple[tuple[int, int], int]:
    return (-(-width // _THREADS), -(-rows // _ROWS)), _THREADS


def _on_device(values: Array) -> Any:
    """A calibration map on the device, copied there once."""
    known = _held.get(id(values))
    if known is not None and known[0]() is values:
        return known[1]
    copied = cuda.to_device(values)
    key = id(values)
    _held[key] = weakref.ref(values, lambda _: _held.pop(key, None)), copied
    return copied


def _finish(
    target: Any,
    totals: Any,
    marks: Any,
    first_row: int,
    out: Array,
    sums: Array,
    by_row: Array,
    by_column: Array,
    unclean: Array,
) -> None:
    """Sums of bundles, and everything back into memory."""
    rows, width = target.shape
    bundles, blocks = by_row.shape[1], len(by_column)
    if bundles and by_column.shape[1]:
        along_rows = cuda.device_array(by_row.shape, np.uint32)
        along_columns = cuda.device_array(by_column.shape, np.uint32)
        count = rows * bundles
        _sum_rows[-(-count // _THREADS), _THREADS](target, width // bundles, along_rows)
        _sum_columns[(-(-width // _THREADS), blocks), _THREADS](
            target, rows // blocks, along_columns
        )
        by_row[:] = along_rows.copy_to_host() * SHARE
        by_column[:] = along_columns.copy_to_host() * SHARE
    out[first_row : first_row + rows] = target.copy_to_host()
    if len(sums):
        sums[0] += totals.copy_to_host()
    if len(unclean):
        unclean |= marks.copy_to_host()[:, : unclean.shape[1]]


@cuda_compiled_kernel(device=True)
def _word(dn, half, ceiling):
    """Halved word within its range, and 1 where the pixel is saturated."""
    # Quirk: numba 0.68.1 does not compile min and max of two numbers for CUDA. Upstream: no report
    # known (2026-11-29).
    half = half if half > 1 else 1  # noqa: FURB136
    half = half if half < 32767 else 32767  # noqa: FURB136
    full = 1 if dn >= ceiling or half >= 32767 else 0
    return half, full


@cuda_compiled_kernel()
def _correct_flat(raw, offset, factor, ceiling, least, first_row, out, totals, marks):
    column = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    rows, width = out.shape
    if column >= width:
        return
    total = 0
    saturated = 0
    unread = 0
    begin = cuda.blockIdx.y * _ROWS
    end = begin + _ROWS if begin + _ROWS < rows else rows  # noqa: FURB136
    for row in range(begin, end):
        dn = int(raw[first_row + row, column])
        signal = fused(difference(np.float32(dn), offset), factor, np.float32(0.5))
        half, full = _word(dn, whole(signal), ceiling)
        out[row, column] = np.uint16(2 * half + full)
        total += half
        saturated += full
        if full:
            marks[(first_row + row) // BLOCK_PX if len(marks) > 1 else 0, column // BLOCK_PX] = 1
        if column % UNREAD_STEP_PX == 0 and dn < least:
            unread += 1
    cuda.atomic.add(totals, 0, total)
    cuda.atomic.add(totals, 1, saturated)
    cuda.atomic.add(totals, 2, unread)


@cuda_compiled_kernel()
def _correct_maps(
    raw,
    bias,
    dark,
    response,
    bias_unit,
    dark_unit,
    base,
    factor,
    shifts,
    back,
    ceiling,
    least,
    first_row,
    out,
    totals,
    marks,
):
    column = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    rows, width = out.shape
    if column >= width:
        return
    total = 0
    saturated = 0
    unread = 0
    begin = cuda.blockIdx.y * _ROWS
    end = begin + _ROWS if begin + _ROWS < rows else rows  # noqa: FURB136
    first = first_row + begin - back
    darkness = 0
    responses = 0
    for visited in range(first, first + shifts + 1):
        darkness += int(dark[visited, column])
        responses += int(response[visited, column])
    for row in range(begin, end):
        if row > begin:
            leaving = first_row + row - 1 - back
            darkness += int(dark[leaving + shifts + 1, column]) - int(dark[leaving, column])
            responses += int(response[leaving + shifts + 1, column])
            responses -= int(response[leaving, column])
        dn = int(raw[first_row + row, column])
        offset = fused(np.float32(int(bias[first_row + row, column])), bias_unit, base)
        offset = fused(np.float32(darkness), dark_unit, offset)
        gain = quotient(factor, np.float32(responses))
        signal = fused(difference(np.float32(dn), offset), gain, np.float32(0.5))
        half, full = _word(dn, whole(signal), ceiling)
        out[row, column] = np.uint16(2 * half + full)
        total += half
        saturated += full
        if full:
            marks[(first_row + row) // BLOCK_PX if len(marks) > 1 else 0, column // BLOCK_PX] = 1
        if column % UNREAD_STEP_PX == 0 and dn < least:
            unread += 1
    cuda.atomic.add(totals, 0, total)
    cuda.atomic.add(totals, 1, saturated)
    cuda.atomic.add(totals, 2, unread)


@cuda_compiled_kernel()
def _sum_rows(words, wide, by_row):
    """One bundle of one row to a thread."""
    index = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    rows, bundles = by_row.shape
    if index >= rows * bundles:
        return
    row, k = index // bundles, index % bundles
    total = 0
    for c in range(k * wide, k * wide + BUNDLE_PX):
        total += int(words[row, c])
    by_row[row, k] = total


@cuda_compiled_kernel()
def _sum_columns(words, tall, by_column):
    """One bundle of one column to a thread."""
    column = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    if column >= by_column.shape[1]:
        return
    block = cuda.blockIdx.y
    total = 0
    for row in range(block * tall, block * tall + BUNDLE_PX):
        total += int(words[row, column])
    by_column[block, column] = total
