"""Pansharpening: the detail of the PAN image in the colours of the colour raster.

Each band becomes PAN times a smooth ratio, found so that the mean over the PAN pixels below a
colour pixel is that colour pixel: geometry is PAN's, radiometry at colour resolution is kept.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

ROUNDS: Final = 3
"""Corrections of the ratio before the last one, which is exact block by block. The bilinear ratio
loses up to 1 - (5/9)^2 of the finest colour at 1:3; three rounds bring most of it back."""

STRIP_ROWS: Final = 128
"""Colour rows sharpened at once, so that memory does not grow with the image."""

_CEILING: Final = 65535.0


def pansharpened(pan: Array, colour: Mapping[str, Array], ratio: float) -> dict[str, Array]:
    """Bands at the resolution of PAN.

    Args:
        pan: (H, W) uint16, linear signal above black, 0 is no data.
        colour: bands by name, (H // ratio, W // ratio) uint16, likewise. Colour pixel (c, r) covers
            the PAN pixels ratio c .. ratio c + ratio - 1 and the rows alike.
        ratio: PAN pixels to the colour pixel along each axis. Where it is not whole (4.8), a PAN
            pixel on the border of two colour pixels counts for both by its shares.

    Returns:
        Bands by name, (H, W) uint16 in the units of `colour`. 0 where PAN or colour has no data, at
        least 1 elsewhere. PAN pixels beyond the last whole colour pixel take the ratio of the
        nearest.

    Raises:
        ValueError: shapes or types that do not belong together.
    """
    if ratio < 1 or pan.dtype != np.uint16 or pan.ndim != 2:
        raise ValueError(f"PAN is {pan.dtype} of shape {pan.shape}, ratio {ratio}; (H, W) uint16")
    height, width = (math.floor(size / ratio + 1e-9) for size in pan.shape)
    for name, band in colour.items():
        if band.shape != (height, width) or band.dtype != np.uint16 or not band.size:
            raise ValueError(
                f"{name} is {band.dtype} of shape {band.shape}; PAN of shape {pan.shape} at 1:"
                f"{ratio} has colour of {(height, width)} uint16"
            )
    result = {name: np.zeros(pan.shape, np.uint16) for name in colour}
    # Strips begin where a colour pixel begins on a whole PAN row.
    step = _common_step(ratio)
    margin = -(-(ROUNDS + 2) // step) * step
    height_of = max(STRIP_ROWS // step, 1) * step
    for first in range(0, height, height_of):
        last = min(first + height_of, height)
        top, bottom = max(first - margin, 0), min(last + margin, height)
        # The rows below the last whole colour pixel belong to the last strip.
        end = pan.shape[0] if last == height else round(last * ratio)
        begin, above = round(first * ratio), round(top * ratio)
        strip = pan[above : max(round(bottom * ratio), end)].astype(np.float32)
        covered = strip[: round((bottom - top) * ratio), : round(width * ratio)]
        for name, band in colour.items():
            target_band = band[top:bottom].astype(np.float32)
            sharp = _sharpened(strip, covered, target_band)
            result[name][begin:end] = sharp[begin - above : end - above]
    return result


def _common_step(ratio: float) -> int:
    """Colour pixels after which colour and PAN pixels end together; ValueError beyond twelve."""
    for step in range(1, 13):
        if abs(step * ratio - round(step * ratio)) < 1e-6:
            return step
    raise ValueError(f"ratio {ratio}; twelve colour pixels at most cover whole PAN pixels")


def _sharpened(strip: Array, covered: Array, target_band: Array) -> Array:
    """One band of one strip, (rows, W) uint16; `whole` is the part of `strip` under colour."""
    has_signal = (covered > 0.0).astype(np.float32)
    share = _block_means(has_signal, target_band.shape)
    target = target_band * share
    usable = (target > 0.0).astype(np.float32)
    quotient = np.zeros_like(target)
    np.divide(target, _block_means(covered, target_band.shape), out=quotient, where=usable > 0.0)
    for _ in range(ROUNDS):
        found = _block_means(covered * _spread(quotient, usable, covered.shape), target_band.shape)
        np.multiply(quotient, target / np.maximum(found, 1e-6), out=quotient, where=usable > 0.0)
    smooth = _spread(quotient, usable, covered.shape)
    found = _block_means(covered * smooth, target_band.shape)
    exact = np.zeros_like(target)
    np.divide(target, found, out=exact, where=usable > 0.0)
    blocks = smooth * _repeated(exact, covered.shape)
    field = cv2.copyMakeBorder(
        blocks,
        0,
        strip.shape[0] - covered.shape[0],
        0,
        strip.shape[1] - covered.shape[1],
        cv2.BORDER_REPLICATE,
    )
    signal = strip * field
    values: Array = np.clip(np.rint(signal), 1.0, _CEILING).astype(np.uint16)
    values[signal <= 0.0] = 0
    return values


def _spread(quotient: Array, usable: Array, shape: tuple[int, ...]) -> Array:
    """The ratio at PAN resolution, bilinear between colour pixels; holes do not darken theirs."""
    size = (shape[1], shape[0])
    field = cv2.resize(quotient * usable, size, interpolation=cv2.INTER_LINEAR)
    if usable.all():
        return np.asarray(field)
    weight = cv2.resize(usable, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(field / np.maximum(weight, 1e-6))


def _block_means(image: Array, shape: tuple[int, ...]) -> Array:
    if image.shape == shape:
        return np.array(image)
    # OpenCV's area interpolation is the mean of the block, border pixels by their shares.
    return np.asarray(cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA))


def _repeated(image: Array, shape: tuple[int, ...]) -> Array:
    return np.asarray(cv2.resize(image, shape[::-1], interpolation=cv2.INTER_NEAREST))
