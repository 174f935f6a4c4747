"""Fetching one cell of target pixels from one frame, in runs for the loops of `taps`.

Compiled; which cells are fetched from which frames, and what becomes of the values, is in
`processing.image.resampling`. A cell lies between four lattice nodes, a scratch row longer than its
side.

Near the identity (`_NEARLY`) pixels go in two passes: raw columns are interpolated to where the
target row crosses them, then the row is interpolated. Taps stay at whole-number distances over long
runs, so both passes vectorise, and each pixel costs 12 products for the 36 of the square of taps.
The first pass takes the row's phase at the raw column instead of at the target pixel: it samples
the row's own slanted line. Everything else goes pixel by pixel.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.image.taps import (
    LINE_LENGTH,
    MISSING,
    along,
    along_strip,
    down,
    down_strip,
    flags_along,
    is_clean,
    values_strip,
    weights_at,
)
from processing.radiometry.unclean_blocks import BLOCK_PX

Array = NDArray[Any]

_IDENTITY_TOLERANCE: Final = 0.02
"""Largest slope of a raw row, and difference of scale from one, that goes in two passes."""
_SLACK: Final = 0.02
"""How far, in px, a run may go past the phase 0..1: tables of weights reach that far. Bilinear
pieces join in a kink, so there it is nothing."""
_VECTOR_WIDTH: Final = 8
"""Columns of the first pass come in whole vectors of this many words."""
_EXTRA: Final = 5
"""Raw pixels that a run of taps takes more than it has samples."""


MAX_CELL_PX: Final = 64
"""Side of the largest cell: its taps fit into a scratch row."""


@compiled_kernel()
def _columns(samples):
    """Raw columns that so many samples take, in whole vectors."""
    return (samples + _EXTRA + _VECTOR_WIDTH - 1) // _VECTOR_WIDTH * _VECTOR_WIDTH


@compiled_kernel()
def _run_length(phase, step, slack, most):
    """How many pixels a run goes on, from a phase in 0..1 until it leaves by more than `slack`."""
    if step > 0.0:
        margin_px = (1.0 + slack - phase) / step
    elif step < 0.0:
        margin_px = (phase + slack) / -step
    else:
        return most
    return most if margin_px >= most else max(min(most, np.int64(margin_px) + 1), 1)


@compiled_kernel(fastmath=True)
def _fetch_points(frame, table, reach, c0, dc, r0, dr, values, flags, y, first, last):
    """Pixel by pixel: whatever is far from the identity."""
    for k in range(first, last):
        c = c0 + dc * k
        r = r0 + dr * k
        ic = np.int64(np.floor(c))
        ir = np.int64(np.floor(r))
        p, x = weights_at(table, np.float32(c - ic))
        q, z = weights_at(table, np.float32(r - ir))
        total = np.float32(0.0)
        least = np.uint16(65535)
        for i in range(2 - reach, 4 + reach):
            line = np.float32(0.0)
            for j in range(2 - reach, 4 + reach):
                value = frame[ir - 2 + i, ic - 2 + j]
                least = min(least, value)
                line += (table[p, j] + x * table[p, 6 + j]) * np.float32(value)
            total += (table[q, i] + z * table[q, 6 + i]) * line
        full = frame[ir, ic] | frame[ir, ic + 1] | frame[ir + 1, ic] | frame[ir + 1, ic + 1]
        values[y, k] = total
        flags[y, k] = np.uint8(full & np.uint16(1)) | np.uint8(np.uint8(least == 0) << np.uint8(1))


@compiled_kernel()
def _base(one, other, slack):
    """Whole pixel that the taps of a run from one place to another lie around, and if all do."""
    least = min(one, other)
    most = max(one, other)
    # The middle decides, so that both ends share what lies beyond the phase.
    base = np.int64(np.floor(0.5 * (least + most)))
    if least >= base - slack and most <= base + 1.0 + slack:
        return base, True
    return np.int64(np.floor(least)), False


@compiled_kernel(fastmath=True)
def _fetch_row(
    flat, width, rows, table, reach, slack, c0, dc, r0, dr, values, flags, y, span, line, spare
):
    """Pixels of one row of a cell in two passes.

    Args:
        rows: first and last raw row that taps may lie around.
        slack: how far phases may go past 0..1, px.
        span: first pixel, the one after the last.
        spare: scratch for flags, or of no length where none are wanted.
    """
    first, last = span
    n = last - first
    g = dc - 1.0
    # Where pixel `first` and the last one have their taps, were all a whole pixel apart.
    begin = c0 + dc * first - first
    end = begin + g * (n - 1)
    left, in_one_run = _base(begin, end, slack)
    most = max(np.int64(np.floor(max(begin, end))), left)
    # Raw columns from `origin` on, as many as the taps reach, in whole vectors.
    origin = max(left + first - 2, 0)
    columns = min(_columns(n + most - left), width - origin)
    slope = dr / dc
    at = r0 + slope * (origin - c0)
    done = np.int64(0)
    while done < columns:
        r = at + slope * done
        ir = np.int64(np.floor(r))
        if done == 0:
            base, all_rows = _base(at, at + slope * (columns - 1), slack)
            ir = base if all_rows else ir
        ir = min(max(ir, rows[0]), rows[1])
        count = _run_length(r - ir, slope, slack, columns - done)
        start = ir * width + origin + done
        down(flat, start, width, np.float32(r - ir), np.float32(slope), table, line[done:], count)
        done += count
    out = values[y, first:last]
    done = np.int64(0)
    while done < n:
        c = begin + g * done
        ic = left if in_one_run else np.int64(np.floor(c))
        count = _run_length(c - ic, g, slack, n - done)
        start = ic + first + done - 2 - origin
        along(line[start:], np.float32(c - ic), np.float32(g), table, out[done:], count)
        done += count
    if spare.shape[1] == 0:
        return
    done = np.int64(0)
    while done < n:
        c = begin + g * done
        r = r0 + dr * (first + done)
        ic = np.int64(np.floor(c))
        ir = np.int64(np.floor(r))
        count = min(
            _run_length(c - ic, g, 0.0, n - done),
            _run_length(r - ir, dr, 0.0, n - done),
        )
        start = ir * width + ic + first + done
        flags_along(flat, start, width, reach, spare, flags[y, first + done : last], count)
        done += count


@compiled_kernel()
def _corners(lattice, band, column, cell):
    """Raw (column, row) at the left end of a cell's first and last row, and their change per pixel.

    In this order: column, row, change of column, change of row; then the same of the last row.
    """
    top_c = lattice[band, column, 0]
    top_r = lattice[band, column, 1]
    low_c = lattice[band + 1, column, 0]
    low_r = lattice[band + 1, column, 1]
    return (
        top_c,
        top_r,
        (lattice[band, column + 1, 0] - top_c) / cell,
        (lattice[band, column + 1, 1] - top_r) / cell,
        low_c,
        low_r,
        (lattice[band + 1, column + 1, 0] - low_c) / cell,
        (lattice[band + 1, column + 1, 1] - low_r) / cell,
    )


@compiled_kernel()
def _row_of(corners, f):
    """Column, row and their change per pixel of the cell's row at a share `f` of its height."""
    return (
        corners[0] + f * (corners[4] - corners[0]),
        corners[1] + f * (corners[5] - corners[1]),
        corners[2] + f * (corners[6] - corners[2]),
        corners[3] + f * (corners[7] - corners[3]),
    )


@compiled_kernel()
def _bounds(corners, cell):
    """Least and most raw column, least and most raw row of a cell."""
    c1 = corners[0] + corners[2] * cell
    r1 = corners[1] + corners[3] * cell
    c3 = corners[4] + corners[6] * cell
    r3 = corners[5] + corners[7] * cell
    return (
        min(min(corners[0], corners[4]), min(c1, c3)),
        max(max(corners[0], corners[4]), max(c1, c3)),
        min(min(corners[1], corners[5]), min(r1, r3)),
        max(max(corners[1], corners[5]), max(r1, r3)),
    )


@compiled_kernel()
def _is_near_identity(corners):
    across = max(abs(corners[2] - 1.0), abs(corners[6] - 1.0))
    return max(across, max(abs(corners[3]), abs(corners[7]))) < _IDENTITY_TOLERANCE


@compiled_kernel()
def straight_taps(frame, valid, lattice, band, column, cell, reach, unclean):
    """Whether a cell's taps are one rectangle of raw pixels, and none of them marred.

    Args:
        frame: (h, w) uint16 words, contiguous.
        valid: first and last usable raw column, first and last usable raw row.
        lattice: (rows, columns, 2) raw (column, row) at the nodes.
        band: row of the cell in the lattice.
        column: column of the cell in the lattice.
        cell: side of the cell, px.
        reach: of a `processing.image.kernels.Kernel`.
        unclean: marks of the frame's blocks (`processing.radiometry.unclean_blocks`); only where
            one is set are the pixels looked at.

    Returns:
        Raw column and row that the taps of the cell's first pixel lie around; -1, -1 where the cell
        has to be fetched by `fetch_cell`.
    """
    corners = _corners(lattice, band, column, cell)
    if reach == 0 or not _is_near_identity(corners):
        return -1, -1
    c_least, c_most, r_least, r_most = _bounds(corners, cell)
    if not (
        c_least >= valid[0] and c_most <= valid[1] and r_least >= valid[2] and r_most <= valid[3]
    ):
        return -1, -1
    # How far columns and rows run ahead of the target's, at the four corners.
    c1 = corners[0] + (corners[2] - 1.0) * cell
    c3 = corners[4] + (corners[6] - 1.0) * cell
    r1 = corners[1] + corners[3] * cell
    r2 = corners[5] - cell
    r3 = r2 + corners[7] * cell
    c_low = min(min(corners[0], c1), min(corners[4], c3))
    c_high = max(max(corners[0], c1), max(corners[4], c3))
    r_low = min(min(corners[1], r1), min(r2, r3))
    r_high = max(max(corners[1], r1), max(r2, r3))
    left = np.int64(np.floor(0.5 * (c_low + c_high)))
    top = np.int64(np.floor(0.5 * (r_low + r_high)))
    if min(c_low - left, r_low - top) < -_SLACK or max(c_high - left, r_high - top) > 1.0 + _SLACK:
        return -1, -1
    height, width = frame.shape
    if left < 2 or top < 2:
        return -1, -1
    if left - 2 + _columns(cell) > width or top - 2 + cell + _EXTRA > height:
        return -1, -1
    marked = False
    for i in range((top - 2) // BLOCK_PX, (top + cell + 2) // BLOCK_PX + 1):
        for j in range((left - 2) // BLOCK_PX, (left + cell + 2) // BLOCK_PX + 1):
            marked |= unclean[i, j] != 0
    first = (top - 2) * width + left - 2
    if marked and not is_clean(frame.reshape(-1), first, width, cell + _EXTRA, cell + _EXTRA):
        return -1, -1
    return left, top


@compiled_kernel(fastmath=True)
def _straight_lines(frame, corners, cell, table, left, top, first, last, n, lines, phases, steps):
    """The first pass of rows first .. last - 1 of a cell of straight taps, and all their phases."""
    width = frame.shape[1]
    flat = frame.reshape(-1)
    columns = _columns(n)
    rows = last - first
    for y in range(rows):
        c0, r0, dc, dr = _row_of(corners, (first + y) / cell)
        # dr / dc, good to the square of the difference of scale from one.
        slope = dr * (2.0 - dc)
        phases[0, y] = r0 + slope * (left - 2 - c0) - (top + first + y)
        steps[0, y] = slope
        phases[1, y] = c0 - left
        steps[1, y] = dc - 1.0
    start = (top + first) * width + left - 2
    # With a count known to the compiler nothing is left over, and rows go in pairs. Where the frame
    # has them, some columns more make the widest vectors whole; their values are not used.
    if columns == 72 and left + 78 <= width:
        down_strip(flat, start, width, phases[0], steps[0], table, lines, rows, 72, 80)
    elif columns == 40 and left + 46 <= width:
        down_strip(flat, start, width, phases[0], steps[0], table, lines, rows, 40, 48)
    elif columns == 72:
        down_strip(flat, start, width, phases[0], steps[0], table, lines, rows, 72, 72)
    elif columns == 40:
        down_strip(flat, start, width, phases[0], steps[0], table, lines, rows, 40, 40)
    else:
        for y in range(rows):
            line = lines[y * LINE_LENGTH :]
            down(flat, start + y * width, width, phases[0, y], steps[0, y], table, line, columns)


@compiled_kernel(fastmath=True)
def fetch_straight(
    frame,
    lattice,
    band,
    column,
    cell,
    table,
    left,
    top,
    first,
    last,
    gain,
    offset,
    lines,
    phases,
    steps,
    out,
    x0,
    n,
):
    """Rows first .. last - 1 of a cell of straight taps, gain and offset applied, into `out`.

    Args:
        frame: as in `fetch_cell`, like `lattice`, `band`, `column`, `cell` and `table`.
        lattice: raw (column, row) at the nodes.
        band: row of the cell in the lattice.
        column: column of the cell in the lattice.
        cell: side of the cell, px.
        table: of a `processing.image.kernels.Kernel`.
        left: raw column from `straight_taps`.
        top: raw row from `straight_taps`.
        first: first row of the cell.
        last: row of the cell behind the last one.
        gain: factor of the signal, float32.
        offset: added after the gain, float32.
        lines: scratch, (last - first + 1) * `LINE_LENGTH` float32.
        phases: scratch, (2, last - first) float32.
        steps: scratch, (2, last - first) float32.
        out: (height, width) uint16; columns x0 .. x0 + n - 1 of the cell's rows are written.
        x0: first column of `out`.
        n: columns of the cell that lie in the target.
    """
    corners = _corners(lattice, band, column, cell)
    _straight_lines(frame, corners, cell, table, left, top, first, last, n, lines, phases, steps)
    rows = last - first
    y0 = band * cell + first
    if n == 64:
        values_strip(lines, phases[1], steps[1], table, gain, offset, out, y0, x0, rows, 64)
    elif n == 32:
        values_strip(lines, phases[1], steps[1], table, gain, offset, out, y0, x0, rows, 32)
    else:
        values_strip(lines, phases[1], steps[1], table, gain, offset, out, y0, x0, rows, n)


@compiled_kernel(fastmath=True)
def fetch_straight_values(
    frame, lattice, band, column, cell, rows, n, table, left, top, lines, phases, steps, values
):
    """All pixels of a cell of straight taps that several frames share: their signal, unrounded.

    Args:
        frame: as in `fetch_cell`, like all up to `table`.
        lattice: raw (column, row) at the nodes.
        band: row of the cell in the lattice.
        column: column of the cell in the lattice.
        cell: side of the cell, px.
        rows: rows of the cell that lie in the target.
        n: columns of the cell that lie in the target.
        table: of a `processing.image.kernels.Kernel`.
        left: raw column from `straight_taps`.
        top: raw row from `straight_taps`.
        lines: scratch as in `fetch_straight`, like `phases` and `steps`.
        phases: scratch, (2, rows of a strip) float32.
        steps: scratch, (2, rows of a strip) float32.
        values: (cell, cell) float32, receives the signal.
    """
    corners = _corners(lattice, band, column, cell)
    for at in range(0, rows, phases.shape[1]):
        end = min(at + phases.shape[1], rows)
        _straight_lines(frame, corners, cell, table, left, top, at, end, n, lines, phases, steps)
        if n == 64:
            along_strip(lines, phases[1], steps[1], table, values, at, end - at, 64)
        else:
            along_strip(lines, phases[1], steps[1], table, values, at, end - at, n)


@compiled_kernel()
def _inside(valid, c0, dc, r0, dr, k):
    c = c0 + dc * k
    r = r0 + dr * k
    return valid[0] <= c <= valid[1] and valid[2] <= r <= valid[3]


@compiled_kernel(fastmath=True)
def fetch_cell(
    frame, valid, lattice, band, column, cell, rows, n, table, reach, line, spare, values, flags
):
    """All pixels of one cell from one frame.

    Args:
        frame: (h, w) uint16 words, contiguous.
        valid: first and last usable raw column, first and last usable raw row.
        lattice: (rows, columns, 2) raw (column, row) at the nodes.
        band: row of the cell in the lattice.
        column: column of the cell in the lattice.
        cell: its side, px.
        rows: rows of the cell that lie in the target.
        n: columns of the cell that lie in the target.
        table: of a `processing.image.kernels.Kernel`.
        reach: of the same kernel.
        line: scratch of `LINE_LENGTH` float32.
        spare: scratch, (2, `LINE_LENGTH`) uint16.
        values: (cell, cell) float32, receives the signal where there is any.
        flags: (cell, cell) uint8, receives `SATURATED` | `MISSING`.
    """
    width = frame.shape[1]
    flat = frame.reshape(-1)
    corners = _corners(lattice, band, column, cell)
    c_least, c_most, r_least, r_most = _bounds(corners, cell)
    in_one_run = (
        c_least >= valid[0] and c_most <= valid[1] and r_least >= valid[2] and r_most <= valid[3]
    )
    two_pass = _is_near_identity(corners)
    # Past the phase 0..1 taps lie one pixel further out: not next to the border or a hole.
    inner = (
        c_least >= valid[0] + 1.0
        and c_most <= valid[1] - 1.0
        and r_least >= valid[2] + 1.0
        and r_most <= valid[3] - 1.0
    )
    clean = False
    if in_one_run and two_pass:
        further = 1 if inner else 0
        first_row = np.int64(np.floor(r_least)) - 2 - further
        first_column = np.int64(np.floor(c_least)) - 2 - further
        clean = is_clean(
            flat,
            first_row * width + first_column,
            width,
            np.int64(np.floor(r_most)) + 4 + further - first_row,
            np.int64(np.floor(c_most)) + 4 + further - first_column,
        )
    slack = _SLACK if reach > 0 and inner and clean else 0.0
    if clean:
        flags[:rows] = 0
    raw_rows = np.int64(np.floor(valid[2])), np.int64(np.floor(valid[3]))
    marks = spare[:, :0] if clean else spare
    for y in range(rows):
        c0, r0, dc, dr = _row_of(corners, y / cell)
        first = np.int64(0)
        last = np.int64(n)
        if not in_one_run:
            while first < last and not _inside(valid, c0, dc, r0, dr, first):
                flags[y, first] = MISSING
                first += 1
            while last > first and not _inside(valid, c0, dc, r0, dr, last - 1):
                last -= 1
                flags[y, last] = MISSING
        if first == last:
            continue
        if two_pass:
            _fetch_row(
                flat,
                width,
                raw_rows,
                table,
                reach,
                slack,
                c0,
                dc,
                r0,
                dr,
                values,
                flags,
                y,
                (first, last),
                line,
                marks,
            )
        else:
            _fetch_points(frame, table, reach, c0, dc, r0, dr, values, flags, y, first, last)
