"""GenICam names of pixel formats, and how their pixels are packed.

Source: PFNC 2.4; GigE Vision 2.0, table 26-1 for the formats that end in Packed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from drivers.cameras.pixels import Packing, pixels_in_a_group

_NAME: Final = re.compile(r"(?:Mono|Bayer(?P<pattern>RG|GR|GB|BG))(?P<suffix>(?P<bits>\d+)\w*)")
_PACKINGS: Final = {
    "8": Packing.BYTES,
    "10": Packing.WORDS,
    "10p": Packing.LSB_10,
    "10Packed": Packing.GVSP_10,
    "12": Packing.WORDS,
    "12p": Packing.LSB_12,
    "12Packed": Packing.GVSP_12,
    "14": Packing.WORDS,
    "16": Packing.WORDS,
}


def packing_of(pixel_format: str) -> Packing | None:
    """The packing of a pixel format.

    Args:
        pixel_format: GenICam name.

    Returns:
        The packing; None for an unsupported format.

    Source: PFNC 2.4, section 5; GigE Vision 2.0, table 26-1.

    Example:
        >>> packing_of("BayerRG12p")
        <Packing.LSB_12: '12p'>
    """
    found = _NAME.fullmatch(pixel_format)
    return _PACKINGS.get(found["suffix"]) if found else None


def pattern_and_bits(pixel_format: str) -> tuple[str, int]:
    """The filter array and the depth of a pixel format.

    Args:
        pixel_format: GenICam name of a supported format.

    Returns:
        Pattern of the first two pixels, empty for monochrome; bits per pixel.

    Raises:
        ValueError: the format is not supported.

    Example:
        >>> pattern_and_bits("BayerRG12Packed")
        ('RG', 12)
    """
    found = _NAME.fullmatch(pixel_format)
    if found is None:
        raise ValueError(f"{pixel_format!r} is no monochrome or Bayer format")
    return found["pattern"] or "", int(found["bits"])


def widest_format(offered: Iterable[str]) -> str | None:
    """The format with the most bits per pixel; unpacked words before packed ones.

    Args:
        offered: GenICam names.

    Returns:
        One of them; None if none is supported.

    Example:
        >>> widest_format(["Mono8", "Mono12Packed", "Mono12", "RGB8"])
        'Mono12'
    """
    known = [name for name in offered if packing_of(name) is not None]
    ranked = [
        (pattern_and_bits(name)[1], packing_of(name) is Packing.WORDS, name) for name in known
    ]
    return max(ranked)[2] if ranked else None


def usual_format(offered: Iterable[str], colour_filter: str = "") -> str | None:
    """The pixel format to use: raw Bayer for a colour head, else the widest one.

    A colour head also offers monochrome, which it computes from its pixels. A head that offers
    several patterns is none, unless it states its filter.

    Args:
        offered: GenICam names of pixel formats.
        colour_filter: the head's PixelColorFilter, such as BayerRG; empty if it states none.

    Returns:
        The name of a format, or None if no format is supported.

    Source: GenICam SFNC 2.7, PixelColorFilter.

    Example:
        >>> usual_format(["Mono8", "Mono16", "BayerRG8", "BayerRG16"])
        'BayerRG16'
        >>> usual_format(["Mono12", "BayerRG12", "BayerGB12"], "BayerGB")
        'BayerGB12'
    """
    names = [name for name in offered if packing_of(name) is not None]
    raw = [name for name in names if pattern_and_bits(name)[0]]
    stated = [name for name in raw if colour_filter and name.startswith(colour_filter)]
    widest, raw_widest = widest_format(names), widest_format(stated or raw)
    if widest is None or raw_widest is None or colour_filter == "None":
        return widest
    is_colour = len({pattern_and_bits(name)[0] for name in raw}) == 1
    has_all_bits = pattern_and_bits(raw_widest)[1] == pattern_and_bits(widest)[1]
    return raw_widest if stated or (is_colour and has_all_bits) else widest


def packing_problem(packing: Packing, width_px: int) -> str | None:
    """The reason why a packing does not fit a width.

    Args:
        packing: the packing.
        width_px: columns of a frame.

    Returns:
        A sentence; None if it fits.
    """
    group = pixels_in_a_group(packing)
    if width_px % group == 0:
        return None
    return f"width_px is {width_px}; a format packed as {packing.value} needs a multiple of {group}"
