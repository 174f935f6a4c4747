"""One resampling from raw geometry to a target raster, fused with gain, seams and validity.

Inverse mapping: each target pixel is fetched from where the lattice says its ray fell on a sensor.
Which sensor serves which pixel is decided in `processing.seams`, the lattice comes from
`processing.lattice`.

Words are Level-1 words (`processing.level1`) on the way in; on the way out 0 is no data, every
other value is signal.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from processing.lattice import OUTSIDE
from processing.placement import SensorPlacement

Array = NDArray[Any]
Interpolation = Literal["bilinear", "cubic", "lanczos"]

WEIGHT_STEP_PX: Final = 8
"""Seam weights are given at every eighth target pixel."""
WEIGHT_UNIT: Final = 255
SATURATED_SOURCE: Final = 0x80
SUPPORT_MARGIN_PX: Final = 2
"""Raw pixels lost at each side, so that the widest kernel never leaves the exposed rows."""

_CODES: Final = {"bilinear": 0, "cubic": 1, "lanczos": 2}
_LANCZOS_PHASES: Final = 1024
_SLACK: Final = (0.0, 0.02, 0.0)
"""How far, in px, a run may go past the phase 0..1 before it is done pixel by pixel. The cubic
pieces join smoothly, so 0.02 px beyond a joint changes the value by 2e-4 of the local curvature."""


def resample(
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
) -> None:
    """Fetch every target pixel from the frames.

    Args:
        frames: (n, rows, columns) uint16, Level-1 words.
        valid: (n, 4) float64: first and last usable raw column, first and last usable raw row.
        lattices: (n, rows, columns, 2) float64, one per frame.
        cell_px: lattice spacing, a multiple of `WEIGHT_STEP_PX`.
        weights: (n, rows, columns) uint8 at every `WEIGHT_STEP_PX`-th target pixel.
        gains: (n,) float32, applied to the signal.
        out: (height, width) uint16; 0 is no data.
        source: (height, width) uint8: 0 no data, else 1 + index of the frame of greatest weight,
            with `SATURATED_SOURCE` set where one of the four nearest raw pixels was saturated.

    Raises:
        ValueError: a cell that is no multiple of the weight step.
    """
    if cell_px % WEIGHT_STEP_PX:
        raise ValueError(f"cell of {cell_px} px; it is a multiple of {WEIGHT_STEP_PX}")
    _resample(
        frames,
        valid,
        lattices,
        cell_px,
        weights,
        gains,
        _CODES[interpolation],
        _SLACK[_CODES[interpolation]],
        _LANCZOS,
        out,
        source,
    )


def usable_area(placement: SensorPlacement, rows: tuple[int, int]) -> Sequence[float]:
    """First and last usable raw column and row, given the fully exposed rows (level1)."""
    margin = SUPPORT_MARGIN_PX
    return (
        float(margin),
        float(placement.sensor.width_px - 1 - margin) - 1e-3,
        float(rows[0] + margin),
        float(rows[1] - margin) - 1e-3,
    )


def _lanczos_table() -> Array:
    phase = np.arange(_LANCZOS_PHASES + 1) / _LANCZOS_PHASES
    offset = phase[:, None] - np.arange(-2, 4)[None, :]
    table = np.sinc(offset) * np.sinc(offset / 3.0)
    normalised: Array = (table / table.sum(axis=1, keepdims=True)).astype(np.float32)
    return normalised


_LANCZOS: Final = _lanczos_table()


@njit(cache=True, fastmath=True, nogil=True)
def _run_cubic(frame, ic, ir, fc, dc, fr, dr, values, flags, y, n):  # type: ignore[no-untyped-def]
    """Catmull-Rom over a run of pixels whose taps move along one raw row; written to vectorise.

    `fc`, `fr` are the phases of the first pixel against raw pixel (ic, ir), `dc`, `dr` their change
    per pixel beyond the one pixel the taps move themselves. Row `y` of the cell is filled.
    """
    a0 = frame[ir - 1, ic - 1 : ic + n + 2]
    a1 = frame[ir, ic - 1 : ic + n + 2]
    a2 = frame[ir + 1, ic - 1 : ic + n + 2]
    a3 = frame[ir + 2, ic - 1 : ic + n + 2]
    half = np.float32(0.5)
    one_half = np.float32(1.5)
    two_half = np.float32(2.5)
    one = np.float32(1.0)
    two = np.float32(2.0)
    for k in range(n):
        x = fc + dc * np.float32(k)
        z = fr + dr * np.float32(k)
        x2 = x * x
        x3 = x2 * x
        z2 = z * z
        z3 = z2 * z
        u0 = x2 - half * (x3 + x)
        u1 = one_half * x3 - two_half * x2 + one
        u2 = two * x2 - one_half * x3 + half * x
        u3 = half * (x3 - x2)
        w0 = z2 - half * (z3 + z)
        w1 = one_half * z3 - two_half * z2 + one
        w2 = two * z2 - one_half * z3 + half * z
        w3 = half * (z3 - z2)
        v0 = (
            u0 * np.float32(a0[k])
            + u1 * np.float32(a0[k + 1])
            + u2 * np.float32(a0[k + 2])
            + u3 * np.float32(a0[k + 3])
        )
        v1 = (
            u0 * np.float32(a1[k])
            + u1 * np.float32(a1[k + 1])
            + u2 * np.float32(a1[k + 2])
            + u3 * np.float32(a1[k + 3])
        )
        v2 = (
            u0 * np.float32(a2[k])
            + u1 * np.float32(a2[k + 1])
            + u2 * np.float32(a2[k + 2])
            + u3 * np.float32(a2[k + 3])
        )
        v3 = (
            u0 * np.float32(a3[k])
            + u1 * np.float32(a3[k + 1])
            + u2 * np.float32(a3[k + 2])
            + u3 * np.float32(a3[k + 3])
        )
        values[y, k] = w0 * v0 + w1 * v1 + w2 * v2 + w3 * v3
        least0 = min(min(a0[k], a0[k + 1]), min(a0[k + 2], a0[k + 3]))
        least1 = min(min(a1[k], a1[k + 1]), min(a1[k + 2], a1[k + 3]))
        least2 = min(min(a2[k], a2[k + 1]), min(a2[k + 2], a2[k + 3]))
        least3 = min(min(a3[k], a3[k + 1]), min(a3[k + 2], a3[k + 3]))
        least = min(min(least0, least1), min(least2, least3))
        full = (a1[k + 1] | a1[k + 2] | a2[k + 1] | a2[k + 2]) & np.uint16(1)
        flags[y, k] = np.uint8(full) | np.uint8(np.uint8(least == 0) << np.uint8(1))


@njit(cache=True, fastmath=True, nogil=True)
def _run_bilinear(frame, ic, ir, fc, dc, fr, dr, values, flags, y, n):  # type: ignore[no-untyped-def]
    """Bilinear over a run; arguments as in `_run_cubic`."""
    a1 = frame[ir, ic : ic + n + 1]
    a2 = frame[ir + 1, ic : ic + n + 1]
    for k in range(n):
        x = fc + dc * np.float32(k)
        z = fr + dr * np.float32(k)
        v1 = np.float32(a1[k]) + x * (np.float32(a1[k + 1]) - np.float32(a1[k]))
        v2 = np.float32(a2[k]) + x * (np.float32(a2[k + 1]) - np.float32(a2[k]))
        values[y, k] = v1 + z * (v2 - v1)
        least = min(min(a1[k], a1[k + 1]), min(a2[k], a2[k + 1]))
        full = (a1[k] | a1[k + 1] | a2[k] | a2[k + 1]) & np.uint16(1)
        flags[y, k] = np.uint8(full) | np.uint8(np.uint8(least == 0) << np.uint8(1))


@njit(cache=True, fastmath=True, nogil=True)
def _run_points(  # type: ignore[no-untyped-def]
    frame, c_min, c_max, r_min, r_max, code, table, c0, dc, r0, dr, values, flags, y, n
):
    """Pixel by pixel: Lanczos, runs that cross a tap's border, runs that leave the usable area."""
    zero = np.float32(0.0)
    for k in range(n):
        c = c0 + dc * k
        r = r0 + dr * k
        if not (c_min <= c <= c_max and r_min <= r <= r_max):
            values[y, k] = zero
            flags[y, k] = np.uint8(2)
            continue
        ic = np.int64(np.floor(c))
        ir = np.int64(np.floor(r))
        if code == 2:
            p = np.int64((c - ic) * _LANCZOS_PHASES + 0.5)
            q = np.int64((r - ir) * _LANCZOS_PHASES + 0.5)
            total = zero
            least = np.uint16(65535)
            for i in range(6):
                line = zero
                for j in range(6):
                    word = frame[ir - 2 + i, ic - 2 + j]
                    least = min(least, word)
                    line += table[p, j] * np.float32(word)
                total += table[q, i] * line
            full = frame[ir, ic] | frame[ir, ic + 1] | frame[ir + 1, ic] | frame[ir + 1, ic + 1]
            values[y, k] = total
            flags[y, k] = np.uint8(full & np.uint16(1)) | np.uint8(
                np.uint8(least == 0) << np.uint8(1)
            )
        else:
            fc = np.float32(c - ic)
            fr = np.float32(r - ir)
            if code == 1:
                _run_cubic(
                    frame,
                    ic,
                    ir,
                    fc,
                    zero,
                    fr,
                    zero,
                    values[y : y + 1, k : k + 1],
                    flags[y : y + 1, k : k + 1],
                    0,
                    1,
                )
            else:
                _run_bilinear(
                    frame,
                    ic,
                    ir,
                    fc,
                    zero,
                    fr,
                    zero,
                    values[y : y + 1, k : k + 1],
                    flags[y : y + 1, k : k + 1],
                    0,
                    1,
                )


@njit(cache=True, fastmath=True, nogil=True)
def _fetch_cell(  # type: ignore[no-untyped-def]
    frame, valid, lattice, band, column, cell, rows, n, code, slack, table, values, flags
):
    """All pixels of one cell from one frame; whole rows vectorised where their taps allow it."""
    c_min = valid[0]
    c_max = valid[1]
    r_min = valid[2]
    r_max = valid[3]
    top_c = lattice[band, column, 0]
    top_r = lattice[band, column, 1]
    top_dc = (lattice[band, column + 1, 0] - top_c) / cell
    top_dr = (lattice[band, column + 1, 1] - top_r) / cell
    low_c = lattice[band + 1, column, 0]
    low_r = lattice[band + 1, column, 1]
    low_dc = (lattice[band + 1, column + 1, 0] - low_c) / cell
    low_dr = (lattice[band + 1, column + 1, 1] - low_r) / cell
    for y in range(rows):
        f = y / cell
        c0 = top_c + f * (low_c - top_c)
        r0 = top_r + f * (low_r - top_r)
        dc = top_dc + f * (low_dc - top_dc)
        dr = top_dr + f * (low_dr - top_dr)
        c1 = c0 + dc * (n - 1)
        r1 = r0 + dr * (n - 1)
        # Taps of pixel k are taken around ic + k; centred, so that both ends share what is beyond.
        ic = np.int64(np.floor(0.5 * (c0 + c1 - (n - 1))))
        ir = np.int64(np.floor(0.5 * (r0 + r1)))
        first_c = c0 - ic
        last_c = c1 - (n - 1) - ic
        first_r = r0 - ir
        last_r = r1 - ir
        if (
            code != 2
            and min(c0, c1) >= c_min
            and max(c0, c1) <= c_max
            and min(r0, r1) >= r_min
            and max(r0, r1) <= r_max
            and min(min(first_c, last_c), min(first_r, last_r)) >= -slack
            and max(max(first_c, last_c), max(first_r, last_r)) <= 1.0 + slack
        ):
            fc = np.float32(first_c)
            gc = np.float32(dc - 1.0)
            fr = np.float32(first_r)
            gr = np.float32(dr)
            if code == 1:
                _run_cubic(frame, ic, ir, fc, gc, fr, gr, values, flags, y, n)
            else:
                _run_bilinear(frame, ic, ir, fc, gc, fr, gr, values, flags, y, n)
        else:
            _run_points(
                frame, c_min, c_max, r_min, r_max, code, table, c0, dc, r0, dr, values, flags, y, n
            )


@njit(cache=True, fastmath=True, nogil=True)
def _add_share(weights, y0, x0, rows, n, name, gain, values, flags, total, weight, best, mark):  # type: ignore[no-untyped-def]
    """Add one frame's weighted values of a cell; weights are bilinear between their nodes."""
    one = np.float32(1.0)
    zero = np.float32(0.0)
    for y in range(rows):
        i = (y0 + y) // WEIGHT_STEP_PX
        fy = np.float32(y0 + y - i * WEIGHT_STEP_PX) / np.float32(WEIGHT_STEP_PX)
        for first in range(0, n, WEIGHT_STEP_PX):
            j = (x0 + first) // WEIGHT_STEP_PX
            left = (one - fy) * np.float32(weights[i, j]) + fy * np.float32(weights[i + 1, j])
            right = (one - fy) * np.float32(weights[i, j + 1])
            right += fy * np.float32(weights[i + 1, j + 1])
            step = (right - left) / np.float32(WEIGHT_STEP_PX)
            for d in range(min(WEIGHT_STEP_PX, n - first)):
                k = first + d
                w = left + step * np.float32(d) if flags[y, k] < 2 else zero
                total[y, k] += w * gain * values[y, k]
                weight[y, k] += w
                full = np.uint8((flags[y, k] & np.uint8(w > zero)) << np.uint8(7))
                mark[y, k] |= full
                if w > best[y, k]:
                    best[y, k] = w
                    mark[y, k] = (mark[y, k] & np.uint8(0x80)) | name


@njit(cache=True, fastmath=True, nogil=True)
def _finish_single(values, flags, gain, name, out, source, y0, x0, rows, n):  # type: ignore[no-untyped-def]
    """Write a cell that one frame fills alone."""
    half = np.float32(0.5)
    floor = np.float32(1.0)
    ceiling = np.float32(65535.0)
    for y in range(rows):
        line = out[y0 + y, x0 : x0 + n]
        whence = source[y0 + y, x0 : x0 + n]
        for k in range(n):
            v = min(max(values[y, k] * gain + half, floor), ceiling)
            there = flags[y, k] < 2
            line[k] = np.uint16(np.int32(v)) if there else np.uint16(0)
            seen = name | np.uint8(np.uint8(flags[y, k] & 1) << np.uint8(7))
            whence[k] = seen if there else np.uint8(0)


@njit(cache=True, parallel=True, fastmath=True, nogil=True)
def _resample(  # type: ignore[no-untyped-def]
    frames, valid, lattices, cell, weights, gains, code, slack, table, out, source
):
    height, width = out.shape
    count = frames.shape[0]
    nodes = cell // WEIGHT_STEP_PX
    for band in prange((height + cell - 1) // cell):
        values = np.empty((cell, cell), np.float32)
        flags = np.empty((cell, cell), np.uint8)
        total = np.empty((cell, cell), np.float32)
        weight = np.empty((cell, cell), np.float32)
        best = np.empty((cell, cell), np.float32)
        mark = np.empty((cell, cell), np.uint8)
        chosen = np.empty(count, np.int64)
        y0 = band * cell
        rows = min(cell, height - y0)
        for column in range((width + cell - 1) // cell):
            x0 = column * cell
            n = min(cell, width - x0)
            found = 0
            for s in range(count):
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
            if found == 1:
                s = chosen[0]
                _fetch_cell(
                    frames[s],
                    valid[s],
                    lattices[s],
                    band,
                    column,
                    cell,
                    rows,
                    n,
                    code,
                    slack,
                    table,
                    values,
                    flags,
                )
                _finish_single(
                    values, flags, gains[s], np.uint8(s + 1), out, source, y0, x0, rows, n
                )
                continue
            total[:] = 0.0
            weight[:] = 0.0
            best[:] = 0.0
            mark[:] = 0
            for f in range(found):
                s = chosen[f]
                _fetch_cell(
                    frames[s],
                    valid[s],
                    lattices[s],
                    band,
                    column,
                    cell,
                    rows,
                    n,
                    code,
                    slack,
                    table,
                    values,
                    flags,
                )
                _add_share(
                    weights[s],
                    y0,
                    x0,
                    rows,
                    n,
                    np.uint8(s + 1),
                    gains[s],
                    values,
                    flags,
                    total,
                    weight,
                    best,
                    mark,
                )
            for y in range(rows):
                for k in range(n):
                    if weight[y, k] > 0.0:
                        v = total[y, k] / weight[y, k] + np.float32(0.5)
                        v = min(max(v, np.float32(1.0)), np.float32(65535.0))
                        out[y0 + y, x0 + k] = np.uint16(np.int32(v))
                        source[y0 + y, x0 + k] = mark[y, k]
                    else:
                        out[y0 + y, x0 + k] = np.uint16(0)
                        source[y0 + y, x0 + k] = np.uint8(0)
