"""Compiled loops over runs of pixels: taps across raw rows, along a row, and their flags.

The taps of a run lie at whole-number distances, so the loops vectorise. Weights come from a table
(`processing.image.kernels`) and change linearly along a run, as phases do. Which pixels make a run
is decided in `processing.image.cells`.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from processing.image.compiled_kernel import compiled_kernel
from processing.image.kernels import MARGIN, PHASES

SATURATED: Final = 1
MISSING: Final = 2
"""Bits of a pixel's flag: one of the four nearest raw pixels saturated; no value at all."""

LINE_LENGTH: Final = 96
"""Words from one scratch row to the next: known to the compiler, which else would not vectorise."""
_SPAN: Final = np.float32(0.08)
"""Phases, in px, over which weights go in a straight line. At its ends a weight is then off by
0.0008 of its second derivative: the phase error grows by 0.0004 px."""
_VECTOR_WIDTH: Final = 8
"""Words of a vector."""


@compiled_kernel(fastmath=True, inline="always")
def weights_at(table, phase):
    """Find the row of a table next to a phase.

    Args:
        table: of a `processing.image.kernels.Kernel`.
        phase: right of pixel 0, px, float32.

    Returns:
        Index of the row, and the phase's distance from it, px.
    """
    steps = phase * np.float32(PHASES)
    row = np.int32(np.floor(steps + np.float32(0.5)))
    row = min(max(row, np.int32(-MARGIN)), np.int32(PHASES + MARGIN))
    return row + np.int32(MARGIN), (steps - np.float32(row)) / np.float32(PHASES)


@compiled_kernel()
def _piece(span, n):
    """How many of n pixels weights go in one straight line, in whole vectors."""
    if span <= _SPAN:
        return n
    pieces = np.int64(np.ceil(span / _SPAN))
    return min(n, (n + pieces * _VECTOR_WIDTH - 1) // (pieces * _VECTOR_WIDTH) * _VECTOR_WIDTH)


@compiled_kernel(fastmath=True, inline="always")
def _spread(t):
    """A row of the table as scalars: six weights, six slopes."""
    return (t[0], t[1], t[2], t[3], t[4], t[5]), (t[6], t[7], t[8], t[9], t[10], t[11])


@compiled_kernel(fastmath=True, inline="always")
def _sum6(w, a, b, c, d, e, f):
    return w[0] * a + w[1] * b + w[2] * c + w[3] * d + w[4] * e + w[5] * f


@compiled_kernel(fastmath=True)
def _down(flat, start, width, first, step, table, line, n):
    row, beyond = weights_at(table, first + np.float32(0.5) * step * np.float32(np.int32(n - 1)))
    begin = beyond - np.float32(0.5) * step * np.float32(np.int32(n - 1))
    w, s = _spread(table[row])
    a0 = flat[start - 2 * width : start - 2 * width + n]
    a1 = flat[start - width : start - width + n]
    a2 = flat[start : start + n]
    a3 = flat[start + width : start + width + n]
    a4 = flat[start + 2 * width : start + 2 * width + n]
    a5 = flat[start + 3 * width : start + 3 * width + n]
    for j in range(n):
        b0 = np.float32(np.int32(a0[j]))
        b1 = np.float32(np.int32(a1[j]))
        b2 = np.float32(np.int32(a2[j]))
        b3 = np.float32(np.int32(a3[j]))
        b4 = np.float32(np.int32(a4[j]))
        b5 = np.float32(np.int32(a5[j]))
        x = begin + step * np.float32(np.int32(j))
        line[j] = _sum6(w, b0, b1, b2, b3, b4, b5) + x * _sum6(s, b0, b1, b2, b3, b4, b5)


@compiled_kernel(fastmath=True)
def down(flat, start, width, first, step, table, line, n):
    """Interpolate n columns across six raw rows; phases are first + step * j.

    Args:
        flat: raw words, row after row, uint16.
        start: index in `flat` of the pixel at phase 0 of the first column.
        width: words from row to row.
        first: phase at the first column, px, float32.
        step: change of phase per column, px, float32.
        table: of a `processing.image.kernels.Kernel`.
        line: receives n values, float32.
        n: columns.
    """
    piece = _piece(abs(step) * np.float32(np.int32(n)), n)
    for done in range(0, n, piece):
        at = first + step * np.float32(np.int32(done))
        _down(flat, start + done, width, at, step, table, line[done:], min(piece, n - done))


@compiled_kernel(fastmath=True)
def middle_and_span(phases, steps, rows, n):
    """Middle of the phases of some rows of n pixels, and how far they spread around it.

    Args:
        phases: at the first pixel of each row, (rows,) float32, px.
        steps: change of phase per pixel, (rows,) float32, px.
        rows: rows looked at.
        n: pixels of each row.

    Returns:
        Middle, and largest less least phase, px.
    """
    least = np.float32(2.0)
    most = np.float32(-1.0)
    along = np.float32(np.int32(n - 1))
    for y in range(rows):
        end = phases[y] + steps[y] * along
        least = min(least, min(phases[y], end))
        most = max(most, max(phases[y], end))
    return np.float32(0.5) * (least + most), most - least


@compiled_kernel(fastmath=True)
def down_strip(flat, start, width, phases, steps, table, lines, rows, n, wide):
    """As `down` for target rows whose taps lie one raw row apart, with one row of the table.

    Row y has the phases phases[y] + steps[y] * j.

    Args:
        flat: raw words, row after row, uint16.
        start: index in `flat` of the pixel at phase 0 of the first row's first column.
        width: words from row to row.
        phases: at the first column of each row, (rows,) float32, px.
        steps: change of phase per column, (rows,) float32, px.
        table: of a `processing.image.kernels.Kernel`.
        lines: receives row y from y * `LINE_LENGTH` on, float32.
        rows: target rows.
        n: columns.
        wide: columns that are computed, `n` or some more; those beyond `n` have no meaning.
    """
    middle, span = middle_and_span(phases, steps, rows, n)
    if span > _SPAN:
        for y in range(rows):
            line = lines[y * LINE_LENGTH :]
            down(flat, start + y * width, width, phases[y], steps[y], table, line, n)
        return
    row, beyond = weights_at(table, middle)
    at = middle - beyond
    w, s = _spread(table[row])
    for y in range(0, rows - 1, 2):
        # Raw pixels are converted once for two rows.
        begin = start + (y - 2) * width
        a0 = flat[begin : begin + wide]
        a1 = flat[begin + width : begin + width + wide]
        a2 = flat[begin + 2 * width : begin + 2 * width + wide]
        a3 = flat[begin + 3 * width : begin + 3 * width + wide]
        a4 = flat[begin + 4 * width : begin + 4 * width + wide]
        a5 = flat[begin + 5 * width : begin + 5 * width + wide]
        a6 = flat[begin + 6 * width : begin + 6 * width + wide]
        line = lines[y * LINE_LENGTH :]
        p0 = phases[y] - at
        p1 = phases[y + 1] - at
        s0 = steps[y]
        s1 = steps[y + 1]
        for j in range(wide):
            b0 = np.float32(np.int32(a0[j]))
            b1 = np.float32(np.int32(a1[j]))
            b2 = np.float32(np.int32(a2[j]))
            b3 = np.float32(np.int32(a3[j]))
            b4 = np.float32(np.int32(a4[j]))
            b5 = np.float32(np.int32(a5[j]))
            b6 = np.float32(np.int32(a6[j]))
            x = p0 + s0 * np.float32(np.int32(j))
            z = p1 + s1 * np.float32(np.int32(j))
            upper = _sum6(w, b0, b1, b2, b3, b4, b5)
            lower = _sum6(w, b1, b2, b3, b4, b5, b6)
            line[j] = upper + x * _sum6(s, b0, b1, b2, b3, b4, b5)
            line[j + LINE_LENGTH] = lower + z * _sum6(s, b1, b2, b3, b4, b5, b6)
    if rows % 2:
        y = rows - 1
        line = lines[y * LINE_LENGTH :]
        down(flat, start + y * width, width, phases[y], steps[y], table, line, n)


@compiled_kernel(fastmath=True)
def _along(a, first, step, table, out, n):
    row, beyond = weights_at(table, first + np.float32(0.5) * step * np.float32(np.int32(n - 1)))
    begin = beyond - np.float32(0.5) * step * np.float32(np.int32(n - 1))
    w, s = _spread(table[row])
    for k in range(n):
        x = begin + step * np.float32(np.int32(k))
        out[k] = _sum6(w, a[k], a[k + 1], a[k + 2], a[k + 3], a[k + 4], a[k + 5]) + x * _sum6(
            s, a[k], a[k + 1], a[k + 2], a[k + 3], a[k + 4], a[k + 5]
        )


@compiled_kernel(fastmath=True)
def along(line, first, step, table, out, n):
    """Interpolate n values along a scratch row; phases are first + step * k, taps from k on.

    Args:
        line: scratch row, at least n + 5 values, float32.
        first: phase of the first value, px, float32.
        step: change of phase per value, px, float32.
        table: of a `processing.image.kernels.Kernel`.
        out: receives n values, float32.
        n: values.
    """
    piece = _piece(abs(step) * np.float32(np.int32(n)), n)
    for done in range(0, n, piece):
        at = first + step * np.float32(np.int32(done))
        count = min(piece, n - done)
        _along(line[done : done + count + 5], at, step, table, out[done : done + count], count)


@compiled_kernel(fastmath=True)
def along_strip(lines, phases, steps, table, values, y0, rows, n):
    """As `along` row by row, with one row of the table.

    Args:
        lines: scratch rows of `LINE_LENGTH` float32.
        phases: at the first value of each row, (rows,) float32, px.
        steps: change of phase per value, (rows,) float32, px.
        table: of a `processing.image.kernels.Kernel`.
        values: rows from `y0` on receive n values each, float32.
        y0: first row of `values`.
        rows: target rows.
        n: values of each row.
    """
    middle, span = middle_and_span(phases, steps, rows, n)
    if span > _SPAN:
        for y in range(rows):
            along(lines[y * LINE_LENGTH :], phases[y], steps[y], table, values[y0 + y], n)
        return
    row, beyond = weights_at(table, middle)
    at = middle - beyond
    w, s = _spread(table[row])
    for y in range(rows):
        a = lines[y * LINE_LENGTH : (y + 1) * LINE_LENGTH]
        target = values[y0 + y, :n]
        phase = phases[y] - at
        step = steps[y]
        for k in range(n):
            x = phase + step * np.float32(np.int32(k))
            v = _sum6(w, a[k], a[k + 1], a[k + 2], a[k + 3], a[k + 4], a[k + 5])
            v += x * _sum6(s, a[k], a[k + 1], a[k + 2], a[k + 3], a[k + 4], a[k + 5])
            target[k] = v


@compiled_kernel(fastmath=True)
def values_strip(lines, phases, steps, table, gain, offset, out, y0, x0, rows, n):
    """As `along` row by row, times gain plus offset, rounded to words that are signal, 1 to 65535.

    Args:
        lines: scratch rows of `LINE_LENGTH` float32, one more than `rows`.
        phases: at the first value of each row, (rows,) float32, px.
        steps: change of phase per value, (rows,) float32, px.
        table: of a `processing.image.kernels.Kernel`.
        gain: factor of the signal, float32.
        offset: added after the gain, float32.
        out: (height, width) uint16, receives the words.
        y0: first row of `out`.
        x0: first column of `out`.
        rows: target rows.
        n: values of each row.
    """
    rise = offset + np.float32(0.5)
    middle, span = middle_and_span(phases, steps, rows, n)
    if span > _SPAN:
        values = lines[rows * LINE_LENGTH :]
        for y in range(rows):
            along(lines[y * LINE_LENGTH :], phases[y], steps[y], table, values, n)
            target = out[y0 + y, x0 : x0 + n]
            for k in range(n):
                v = min(max(values[k] * gain + rise, np.float32(1.0)), np.float32(65535.0))
                target[k] = np.uint16(np.int32(v))
        return
    row, beyond = weights_at(table, middle)
    at = middle - beyond
    w, s = _spread(table[row])
    for y in range(rows):
        a = lines[y * LINE_LENGTH : (y + 1) * LINE_LENGTH]
        target = out[y0 + y, x0 : x0 + n]
        phase = phases[y] - at
        step = steps[y]
        for k in range(n):
            x = phase + step * np.float32(np.int32(k))
            v = _sum6(w, a[k], a[k + 1], a[k + 2], a[k + 3], a[k + 4], a[k + 5])
            v += x * _sum6(s, a[k], a[k + 1], a[k + 2], a[k + 3], a[k + 4], a[k + 5])
            v = min(max(v * gain + rise, np.float32(1.0)), np.float32(65535.0))
            target[k] = np.uint16(np.int32(v))


@compiled_kernel()
def is_clean(flat, start, width, rows, columns):
    """Whether a box of raw words holds neither saturated pixels nor holes.

    Args:
        flat: raw words, row after row, uint16.
        start: index in `flat` of the box's first word.
        width: words from row to row.
        rows: height of the box, px.
        columns: width of the box, px.

    Returns:
        True where no word is 0 or has its lowest bit set.
    """
    least = np.uint16(65535)
    odd_bits = np.uint16(0)
    for r in range(rows):
        a = flat[start + r * width : start + r * width + columns]
        for j in range(len(a)):
            least = min(least, a[j])
            odd_bits |= a[j]
    return least != 0 and (odd_bits & np.uint16(1)) == 0


@compiled_kernel()
def flags_along(flat, start, width, reach, spare, out, n):
    """Flags of n pixels whose four nearest raw pixels begin at `start` and move along that row.

    Args:
        flat: raw words, row after row, uint16.
        start: index in `flat` of the upper left of the first pixel's four.
        width: words from row to row.
        reach: raw pixels beyond the four nearest that count, along each axis.
        spare: scratch, (2, n + 2 + 2 * reach) uint16.
        out: receives `SATURATED` | `MISSING`, (n,) uint8.
        n: pixels.
    """
    columns = n + 1 + 2 * reach
    least = spare[0, :columns]
    full = spare[1, :columns]
    left = start - reach
    near = flat[left : left + columns]
    below = flat[left + width : left + width + columns]
    for j in range(columns):
        least[j] = min(near[j], below[j])
        full[j] = near[j] | below[j]
    for i in range(1, reach + 1):
        upper = flat[left - i * width : left - i * width + columns]
        lower = flat[left + (1 + i) * width : left + (1 + i) * width + columns]
        for j in range(columns):
            least[j] = min(least[j], min(upper[j], lower[j]))
    for k in range(n):
        out[k] = np.uint8((full[k + reach] | full[k + reach + 1]) & np.uint16(1))
    for i in range(2 + 2 * reach):
        for k in range(n):
            out[k] |= np.uint8(np.uint8(least[k + i] == 0) << np.uint8(1))
