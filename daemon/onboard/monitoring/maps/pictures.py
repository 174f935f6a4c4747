"""Tiles as pictures: JPEG where every pixel is known, PNG with transparency elsewhere."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.onboard.monitoring.maps.tiles import Tile

JPEG_QUALITY: Final = 80
PNG_COMPRESSION: Final = 6


def encode(
    pixels: NDArray[np.uint8], alpha: NDArray[np.uint8] | None = None, *, lossless: bool = False
) -> Tile:
    """A tile from pixels.

    Args:
        pixels: shape (h, w, 1), (h, w, 3) in the order red, green, blue, or (h, w).
        alpha: shape (h, w), 0 is transparent; None: all is known.
        lossless: PNG also where all is known.

    Returns:
        The tile.
    """
    import cv2

    image: NDArray[Any] = pixels[..., 0] if pixels.ndim == 3 and pixels.shape[2] == 1 else pixels
    if image.ndim == 3:
        image = image[..., ::-1]
    is_opaque = alpha is None or bool(alpha.all())
    if is_opaque and not lossless:
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return Tile(data.tobytes(), "image/jpeg")
    if not is_opaque and alpha is not None:
        colour = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        image = np.dstack([colour, alpha])
    parameters = [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]
    _, data = cv2.imencode(".png", np.ascontiguousarray(image), parameters)
    return Tile(data.tobytes(), "image/png")
