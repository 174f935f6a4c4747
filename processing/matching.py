"""Area-based matching of small patches: correlation search, then least-squares matching.

Compiled kernels over many points; which points, in which frames, and what the positions mean is in
`processing.tie_points`. A bad pixel makes its patch unusable: for uint16 frames a Level-1 word that
is no data or saturated, for float32 frames one that is not finite.

Why it is unbiased: both patches are carried half of the shift towards each other, so what noise
does to the gradients cancels; and the interpolation kernel (8 taps, a sinc low-passed at 0.3
cycles per pixel under a Kaiser window that ends at zero) has a phase error below 0.0004 px up to
0.35 cycles per pixel and passes the same noise power at every sub-pixel phase (to 0.2 %), so noise
prefers no phase. Bilinear interpolation passes half the noise power at phase 1/2, per axis, and
draws matches there.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array = NDArray[Any]

MARGIN_PX: Final = 4
"""Pixels a patch needs around its window: four taps and the largest half shift."""

_TAPS: Final = 8
_CUTOFF: Final = 0.30
_KAISER_BETA: Final = 8.0
_PHASES: Final = 1024
_STEPS: Final = 8
_CONVERGED_PX: Final = 0.004
_LARGEST_SHIFT_PX: Final = 1.2
_BLOCK: Final = 32


def _kernel(x: Array) -> Array:
    # Less its value at the ends: a step there would be a spike of the slope at whole pixels.
    taper = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1.0 - (x / 4.0) ** 2))) - 1.0
    value: Array = np.sinc(2.0 * _CUTOFF * x) * taper
    return value


def _kernel_tables() -> tuple[Array, Array]:
    """Weights and their derivatives at phases 0 .. 1, shape (phases + 1, taps), float32.

    Row i weighs the pixels -3 .. 4 for a sample at i / phases right of pixel 0.
    """
    taps = np.arange(-3, 5)
    phase = np.arange(_PHASES + 1) / _PHASES
    step = 1e-4

    def weights(at: Array) -> Array:
        w = _kernel(taps[None, :] - at[:, None])
        normalised: Array = w / w.sum(axis=1, keepdims=True)
        return normalised

    slope = (weights(phase + step) - weights(phase - step)) / (2.0 * step)
    return weights(phase).astype(np.float32), slope.astype(np.float32)


INTERPOLATION: Final = _kernel_tables()


@njit(cache=True)  # type: ignore[untyped-decorator]
def _unusable(word: Any) -> bool:
    """A Level-1 word that is no data (0) or saturated (its lowest bit is set)."""
    return bool(word == 0 or (np.int64(word) & 1) != 0)


@njit(cache=True, parallel=True)  # type: ignore[untyped-decorator]
def select_features(
    frame: Array, cells: Array, half_window: int, stride: int, words: bool
) -> Array:
    """The most feature-rich position of each cell: the structure tensor's smaller eigenvalue peaks.

    Args:
        frame: (h, w), uint16 Level-1 words or float32.
        cells: (n, 4) int64: first and last column, first and last row a window centre may take. The
            window and one pixel around it must lie in the frame.
        half_window: half of the window's side, px.
        stride: candidates and gradients are looked at every so many pixels.
        words: frame holds Level-1 words.

    Returns:
        (n, 3) float64: column, row, eigenvalue (mean squared gradient per pixel along the weaker
        direction, halved step); eigenvalue -1 where bad pixels leave no candidate.
    """
    result = np.empty((len(cells), 3))
    for i in prange(len(cells)):
        first_col, last_col = cells[i, 0], cells[i, 1]
        first_row, last_row = cells[i, 2], cells[i, 3]
        # Integral images of the gradient products, on every stride-th pixel.
        span_col = (last_col - first_col + 2 * half_window) // stride + 1
        span_row = (last_row - first_row + 2 * half_window) // stride + 1
        sums = np.zeros((span_row + 1, span_col + 1, 4))
        for r in range(span_row):
            row = first_row - half_window + r * stride
            xx = xy = yy = bad = 0.0
            for c in range(span_col):
                col = first_col - half_window + c * stride
                right, left = frame[row, col + 1], frame[row, col - 1]
                down, up = frame[row + 1, col], frame[row - 1, col]
                broken = words and (
                    _unusable(right)
                    or _unusable(left)
                    or _unusable(down)
                    or _unusable(up)
                    or _unusable(frame[row, col])
                )
                dx = float(right) - float(left)
                dy = float(down) - float(up)
                if not (np.isfinite(dx) and np.isfinite(dy)):
                    broken = True
                if broken:
                    bad += 1.0
                else:
                    xx += dx * dx
                    xy += dx * dy
                    yy += dy * dy
                sums[r + 1, c + 1, 0] = sums[r, c + 1, 0] + xx
                sums[r + 1, c + 1, 1] = sums[r, c + 1, 1] + xy
                sums[r + 1, c + 1, 2] = sums[r, c + 1, 2] + yy
                sums[r + 1, c + 1, 3] = sums[r, c + 1, 3] + bad
        reach = 2 * half_window // stride
        best, best_col, best_row = -1.0, first_col, first_row
        for r in range(span_row - reach):
            for c in range(span_col - reach):
                s = (
                    sums[r + reach + 1, c + reach + 1]
                    - sums[r, c + reach + 1]
                    - sums[r + reach + 1, c]
                    + sums[r, c]
                )
                if s[3] > 0.0:
                    continue
                half_trace = 0.5 * (s[0] + s[2])
                weaker = half_trace - np.sqrt(
                    max(0.25 * (s[0] - s[2]) * (s[0] - s[2]) + s[1] * s[1], 0.0)
                )
                if weaker > best:
                    best = weaker
                    best_col = first_col + c * stride
                    best_row = first_row + r * stride
        result[i, 0] = best_col
        result[i, 1] = best_row
        result[i, 2] = best / ((reach + 1) * (reach + 1)) if best > 0.0 else best
    return result


@njit(cache=True)  # type: ignore[untyped-decorator]
def _load(frame: Array, col: int, row: int, ratio: int, words: bool, patch: Array) -> bool:
    """Fill a patch with box means of ratio x ratio pixels, the first box beginning at (col, row).

    The patch is left with a mean near zero, so that single precision suffices. False: bad pixels.
    """
    height, width = patch.shape
    share = np.float32(1.0 / (ratio * ratio))
    origin = np.float32(frame[row + ratio * (height // 2), col + ratio * (width // 2)])
    for r in range(height):
        for c in range(width):
            total = np.float32(0.0)
            for i in range(ratio):
                for j in range(ratio):
                    value = frame[row + r * ratio + i, col + c * ratio + j]
                    if words and _unusable(value):
                        return False
                    total += np.float32(value) - origin
            patch[r, c] = total * share
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]
def _all_finite(patch: Array) -> bool:
    total = np.float32(0.0)
    for r in range(patch.shape[0]):
        for c in range(patch.shape[1]):
            total += patch[r, c] * np.float32(0.0)
    return bool(total == 0.0)


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _correlate(
    a: Array,
    b: Array,
    half: int,
    margin: int,
    reach: Array,
    scratch: tuple[Array, Array, Array, Array],
    surface: Array,
) -> None:
    """Normalised cross correlation of a's window with b at all offsets; -2 where not tried.

    `reach` holds the first and last column offset and the first and last row offset to be tried.
    """
    template, products, sums, squares = scratch
    side = 2 * half + 1
    n = side * side
    width = surface.shape[1]
    search = (width - 1) // 2
    mean = np.float32(0.0)
    for r in range(side):
        for c in range(side):
            mean += a[r + margin, c + margin]
    mean /= np.float32(n)
    energy = 0.0
    for r in range(side):
        for c in range(side):
            value = a[r + margin, c + margin] - mean
            template[r, c] = value
            energy += value * value
    surface[:] = np.float32(-2.0)
    sums[:] = 0.0
    squares[:] = 0.0
    first = margin + search + reach[2]
    for r in range(first, first + side):
        for j in range(width + side - 1):
            value = float(b[r, margin + j])
            sums[j] += value
            squares[j] += value * value
    for dr in range(reach[2], reach[3] + 1):
        top = margin + search + dr
        products[:] = np.float32(0.0)
        for r in range(side):
            for c in range(side):
                weight = template[r, c]
                for k in range(width):
                    products[k] += weight * b[top + r, margin + c + k]
        total = square = 0.0
        for j in range(side - 1):
            total += sums[j]
            square += squares[j]
        for k in range(width):
            total += sums[k + side - 1]
            square += squares[k + side - 1]
            if reach[0] <= k - search <= reach[1]:
                spread = (square - total * total / n) * energy
                if spread > 1e-6:
                    surface[search + dr, k] = products[k] / np.sqrt(spread)
            total -= sums[k]
            square -= squares[k]
        if dr < reach[3]:
            for j in range(width + side - 1):
                leaving = float(b[top, margin + j])
                coming = float(b[top + side, margin + j])
                sums[j] += coming - leaving
                squares[j] += coming * coming - leaving * leaving


@njit(cache=True)  # type: ignore[untyped-decorator]
def _peak(surface: Array, reach: Array, found: Array) -> bool:
    """Best offset, its sub-pixel part by parabola, its height and that of the next maximum.

    False where the peak lies on the edge of what was searched.
    """
    search = (surface.shape[0] - 1) // 2
    best, row, col = -2.0, 0, 0
    for dr in range(reach[2], reach[3] + 1):
        for dc in range(reach[0], reach[1] + 1):
            if surface[search + dr, search + dc] > best:
                best = surface[search + dr, search + dc]
                row, col = dr, dc
    if best <= 0.0 or row == reach[2] or row == reach[3] or col == reach[0] or col == reach[1]:
        return False
    second = -1.0
    for dr in range(reach[2], reach[3] + 1):
        for dc in range(reach[0], reach[1] + 1):
            value = surface[search + dr, search + dc]
            if value <= second or (abs(dr - row) <= 1 and abs(dc - col) <= 1):
                continue
            highest = True
            for i in range(max(dr - 1, reach[2]), min(dr + 1, reach[3]) + 1):
                for j in range(max(dc - 1, reach[0]), min(dc + 1, reach[1]) + 1):
                    if surface[search + i, search + j] > value:
                        highest = False
            if highest:
                second = value
    r, c = search + row, search + col
    found[0] = col
    found[1] = row
    found[2] = _vertex(surface[r, c - 1], surface[r, c], surface[r, c + 1])
    found[3] = _vertex(surface[r - 1, c], surface[r, c], surface[r + 1, c])
    found[4] = best
    found[5] = second
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]
def _vertex(before: float, at: float, after: float) -> float:
    curvature = before - 2.0 * at + after
    if curvature >= 0.0:
        return 0.0
    return min(0.5, max(-0.5, 0.5 * (before - after) / curvature))


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _tap_weights(table: Array, phase: float, out: Array) -> None:
    at = phase * (table.shape[0] - 1)
    i = min(int(at), table.shape[0] - 2)
    f = np.float32(at - i)
    for k in range(8):
        out[k] = table[i, k] * (np.float32(1.0) - f) + table[i + 1, k] * f


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _along_rows(source: Array, top: int, left: int, w: Array, out: Array) -> None:
    w0, w1, w2, w3, w4, w5, w6, w7 = w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7]
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            j = left + c
            i = top + r
            out[r, c] = (
                w0 * source[i, j]
                + w1 * source[i, j + 1]
                + w2 * source[i, j + 2]
                + w3 * source[i, j + 3]
                + w4 * source[i, j + 4]
                + w5 * source[i, j + 5]
                + w6 * source[i, j + 6]
                + w7 * source[i, j + 7]
            )


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _along_columns(source: Array, w: Array, out: Array) -> None:
    w0, w1, w2, w3, w4, w5, w6, w7 = w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7]
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[r, c] = (
                w0 * source[r, c]
                + w1 * source[r + 1, c]
                + w2 * source[r + 2, c]
                + w3 * source[r + 3, c]
                + w4 * source[r + 4, c]
                + w5 * source[r + 5, c]
                + w6 * source[r + 6, c]
                + w7 * source[r + 7, c]
            )


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _sample(
    patch: Array,
    top: int,
    left: int,
    dx: float,
    dy: float,
    tables: tuple[Array, Array],
    rows: tuple[Array, Array],
    w: Array,
    value: Array,
    slope_x: Array,
    slope_y: Array,
) -> tuple[float, float]:
    """A window of `patch` (first pixel at top, left) moved by (dx, dy): values and both slopes.

    Returns the noise power the interpolation passes, and that of its slopes' mean.
    """
    whole_x, whole_y = int(np.floor(dx)), int(np.floor(dy))
    _tap_weights(tables[0], dx - whole_x, w[0])
    _tap_weights(tables[1], dx - whole_x, w[1])
    _tap_weights(tables[0], dy - whole_y, w[2])
    _tap_weights(tables[1], dy - whole_y, w[3])
    i, j = top + whole_y - 3, left + whole_x - 3
    _along_rows(patch, i, j, w[0], rows[0])
    _along_rows(patch, i, j, w[1], rows[1])
    _along_columns(rows[0], w[2], value)
    _along_columns(rows[1], w[2], slope_x)
    _along_columns(rows[0], w[3], slope_y)
    power_x = power_y = slope_power_x = slope_power_y = 0.0
    for k in range(8):
        power_x += w[0, k] * w[0, k]
        slope_power_x += w[1, k] * w[1, k]
        power_y += w[2, k] * w[2, k]
        slope_power_y += w[3, k] * w[3, k]
    return power_x * power_y, 0.5 * (slope_power_x * power_y + slope_power_y * power_x)


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _centre(values: Array) -> float:
    """Take the mean away; returns the sum of squares that is left."""
    mean = 0.0
    for r in range(values.shape[0]):
        for c in range(values.shape[1]):
            mean += values[r, c]
    centre = np.float32(mean / values.size)
    squares = 0.0
    for r in range(values.shape[0]):
        for c in range(values.shape[1]):
            values[r, c] -= centre
            squares += values[r, c] * values[r, c]
    return squares


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _dot(a: Array, b: Array) -> float:
    total = 0.0
    for r in range(a.shape[0]):
        for c in range(a.shape[1]):
            total += a[r, c] * b[r, c]
    return total


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _spread(jacobian: Array, w: Array, rows: Array, out: Array) -> None:
    """How each raw pixel enters the window's sum of jacobian * sample: interpolation transposed."""
    side = jacobian.shape[0]
    rows[:] = np.float32(0.0)
    out[:] = np.float32(0.0)
    for k in range(8):
        weight = w[2, k]
        for r in range(side):
            for c in range(side):
                rows[r + k, c] += weight * jacobian[r, c]
    for k in range(8):
        weight = w[0, k]
        for r in range(side + 7):
            for c in range(side):
                out[r, c + k] += weight * rows[r, c]


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _refine(
    a: Array,
    b: Array,
    offset: tuple[int, int],
    shift: tuple[float, float],
    half: int,
    margin: int,
    scratch: tuple[Any, ...],
    found: Array,
) -> bool:
    """Least-squares matching of a translation with gain and offset, symmetric in both patches.

    `found` receives shift x, shift y, sigma (px, root mean square of both axes), correlation.
    False where it does not converge within the reach of the patches.
    """
    tables, rows, wa, wb, fa, ax, ay, fb, bx, by, lean, wide_x, wide_y = scratch
    side = 2 * half + 1
    dx, dy = shift
    top_b, left_b = margin + offset[1], margin + offset[0]
    for step in range(_STEPS):
        power, slope_power = _sample(
            a, margin, margin, -0.5 * dx, -0.5 * dy, tables, rows, wa, fa, ax, ay
        )
        _sample(b, top_b, left_b, 0.5 * dx, 0.5 * dy, tables, rows, wb, fb, bx, by)
        energy_a, energy_b = _centre(fa), _centre(fb)
        if energy_a <= 0.0 or energy_b <= 0.0:
            return False
        # Gain as the ratio of contrasts treats both images alike; least squares would not.
        gain = np.float32(np.sqrt(energy_a / energy_b))
        correlation = _dot(fa, fb) / np.sqrt(energy_a * energy_b)
        for r in range(side):
            for c in range(side):
                scaled = gain * fb[r, c]
                lean[r, c] = fa[r, c] + scaled
                fa[r, c] -= scaled
                ax[r, c] = np.float32(0.5) * (ax[r, c] + gain * bx[r, c])
                ay[r, c] = np.float32(0.5) * (ay[r, c] + gain * by[r, c])
        # Offset and gain leave the system: slopes lose their mean and their share of the signal.
        _centre(ax)
        _centre(ay)
        signal = _dot(lean, lean)
        share_x = np.float32(_dot(ax, lean) / signal)
        share_y = np.float32(_dot(ay, lean) / signal)
        for r in range(side):
            for c in range(side):
                ax[r, c] -= share_x * lean[r, c]
                ay[r, c] -= share_y * lean[r, c]
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
        if abs(step_x) < _CONVERGED_PX and abs(step_y) < _CONVERGED_PX:
            break
        if step == _STEPS - 1:
            return False
    squares = _dot(fa, fa) - (hx * step_x + hy * step_y)
    # Neighbouring samples share raw pixels: the variance of the shift comes from the raw pixels.
    # (Power of noise is the same in both patches, which lie at mirrored phases.)
    variance = max(squares, 0.0) / (side * side * power - 4.0)
    # Noise in the slopes looks like signal and must not be counted as such.
    noise = 0.25 * variance * slope_power * side * side
    nxx -= noise
    nyy -= noise
    determinant = nxx * nyy - nxy * nxy
    if nxx <= 0.0 or nyy <= 0.0 or determinant <= 1e-3 * nxx * nyy:
        return False
    _spread(ax, wa, rows[0], wide_x)
    _spread(ay, wa, rows[0], wide_y)
    mxx, mxy, myy = _dot(wide_x, wide_x), _dot(wide_x, wide_y), _dot(wide_y, wide_y)
    qxx, qxy, qyy = nyy / determinant, -nxy / determinant, nxx / determinant
    var_x = qxx * qxx * mxx + 2.0 * qxx * qxy * mxy + qxy * qxy * myy
    var_y = qxy * qxy * mxx + 2.0 * qxy * qyy * mxy + qyy * qyy * myy
    found[0] = dx
    found[1] = dy
    found[2] = np.sqrt(0.5 * variance * (var_x + var_y))
    found[3] = correlation
    return True


@njit(cache=True, parallel=True)  # type: ignore[untyped-decorator]
def match_patches(
    frame_a: Array,
    frame_b: Array,
    at_a: Array,
    at_b: Array,
    limits_b: Array,
    ratio: int,
    half_window: int,
    search: int,
    words: bool,
    tables: tuple[Array, Array],
) -> Array:
    """Find windows of frame a, reduced by `ratio`, in frame b.

    Args:
        frame_a: (h, w), uint16 Level-1 words or float32; the finer frame.
        frame_b: (h, w), same type.
        at_a: (n, 2) int64, first pixel (column, row) of the centre box of ratio x ratio pixels.
        at_b: (n, 2) int64, predicted pixel of frame b, rounded.
        limits_b: (4,) int64, first and last usable column, first and last usable row of frame b.
        ratio: pixels of a per pixel of b along each axis.
        half_window: the window has 2 * half_window + 1 pixels of b.
        search: offsets tried around the prediction, px of b.
        words: the frames hold Level-1 words.
        tables: `INTERPOLATION`.

    Returns:
        (n, 8) float64: column and row in a, column and row in b of the same ground, sigma of their
        difference (px of b, per coordinate), correlation after refinement, height of the
        correlation peak over the next maximum, and 1 where matched (the rest of the row is
        undefined otherwise).
    """
    count = len(at_a)
    result = np.zeros((count, 8))
    side = 2 * half_window + 1
    margin = MARGIN_PX
    size_a, size_b = side + 2 * margin, side + 2 * margin + 2 * search
    blocks = (count + _BLOCK - 1) // _BLOCK
    for block in prange(blocks):
        a = np.empty((size_a, size_a), np.float32)
        b = np.zeros((size_b, size_b), np.float32)
        width = 2 * search + 1
        surface = np.empty((width, width), np.float32)
        correlation = (
            np.empty((side, side), np.float32),
            np.empty(width, np.float32),
            np.empty(width + side - 1),
            np.empty(width + side - 1),
        )
        rows = (
            np.empty((side + 7, side), np.float32),
            np.empty((side + 7, side), np.float32),
        )
        scratch = (
            tables,
            rows,
            np.empty((4, 8), np.float32),
            np.empty((4, 8), np.float32),
            np.empty((side, side), np.float32),
            np.empty((side, side), np.float32),
            np.empty((side, side), np.float32),
            np.empty((side, side), np.float32),
            np.empty((side, side), np.float32),
            np.empty((side, side), np.float32),
            np.empty((side, side), np.float32),
            np.empty((side + 7, side + 7), np.float32),
            np.empty((side + 7, side + 7), np.float32),
        )
        peak = np.empty(6)
        found = np.empty(4)
        reach = np.empty(4, np.int64)
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            col_b, row_b = at_b[i, 0], at_b[i, 1]
            room = half_window + margin
            reach[0] = max(-search, limits_b[0] + room - col_b)
            reach[1] = min(search, limits_b[1] - room - col_b)
            reach[2] = max(-search, limits_b[2] + room - row_b)
            reach[3] = min(search, limits_b[3] - room - row_b)
            if reach[1] - reach[0] < 2 or reach[3] - reach[2] < 2:
                continue
            col_a = at_a[i, 0] - ratio * room
            row_a = at_a[i, 1] - ratio * room
            if not _load(frame_a, col_a, row_a, ratio, words, a) or not _all_finite(a):
                continue
            # Only what lies in the frame is loaded; the rest of b is never looked at.
            rows_b = 2 * room + 1 + reach[3] - reach[2]
            cols_b = 2 * room + 1 + reach[1] - reach[0]
            part = b[
                search + reach[2] : search + reach[2] + rows_b,
                search + reach[0] : search + reach[0] + cols_b,
            ]
            first_col, first_row = col_b - room + reach[0], row_b - room + reach[2]
            if not _load(frame_b, first_col, first_row, 1, words, part) or not _all_finite(part):
                continue
            _correlate(a, b, half_window, margin, reach, correlation, surface)
            if not _peak(surface, reach, peak):
                continue
            moved_col = moved_row = 0
            shift = (peak[2], peak[3])
            if ratio > 1:
                # Reduced pixels in phase with b's: what is finer than b's pixels folds over alike.
                moved_col = -int(np.round(peak[2] * ratio))
                moved_row = -int(np.round(peak[3] * ratio))
                if moved_col != 0 or moved_row != 0:
                    col, row = col_a + moved_col, row_a + moved_row
                    if (
                        col < 0
                        or row < 0
                        or col + ratio * size_a > frame_a.shape[1]
                        or row + ratio * size_a > frame_a.shape[0]
                    ):
                        continue
                    if not _load(frame_a, col, row, ratio, words, a) or not _all_finite(a):
                        continue
                shift = (peak[2] + moved_col / ratio, peak[3] + moved_row / ratio)
            offset = (search + int(peak[0]), search + int(peak[1]))
            if not _refine(a, b, offset, shift, half_window, margin, scratch, found):
                continue
            middle = (ratio - 1) / 2.0
            result[i, 0] = at_a[i, 0] + moved_col + middle - 0.5 * found[0] * ratio
            result[i, 1] = at_a[i, 1] + moved_row + middle - 0.5 * found[1] * ratio
            result[i, 2] = col_b + peak[0] + 0.5 * found[0]
            result[i, 3] = row_b + peak[1] + 0.5 * found[1]
            result[i, 4] = found[2]
            result[i, 5] = found[3]
            result[i, 6] = peak[4] - peak[5]
            result[i, 7] = 1.0
    return result
