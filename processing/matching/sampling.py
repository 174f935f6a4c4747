"""Windows of small patches at fractions of a pixel: values, slopes and Laplacians, compiled.

What they are compared for is in `processing.matching.least_squares`.

The interpolation kernel (8 taps, a sinc low-passed at 0.3 cycles per pixel under a Kaiser window
that ends at zero) has a phase error below 0.0004 px up to 0.35 cycles per pixel and passes the same
noise power at every sub-pixel phase (to 0.2 %), so noise prefers no phase. Bilinear interpolation
passes half the noise power at phase 1/2, per axis, and draws matches there.

Why windows are flat: loops over fifteen pixels do not vectorise, loops over two hundred do. A
window lies in memory row by row in whole vectors (`window_stride`), zero where it is not used.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

PATCH_SLACK: Final = 64
"""Words behind a patch that whole vectors may read; what is read there is not used."""

_TAPS: Final = 8
_CUTOFF: Final = 0.30
_KAISER_BETA: Final = 8.0
_PHASES: Final = 1024


def _kernel(x: Array) -> Array:
    # Less its value at the ends: a step there would be a spike of the slope at whole pixels.
    taper = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1.0 - (x / 4.0) ** 2))) - 1.0
    value: Array = np.sinc(2.0 * _CUTOFF * x) * taper
    return value


def _kernel_table() -> Array:
    """Weights, their slopes and bends at phases 0 .. 1, shape (3, phases + 1, taps), float32.

    Row i weighs the pixels -3 .. 4 for a sample at i / phases right of pixel 0.
    """
    taps = np.arange(-3, 5)
    phase = np.arange(_PHASES + 1) / _PHASES
    step = 1e-3

    def weights(at: Array) -> Array:
        w = _kernel(taps[None, :] - at[:, None])
        normalised: Array = w / w.sum(axis=1, keepdims=True)
        return normalised

    before, at, after = weights(phase - step), weights(phase), weights(phase + step)
    slope, bend = (after - before) / (2.0 * step), (after - 2.0 * at + before) / step**2
    return np.stack([at, slope, bend]).astype(np.float32)


INTERPOLATION: Final = _kernel_table()
"""The one table `refine` takes."""


@compiled_kernel()
def window_stride(side: int) -> int:
    """Words from row to row of a window: whole vectors of eight; what is beyond `side` is zero.

    Args:
        side: side of the window, px.

    Returns:
        The next multiple of eight.
    """
    return (side + 7) // 8 * 8


@compiled_kernel(fastmath=True)
def _tap_weights(table: Array, order: int, phase: float, out: Array) -> None:
    """Weights of a derivative of that order, between the two nearest phases."""
    at = phase * (table.shape[1] - 1)
    i = min(int(at), table.shape[1] - 2)
    f = np.float32(at - i)
    for k in range(8):
        out[k] = table[order, i, k] * (np.float32(1.0) - f) + table[order, i + 1, k] * f


@compiled_kernel(fastmath=True, inline="always")
def _row_taps(s: Array, w: tuple[Any, ...], o: Array, count: int) -> None:
    w0, w1, w2, w3, w4, w5, w6, w7 = w
    for c in range(count):
        o[c] = (
            w0 * s[c]
            + w1 * s[c + 1]
            + w2 * s[c + 2]
            + w3 * s[c + 3]
            + w4 * s[c + 4]
            + w5 * s[c + 5]
            + w6 * s[c + 6]
            + w7 * s[c + 7]
        )


@compiled_kernel(fastmath=True)
def _along_rows(
    source: Array, width: int, first: int, w: Array, out: Array, stride: int, rows: int
) -> None:
    """Eight taps along each of `rows` rows of a flat patch, the first tap at word `first`."""
    taps = (w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7])
    for r in range(rows):
        start = first + r * width
        s = source[start : start + stride + 7]
        o = out[r * stride : (r + 1) * stride]
        # A count known to the compiler: two or three vectors and nothing left over.
        if stride == 16:
            _row_taps(s, taps, o, 16)
        elif stride == 24:
            _row_taps(s, taps, o, 24)
        else:
            _row_taps(s, taps, o, stride)


@compiled_kernel(fastmath=True)
def _along_columns(source: Array, w: Array, out: Array, side: int, stride: int) -> None:
    """Eight taps along the columns; columns beyond `side` become zero."""
    w0, w1, w2, w3, w4, w5, w6, w7 = w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7]
    n = side * stride
    s0 = source[0:n]
    s1 = source[stride : stride + n]
    s2 = source[2 * stride : 2 * stride + n]
    s3 = source[3 * stride : 3 * stride + n]
    s4 = source[4 * stride : 4 * stride + n]
    s5 = source[5 * stride : 5 * stride + n]
    s6 = source[6 * stride : 6 * stride + n]
    s7 = source[7 * stride : 7 * stride + n]
    for p in range(n):
        out[p] = (
            w0 * s0[p]
            + w1 * s1[p]
            + w2 * s2[p]
            + w3 * s3[p]
            + w4 * s4[p]
            + w5 * s5[p]
            + w6 * s6[p]
            + w7 * s7[p]
        )
    clear_beyond(out, side, stride)


@compiled_kernel(fastmath=True)
def clear_beyond(window: Array, side: int, stride: int) -> None:
    """Set a window's unused words to zero.

    Args:
        window: flat, (side * stride,); columns from `side` on are cleared in place.
        side: side of the window, px.
        stride: `window_stride` of the side.
    """
    for r in range(side):
        for c in range(r * stride + side, (r + 1) * stride):
            window[c] = np.float32(0.0)


@compiled_kernel(fastmath=True)
def sample_window(
    patch: Array,
    width: int,
    corner: tuple[int, int],
    shift: tuple[float, float],
    side: int,
    table: Array,
    rows: Array,
    w: Array,
    value: Array,
    slope_x: Array,
    slope_y: Array,
) -> tuple[float, float]:
    """Sample a window of a patch at a shift: values and both slopes.

    Args:
        patch: flat float32, `PATCH_SLACK` words longer than it need be.
        width: words from row to row of the patch.
        corner: row and column of the window's upper left pixel in the patch, before the shift.
        shift: x right and y down, px.
        side: side of the window, px.
        table: `INTERPOLATION`.
        rows: memory, (2, (side + 7) * stride).
        w: receives tap weights of values and slopes in x, then in y, (4, 8).
        value: receives grey values, (side * stride,).
        slope_x: receives derivatives in x per pixel, (side * stride,).
        slope_y: receives derivatives in y per pixel, (side * stride,).

    Returns:
        Noise power that the interpolation passes, and the mean noise power of both slopes.
    """
    dx, dy = shift
    stride = window_stride(side)
    integer_x, integer_y = int(np.floor(dx)), int(np.floor(dy))
    _tap_weights(table, 0, dx - integer_x, w[0])
    _tap_weights(table, 1, dx - integer_x, w[1])
    _tap_weights(table, 0, dy - integer_y, w[2])
    _tap_weights(table, 1, dy - integer_y, w[3])
    first = (corner[0] + integer_y - 3) * width + corner[1] + integer_x - 3
    _along_rows(patch, width, first, w[0], rows[0], stride, side + 7)
    _along_rows(patch, width, first, w[1], rows[1], stride, side + 7)
    _along_columns(rows[0], w[2], value, side, stride)
    _along_columns(rows[1], w[2], slope_x, side, stride)
    _along_columns(rows[0], w[3], slope_y, side, stride)
    power_x = power_y = slope_power_x = slope_power_y = 0.0
    for k in range(8):
        power_x += w[0, k] * w[0, k]
        slope_power_x += w[1, k] * w[1, k]
        power_y += w[2, k] * w[2, k]
        slope_power_y += w[3, k] * w[3, k]
    return power_x * power_y, 0.5 * (slope_power_x * power_y + slope_power_y * power_x)


@compiled_kernel(fastmath=True)
def add_laplacian(
    patch: Array,
    width: int,
    corner: tuple[int, int],
    shift: tuple[float, float],
    side: int,
    table: Array,
    rows: Array,
    w: Array,
    spare: Array,
    factor: np.float32,
    out: Array,
) -> None:
    """Add a factor times the Laplacian of the window that `sample_window` took.

    Args:
        patch: as of `sample_window`, like `width`, `corner`, `shift`, `side`, `table` and `rows`.
        width: words from row to row of the patch.
        corner: row and column of the window's upper left pixel.
        shift: x right and y down, px.
        side: side of the window, px.
        table: `INTERPOLATION`.
        rows: memory, (2, (side + 7) * stride).
        w: tap weights that `sample_window` left, (4, 8); those of slopes, rows 1 and 3, are
            overwritten.
        spare: memory, (side * stride,).
        factor: weight of the Laplacian.
        out: sum to which it is added, (side * stride,).
    """
    dx, dy = shift
    stride = window_stride(side)
    integer_x, integer_y = int(np.floor(dx)), int(np.floor(dy))
    _tap_weights(table, 2, dx - integer_x, w[1])
    _tap_weights(table, 2, dy - integer_y, w[3])
    first = (corner[0] + integer_y - 3) * width + corner[1] + integer_x - 3
    for along_x in range(2):
        _along_rows(patch, width, first, w[along_x], rows[0], stride, side + 7)
        _along_columns(rows[0], w[3 - along_x], spare, side, stride)
        for p in range(side * stride):
            out[p] += factor * spare[p]
