"""Pixels of the images of an orthomosaic, whole or a window: PAN, and pansharpened colour.

For ground pixels larger than those of an image they are means of blocks of its pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.store.level0 import read_description, read_tiff_rows
from daemon.postflight.orthomosaic.inputs import OrthoBlock, OrthoImage
from daemon.postflight.orthomosaic.photographs import photograph_pixels
from processing.image.orthoimage.ground_resampling import reduced_image
from processing.image.pansharpening import pansharpened

Array = NDArray[Any]

MARGIN_PX: Final = 10
"""Colour pixels around a window that pansharpening sees."""


def reduction_of(block: OrthoBlock, image: OrthoImage, gsd_m: float) -> int:
    """Pixels of an image along a ground pixel, rounded; at least one.

    Args:
        block: of the image.
        image: whose pixels.
        gsd_m: size of the ground pixels.
    """
    ground = block.ground.surface
    level = ground if isinstance(ground, float) else float(np.nanmean(ground.height_m))
    pixel_m = (image.height_m - level) * image.pose.pixel_mm / image.pose.f_mm
    return max(round(gsd_m / pixel_m), 1)


def reduced_pixels(
    block: OrthoBlock,
    image: OrthoImage,
    bands: Sequence[str],
    factor: int,
    window: tuple[int, int, int, int] | None = None,
) -> Array:
    """Means of blocks of pixels of an image, those of `image.pose.reduced(factor)`.

    Args:
        block: of the image.
        image: whose pixels.
        bands: "pan" first, then colour bands.
        factor: pixels to a block along each axis.
        window: first column and row, columns, rows, of the blocks; None: all.

    Returns:
        (bands, rows, columns) float32, with a factor of 1 uint16; 0 is no data.

    Raises:
        RasterError: a raster that cannot be read.
    """
    if window is not None:
        first_column, first_row, width, height = (factor * n for n in window)
        window = first_column, first_row, width, height
    pixels = image_pixels(block, image, bands, window)
    return pixels if factor == 1 else reduced_image(pixels, factor)


def image_pixels(
    block: OrthoBlock,
    image: OrthoImage,
    bands: Sequence[str],
    window: tuple[int, int, int, int] | None = None,
) -> Array:
    """Bands of an image, colour bands pansharpened.

    Args:
        block: of the image.
        image: whose pixels.
        bands: "pan" first, then colour bands.
        window: first column and row, columns, rows; None: the whole image.

    Returns:
        (bands, rows, columns) uint16, 0 is no data.

    Raises:
        RasterError: a raster that cannot be read.
    """
    size = block.image
    c, r, width, height = window or (0, 0, image.pose.width_px, image.pose.height_px)
    if image.head is not None:
        return photograph_pixels(
            block.mission, image.exposure, image.head, tuple(bands), (c, r, width, height)
        )
    folder = block.mission.level2(image.exposure)

    def pan_rows(first: int, count: int) -> Array:
        return read_tiff_rows(
            folder / "pan.tif", first, count, width_px=size.width_px, height_px=size.height_px
        )

    if len(bands) == 1:
        return np.ascontiguousarray(pan_rows(r, height)[:, c : c + width])[None]
    ratio = size.colour_ratio
    # Windows begin and end where a colour pixel begins on a whole PAN pixel.
    unit = next(n for n in range(1, 13) if abs(n * ratio - round(n * ratio)) < 1e-6)
    pixels = round(unit * ratio)
    colour_width, colour_height = (
        math.floor(n / ratio + 1e-9) for n in (size.width_px, size.height_px)
    )

    def aligned(first: int, count: int, end: int) -> tuple[int, int]:
        low = max((first // pixels) - -(-MARGIN_PX // unit), 0)
        high = -(-(first + count) // pixels) + -(-MARGIN_PX // unit)
        return low * pixels, min(high * pixels, end)

    c0, c1 = aligned(c, width, size.width_px)
    r0, r1 = aligned(r, height, size.height_px)
    rows = slice(round(r0 / ratio), min(math.floor(r1 / ratio + 1e-9), colour_height))
    columns = slice(round(c0 / ratio), min(math.floor(c1 / ratio + 1e-9), colour_width))
    path = folder / "rgbn.tif"
    names = list(read_description(path)["bands"])
    planes = read_tiff_rows(
        path, rows.start, rows.stop - rows.start,
        width_px=colour_width, height_px=colour_height, planes=[names.index(b) for b in bands[1:]],
    )  # fmt: skip
    colour = {
        band: np.ascontiguousarray(plane[:, columns])
        for band, plane in zip(bands[1:], planes, strict=True)
    }
    pan = np.ascontiguousarray(pan_rows(r0, r1 - r0)[:, c0:c1])
    sharp = pansharpened(pan, colour, ratio)
    part = np.s_[r - r0 : r - r0 + height, c - c0 : c - c0 + width]
    return np.stack([plane[part] for plane in (pan, *(sharp[band] for band in bands[1:]))])
