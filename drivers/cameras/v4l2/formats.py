"""Pixel formats of V4L2 that are frames of a survey camera: their names, codes and packings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from drivers.cameras.pixels import Packing
from drivers.cameras.v4l2.uapi import fourcc


@dataclass(frozen=True)
class PixelFormat:
    """A format by the name of its macro in videodev2.h, V4L2_PIX_FMT_ taken off."""

    name: str
    code: int
    bits: int
    packing: Packing


_CODES: Final = (
    ("GREY", "GREY", 8, Packing.BYTES),
    ("Y10", "Y10", 10, Packing.WORDS),
    ("Y12", "Y12", 12, Packing.WORDS),
    ("Y14", "Y14", 14, Packing.WORDS),
    ("Y16", "Y16", 16, Packing.WORDS),
    ("Y16_BE", "Y16-BE", 16, Packing.WORDS_BIG_ENDIAN),
    ("Y10P", "Y10P", 10, Packing.MIPI_10),
    ("Y12P", "Y12P", 12, Packing.MIPI_12),
    ("Y14P", "Y14P", 14, Packing.MIPI_14),
    ("SBGGR8", "BA81", 8, Packing.BYTES),
    ("SGBRG8", "GBRG", 8, Packing.BYTES),
    ("SGRBG8", "GRBG", 8, Packing.BYTES),
    ("SRGGB8", "RGGB", 8, Packing.BYTES),
    ("SBGGR10", "BG10", 10, Packing.WORDS),
    ("SGBRG10", "GB10", 10, Packing.WORDS),
    ("SGRBG10", "BA10", 10, Packing.WORDS),
    ("SRGGB10", "RG10", 10, Packing.WORDS),
    ("SBGGR10P", "pBAA", 10, Packing.MIPI_10),
    ("SGBRG10P", "pGAA", 10, Packing.MIPI_10),
    ("SGRBG10P", "pgAA", 10, Packing.MIPI_10),
    ("SRGGB10P", "pRAA", 10, Packing.MIPI_10),
    ("SBGGR12", "BG12", 12, Packing.WORDS),
    ("SGBRG12", "GB12", 12, Packing.WORDS),
    ("SGRBG12", "BA12", 12, Packing.WORDS),
    ("SRGGB12", "RG12", 12, Packing.WORDS),
    ("SBGGR12P", "pBCC", 12, Packing.MIPI_12),
    ("SGBRG12P", "pGCC", 12, Packing.MIPI_12),
    ("SGRBG12P", "pgCC", 12, Packing.MIPI_12),
    ("SRGGB12P", "pRCC", 12, Packing.MIPI_12),
    ("SBGGR14", "BG14", 14, Packing.WORDS),
    ("SGBRG14", "GB14", 14, Packing.WORDS),
    ("SGRBG14", "GR14", 14, Packing.WORDS),
    ("SRGGB14", "RG14", 14, Packing.WORDS),
    ("SBGGR14P", "pBEE", 14, Packing.MIPI_14),
    ("SGBRG14P", "pGEE", 14, Packing.MIPI_14),
    ("SGRBG14P", "pgEE", 14, Packing.MIPI_14),
    ("SRGGB14P", "pREE", 14, Packing.MIPI_14),
    ("SBGGR16", "BYR2", 16, Packing.WORDS),
    ("SGBRG16", "GB16", 16, Packing.WORDS),
    ("SGRBG16", "GR16", 16, Packing.WORDS),
    ("SRGGB16", "RG16", 16, Packing.WORDS),
)

FORMATS: Final = {
    name: PixelFormat(name, fourcc(code), bits, packing) for name, code, bits, packing in _CODES
}


def format_of_code(code: int) -> PixelFormat | None:
    """A supported format by its code.

    Args:
        code: V4L2 pixel format, four characters as a number.

    Returns:
        The format; None if it is not supported.
    """
    return next((found for found in FORMATS.values() if found.code == code), None)
