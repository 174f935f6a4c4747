"""Resampling in integers: the same bits on every processor and on an accelerator.

The floating-point kernels of `processing.image.resampling` may be compiled with fused
multiply-adds and in another order of sums, so their last bits follow the machine. Here positions,
weights, gains and sums are integers, and the function of one pixel is compiled for both. What is
fetched, blended and marked is the same; words differ from those of the floating-point kernels by
what `benchmarks.accelerator` measures.

Source: docs/explanation/mathematics/resampling.md#evaluation and #saturation-and-holes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.image.kernels import KERNELS, MARGIN, PHASES, Interpolation
from processing.image.lattice import OUTSIDE
from processing.image.resampling import SATURATED_SOURCE, WEIGHT_STEP_PX

Array = NDArray[Any]

POSITION_BITS: Final = 20
"""Raw positions are counted in 2^-20 px."""
PHASE_BITS: Final = 12
"""The table has 4096 phases a pixel: the nearest one is at most 0.00013 px away."""
WEIGHT_BITS: Final = 20
GAIN_BITS: Final = 20
VALUE_BITS: Final = 12
"""Signal between fetching and rounding is counted in 2^-12 of a Level-1 word."""
MAX_GAIN: Final = 1024.0
MAX_OFFSET: Final = 2.0**24
OUTSIDE_POSITION: Final = -(2**62)
"""A lattice node where the sensor has no pixel."""
_FARTHEST_PX: Final = 2.0**24
_TAPS_BEFORE: Final = 2
_TAPS_BEHIND: Final = 3


@dataclass(frozen=True)
class FixedResampling:
    """What both kernels take in place of floating-point numbers.

    Attributes:
        positions: (n, rows, columns, 2) int64, raw (column, row) at the nodes, `OUTSIDE_POSITION`
            where there is none.
        valid: (n, 4) int64, first and last usable raw column, first and last usable raw row.
        serving: (rows - 1, columns - 1, n) uint8, which frames have weight in which cell.
        gains: (n,) int64 in 2^-`GAIN_BITS`.
        offsets: (n,) int64 in 2^-`VALUE_BITS`.
        table: (4097, 6) int32 in 2^-`WEIGHT_BITS`; every row sums to one exactly.
        reach: of the kernel.
        cell_bits: binary logarithm of the lattice spacing.
    """

    positions: Array
    valid: Array
    serving: Array
    gains: Array
    offsets: Array
    table: Array
    reach: int
    cell_bits: int


def in_integers(
    frames: Array,
    valid: Array,
    lattices: Array,
    cell_px: int,
    weights: Array,
    gains: Array,
    *,
    offsets: Array | None,
    interpolation: Interpolation,
    shape: tuple[int, ...],
) -> FixedResampling:
    """Convert the floating-point arguments of a resampling, once for all its pixels.

    Args:
        frames: as in `processing.image.resampling.resample`, like all that follow.
        valid: usable area of each frame; what the taps would overrun is cut off.
        lattices: raw positions at the nodes.
        cell_px: lattice spacing.
        weights: seam weights.
        gains: factors of the signal.
        offsets: added after the gain; None adds nothing.
        interpolation: name of the kernel.
        shape: of the target raster, which lattices and weights have to cover.

    Returns:
        The same as integers.

    Raises:
        ValueError: a cell that is no power of two from 8 to 64, a gain, an offset or a usable area
            out of range, or arrays that do not cover the raster.
    """
    if cell_px not in (8, 16, 32, 64):
        raise ValueError(f"cell of {cell_px} px; in integers it is 8, 16, 32 or 64")
    added = np.zeros(len(gains), np.float32) if offsets is None else offsets
    for name, values, limit in (("gain", gains, MAX_GAIN), ("offset", added, MAX_OFFSET)):
        if not bool(np.all(np.abs(values) < limit)):
            raise ValueError(f"{name} of {values.tolist()}; in integers it is below {limit:g}")
    if not bool(np.isfinite(valid).all()):
        raise ValueError(f"usable area of {valid.tolist()}; its four numbers are finite")
    cells = tuple(-(-pixels // cell_px) for pixels in shape)
    nodes = tuple(count * (cell_px // WEIGHT_STEP_PX) + 1 for count in cells)
    covered = all(a > n for a, n in zip(lattices.shape[1:3], cells, strict=True))
    if not covered or any(a < n for a, n in zip(weights.shape[1:], nodes, strict=True)):
        raise ValueError(
            f"lattices of {lattices.shape[1:3]} and weights of {weights.shape[1:]} nodes do not "
            f"cover {shape} px in cells of {cell_px} px"
        )
    unit = float(1 << POSITION_BITS)
    height, width = frames.shape[1:]
    least = np.array([_TAPS_BEFORE, -np.inf, _TAPS_BEFORE, -np.inf])
    last_column, last_row = width - _TAPS_BEHIND - 1.0 / unit, height - _TAPS_BEHIND - 1.0 / unit
    most = np.array([np.inf, last_column, np.inf, last_row])
    area = np.clip(valid, least, most) * unit
    area[:, ::2], area[:, 1::2] = np.ceil(area[:, ::2]), np.floor(area[:, 1::2])
    near = np.abs(lattices) < _FARTHEST_PX
    known = (near & (lattices != OUTSIDE)).all(axis=-1, keepdims=True)
    positions = np.full(lattices.shape, OUTSIDE_POSITION, np.int64)
    np.copyto(
        positions, np.rint(np.where(known, lattices, 0.0) * unit).astype(np.int64), where=known
    )
    kernel = KERNELS[interpolation]
    return FixedResampling(
        positions,
        area.astype(np.int64),
        _serving_cells(positions, weights, cell_px // WEIGHT_STEP_PX),
        np.rint(gains.astype(np.float64) * (1 << GAIN_BITS)).astype(np.int64),
        np.rint(added.astype(np.float64) * (1 << VALUE_BITS)).astype(np.int64),
        fixed_table(interpolation),
        kernel.reach,
        cell_px.bit_length() - 1,
    )


@cache
def fixed_table(interpolation: Interpolation) -> Array:
    """Weights of a kernel as integers, by phase.

    Args:
        interpolation: name of the kernel.

    Returns:
        (2^`PHASE_BITS` + 1, 6) int32 in 2^-`WEIGHT_BITS`, read-only; every row sums to one exactly.

    Example:
        >>> fixed_table("bilinear")[1024].tolist()
        [0, 0, 786432, 262144, 0, 0]
    """
    table = KERNELS[interpolation].table.astype(np.float64)
    phase = np.arange((1 << PHASE_BITS) + 1) / float(1 << PHASE_BITS)
    row = np.floor(phase * PHASES + 0.5).astype(np.int64)
    beyond = (phase - row / PHASES)[:, None]
    exact = table[row + MARGIN, :6] + beyond * table[row + MARGIN, 6:]
    one = 1 << WEIGHT_BITS
    words = np.rint(exact * one).astype(np.int64)
    # What rounding leaves goes to the largest weight.
    words[np.arange(len(words)), words.argmax(axis=1)] += one - words.sum(axis=1)
    fixed = np.ascontiguousarray(words.astype(np.int32))
    fixed.flags.writeable = False
    return fixed


@dataclass(frozen=True)
class IntegerResampling:
    """Fetches every target pixel in integers, like `processing.image.resampling.resample`.

    `run` takes frames, seam weights, the tables in integers, and the words and marks to fill; what
    devices differ in is there.

    Source: docs/explanation/mathematics/resampling.md#evaluation and #saturation-and-holes.
    """

    run: Callable[[Array, Array, FixedResampling, Array, Array], None]

    def __call__(
        self,
        frames: Array,
        valid: Array,
        lattices: Array,
        cell_px: int,
        weights: Array,
        gains: Array,
        *,
        interpolation: Interpolation,
        out: Array,
        source: Array,
        offsets: Array | None = None,
        unclean: Array | None = None,
    ) -> None:
        """Fill `out` and `source`; `unclean` is not needed, every pixel is looked at.

        Raises:
            ValueError: as `in_integers`.
        """
        given = in_integers(
            frames,
            valid,
            lattices,
            cell_px,
            weights,
            gains,
            offsets=offsets,
            interpolation=interpolation,
            shape=out.shape,
        )
        self.run(frames, weights, given, out, source)


def _on_processor(
    frames: Array, weights: Array, given: FixedResampling, out: Array, source: Array
) -> None:
    _resample_fixed(
        frames,
        given.valid,
        given.positions,
        given.serving,
        weights,
        given.gains,
        given.offsets,
        given.table,
        given.reach,
        given.cell_bits,
        out,
        source,
    )


resample_fixed: Final = IntegerResampling(_on_processor)
"""On the processor, with the bits of the device."""


@compiled_kernel()
def _serving_cells(positions, weights, nodes):
    """Which frames have weight in which cell, (rows - 1, columns - 1, n) uint8."""
    count, rows, columns, _ = positions.shape
    serving = np.zeros((rows - 1, columns - 1, count), np.uint8)
    for band in range(rows - 1):
        for column in range(columns - 1):
            for s in range(count):
                if (
                    positions[s, band, column, 0] == OUTSIDE_POSITION
                    or positions[s, band, column + 1, 0] == OUTSIDE_POSITION
                    or positions[s, band + 1, column, 0] == OUTSIDE_POSITION
                    or positions[s, band + 1, column + 1, 0] == OUTSIDE_POSITION
                ):
                    continue
                some = False
                for i in range(band * nodes, min((band + 1) * nodes + 1, weights.shape[1])):
                    for j in range(column * nodes, min((column + 1) * nodes + 1, weights.shape[2])):
                        some |= weights[s, i, j] != 0
                serving[band, column, s] = np.uint8(some)
    return serving


@compiled_kernel()
def fixed_pixel(
    frames, valid, positions, serving, weights, gains, offsets, table, reach, cell_bits, y, x
):
    """One target pixel; compiled for the processor and for the accelerator.

    Every number is an int64, so nothing depends on how products and sums are contracted.

    Args:
        frames: (n, rows, columns) uint16, Level-1 words.
        valid: of a `FixedResampling`, like all that follow up to `offsets` but the weights.
        positions: raw positions at the nodes.
        serving: which frames have weight in which cell.
        weights: (n, rows, columns) uint8 at every `WEIGHT_STEP_PX`-th target pixel.
        gains: factors of the signal.
        offsets: added after the gain.
        table: of a `FixedResampling`.
        reach: of the kernel.
        cell_bits: binary logarithm of the lattice spacing.
        y: row of the target pixel.
        x: column of the target pixel.

    Returns:
        Word and provenance, as in `processing.image.resampling.resample`.
    """
    cell = 1 << cell_bits
    band, column = y >> cell_bits, x >> cell_bits
    below, right = y & (cell - 1), x & (cell - 1)
    above, left = cell - below, cell - right
    i, j = y // WEIGHT_STEP_PX, x // WEIGHT_STEP_PX
    low, far = y % WEIGHT_STEP_PX, x % WEIGHT_STEP_PX
    high, near = WEIGHT_STEP_PX - low, WEIGHT_STEP_PX - far
    found = np.int64(0)
    for s in range(frames.shape[0]):
        found += np.int64(serving[band, column, s])
    sums = np.int64(0)
    total_weight = np.int64(0)
    highest = np.int64(0)
    mark = np.int64(0)
    for s in range(frames.shape[0]):
        if serving[band, column, s] == 0:
            continue
        half = np.int64(1) << (2 * cell_bits - 1)
        c = (
            above
            * (left * positions[s, band, column, 0] + right * positions[s, band, column + 1, 0])
            + below
            * (
                left * positions[s, band + 1, column, 0]
                + right * positions[s, band + 1, column + 1, 0]
            )
            + half
        ) >> (2 * cell_bits)
        r = (
            above
            * (left * positions[s, band, column, 1] + right * positions[s, band, column + 1, 1])
            + below
            * (
                left * positions[s, band + 1, column, 1]
                + right * positions[s, band + 1, column + 1, 1]
            )
            + half
        ) >> (2 * cell_bits)
        if c < valid[s, 0] or c > valid[s, 1] or r < valid[s, 2] or r > valid[s, 3]:
            continue
        ic = c >> POSITION_BITS
        ir = r >> POSITION_BITS
        step = np.int64(1) << (POSITION_BITS - PHASE_BITS)
        p = (c - (ic << POSITION_BITS) + step // 2) // step
        q = (r - (ir << POSITION_BITS) + step // 2) // step
        value = np.int64(0)
        whole = True
        for k in range(2 - reach, 4 + reach):
            line = np.int64(0)
            for m in range(2 - reach, 4 + reach):
                word = np.int64(frames[s, ir - 2 + k, ic - 2 + m])
                whole &= word != 0
                line += np.int64(table[p, m]) * word
            line = (line + (1 << (WEIGHT_BITS - VALUE_BITS - 1))) >> (WEIGHT_BITS - VALUE_BITS)
            value += np.int64(table[q, k]) * line
        if not whole:
            continue
        value = (value + (1 << (WEIGHT_BITS - 1))) >> WEIGHT_BITS
        full = np.int64(
            (
                frames[s, ir, ic]
                | frames[s, ir, ic + 1]
                | frames[s, ir + 1, ic]
                | frames[s, ir + 1, ic + 1]
            )
            & 1
        )
        signal = ((value * gains[s]) >> GAIN_BITS) + offsets[s]
        w = np.int64(1)
        if found > 1:
            w = high * (
                near * np.int64(weights[s, i, j]) + far * np.int64(weights[s, i, j + 1])
            ) + low * (
                near * np.int64(weights[s, i + 1, j]) + far * np.int64(weights[s, i + 1, j + 1])
            )
        if w == 0:
            continue
        sums += w * signal
        total_weight += w
        mark |= full * SATURATED_SOURCE
        if w > highest:
            highest = w
            mark = (mark & SATURATED_SOURCE) | (s + 1)
    if total_weight == 0:
        return np.int64(0), np.int64(0)
    rounded = sums + (total_weight << (VALUE_BITS - 1))
    word = np.int64(1)
    if rounded > 0:
        mean = rounded if total_weight == 1 else rounded // total_weight
        word = mean >> VALUE_BITS
        # Neither min nor max, as in `processing.image.accelerator.cuda_radiometry`.
        word = word if word > 1 else np.int64(1)
        word = word if word < 65535 else np.int64(65535)
    return word, mark


@compiled_kernel(parallel=True)
def _resample_fixed(
    frames,
    valid,
    positions,
    serving,
    weights,
    gains,
    offsets,
    table,
    reach,
    cell_bits,
    out,
    source,
):
    for row in prange(out.shape[0]):
        y = np.int64(row)
        for x in range(out.shape[1]):
            word, mark = fixed_pixel(
                frames,
                valid,
                positions,
                serving,
                weights,
                gains,
                offsets,
                table,
                reach,
                cell_bits,
                y,
                x,
            )
            out[y, x] = np.uint16(word)
            source[y, x] = np.uint8(mark)
