"""Least-squares matching of small patches: a translation with gain and offset, without bias.

Compiled kernels for one pair of patches; loading them and the search for the whole pixel are in
`processing.matching` and `processing.correlation`.

Why it is unbiased: both patches are carried half of the shift towards each other, so what noise
does to the gradients cancels; and the interpolation kernel (8 taps, a sinc low-passed at 0.3
cycles per pixel under a Kaiser window that ends at zero) has a phase error below 0.0004 px up to
0.35 cycles per pixel and passes the same noise power at every sub-pixel phase (to 0.2 %), so noise
prefers no phase. Bilinear interpolation passes half the noise power at phase 1/2, per axis, and
draws matches there.

Why unequal sharpness does not matter: to first order it leaves a multiple of the image's Laplacian,
which is even where slopes are odd. One unknown of its own takes it out of shift and residuals, so
that what is left to tell the sigma is noise.

Why windows are flat: loops over fifteen pixels do not vectorise, loops over two hundred do. A
window lies in memory row by row in whole vectors (`window_stride`), zero where it is not used.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

PATCH_SLACK: Final = 64
"""Words behind a patch that whole vectors may read; what is read there is not used."""

_TAPS: Final = 8
_CUTOFF: Final = 0.30
_KAISER_BETA: Final = 8.0
_PHASES: Final = 1024
_STEPS: Final = 8
_CONVERGED_PX: Final = 0.004
_LARGEST_SHIFT_PX: Final = 1.2


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


@njit(cache=True)  # type: ignore[untyped-decorator]
def window_stride(side: int) -> int:
    """Words from row to row of a window: whole vectors of eight; what is beyond `side` is zero."""
    return (side + 7) // 8 * 8


@njit(cache=True)  # type: ignore[untyped-decorator]
def refinement_scratch(side: int) -> tuple[Array, Array, Array, Array, Array]:
    """Memory for `refine`: rows (2, .), tap weights of a and of b, windows (8, .), wide (4, .)."""
    stride = window_stride(side)
    return (
        np.zeros((2, (side + 7) * stride), np.float32),
        np.empty((4, 8), np.float32),
        np.empty((4, 8), np.float32),
        np.zeros((8, side * stride), np.float32),
        np.zeros((4, (side + 14) * (stride + 8) + 8), np.float32),
    )


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _tap_weights(table: Array, order: int, phase: float, out: Array) -> None:
    """Weights of a derivative of that order, between the two nearest phases."""
    at = phase * (table.shape[1] - 1)
    i = min(int(at), table.shape[1] - 2)
    f = np.float32(at - i)
    for k in range(8):
        out[k] = table[order, i, k] * (np.float32(1.0) - f) + table[order, i + 1, k] * f


@njit(cache=True, fastmath=True, inline="always")  # type: ignore[untyped-decorator]
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


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
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


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
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
    _clear(out, side, stride)


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _clear(window: Array, side: int, stride: int) -> None:
    for r in range(side):
        for c in range(r * stride + side, (r + 1) * stride):
            window[c] = np.float32(0.0)


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _sample(
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
    """A window of `patch` (corner top, left) moved by a shift (x, y): values and both slopes.

    Returns the noise power the interpolation passes, and that of its slopes' mean.
    """
    dx, dy = shift
    stride = window_stride(side)
    whole_x, whole_y = int(np.floor(dx)), int(np.floor(dy))
    _tap_weights(table, 0, dx - whole_x, w[0])
    _tap_weights(table, 1, dx - whole_x, w[1])
    _tap_weights(table, 0, dy - whole_y, w[2])
    _tap_weights(table, 1, dy - whole_y, w[3])
    first = (corner[0] + whole_y - 3) * width + corner[1] + whole_x - 3
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


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _add_laplacian(
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
    """Add a factor times the Laplacian of the window that `_sample` took with weights `w`.

    The weights of the slopes, w[1] and w[3], are overwritten.
    """
    dx, dy = shift
    stride = window_stride(side)
    whole_x, whole_y = int(np.floor(dx)), int(np.floor(dy))
    _tap_weights(table, 2, dx - whole_x, w[1])
    _tap_weights(table, 2, dy - whole_y, w[3])
    first = (corner[0] + whole_y - 3) * width + corner[1] + whole_x - 3
    for along_x in range(2):
        _along_rows(patch, width, first, w[along_x], rows[0], stride, side + 7)
        _along_columns(rows[0], w[3 - along_x], spare, side, stride)
        for p in range(side * stride):
            out[p] += factor * spare[p]


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _centre(values: Array, side: int, stride: int) -> float:
    """Take the mean away; returns the sum of squares that is left."""
    mean = np.float32(0.0)
    for p in range(values.shape[0]):
        mean += values[p]
    centre = mean / np.float32(side * side)
    for p in range(values.shape[0]):
        values[p] -= centre
    _clear(values, side, stride)
    return float(_dot(values, values))


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _dot(a: Array, b: Array) -> float:
    total = np.float32(0.0)
    for p in range(a.shape[0]):
        total += a[p] * b[p]
    return float(total)


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _take_away(values: Array, direction: Array, square: float) -> None:
    """Leave what is orthogonal to a direction, whose sum of squares is given."""
    share = np.float32(_dot(values, direction) / max(square, 1e-12))
    for p in range(values.shape[0]):
        values[p] -= share * direction[p]


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _spread(
    jacobian: Array, w: Array, side: int, stride: int, spare: tuple[Array, Array], out: Array
) -> None:
    """How each raw pixel enters the window's sum of jacobian * sample: interpolation transposed.

    The window is laid between seven rows of zeros and eight columns of them, so that both steps
    are flat sums of shifted copies.
    """
    framed, rows = spare
    wide = stride + 8
    n = (side + 7) * wide
    framed[:] = np.float32(0.0)
    for r in range(side):
        start = (r + 7) * wide + 8
        framed[start : start + side] = jacobian[r * stride : r * stride + side]
    rows[: n + 8] = np.float32(0.0)
    target = rows[8 : 8 + n]
    for k in range(8):
        weight = w[2, k]
        source = framed[(7 - k) * wide + 8 : (7 - k) * wide + 8 + n]
        for p in range(n):
            target[p] += weight * source[p]
    out[: n + 8] = np.float32(0.0)
    for k in range(8):
        weight = w[0, k]
        source = rows[8 - k : 8 - k + n]
        for p in range(n):
            out[p] += weight * source[p]


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def refine(
    patches: tuple[Array, Array],
    widths: tuple[int, int],
    offset: tuple[int, int],
    shift: tuple[float, float],
    half: int,
    margin: int,
    pixels_a: int,
    table: Array,
    scratch: tuple[Array, Array, Array, Array, Array],
    found: Array,
) -> bool:
    """Least-squares matching of a translation with gain and offset, symmetric in both patches.

    Args:
        patches: a and b, flat, `PATCH_SLACK` words longer than they need be.
        widths: words from row to row of each.
        offset: column and row of b's window against a's.
        shift: start value beyond the offset.
        half, margin: half of the window's side; pixels around a's window.
        pixels_a: raw pixels behind one of a's, against one of b's.
        table: `INTERPOLATION`.
        scratch: from `refinement_scratch`.
        found: receives shift x, shift y, sigma (px, root mean square of both axes), correlation.

    Returns:
        False where it does not converge within the reach of the patches.
    """
    rows, wa, wb, windows, wide = scratch
    fa, ax, ay = windows[0], windows[1], windows[2]
    fb, bx, by = windows[3], windows[4], windows[5]
    lean, bent = windows[6], windows[7]
    side = 2 * half + 1
    stride = window_stride(side)
    size = side * stride
    dx, dy = shift
    corner_a = (margin, margin)
    corner_b = (margin + offset[1], margin + offset[0])
    for step in range(_STEPS):
        power, slope_power = _sample(
            patches[0],
            widths[0],
            corner_a,
            (-0.5 * dx, -0.5 * dy),
            side,
            table,
            rows,
            wa,
            fa,
            ax,
            ay,
        )
        _sample(
            patches[1],
            widths[1],
            corner_b,
            (0.5 * dx, 0.5 * dy),
            side,
            table,
            rows,
            wb,
            fb,
            bx,
            by,
        )
        energy_a, energy_b = _centre(fa, side, stride), _centre(fb, side, stride)
        if energy_a <= 0.0 or energy_b <= 0.0:
            return False
        # Gain as the ratio of contrasts treats both images alike; least squares would not.
        gain = np.float32(np.sqrt(energy_a / energy_b))
        correlation = _dot(fa, fb) / np.sqrt(energy_a * energy_b)
        for p in range(size):
            scaled = gain * fb[p]
            lean[p] = fa[p] + scaled
            fa[p] -= scaled
            ax[p] = np.float32(0.5) * (ax[p] + gain * bx[p])
            ay[p] = np.float32(0.5) * (ay[p] + gain * by[p])
        # Offset and gain leave the system: slopes lose their mean and their share of the signal.
        _centre(ax, side, stride)
        _centre(ay, side, stride)
        signal = _dot(lean, lean)
        _take_away(ax, lean, signal)
        _take_away(ay, lean, signal)
        nxx, nxy, nyy = _dot(ax, ax), _dot(ax, ay), _dot(ay, ay)
        determinant = nxx * nyy - nxy * nxy
        if determinant <= 1e-9 * nxx * nyy:
            return False
        hx, hy = _dot(ax, fa), _dot(ay, fa)
        step_x = (nyy * hx - nxy * hy) / determinant
        step_y = (nxx * hy - nxy * hx) / determinant
        if abs(step_x) < _CONVERGED_PX and abs(step_y) < _CONVERGED_PX:
            break
        if step == _STEPS - 1:
            return False
        dx += step_x
        dy += step_y
        if abs(dx) > _LARGEST_SHIFT_PX or abs(dy) > _LARGEST_SHIFT_PX:
            return False
    # The last step once more, with the difference in sharpness beside the shift. Noise is in the
    # Laplacian too; weighed by what is behind a sample it agrees with neither image.
    bent[:size] = np.float32(0.0)
    back, forth = (-0.5 * dx, -0.5 * dy), (0.5 * dx, 0.5 * dy)
    part_a = np.float32(pixels_a / (pixels_a + 1.0))
    part_b = gain * (np.float32(1.0) - part_a)
    _add_laplacian(patches[0], widths[0], corner_a, back, side, table, rows, wa, bx, part_a, bent)
    _add_laplacian(patches[1], widths[1], corner_b, forth, side, table, rows, wb, bx, part_b, bent)
    _centre(bent, side, stride)
    _take_away(bent, lean, signal)
    bend = _dot(bent, bent)
    _take_away(ax, bent, bend)
    _take_away(ay, bent, bend)
    _take_away(fa, bent, bend)
    nxx, nxy, nyy = _dot(ax, ax), _dot(ax, ay), _dot(ay, ay)
    determinant = nxx * nyy - nxy * nxy
    if determinant <= 1e-9 * nxx * nyy:
        return False
    hx, hy = _dot(ax, fa), _dot(ay, fa)
    step_x = (nyy * hx - nxy * hy) / determinant
    step_y = (nxx * hy - nxy * hx) / determinant
    dx += step_x
    dy += step_y
    if abs(dx) > _LARGEST_SHIFT_PX or abs(dy) > _LARGEST_SHIFT_PX:
        return False
    squares = _dot(fa, fa) - (hx * step_x + hy * step_y)
    # Neighbouring samples share raw pixels: the variance of the shift comes from the raw pixels.
    # (Power of noise is the same in both patches, which lie at mirrored phases.)
    variance = max(squares, 0.0) / (side * side * power - 5.0)
    # Noise in the slopes looks like signal and must not be counted as such.
    noise = 0.25 * variance * slope_power * side * side
    nxx -= noise
    nyy -= noise
    determinant = nxx * nyy - nxy * nxy
    if nxx <= 0.0 or nyy <= 0.0 or determinant <= 1e-3 * nxx * nyy:
        return False
    _spread(ax, wa, side, stride, (wide[0], wide[1]), wide[2])
    _spread(ay, wa, side, stride, (wide[0], wide[1]), wide[3])
    mxx, mxy, myy = _dot(wide[2], wide[2]), _dot(wide[2], wide[3]), _dot(wide[3], wide[3])
    qxx, qxy, qyy = nyy / determinant, -nxy / determinant, nxx / determinant
    var_x = qxx * qxx * mxx + 2.0 * qxx * qxy * mxy + qxy * qxy * myy
    var_y = qxy * qxy * mxx + 2.0 * qxy * qyy * mxy + qyy * qyy * myy
    found[0] = dx
    found[1] = dy
    found[2] = np.sqrt(0.5 * variance * (var_x + var_y))
    found[3] = correlation
    return True
