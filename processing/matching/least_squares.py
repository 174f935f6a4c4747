"""Least-squares matching of small patches: a translation with gain and offset, without bias.

Compiled kernels for one pair of patches; loading them and the search for the whole pixel are in
`processing.matching.patches` and `processing.matching.correlation`, sampling them at fractions of a
pixel in `processing.matching.sampling`.

Why it is unbiased: both patches are carried half of the shift towards each other, so what noise
does to the gradients cancels; and interpolation passes the same noise at every sub-pixel phase.

Why unequal sharpness does not matter: to first order it leaves a multiple of the image's Laplacian,
which is even where slopes are odd. A separate unknown removes it from shift and residuals, so
that the sigma follows from noise alone.

Source: docs/explanation/mathematics/matching.md#least-squares-matching; Gruen (1985).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.matching.sampling import (
    INTERPOLATION,
    PATCH_SLACK,
    add_laplacian,
    clear_beyond,
    sample_window,
    window_stride,
)

__all__ = ["INTERPOLATION", "PATCH_SLACK", "refine", "refinement_scratch"]

Array = NDArray[Any]

_STEPS: Final = 8
_CONVERGED_PX: Final = 0.004
_MAX_SHIFT_PX: Final = 1.2


@compiled_kernel()
def refinement_scratch(side: int) -> tuple[Array, Array, Array, Array, Array]:
    """Memory for `refine`.

    Args:
        side: side of the window, px, odd.

    Returns:
        Rows (2, .), tap weights of a and of b (4, 8), windows (8, .), wide windows (4, .).
    """
    stride = window_stride(side)
    return (
        np.zeros((2, (side + 7) * stride), np.float32),
        np.empty((4, 8), np.float32),
        np.empty((4, 8), np.float32),
        np.zeros((8, side * stride), np.float32),
        np.zeros((4, (side + 14) * (stride + 8) + 8), np.float32),
    )


@compiled_kernel(fastmath=True)
def _centre(values: Array, side: int, stride: int) -> float:
    """Take the mean away; returns the sum of squares that is left."""
    mean = np.float32(0.0)
    for p in range(values.shape[0]):
        mean += values[p]
    centre = mean / np.float32(side * side)
    for p in range(values.shape[0]):
        values[p] -= centre
    clear_beyond(values, side, stride)
    return float(_dot(values, values))


@compiled_kernel(fastmath=True)
def _dot(a: Array, b: Array) -> float:
    total = np.float32(0.0)
    for p in range(a.shape[0]):
        total += a[p] * b[p]
    return float(total)


@compiled_kernel(fastmath=True)
def _orthogonalise(values: Array, direction: Array, square: float) -> None:
    """Leave what is orthogonal to a direction, whose sum of squares is given."""
    share = np.float32(_dot(values, direction) / max(square, 1e-12))
    for p in range(values.shape[0]):
        values[p] -= share * direction[p]


@compiled_kernel(fastmath=True)
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
        # A loop: numba compiles the messages of array assignments, which takes seconds.
        for p in range(side):
            framed[start + p] = jacobian[r * stride + p]
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


@compiled_kernel(fastmath=True)
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
        offset: column and row of b's window against a's, px.
        shift: start value beyond the offset, x right and y down, px.
        half: half of the window's side, px.
        margin: pixels around a's window.
        pixels_a: raw pixels behind one of a's, against one of b's.
        table: `INTERPOLATION`.
        scratch: from `refinement_scratch`.
        found: receives shift x, shift y, sigma (px, root mean square of both axes), correlation.

    Returns:
        False where it does not converge within the reach of the patches.

    Source: docs/explanation/mathematics/matching.md#least-squares-matching and
        #standard-deviation-of-a-match.
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
        power, slope_power = sample_window(
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
        sample_window(
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
        _orthogonalise(ax, lean, signal)
        _orthogonalise(ay, lean, signal)
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
        if abs(dx) > _MAX_SHIFT_PX or abs(dy) > _MAX_SHIFT_PX:
            return False
    # The last step once more, with the difference in sharpness and the shift. Noise is in the
    # Laplacian too; weighed by what is behind a sample it agrees with neither image.
    bent[:size] = np.float32(0.0)
    back, forth = (-0.5 * dx, -0.5 * dy), (0.5 * dx, 0.5 * dy)
    part_a = np.float32(pixels_a / (pixels_a + 1.0))
    part_b = gain * (np.float32(1.0) - part_a)
    add_laplacian(patches[0], widths[0], corner_a, back, side, table, rows, wa, bx, part_a, bent)
    add_laplacian(patches[1], widths[1], corner_b, forth, side, table, rows, wb, bx, part_b, bent)
    _centre(bent, side, stride)
    _orthogonalise(bent, lean, signal)
    bend = _dot(bent, bent)
    _orthogonalise(ax, bent, bend)
    _orthogonalise(ay, bent, bend)
    _orthogonalise(fa, bent, bend)
    nxx, nxy, nyy = _dot(ax, ax), _dot(ax, ay), _dot(ay, ay)
    determinant = nxx * nyy - nxy * nxy
    if determinant <= 1e-9 * nxx * nyy:
        return False
    hx, hy = _dot(ax, fa), _dot(ay, fa)
    step_x = (nyy * hx - nxy * hy) / determinant
    step_y = (nxx * hy - nxy * hx) / determinant
    dx += step_x
    dy += step_y
    if abs(dx) > _MAX_SHIFT_PX or abs(dy) > _MAX_SHIFT_PX:
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
