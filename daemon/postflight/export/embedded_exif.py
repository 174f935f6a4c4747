"""EXIF in TIFF and JPEG 2000 files that GDAL wrote, which writes none itself.

A TIFF's first directory gets Make, Model and the pointers to the EXIF and GPS directories in place
of entries that GDAL wrote for this purpose (`PLACEHOLDERS`), so that nothing moves: the layout of a
Cloud Optimized GeoTIFF stays. The directories follow the pixels. A JPEG 2000 file gets a UUID box.

Source: TIFF 6.0, section 2; CIPA DC-008 (EXIF 2.32), 4.6.3; ISO/IEC 15444-1, annex I.7.2; the box's
UUID is the one that readers know as `JpgTiffExif->JP2`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from daemon import DaemonError
from daemon.postflight.export.exif import (
    EXIF_IFD,
    GPS_IFD,
    PictureMetadata,
    directory_bytes,
    exif_bytes,
    exif_entries,
)

_ARTIST, _DOCUMENT_NAME, _HOST, _COPYRIGHT = 315, 269, 316, 33432
_MAKE, _MODEL, _LONG = 271, 272, 4
JP2_UUID: Final = b"JpgTiffExif->JP2"
_ENTRY: Final = struct.Struct("<HHII")


class EmbeddedExifError(DaemonError, ValueError):
    """A file in which EXIF has no place; the message states why."""


def placeholders(shot: PictureMetadata) -> Mapping[str, str]:
    """Items for GDAL's TIFF writer: descriptions, and entries that `embed_in_tiff` replaces."""
    instant = shot.utc_text
    return {
        "TIFFTAG_IMAGEDESCRIPTION": shot.remark,
        "TIFFTAG_SOFTWARE": "Syntopic",
        "TIFFTAG_DATETIME": instant,
        "TIFFTAG_DOCUMENTNAME": "Syntopic",
        "TIFFTAG_HOSTCOMPUTER": shot.camera,
        "TIFFTAG_ARTIST": "-",
        "TIFFTAG_COPYRIGHT": "-",
    }


def embed_in_tiff(path: Path, shot: PictureMetadata) -> None:
    """Write EXIF into a classic little-endian TIFF with the entries of `placeholders`.

    Raises:
        EmbeddedExifError: it is another TIFF, or an entry is missing.
        OSError: the disk refused.
    """
    _, detail, gps = exif_entries(shot)
    with path.open("r+b") as file:
        order, version, at = struct.unpack("<2sHI", file.read(8))
        if (order, version) != (b"II", 42):
            raise EmbeddedExifError(f"{path.name} is no classic TIFF of little-endian order")
        file.seek(at)
        (count,) = struct.unpack("<H", file.read(2))
        entries = {}
        for tag, kind, number, value in _ENTRY.iter_unpack(file.read(_ENTRY.size * count)):
            entries[tag] = (kind, number, value)
        end = file.seek(0, 2)
        exif_at = end + end % 2
        exif = directory_bytes(detail, exif_at)
        gps_at = exif_at + len(exif)
        for old, new, replacement in (
            (_DOCUMENT_NAME, _MAKE, None),
            (_HOST, _MODEL, None),
            (_ARTIST, EXIF_IFD, (_LONG, 1, exif_at)),
            (_COPYRIGHT, GPS_IFD, (_LONG, 1, gps_at)),
        ):
            if old not in entries or new in entries:
                raise EmbeddedExifError(f"{path.name} has no entry {old} to replace by {new}")
            kept = entries.pop(old)
            entries[new] = replacement or kept
        file.write(b"\0" * (end % 2) + exif + directory_bytes(gps, gps_at))
        file.seek(at + 2)
        file.write(b"".join(_ENTRY.pack(tag, *entries[tag]) for tag in sorted(entries)))


def append_to_jp2(path: Path, shot: PictureMetadata) -> None:
    """Append EXIF to a JPEG 2000 file.

    Raises:
        EmbeddedExifError: the last box has no length of its own, so that nothing can follow it.
        OSError: the disk refused.
    """
    content = JP2_UUID + exif_bytes(shot)
    with path.open("r+b") as file:
        end = file.seek(0, 2)
        at = 0
        while at < end:
            file.seek(at)
            length, _, extended = struct.unpack(">I4sQ", file.read(16).ljust(16, b"\0"))
            size = extended if length == 1 else length
            if size < 8 or at + size > end:
                raise EmbeddedExifError(f"{path.name}: a box at {at} has no length")
            at += size
        file.seek(end)
        file.write(struct.pack(">I4s", 8 + len(content), b"uuid") + content)
