"""GenICam names of pixel formats, and how their pixels are packed.

Source: PFNC 2.4; GigE Vision 2.0, table 26-1 for the formats that end in Packed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from drivers.cameras.pixels import Packing, pixels_in_a_group

_NAME: Final = re.compile(r"(?:Mono|Bayer(?:RG|GR|GB|BG))(\d+\w*)")
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
    return _PACKINGS.get(found[1]) if found else None


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
    known = [(name, packing_of(name)) for name in offered]
    ranked = [
        (int(re.sub(r"\D.*", "", re.sub(r"^\D+", "", name))), packing is Packing.WORDS, name)
        for name, packing in known
        if packing is not None
    ]
    return max(ranked)[2] if ranked else None


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
