"""The quick look: a small picture of the virtual image for the operator's eye.

Arrays only; how it is compressed and sent is the daemon's. Holes are shown as holes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

QUICKLOOK_WIDTH_PX: Final = 1200
_RGB: Final = ("red", "green", "blue")
_HOLE: Final = (70, 20, 20)
_ROWS_OF_BLOCK: Final = 4
"""At least so many rows of a block are averaged: 48 of 144 pixels, and the eye sees no noise."""
_EVERY: Final = 3
"""Stretch and white are chosen from every third pixel of every third row."""
_GAMMA: Final = 0.55
_LOW_PERCENT: Final = 0.5
_HIGH_PERCENT: Final = 99.5


def quicklook(pan: Array, colour: Mapping[str, Array]) -> Array:
    """A picture of about 1200 pixels' width.

    PAN gives the detail, red, green and blue the hue where all three are there; the stretch is
    chosen from this image alone, so brightness is not comparable between exposures.

    Args:
        pan: (H, W) uint16, 0 is no data.
        colour: bands by name, (h, w) uint16, 0 is no data, on a raster that covers the same image.

    Returns:
        Red, green, blue, (h, w, 3) uint8; pixels without PAN data are dark red.
    """
    factor = max(round(pan.shape[1] / QUICKLOOK_WIDTH_PX), 1)
    shape = (max(pan.shape[0] // factor, 1), max(pan.shape[1] // factor, 1))
    grey = np.zeros(shape, np.float32)
    _block_means(pan, factor, max(factor // _ROWS_OF_BLOCK, 1), grey)
    picture = np.zeros((*shape, 3), np.uint8)
    sample = grey[::_EVERY, ::_EVERY]
    sample = sample[sample > 0.0]
    if not len(sample):
        picture[:] = _HOLE
        return picture
    low, high = np.percentile(sample, (_LOW_PERCENT, _HIGH_PERCENT))
    bands = [colour[name] for name in _RGB if name in colour]
    coloured = len(bands) == 3
    if not coloured:
        bands = [np.zeros((1, 1), np.uint16)] * 3
    rows, columns = _nearest(bands[0].shape, shape)
    _paint(
        grey,
        np.float32(low),
        np.float32(max(high - low, 1.0)),
        bands[0],
        bands[1],
        bands[2],
        rows,
        columns,
        _whites(bands, rows, columns, grey),
        coloured,
        _LIGHT,
        _TINT,
        picture,
    )
    return picture


def _nearest(band: tuple[int, ...], shape: tuple[int, int]) -> tuple[Array, Array]:
    """Row and column of a band for each of the quick look's, nearest pixel: hue needs no more."""
    rows = np.minimum((np.arange(shape[0]) + 0.5) * band[0] / shape[0], band[0] - 1)
    columns = np.minimum((np.arange(shape[1]) + 0.5) * band[1] / shape[1], band[1] - 1)
    return rows.astype(np.intp), columns.astype(np.intp)


def _whites(bands: list[Array], rows: Array, columns: Array, grey: Array) -> Array:
    """What each band shows of something white: what is bright. Roofs and roads are greyer than
    the mean of a forest."""
    at = np.ix_(rows[::_EVERY], columns[::_EVERY])
    samples = [band[at] for band in bands]
    lit = np.logical_and.reduce([sample > 0 for sample in samples])
    lit &= grey[::_EVERY, ::_EVERY] > 0.0
    if not lit.any():
        return np.ones(3, np.float32)
    whites = [max(float(np.percentile(sample[lit], _HIGH_PERCENT)), 1.0) for sample in samples]
    return np.array(whites, np.float32)


_LIGHT: Final = (255.0 * np.linspace(0.0, 1.0, 4097) ** _GAMMA).astype(np.float32)
"""Brightness by share of the stretch, at 1 / 4096."""
_TINT: Final = (np.linspace(0.0, 2.0, 1025) ** 0.8).astype(np.float32)
"""What a band's share of the mean makes of its brightness, at 1 / 512."""


@compiled_kernel(parallel=True)
def _paint(
    grey, low, span, red, green, blue, rows, columns, whites, coloured, light, tint, picture
):
    """Each band in its own stretch, brightened so that together they have PAN's brightness."""
    zero = np.float32(0.0)
    for i in prange(grey.shape[0]):
        for j in range(grey.shape[1]):
            if grey[i, j] <= zero:
                for k in range(3):
                    picture[i, j, k] = _HOLE[k]
                continue
            unit = min(max((grey[i, j] - low) / span, zero), np.float32(1.0))
            bright = light[np.int64(unit * np.float32(4096.0))]
            r = np.float32(red[rows[i], columns[j]]) / whites[0]
            g = np.float32(green[rows[i], columns[j]]) / whites[1]
            b = np.float32(blue[rows[i], columns[j]]) / whites[2]
            if not coloured or min(min(r, g), b) <= zero:
                for k in range(3):
                    picture[i, j, k] = np.uint8(bright)
                continue
            mean = (r + g + b) / np.float32(3.0)
            picture[i, j, 0] = _tinted(bright, r / mean, tint)
            picture[i, j, 1] = _tinted(bright, g / mean, tint)
            picture[i, j, 2] = _tinted(bright, b / mean, tint)


@compiled_kernel()
def _tinted(bright, share, tint):
    within = min(max(share, np.float32(0.25)), np.float32(2.0))
    return np.uint8(min(bright * tint[np.int64(within * np.float32(512.0))], np.float32(255.0)))


@compiled_kernel(parallel=True)
def _block_means(image, factor, step, out):
    """Means of the pixels that hold data in every `step`-th row of factor x factor blocks; 0 where
    none does."""
    rows, columns = out.shape
    for i in prange(rows):
        totals = np.zeros(columns * factor, np.int32)
        counts = np.zeros(columns * factor, np.int32)
        for y in range(i * factor, (i + 1) * factor, step):
            line = image[y, : columns * factor]
            for x in range(columns * factor):
                value = np.int32(line[x])
                totals[x] += value
                counts[x] += np.int32(value != 0)
        for j in range(columns):
            total = np.int64(0)
            count = np.int64(0)
            for x in range(j * factor, (j + 1) * factor):
                total += totals[x]
                count += counts[x]
            out[i, j] = total / count if count > 0 else 0.0
