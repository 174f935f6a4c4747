"""Fetching one cell of target pixels from one frame, in runs for the kernels of `taps`.

Compiled; which cells are fetched from which frames, and what becomes of the values, is in
`processing.image.resampling`. A cell lies between four lattice nodes, a scratch row longer than its
side.

Near the identity (`_NEARLY`) cubic and bilinear go in two passes: raw columns are interpolated to
where the target row crosses them, then the row is interpolated. Taps stay at whole-number distances
over long runs, so both passes vectorise, and each pixel costs 8 products for the 16 of the square
of taps. The first pass takes the row's phase at the raw column instead of at the target pixel;
both reproduce second-order surfaces exactly and differ by the row's slope (below 1e-3 on our
cameras) times a third derivative. Everything else goes pixel by pixel.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.image.taps import (
    CUBIC,
    LANCZOS,
    LANCZOS_PHASES,
    MISSING,
    cubic_along,
    cubic_down,
    cubic_words,
    flags_along,
    flags_along_linear,
    is_clean,
    linear_along,
    linear_down,
    tap_weight,
)

Array = NDArray[Any]

_NEARLY: Final = 0.02
"""Largest slope of a raw row, and difference of scale from one, that goes in two passes."""
_SLACK: Final = 0.02
"""How far, in px, a run of cubic taps may go past the phase 0..1. The pieces join smoothly, so 0.02
px beyond a joint changes the value by 2e-4 of the local curvature; bilinear pieces join in a kink,
so there it is nothing."""
_LANES: Final = 8
"""Columns of the first pass come in whole vectors of this many words."""


@njit(cache=True, nogil=True)
def scratch_words(cell: int) -> int:
    """Words of scratch that `fetch_cell` needs for cells of this side."""
    return cell + cell // 16 + 2 * _LANES


@njit(cache=True, nogil=True)
def _run_length(phase, step, slack, most):
    """How many pixels a run goes on, from a phase in 0..1 until it leaves by more than `slack`."""
    if step > 0.0:
        room = (1.0 + slack - phase) / step
    elif step < 0.0:
        room = (phase + slack) / -step
    else:
        return most
    return most if room >= most else min(most, np.int64(room) + 1)


@njit(cache=True, fastmath=True, nogil=True)
def _fetch_points(frame, code, table, c0, dc, r0, dr, values, flags, y, first, last):
    """Pixel by pixel: Lanczos, and whatever is far from the identity."""
    for k in range(first, last):
        c = c0 + dc * k
        r = r0 + dr * k
        ic = np.int64(np.floor(c))
        ir = np.int64(np.floor(r))
        x = np.float32(c - ic)
        z = np.float32(r - ir)
        total = np.float32(0.0)
        least = np.uint16(65535)
        if code == LANCZOS:
            p = np.int64((c - ic) * LANCZOS_PHASES + 0.5)
            q = np.int64((r - ir) * LANCZOS_PHASES + 0.5)
            for i in range(6):
                line = np.float32(0.0)
                for j in range(6):
                    word = frame[ir - 2 + i, ic - 2 + j]
                    least = min(least, word)
                    line += table[p, j] * np.float32(word)
                total += table[q, i] * line
        else:
            reach = 1 if code == CUBIC else 0
            for i in range(-reach, 2 + reach):
                line = np.float32(0.0)
                for j in range(-reach, 2 + reach):
                    word = frame[ir + i, ic + j]
                    least = min(least, word)
                    line += tap_weight(code, x - np.float32(j)) * np.float32(word)
                total += tap_weight(code, z - np.float32(i)) * line
        full = frame[ir, ic] | frame[ir, ic + 1] | frame[ir + 1, ic] | frame[ir + 1, ic + 1]
        values[y, k] = total
        flags[y, k] = np.uint8(full & np.uint16(1)) | np.uint8(np.uint8(least == 0) << np.uint8(1))


@njit(cache=True, fastmath=True, nogil=True)
def _fetch_row(flat, width, code, c0, dc, r0, dr, values, flags, y, first, last, line, clean):
    """Pixels first .. last - 1 of one row of a cell in two passes; flags unless `clean`."""
    n = last - first
    slack = _SLACK if code == CUBIC else 0.0
    g = dc - 1.0
    # Where pixel `first` and the last one have their taps, were all a whole pixel apart.
    begin = c0 + dc * first - first
    end = begin + g * (n - 1)
    left = np.int64(np.floor(0.5 * (begin + end)))
    if min(begin, end) < left - slack or max(begin, end) > left + 1.0 + slack:
        left = np.int64(np.floor(min(begin, end)))
    most = max(np.int64(np.floor(max(begin, end))), left)
    # Raw columns from `origin` on, as many as the taps reach, in whole vectors.
    origin = left + first - 1
    columns = (n + 3 + most - left + _LANES - 1) // _LANES * _LANES
    slope = dr / dc
    at = r0 + slope * (origin - c0)
    done = np.int64(0)
    while done < columns:
        r = at + slope * done
        ir = np.int64(np.floor(r))
        if done == 0:
            # The middle decides, so that both ends share what lies beyond the phase.
            middle = np.int64(np.floor(at + slope * 0.5 * (columns - 1)))
            if (
                min(at, at + slope * (columns - 1)) >= middle - slack
                and max(at, at + slope * (columns - 1)) <= middle + 1.0 + slack
            ):
                ir = middle
        count = _run_length(r - ir, slope, slack, columns - done)
        start = ir * width + origin + done
        phase = np.float32(r - ir)
        if code == CUBIC:
            cubic_down(flat, start, width, phase, np.float32(slope), line[done:], count)
        else:
            linear_down(flat, start, width, phase, np.float32(slope), line[done:], count)
        done += count
    done = np.int64(0)
    while done < n:
        c = begin + g * done
        ic = np.int64(np.floor(c))
        if done == 0 and left - slack <= min(begin, end) and max(begin, end) <= left + 1.0 + slack:
            ic = left
        count = _run_length(c - ic, g, slack, n - done)
        phase = np.float32(c - ic)
        start = ic - left + done
        if code == CUBIC:
            cubic_along(line, start, phase, np.float32(g), values, y, first + done, count)
        else:
            linear_along(line, start, phase, np.float32(g), values, y, first + done, count)
        done += count
    if clean:
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
        if code == CUBIC:
            flags_along(flat, start, width, flags, y, first + done, count)
        else:
            flags_along_linear(flat, start, width, flags, y, first + done, count)
        done += count


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _row_of(corners, f):
    """Column, row and their change per pixel of the cell's row at a share `f` of its height."""
    return (
        corners[0] + f * (corners[4] - corners[0]),
        corners[1] + f * (corners[5] - corners[1]),
        corners[2] + f * (corners[6] - corners[2]),
        corners[3] + f * (corners[7] - corners[3]),
    )


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _is_near_identity(corners):
    across = max(abs(corners[2] - 1.0), abs(corners[6] - 1.0))
    return max(across, max(abs(corners[3]), abs(corners[7]))) < _NEARLY


@njit(cache=True, nogil=True)
def straight_taps(frame, valid, lattice, band, column, cell, code):
    """Whether a cell's taps are one rectangle of raw pixels, and none of them marred.

    Returns:
        Raw column and row that the taps of the cell's first pixel lie around; -1, -1 where the cell
        has to be fetched by `fetch_cell`.
    """
    corners = _corners(lattice, band, column, cell)
    if code != CUBIC or not _is_near_identity(corners):
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
    width = frame.shape[1]
    first = (top - 1) * width + left - 1
    if not is_clean(frame.reshape(-1), first, width, cell + 3, cell + 3):
        return -1, -1
    return left, top


@njit(cache=True, fastmath=True, nogil=True)
def fetch_straight(
    frame, lattice, band, column, cell, left, top, first, last, gain, offset, lines, out, x0, n
):
    """Rows first .. last - 1 of a cell of straight taps, gain and offset applied, into `out`.

    Args:
        left, top: from `straight_taps`; the other arguments as in `fetch_cell`.
        lines: scratch, (last - first, `scratch_words`) float32.
        out: (height, width) uint16; columns x0 .. x0 + n - 1 of the cell's rows are written.
    """
    width = frame.shape[1]
    flat = frame.reshape(-1)
    corners = _corners(lattice, band, column, cell)
    columns = (n + 3 + _LANES - 1) // _LANES * _LANES
    for y in range(first, last):
        c0, r0, dc, dr = _row_of(corners, y / cell)
        # dr / dc, good to the square of the difference of scale from one.
        slope = dr * (2.0 - dc)
        row = top + y
        phase = np.float32(r0 + slope * (left - 1 - c0) - row)
        start = row * width + left - 1
        # A count known to the compiler leaves nothing over after whole vectors.
        if columns == 72:
            cubic_down(flat, start, width, phase, np.float32(slope), lines[y - first], 72)
        elif columns == 40:
            cubic_down(flat, start, width, phase, np.float32(slope), lines[y - first], 40)
        else:
            cubic_down(flat, start, width, phase, np.float32(slope), lines[y - first], columns)
    for y in range(first, last):
        c0, r0, dc, dr = _row_of(corners, y / cell)
        phase = np.float32(c0 - left)
        target = out[band * cell + y, x0 : x0 + n]
        step = np.float32(dc - 1.0)
        if n == 64:
            cubic_words(lines[y - first], phase, step, gain, offset, target, 64)
        elif n == 32:
            cubic_words(lines[y - first], phase, step, gain, offset, target, 32)
        else:
            cubic_words(lines[y - first], phase, step, gain, offset, target, n)


@njit(cache=True, nogil=True)
def _inside(valid, c0, dc, r0, dr, k):
    c = c0 + dc * k
    r = r0 + dr * k
    return valid[0] <= c <= valid[1] and valid[2] <= r <= valid[3]


@njit(cache=True, fastmath=True, nogil=True)
def fetch_cell(
    frame, valid, lattice, band, column, cell, rows, n, code, table, line, values, flags
):
    """All pixels of one cell from one frame.

    Args:
        frame: (h, w) uint16 words, contiguous. One row more than the taps of the usable area reach
            is there: whole vectors run past the end of a row.
        valid: first and last usable raw column, first and last usable raw row.
        lattice: (rows, columns, 2) raw (column, row) at the nodes; `band`, `column` name the cell.
        cell: its side, px; rows, n: how much of it lies in the target.
        code: `BILINEAR`, `CUBIC`, `LANCZOS` with its `table`.
        line: scratch of `scratch_words` float32.
        values: (cell, cell) float32, receives the signal where there is any.
        flags: (cell, cell) uint8, receives `SATURATED` | `MISSING`.
    """
    width = frame.shape[1]
    flat = frame.reshape(-1)
    corners = _corners(lattice, band, column, cell)
    c_least, c_most, r_least, r_most = _bounds(corners, cell)
    whole = (
        c_least >= valid[0] and c_most <= valid[1] and r_least >= valid[2] and r_most <= valid[3]
    )
    two_pass = code != LANCZOS and _is_near_identity(corners)
    clean = False
    if whole and two_pass:
        first_row = np.int64(np.floor(r_least)) - 2
        first_column = np.int64(np.floor(c_least)) - 2
        clean = is_clean(
            flat,
            first_row * width + first_column,
            width,
            np.int64(np.floor(r_most)) + 4 - first_row,
            np.int64(np.floor(c_most)) + 4 - first_column,
        )
    if clean:
        flags[:rows] = 0
    for y in range(rows):
        c0, r0, dc, dr = _row_of(corners, y / cell)
        first = np.int64(0)
        last = np.int64(n)
        if not whole:
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
                flat, width, code, c0, dc, r0, dr, values, flags, y, first, last, line, clean
            )
        else:
            _fetch_points(frame, code, table, c0, dc, r0, dr, values, flags, y, first, last)
