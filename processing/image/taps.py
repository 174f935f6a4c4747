"""The interpolation kernels of the resampling: taps across raw rows, along a row, and their flags.

Compiled loops over runs of pixels whose taps lie at whole-number distances, written to vectorise.
Which pixels make a run is decided in `processing.image.cells`.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

BILINEAR: Final = 0
CUBIC: Final = 1
LANCZOS: Final = 2

SATURATED: Final = 1
MISSING: Final = 2
"""Bits of a pixel's flag: one of the four nearest raw pixels saturated; no value at all."""

LANCZOS_PHASES: Final = 1024


def _lanczos_table() -> Array:
    """Weights of the pixels -2 .. 3 at phases 0 .. 1, (phases + 1, 6) float32."""
    phase = np.arange(LANCZOS_PHASES + 1) / LANCZOS_PHASES
    offset = phase[:, None] - np.arange(-2, 4)[None, :]
    table = np.sinc(offset) * np.sinc(offset / 3.0)
    normalised: Array = (table / table.sum(axis=1, keepdims=True)).astype(np.float32)
    return normalised


LANCZOS_TABLE: Final = _lanczos_table()


@njit(cache=True, fastmath=True, nogil=True, inline="always")
def _catmull_rom(z):
    """Weights of the pixels -1 .. 2 at a phase."""
    half = np.float32(0.5)
    z2 = z * z
    z3 = z2 * z
    w0 = z2 - half * (z3 + z)
    w3 = half * (z3 - z2)
    w2 = half * (z + z2) + np.float32(1.5) * (z2 - z3)
    return w0, np.float32(1.0) - w0 - w2 - w3, w2, w3


@njit(cache=True, fastmath=True, nogil=True)
def cubic_down(flat, start, width, first, step, line, n):
    """Catmull-Rom across four raw rows at n columns; phases first + step * j."""
    a0 = flat[start - width : start - width + n]
    a1 = flat[start : start + n]
    a2 = flat[start + width : start + width + n]
    a3 = flat[start + 2 * width : start + 2 * width + n]
    for j in range(n):
        z = first + step * np.float32(np.int32(j))
        w0, w1, w2, w3 = _catmull_rom(z)
        line[j] = (
            w0 * np.float32(np.int32(a0[j]))
            + w1 * np.float32(np.int32(a1[j]))
            + w2 * np.float32(np.int32(a2[j]))
            + w3 * np.float32(np.int32(a3[j]))
        )


@njit(cache=True, fastmath=True, nogil=True)
def cubic_along(line, start, first, step, values, y, k0, n):
    """Catmull-Rom along the scratch row; phases first + step * k, taps from `start` + k on."""
    a = line[start : start + n + 3]
    out = values[y, k0 : k0 + n]
    for k in range(n):
        x = first + step * np.float32(np.int32(k))
        u0, u1, u2, u3 = _catmull_rom(x)
        out[k] = u0 * a[k] + u1 * a[k + 1] + u2 * a[k + 2] + u3 * a[k + 3]


@njit(cache=True, fastmath=True, nogil=True)
def cubic_words(a, first, step, gain, offset, out, n):
    """As `cubic_along`, times gain plus offset, rounded to a word that is signal."""
    rise = offset + np.float32(0.5)
    for k in range(n):
        x = first + step * np.float32(np.int32(k))
        u0, u1, u2, u3 = _catmull_rom(x)
        v = u0 * a[k] + u1 * a[k + 1] + u2 * a[k + 2] + u3 * a[k + 3]
        v = min(max(v * gain + rise, np.float32(1.0)), np.float32(65535.0))
        out[k] = np.uint16(np.int32(v))


@njit(cache=True, fastmath=True, nogil=True)
def linear_down(flat, start, width, first, step, line, n):
    """Linear across two raw rows; arguments as in `cubic_down`."""
    a1 = flat[start : start + n]
    a2 = flat[start + width : start + width + n]
    for j in range(n):
        z = first + step * np.float32(np.int32(j))
        above = np.float32(np.int32(a1[j]))
        line[j] = above + z * (np.float32(np.int32(a2[j])) - above)


@njit(cache=True, fastmath=True, nogil=True)
def linear_along(line, start, first, step, values, y, k0, n):
    """Linear along the scratch row; arguments as in `cubic_along`."""
    a = line[start + 1 : start + n + 2]
    out = values[y, k0 : k0 + n]
    for k in range(n):
        x = first + step * np.float32(np.int32(k))
        out[k] = a[k] + x * (a[k + 1] - a[k])


@njit(cache=True, nogil=True)
def is_clean(flat, start, width, rows, columns):
    """Whether a box of raw words holds neither saturated pixels nor holes."""
    least = np.uint16(65535)
    odd = np.uint16(0)
    for r in range(rows):
        a = flat[start + r * width : start + r * width + columns]
        for j in range(len(a)):
            least = min(least, a[j])
            odd |= a[j]
    return least != 0 and (odd & np.uint16(1)) == 0


@njit(cache=True, nogil=True)
def flags_along(flat, start, width, flags, y, k0, n):
    """Flags of n pixels whose taps move along the raw row that `start` lies on."""
    a0 = flat[start - width - 1 : start - width + n + 2]
    a1 = flat[start - 1 : start + n + 2]
    a2 = flat[start + width - 1 : start + width + n + 2]
    a3 = flat[start + 2 * width - 1 : start + 2 * width + n + 2]
    out = flags[y, k0 : k0 + n]
    for k in range(n):
        least0 = min(min(a0[k], a0[k + 1]), min(a0[k + 2], a0[k + 3]))
        least1 = min(min(a1[k], a1[k + 1]), min(a1[k + 2], a1[k + 3]))
        least2 = min(min(a2[k], a2[k + 1]), min(a2[k + 2], a2[k + 3]))
        least3 = min(min(a3[k], a3[k + 1]), min(a3[k + 2], a3[k + 3]))
        least = min(min(least0, least1), min(least2, least3))
        full = (a1[k + 1] | a1[k + 2] | a2[k + 1] | a2[k + 2]) & np.uint16(1)
        out[k] = np.uint8(full) | np.uint8(np.uint8(least == 0) << np.uint8(1))


@njit(cache=True, nogil=True)
def flags_along_linear(flat, start, width, flags, y, k0, n):
    """As `flags_along`, where only the four nearest pixels are read."""
    a1 = flat[start : start + n + 1]
    a2 = flat[start + width : start + width + n + 1]
    out = flags[y, k0 : k0 + n]
    for k in range(n):
        least = min(min(a1[k], a1[k + 1]), min(a2[k], a2[k + 1]))
        full = (a1[k] | a1[k + 1] | a2[k] | a2[k + 1]) & np.uint16(1)
        out[k] = np.uint8(full) | np.uint8(np.uint8(least == 0) << np.uint8(1))


@njit(cache=True, fastmath=True, nogil=True)
def tap_weight(code, distance):
    """What a raw pixel at a distance weighs: linear, or Keys' cubic with a = -1/2."""
    d = abs(distance)
    one = np.float32(1.0)
    if code == BILINEAR:
        return max(one - d, np.float32(0.0))
    if d < one:
        return (np.float32(1.5) * d - np.float32(2.5)) * d * d + one
    if d < np.float32(2.0):
        return ((np.float32(2.5) - np.float32(0.5) * d) * d - np.float32(4.0)) * d + np.float32(2.0)
    return np.float32(0.0)
