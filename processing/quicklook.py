"""The quick look: a small picture of the virtual image for the operator's eye.

Arrays only; how it is compressed and sent is the daemon's. Holes are shown as holes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array = NDArray[Any]

QUICKLOOK_WIDTH_PX: Final = 1200
_RGB: Final = ("red", "green", "blue")
_HOLE: Final = (70, 20, 20)
_GAMMA: Final = 0.55
_LOW_PERCENT: Final = 0.5
_HIGH_PERCENT: Final = 99.5


def quicklook(pan: Array, colour: Mapping[str, Array]) -> Array:
    """A picture of about 1200 pixels' width, (h, w, 3) uint8.

    PAN gives the detail, red, green and blue the hue where all three are there; the stretch is
    chosen from this image alone, so brightness is not comparable between exposures. Pixels without
    PAN data are dark red.

    Args:
        pan: (H, W) uint16, 0 is no data.
        colour: bands by name, (h, w) uint16, 0 is no data, on a raster that covers the same image.
    """
    factor = max(round(pan.shape[1] / QUICKLOOK_WIDTH_PX), 1)
    shape = (max(pan.shape[0] // factor, 1), max(pan.shape[1] // factor, 1))
    grey = np.zeros(shape, np.float32)
    _block_means(pan, factor, grey)
    seen = grey > 0.0
    picture = np.zeros((*shape, 3), np.uint8)
    if seen.any():
        bands = [_fitted(colour[name], shape) for name in _RGB if name in colour]
        if len(bands) == 3:
            _hue(picture, grey, seen, bands)
        else:
            picture[:] = _stretched(grey, seen)[:, :, None]
    picture[~seen] = _HOLE
    return picture


def _hue(picture: Array, grey: Array, seen: Array, bands: list[Array]) -> None:
    """Each band in its own stretch, brightened so that together they have PAN's brightness."""
    lit = seen & np.logical_and.reduce([band > 0.0 for band in bands])
    light = _stretched(grey, seen).astype(np.float32)
    if not lit.any():
        picture[:] = light[:, :, None]
        return
    # White is what is bright: roofs and roads are greyer than the mean of a forest.
    balanced = [
        band / max(float(np.percentile(band[lit][::7], _HIGH_PERCENT)), 1.0) for band in bands
    ]
    mean = (balanced[0] + balanced[1] + balanced[2]) / 3.0
    for k in range(3):
        ratio = np.ones_like(grey)
        np.divide(balanced[k], mean, out=ratio, where=lit)
        picture[:, :, k] = np.clip(light * np.clip(ratio, 0.25, 2.0) ** 0.8, 0.0, 255.0)


def _stretched(grey: Array, seen: Array) -> Array:
    sample = grey[seen][::7]
    low, high = np.percentile(sample, (_LOW_PERCENT, _HIGH_PERCENT))
    unit = np.clip((grey - np.float32(low)) / np.float32(max(high - low, 1.0)), 0.0, 1.0)
    picture: Array = (255.0 * unit ** np.float32(_GAMMA)).astype(np.uint8)
    return picture


def _fitted(band: Array, shape: tuple[int, int]) -> Array:
    """A band on the quick look's raster, nearest pixel: hue needs no more."""
    rows = np.minimum((np.arange(shape[0]) + 0.5) * band.shape[0] / shape[0], band.shape[0] - 1)
    columns = np.minimum((np.arange(shape[1]) + 0.5) * band.shape[1] / shape[1], band.shape[1] - 1)
    fitted: Array = band[np.ix_(rows.astype(np.intp), columns.astype(np.intp))].astype(np.float32)
    return fitted


@njit(cache=True, parallel=True, nogil=True)
def _block_means(image, factor, out):  # type: ignore[no-untyped-def]
    """Means of factor x factor pixels that hold data; 0 where none does."""
    rows, columns = out.shape
    for i in prange(rows):
        for j in range(columns):
            total = 0
            count = 0
            for y in range(i * factor, (i + 1) * factor):
                for x in range(j * factor, (j + 1) * factor):
                    word = image[y, x]
                    total += word
                    count += word != 0
            out[i, j] = total / count if count > 0 else 0.0
