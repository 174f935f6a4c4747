"""Pixels as heads send them, 8 to 16 bit and packed, made into right-justified 16-bit words.

Which head sends which packing is in the rooms of the heads. NumPy is loaded with the first frame:
whoever only asks for a driver's settings does not wait for it.
"""

from __future__ import annotations

import ctypes
import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

BLOCK_GROUPS: Final = 1 << 15
"""Groups that are worked on at a time: source, target and what lies between stay in the cache."""


class Packing(enum.Enum):
    """How pixels lie in memory. Numbers of bits are significant bits of a pixel."""

    BYTES = "bytes"
    """8 bits a pixel."""
    WORDS = "words"
    """16 bits a pixel, little-endian, right-justified."""
    WORDS_BIG_ENDIAN = "words-big-endian"
    LSB_10 = "10p"
    """PFNC Mono10p: a stream of bits, the lowest first; 4 pixels in 5 bytes."""
    LSB_12 = "12p"
    """PFNC Mono12p: a stream of bits, the lowest first; 2 pixels in 3 bytes."""
    GVSP_10 = "10Packed"
    """GigE Vision Mono10Packed: 2 pixels in 3 bytes, the middle one has both's lowest 2 bits."""
    GVSP_12 = "12Packed"
    """GigE Vision Mono12Packed: 2 pixels in 3 bytes, the middle one has both's lowest 4 bits."""
    MIPI_10 = "10P"
    """MIPI RAW10: 4 bytes with the upper bits of 4 pixels, then one with their lowest 2 bits."""
    MIPI_12 = "12P"
    """MIPI RAW12: 2 bytes with the upper bits of 2 pixels, then one with their lowest 4 bits."""
    MIPI_14 = "14P"
    """MIPI RAW14: 4 bytes with the upper bits of 4 pixels, then 3 with their lowest 6 bits,
    each."""


@dataclass(frozen=True)
class _Group:
    """So many pixels in so many bytes; `spread` makes one number of the bytes, low byte first,
    into one number of the pixels, 16 bits each, the first one lowest."""

    pixels: int
    nbytes: int
    spread: Callable[[NDArray[Any]], NDArray[Any]]


def _lsb_10(x: NDArray[Any]) -> NDArray[Any]:
    pixels = x & 0x3FF
    pixels |= (x & 0xFFC00) << 6
    pixels |= (x & 0x3FF0_0000) << 12
    pixels |= (x & 0xFF_C000_0000) << 18
    return pixels


def _lsb_12(x: NDArray[Any]) -> NDArray[Any]:
    pixels = x & 0xFFF
    pixels |= (x & 0xFF_F000) << 4
    return pixels


def _gvsp_10(x: NDArray[Any]) -> NDArray[Any]:
    pixels = (x & 0xFF_00FF) << 2
    pixels |= (x >> 8) & 0x3
    pixels |= (x & 0x3000) << 4
    return pixels


def _gvsp_12(x: NDArray[Any]) -> NDArray[Any]:
    pixels = (x & 0xFF_F0FF) << 4
    pixels |= (x >> 8) & 0xF
    return pixels


def _mipi_10(x: NDArray[Any]) -> NDArray[Any]:
    pixels = (x & 0xFF) << 2
    pixels |= (x & 0xFF00) << 10
    pixels |= (x & 0xFF_0000) << 18
    pixels |= (x & 0xFF00_0000) << 26
    pixels |= (x >> 32) & 0x3
    pixels |= (x >> 18) & 0x3_0000
    pixels |= (x >> 4) & 0x3_0000_0000
    pixels |= (x << 10) & 0x3_0000_0000_0000
    return pixels


def _mipi_12(x: NDArray[Any]) -> NDArray[Any]:
    pixels = (x & 0xFF) << 4
    pixels |= (x & 0xFF00) << 12
    pixels |= (x >> 16) & 0xF
    pixels |= (x >> 4) & 0xF_0000
    return pixels


def _mipi_14(x: NDArray[Any]) -> NDArray[Any]:
    pixels = (x & 0xFF) << 6
    pixels |= (x & 0xFF00) << 14
    pixels |= (x & 0xFF_0000) << 22
    pixels |= (x & 0xFF00_0000) << 30
    pixels |= (x >> 32) & 0x3F
    pixels |= (x >> 22) & 0x3F_0000
    pixels |= (x >> 12) & 0x3F_0000_0000
    pixels |= (x >> 2) & 0x3F_0000_0000_0000
    return pixels


_GROUPS: Final = {
    Packing.LSB_10: _Group(4, 5, _lsb_10),
    Packing.LSB_12: _Group(2, 3, _lsb_12),
    Packing.GVSP_10: _Group(2, 3, _gvsp_10),
    Packing.GVSP_12: _Group(2, 3, _gvsp_12),
    Packing.MIPI_10: _Group(4, 5, _mipi_10),
    Packing.MIPI_12: _Group(2, 3, _mipi_12),
    Packing.MIPI_14: _Group(4, 7, _mipi_14),
}


def pixels_in_a_group(packing: Packing) -> int:
    """Pixels that a packing stores together; the width of a frame is a multiple of it.

    Args:
        packing: the packing.

    Returns:
        1, 2 or 4.
    """
    return _GROUPS[packing].pixels if packing in _GROUPS else 1


def packed_nbytes(packing: Packing, pixel_count: int) -> int:
    """Bytes of packed pixels.

    Args:
        packing: the packing.
        pixel_count: number of pixels.

    Returns:
        Number of bytes.

    Raises:
        ValueError: the pixels do not fill their last group.
    """
    if packing in _GROUPS:
        group = _GROUPS[packing]
        if pixel_count % group.pixels:
            raise ValueError(
                f"{pixel_count} pixels are not a multiple of {group.pixels}, as {packing.value} "
                "needs"
            )
        return pixel_count // group.pixels * group.nbytes
    return pixel_count if packing is Packing.BYTES else 2 * pixel_count


def unpack(packing: Packing, source: NDArray[np.uint8], target: NDArray[np.uint16]) -> None:
    """Write pixels as right-justified 16-bit words.

    Args:
        packing: how `source` is packed.
        source: shape (packed_nbytes(packing, target.size),), contiguous.
        target: shape (n,), contiguous. It may overlap `source` where it begins before it and ends
            no later.

    Raises:
        ValueError: the sizes do not fit each other.

    Source: PFNC 2.4, section 5; GigE Vision 2.0, table 26-1; MIPI CSI-2, section 11.4.
    """
    import numpy as np

    needed = packed_nbytes(packing, target.size)
    if source.size != needed:
        raise ValueError(
            f"{target.size} pixels of {packing.value} have {needed} bytes; there are {source.size}"
        )
    if packing is Packing.BYTES:
        np.copyto(target, source)
    elif packing in (Packing.WORDS, Packing.WORDS_BIG_ENDIAN):
        order = "<u2" if packing is Packing.WORDS else ">u2"
        np.copyto(target, source.view(order))
    else:
        _unpack_groups(_GROUPS[packing], source, target)


def _unpack_groups(group: _Group, source: NDArray[np.uint8], target: NDArray[np.uint16]) -> None:
    import numpy as np

    number = np.dtype("<u8" if group.nbytes > 4 else "<u4")
    spare = number.itemsize - group.nbytes
    groups = target.size // group.pixels
    spread = target.view(number)
    # A block of one's own: memory of a device may not be cached, and the last number reads on.
    block = np.zeros(min(BLOCK_GROUPS, groups) * group.nbytes + spare, np.uint8)
    for first in range(0, groups, BLOCK_GROUPS):
        count = min(BLOCK_GROUPS, groups - first)
        nbytes = count * group.nbytes
        block[:nbytes] = source[first * group.nbytes :][:nbytes]
        numbers = np.ndarray((count,), number, block, strides=(group.nbytes,))
        spread[first : first + count] = group.spread(numbers)


def bytes_at(address: int, count: int) -> NDArray[np.uint8]:
    """Bytes of memory as an array, without a copy.

    Args:
        address: of the first byte, in this process.
        count: number of bytes.

    Returns:
        Shape (count,); valid as long as the memory is.
    """
    import numpy as np

    memory: Any = (ctypes.c_uint8 * count).from_address(address)
    return np.frombuffer(memory, np.uint8)


def words_at(address: int, count: int) -> NDArray[np.uint16]:
    """16-bit words of memory as an array to write to, without a copy.

    Args:
        address: of the first word, such as that of a slot of `FrameMemory`.
        count: number of words.

    Returns:
        Shape (count,); valid as long as the memory is.
    """
    import numpy as np

    memory: Any = (ctypes.c_uint16 * count).from_address(address)
    return np.frombuffer(memory, np.uint16)
