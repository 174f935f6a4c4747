"""Three full colours of a Bayer head: green for matching and all bands for the image.

All kernels are linear and symmetric about the pixel they serve, so no colour is shifted against the
raw pixels, by any part of a pixel: the demosaic shift is zero by construction, for each of the four
arrangements. Red and blue therefore share green's geometry but for what the lens does to colours.

Frames are Level-1 words as in `processing.radiometry.level1`: 0 no data, lowest bit saturation.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.radiometry.level1 import LEVEL1_CEILING, LEVEL1_FLOOR
from processing.rig import Sensor

Array = NDArray[Any]

BAYER_BANDS: Final = ("red", "green", "blue")
_LETTERS: Final = {"R": 0, "G": 1, "B": 2}


def is_bayer(sensor: Sensor) -> bool:
    """Whether a sensor's pixels lie behind a colour filter array.

    Args:
        sensor: `colour_filter_array` is used.

    Returns:
        False for "none".
    """
    return sensor.colour_filter_array != "none"


def demosaic(level1: Array, colour_filter_array: str, *, out: Array) -> None:
    """Fill the red, green and blue frames of a Bayer head.

    Green is kept where it was measured; in between it is 3/2 F - 1/2 F^3 of its neighbours, F being
    the mean of the four next pixels: the Deslauriers-Dubuc half-band filter of four taps carried to
    the quincunx lattice by McClellan's transformation, flat to the third order at zero frequency.
    Red and blue are green plus the bilinear interpolation of their difference to green.

    A pixel without data stays without; taps without data fall away together with their mirror
    image, so that what is left is symmetric still; along the frame's border some colours have no
    pair and no data. A value that saturated neighbours took part in
    is marked as saturated.

    Args:
        level1: the head's frame, (h, w) uint16.
        colour_filter_array: four letters, the filters of pixels (column, row) (0, 0), (1, 0),
            (0, 1), (1, 1).
        out: (3, h, w) uint16, overwritten: red, green, blue.

    Raises:
        ValueError: no colour filter array, or arrays that do not fit each other.

    Example:
        A grey surface stays grey: words of 1000 in every colour.

        >>> out = np.zeros((3, 6, 6), np.uint16)
        >>> demosaic(np.full((6, 6), 1000, np.uint16), "RGGB", out=out)
        >>> out[:, 2, 3]
        array([1000, 1000, 1000], dtype=uint16)
    """
    if sorted(colour_filter_array) != ["B", "G", "G", "R"]:
        raise ValueError(f"colour filter array {colour_filter_array!r} is no R, B and two greens")
    if out.shape != (3, *level1.shape) or out.dtype != np.uint16 or level1.dtype != np.uint16:
        raise ValueError(
            f"level1 is {level1.shape} {level1.dtype}, out {out.shape} {out.dtype}; "
            f"out is {(3, *level1.shape)} uint16"
        )
    letters = np.array([_LETTERS[letter] for letter in colour_filter_array], np.int64)
    _green(level1, letters.reshape(2, 2), _GREEN_TAPS, out[1])
    _red_and_blue(level1, letters.reshape(2, 2), out)


def _green_taps() -> Array:
    """Half of the taps of 3/2 F - 1/2 F^3, (n, 3): column, row, weight; the rest are their mirror
    images. F is the mean of the four next pixels."""
    f = np.zeros((7, 7))
    f[3, [2, 4]] = f[[2, 4], 3] = 0.25
    cube = np.zeros((7, 7))
    steps = [(0, 1), (0, -1), (1, 0), (-1, 0)]
    for a in steps:
        for b in steps:
            for c in steps:
                cube[3 + a[0] + b[0] + c[0], 3 + a[1] + b[1] + c[1]] += 1.0 / 64.0
    kernel = 1.5 * f - 0.5 * cube
    rows, columns = np.nonzero(kernel)
    taps = np.stack([columns - 3.0, rows - 3.0, kernel[rows, columns]], axis=1)
    return np.ascontiguousarray(taps[(taps[:, 1] > 0) | ((taps[:, 1] == 0) & (taps[:, 0] > 0))])


_GREEN_TAPS: Final = _green_taps()


@compiled_kernel()
def _saturating_value(value, saturated, floor, ceiling):
    half = int(0.5 * value + 0.5)
    half = min(max(half, floor // 2), ceiling // 2)
    return np.uint16(2 * half + saturated)


@compiled_kernel(parallel=True)
def _green(level1, letters, taps, out):
    height, width = level1.shape
    for row in prange(height):
        for col in range(width):
            pixel_value = level1[row, col]
            if pixel_value == 0 or letters[row % 2, col % 2] == 1:
                out[row, col] = pixel_value
                continue
            total = 0.0
            weight = 0.0
            saturated = 0
            for k in range(taps.shape[0]):
                c = int(taps[k, 0])
                r = int(taps[k, 1])
                # A tap and its mirror image count together or not at all: no shift at borders.
                if row - r < 0 or row + r >= height or row + r < 0 or row - r >= height:
                    continue
                if col - c < 0 or col + c >= width or col + c < 0 or col - c >= width:
                    continue
                one, other = level1[row + r, col + c], level1[row - r, col - c]
                if one == 0 or other == 0:
                    continue
                share = taps[k, 2]
                total += share * (float(one & 0xFFFE) + float(other & 0xFFFE))
                weight += 2.0 * share
                saturated |= (one | other) & 1
            if weight <= 0.2:
                # A corner of the frame: no pair of neighbours is there.
                out[row, col] = 0
                continue
            out[row, col] = _saturating_value(
                total / weight, saturated, LEVEL1_FLOOR, LEVEL1_CEILING
            )


@compiled_kernel(parallel=True)
def _red_and_blue(level1, letters, out):
    height, width = level1.shape
    green = out[1]
    for row in prange(height):
        for col in range(width):
            middle = green[row, col]
            for colour in (0, 2):
                if level1[row, col] == 0 or middle == 0:
                    out[colour, row, col] = 0
                    continue
                if letters[row % 2, col % 2] == colour:
                    out[colour, row, col] = level1[row, col]
                    continue
                total = 0.0
                count = 0
                saturated = middle & 1
                # Pixels of this colour are left and right, above and below, or at the four corners.
                for r in range(-1, 2):
                    for c in range(-1, 2):
                        y, x = row + r, col + c
                        if letters[y % 2, x % 2] != colour:
                            continue
                        if row - abs(r) < 0 or row + abs(r) >= height:
                            continue
                        if col - abs(c) < 0 or col + abs(c) >= width:
                            continue
                        pixel_value = level1[y, x]
                        mirror = level1[row - r, col - c]
                        if pixel_value == 0 or mirror == 0 or green[y, x] == 0:
                            continue
                        total += float(pixel_value & 0xFFFE) - float(green[y, x] & 0xFFFE)
                        count += 1
                        saturated |= pixel_value & 1
                if count == 0:
                    out[colour, row, col] = 0
                    continue
                value = float(middle & 0xFFFE) + total / count
                out[colour, row, col] = _saturating_value(
                    value, saturated, LEVEL1_FLOOR, LEVEL1_CEILING
                )
