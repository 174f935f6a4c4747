"""Which files of a folder are photographs, and whether they are complete.

What their tags mean is read elsewhere (`exif_tags`, `photographs`).
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Final

from daemon.postflight.importers.exif_tags import ImageTags, TagsError
from daemon.postflight.importers.multispectral_tags import ImagesError

SUFFIXES: Final = (".jpg", ".jpeg", ".tif", ".tiff")
_OTHER_IMAGES: Final = (
    *(".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".iiq", ".3fr", ".fff"),
    *(".heic", ".heif", ".png", ".webp", ".jp2", ".mp4", ".mov"),
)
_FILES_MAX: Final = 100_000
_PLACES: Final = ((273, 279), (324, 325))
"""StripOffsets and StripByteCounts, TileOffsets and TileByteCounts."""
_JPEG_AT: Final = 513
"""JPEGInterchangeFormat: of a TIFF that holds a JPEG as a whole."""
_START_OF_SCAN: Final = b"\xff\xda"
_END_OF_IMAGE: Final = b"\xff\xd9"


def photograph_paths(folder: Path) -> list[Path]:
    """JPEG and TIFF files of a folder, in the order of their names.

    Hidden files, such as the `._IMG_1.jpg` that macOS writes next to a file, are not looked at.

    Raises:
        ImagesError: no folder, or fewer than two files; the message names what is there.
    """
    if not folder.is_dir():
        raise ImagesError([f"{folder}: no such folder; give the one with the photographs"])
    paths = _of(folder)
    if 2 <= len(paths) <= _FILES_MAX:
        return paths
    inside = [(one, len(_of(one))) for one in sorted(folder.iterdir()) if one.is_dir()]
    named = ", ".join(f"{one.name} ({count})" for one, count in inside[:8] if count)
    found = f"{folder}: holds {len(paths)} JPEG or TIFF files; a block takes two"
    if named:
        found += f". Folders in it hold some: {named}. Give one of these, or copy them together"
    elif others := other_images(folder):
        found += f". {others}"
    raise ImagesError([found])


def other_images(folder: Path) -> str:
    """A sentence about images of other formats in a folder; empty where there are none."""
    kinds = Counter(path.suffix.lower() for path in folder.iterdir())
    named = ", ".join(f"{kinds[kind]} {kind}" for kind in _OTHER_IMAGES if kinds[kind])
    return f"Not read: {named}. Convert images to JPEG or TIFF with their EXIF" if named else ""


def check_complete(path: Path, *, is_jpeg: bool) -> None:
    """Whether a file holds its whole image: decoders fill what is missing with grey.

    A JPEG ends with a marker that cannot occur in its compressed pixels. What a camera appends
    behind it, such as previews, is not looked at.

    Args:
        path: the file; its tags can be read.
        is_jpeg: whether it is one.

    Raises:
        TagsError: the file ends early.

    Source: ISO/IEC 10918-1, B.1.1.3 and B.2.1.
    """
    if not is_jpeg:
        return
    data = path.read_bytes()
    at = 2
    while data[at : at + 2] != _START_OF_SCAN and at < len(data) - 4:
        fill = data[at + 1] == 0xFF
        at += 1 if fill else 2 + int.from_bytes(data[at + 2 : at + 4])
    if data.find(_END_OF_IMAGE, at) < 0:
        raise TagsError(
            f"{path.name}: ends before its image does; copy it from the camera's card again, or "
            "move it out of the folder"
        )


def check_strips(path: Path, tags: ImageTags) -> None:
    """Whether the strips or tiles of a TIFF lie within the file.

    Args:
        path: the file.
        tags: its tags; those of a JPEG are not looked at.

    Raises:
        TagsError: the file ends early, or has no strips.

    Source: TIFF 6.0, sections 3 and 15.
    """
    if tags.kind != "tiff" or _JPEG_AT in tags.image:
        return
    size = path.stat().st_size
    for offsets, counts in _PLACES:
        at, length = tags.image.get(offsets), tags.image.get(counts)
        if isinstance(at, tuple) and isinstance(length, tuple) and len(at) == len(length):
            end = max(a + n for a, n in zip(at, length, strict=True))
            if end > size:
                raise TagsError(
                    f"{path.name}: ends before its image does ({size} of {end:.0f} bytes); copy it "
                    "from the camera's card again, or move it out of the folder"
                )
            return
    raise TagsError(
        f"{path.name}: has no pixels (StripOffsets or TileOffsets); copy it from the camera's card "
        "again, or move it out of the folder"
    )


def _of(folder: Path) -> list[Path]:
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
    )
