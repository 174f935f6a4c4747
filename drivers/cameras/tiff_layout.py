"""Tags of a TIFF that change what its words mean: refused, since a frame is stored as it was read.

A thumbnail of EXIF, a compressed JPEG without NewSubfileType, is no image of its own.

Source: TIFF 6.0, sections 8 (Orientation, PhotometricInterpretation, NewSubfileType) and 5;
EXIF 2.32, 4.5.5, for thumbnails; TIFF/EP (ISO 12234-2) for colour filter arrays, DNG 1.6 for
linear raw.
"""

from __future__ import annotations

from typing import Any, Final

MAX_PAGES: Final = 16
"""So many directories are looked at; a file with more is no frame."""
_TOP_LEFT: Final = 1
_MIN_IS_WHITE: Final = 0
_BRIGHTER_IS_HIGHER: Final = (1, 2, 32803, 34892)
"""MinIsBlack, RGB planes, colour filter array, linear raw."""
_REDUCED: Final = 1
"""Bit of NewSubfileType: the page is a smaller copy of another one."""


def layout_problem(tiff: Any) -> str | None:
    """What in the tags of a TIFF keeps its first page from being a frame as it stands.

    Args:
        tiff: an open `tifffile.TiffFile`.

    Returns:
        A sentence with the cure: another orientation than row by row from the top left, words that
        count towards black, or several images. None where there is nothing; smaller copies of the
        first page (overviews, thumbnails) are none.

    Raises:
        Exception: what tifffile raises on damaged directories.
    """
    page = tiff.pages[0]
    orientation = int(page.tags.valueof("Orientation", _TOP_LEFT))
    if orientation != _TOP_LEFT:
        return (
            f"tag Orientation is {orientation}; frames are stored row by row from the top left: "
            "turn the pixels and set the tag to 1"
        )
    photometric = int(page.photometric)
    if photometric == _MIN_IS_WHITE:
        return "its words count towards black (MinIsWhite); invert them and set MinIsBlack"
    if photometric not in _BRIGHTER_IS_HIGHER:
        return f"PhotometricInterpretation is {photometric}; MinIsBlack (1) is needed"
    pages = tiff.pages
    for number in range(1, MAX_PAGES + 1):
        try:
            further = pages[number]
        except IndexError:
            return None
        is_thumbnail = (
            "JPEGInterchangeFormat" in further.tags and further.imagewidth < page.imagewidth
        )
        if not int(further.subfiletype) & _REDUCED and not is_thumbnail:
            return f"holds several images (page {number + 1}); write one frame a file"
    return f"holds more than {MAX_PAGES} pages; write one frame a file"
