"""Pixels of the sensor as the head puts them on the wire (PFNC 2.4; GigE Vision 2.0, section 26).

The sensor counts to 12 bits. Formats of fewer bits drop the lowest, formats of more bits send the
values as they are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SENSOR_BITS = 12

BITS = {
    "Mono8": 8,
    "Mono10": 10,
    "Mono10p": 10,
    "Mono10Packed": 10,
    "Mono12": 12,
    "Mono12p": 12,
    "Mono12Packed": 12,
    "Mono14": 14,
    "Mono16": 16,
}
"""Significant bits of a pixel."""


def wire_pixels(
    image: NDArray[np.uint16], pixel_format: str
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """The bytes or words of a frame, contiguous; `image` has shape (height, width)."""
    bits = BITS[pixel_format]
    if pixel_format in ("Mono12", "Mono14", "Mono16"):
        # As they are and where they are: a full frame is not copied to be sent.
        return np.ascontiguousarray(image, dtype="<u2")
    values: NDArray[np.uint16] = np.minimum(image >> max(0, SENSOR_BITS - bits), (1 << bits) - 1)
    if bits == 8:
        return values.astype(np.uint8)
    if pixel_format.endswith("Packed"):
        return _two_in_three_bytes(values, bits)
    if pixel_format.endswith("p"):
        return _bit_stream(values, bits)
    return np.ascontiguousarray(values, dtype="<u2")


def _two_in_three_bytes(values: NDArray[np.uint16], bits: int) -> NDArray[np.uint8]:
    """GigE Vision's own: the upper eight bits of each of two pixels, between them what is left."""
    low = bits - 8
    pairs = values.reshape(-1, 2)
    left = pairs & ((1 << low) - 1)
    three = np.stack([pairs[:, 0] >> low, left[:, 0] | left[:, 1] << 4, pairs[:, 1] >> low], axis=1)
    return np.ascontiguousarray(three, dtype=np.uint8).reshape(-1)


def _bit_stream(values: NDArray[np.uint16], bits: int) -> NDArray[np.uint8]:
    """PFNC's "p" formats: every pixel's bits, the lowest first, without a gap."""
    as_bytes = np.ascontiguousarray(values, dtype="<u2").view(np.uint8).reshape(-1, 2)
    of_pixel = np.unpackbits(as_bytes, axis=1, bitorder="little")[:, :bits]
    return np.packbits(of_pixel.reshape(-1), bitorder="little")
