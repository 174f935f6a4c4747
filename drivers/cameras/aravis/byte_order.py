"""Whether the pixels of a frame were read in the wrong byte order, by their values.

Heads that send 16-bit words with the most significant byte first do not all state it.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

ROWS: Final = 32
COLUMNS: Final = 256
"""Pixels that are looked at: so many of so many rows, a fraction of a millisecond."""
OUTSIDE_MIN: Final = 0.5
"""Fraction of pixels above the format's highest value from which the order is wrong."""
ROUGHNESS_RATIO: Final = 4.0
"""The wrong order of a picture is rougher than the right one by a factor of 20 and more."""
PIXELS_MIN: Final = 64


def is_swapped(image: NDArray[np.uint16], bits: int) -> bool:
    """Whether swapping the bytes of an image makes a picture of it.

    Below 16 bits the wrong order shows in values that the format does not have. With 16 bits,
    neighbouring pixels differ more in the wrong order than in the right one, since the lower byte
    is the rougher one. An image whose lower or upper byte is the same everywhere decides nothing.

    Args:
        image: pixels as they were read, shape (rows, columns).
        bits: significant bits of the format.

    Returns:
        True if the order is wrong; False if it is right, or cannot be found out.

    Source: PFNC 2.4, section 5: words are little-endian; AravisProject/aravis#921.

    Example:
        >>> import numpy as np
        >>> ramp = np.add.outer(np.arange(40), np.arange(64)).astype(np.uint16) * 37
        >>> is_swapped(ramp, 16), is_swapped(ramp.byteswap(), 16)
        (False, True)
    """
    import numpy as np

    step = max(1, image.shape[0] // ROWS)
    sample = np.ascontiguousarray(image[::step, :COLUMNS])
    if sample.size < PIXELS_MIN:
        return False
    swapped = sample.byteswap()
    if bits < 16:
        highest = (1 << bits) - 1
        outside = float(np.mean(sample > highest))
        return outside > OUTSIDE_MIN and float(np.mean(swapped > highest)) < outside
    if np.ptp(sample & 0xFF) == 0 or np.ptp(sample >> 8) == 0:
        return False
    return _roughness(sample) > ROUGHNESS_RATIO * _roughness(swapped)


def bits_of(pixel_format: str) -> int:
    """Significant bits of a pixel format.

    Args:
        pixel_format: GenICam name.

    Returns:
        Number of bits; 16 if the name does not state it.

    Example:
        >>> bits_of("BayerRG12Packed")
        12
    """
    found = re.match(r"[A-Za-z]+(\d+)", pixel_format)
    return int(found[1]) if found else 16


def _roughness(sample: NDArray[Any]) -> float:
    """Mean difference of horizontal neighbours."""
    import numpy as np

    return float(np.mean(np.abs(np.diff(sample.astype(np.int32), axis=1))))
