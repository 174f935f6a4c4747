"""EXIF and XMP of a JPEG or TIFF file, without its pixels.

The file is untrusted input: sizes, counts and the number of entries are limited, and offsets that
leave the file are refused. Values keep the kinds of TIFF 6.0; what they mean is the caller's.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from daemon import DaemonError

Value = str | bytes | tuple[float, ...]

FILE_MAX_BYTES: Final = 1_000_000_000
_ENTRIES_MAX: Final = 512
_VALUE_MAX_BYTES: Final = 2_000_000
_SEGMENTS_MAX: Final = 1000

MAKE, MODEL, ORIENTATION, SOFTWARE, DATE_TIME, XMP = 271, 272, 274, 305, 306, 700
IMAGE_WIDTH, IMAGE_LENGTH, BITS_PER_SAMPLE, SAMPLES_PER_PIXEL = 256, 257, 258, 277
EXPOSURE_TIME, F_NUMBER, ISO = 33434, 33437, 34855
DATE_TIME_ORIGINAL, SUBSEC_TIME, SUBSEC_ORIGINAL = 36867, 37520, 37521
FOCAL_LENGTH, FOCAL_LENGTH_35 = 37386, 41989
PIXEL_X, PIXEL_Y = 40962, 40963
FOCAL_PLANE_X, FOCAL_PLANE_Y, FOCAL_PLANE_UNIT = 41486, 41487, 41488
BODY_SERIAL, LENS_MODEL = 42033, 42036
_EXIF_IFD, _GPS_IFD = 34665, 34853
GPS_LATITUDE_REF, GPS_LATITUDE, GPS_LONGITUDE_REF, GPS_LONGITUDE = 1, 2, 3, 4
GPS_ALTITUDE_REF, GPS_ALTITUDE, GPS_TIME, GPS_DATE = 5, 6, 7, 29

_SIZES: Final = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
_LETTERS: Final = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 11: "f", 12: "d", 13: "I"}
_MM_PER_UNIT: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
_BELOW: Final = ((1.0,), (3.0,), b"\x01", b"\x03", "1", "3")
"""GPSAltitudeRef of heights below the sea (EXIF 2.32; in 3.0 the ellipsoid) and, 3, the sea."""
_START_OF_FRAME: Final = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})


class TagsError(DaemonError, ValueError):
    """A file whose tags cannot be read; the message names file, finding and remedy."""


@dataclass(frozen=True)
class ImageTags:
    """Tags by number: of the image, of EXIF, of GPS; the XMP packet; size in pixels.

    `kind` is "jpeg" or "tiff". Numbers are tuples, also single ones; rationals are divided.
    """

    kind: str
    width_px: int
    height_px: int
    image: Mapping[int, Value] = field(default_factory=dict)
    exif: Mapping[int, Value] = field(default_factory=dict)
    gps: Mapping[int, Value] = field(default_factory=dict)
    xmp: bytes | None = None

    def text(self, code: int) -> str:
        """A text of EXIF, else of the image; empty where it is not given."""
        value = self.exif.get(code, self.image.get(code, ""))
        return value if isinstance(value, str) else ""

    def number(self, code: int) -> float | None:
        """A finite number of EXIF, else of the image."""
        value = self.exif.get(code, self.image.get(code))
        if isinstance(value, tuple) and value and math.isfinite(value[0]):
            return value[0]
        return None


def read_tags(path: Path) -> ImageTags:
    """Read the tags of a file.

    Raises:
        TagsError: no JPEG or TIFF, or damaged tags.
    """
    try:
        if path.stat().st_size > FILE_MAX_BYTES:
            raise TagsError(f"{path.name}: larger than {FILE_MAX_BYTES} bytes; no photograph")
        data = path.read_bytes()
    except OSError as error:
        raise TagsError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        if data[:2] == b"\xff\xd8":
            return _jpeg(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data, "tiff")
    except (struct.error, IndexError, ValueError, OverflowError) as error:
        raise TagsError(f"{path.name}: damaged tags ({error}); give the original file") from error
    if not data:
        raise TagsError(
            f"{path.name}: is empty; copy it from the camera's card again, or move it out of the "
            "folder"
        )
    if data[:4] in (b"II+\0", b"MM\0+"):
        raise TagsError(f"{path.name}: BigTIFF is not read; write it as TIFF")
    raise TagsError(f"{path.name}: neither JPEG nor TIFF; move it out of the folder")


def _jpeg(data: bytes) -> ImageTags:
    """Tags of the segments before the pixels.

    Source: ISO/IEC 10918-1, annex B; CIPA DC-008 (EXIF 2.32), 4.5.4 and 4.7.2.
    """
    at, exif, xmp, size = 2, None, None, (0, 0)
    for _ in range(_SEGMENTS_MAX):
        while data[at] == 0xFF and data[at + 1] == 0xFF:
            at += 1
        if data[at] != 0xFF:
            raise ValueError("a segment does not begin with FF")
        marker = data[at + 1]
        if marker in (0xDA, 0xD9):
            break
        (length,) = struct.unpack_from(">H", data, at + 2)
        content = data[at + 4 : at + 2 + length]
        if length < 2 or len(content) != length - 2:
            raise ValueError("a segment ends early")
        if marker == 0xE1 and content.startswith(b"Exif\0\0") and exif is None:
            exif = content[6:]
        elif marker == 0xE1 and content.startswith(b"http://ns.adobe.com/xap/1.0/\0"):
            xmp = content.split(b"\0", 1)[1] if xmp is None else xmp
        elif marker in _START_OF_FRAME and size == (0, 0):
            height, width = struct.unpack_from(">HH", content, 1)
            size = (width, height)
        at += 2 + length
    if min(size) < 1:
        raise ValueError("no frame header")
    tags = ImageTags("jpeg", *size) if exif is None else _tiff(exif, "jpeg", size)
    own = tags.image.get(XMP)
    return ImageTags(
        "jpeg",
        *size,
        tags.image,
        tags.exif,
        tags.gps,
        xmp or (own if isinstance(own, bytes) else None),
    )


def _tiff(data: bytes, kind: str, size: tuple[int, int] | None = None) -> ImageTags:
    order = "<" if data[:2] == b"II" else ">"
    if data[:4] not in (b"II*\0", b"MM\0*"):
        raise ValueError("EXIF has no TIFF header")
    (first,) = struct.unpack_from(f"{order}I", data, 4)
    image = _directory(data, order, first)
    parts = []
    for code in (_EXIF_IFD, _GPS_IFD):
        place = image.get(code)
        parts.append(
            _directory(data, order, int(place[0])) if isinstance(place, tuple) and place else {}
        )
    if size is None:
        sides = [
            int(side[0])
            for side in (image.get(IMAGE_WIDTH), image.get(IMAGE_LENGTH))
            if isinstance(side, tuple) and side and side[0] >= 1
        ]
        if len(sides) != 2:
            raise ValueError("no image size")
        size = (sides[0], sides[1])
    xmp = image.get(XMP)
    exif, gps = parts
    return ImageTags(kind, *size, image, exif, gps, xmp if isinstance(xmp, bytes) else None)


def _directory(data: bytes, order: str, at: int) -> dict[int, Value]:
    """Entries of one image file directory (TIFF 6.0, section 2)."""
    (count,) = struct.unpack_from(f"{order}H", data, at)
    if count > _ENTRIES_MAX:
        raise ValueError(f"a directory of {count} entries")
    found: dict[int, Value] = {}
    for k in range(count):
        code, kind, n = struct.unpack_from(f"{order}HHI", data, at + 2 + 12 * k)
        nbytes = _SIZES.get(kind, 0) * n
        if not 0 < nbytes <= _VALUE_MAX_BYTES:
            continue
        place = at + 10 + 12 * k
        if nbytes > 4:
            (place,) = struct.unpack_from(f"{order}I", data, place)
        raw = data[place : place + nbytes]
        if len(raw) != nbytes:
            raise ValueError(f"tag {code} lies outside the file")
        found[code] = _value(raw, kind, n, order, code)
    return found


def _value(raw: bytes, kind: int, n: int, order: str, code: int) -> Value:
    if kind == 2:
        return raw.split(b"\0", 1)[0].decode("utf-8", "replace").strip()
    if kind == 7 or code == XMP:
        return raw
    if kind in (5, 10):
        parts = struct.unpack(f"{order}{2 * n}{'I' if kind == 5 else 'i'}", raw)
        return tuple(a / b if b else math.nan for a, b in zip(parts[::2], parts[1::2], strict=True))
    return tuple(float(v) for v in struct.unpack(f"{order}{n}{_LETTERS[kind]}", raw))


def position_of(tags: ImageTags) -> tuple[float, float, float] | None:
    """Latitude, longitude, deg, and height, m, as the camera's receiver gave them; else None.

    A height below its reference (GPSAltitudeRef 1, of EXIF 3.0 also 3) is negative; of one that is
    not given it is NaN.
    Zero degrees on both axes is a receiver without a fix. More than 60 minutes or seconds, and
    degrees below zero in the north or east, are no position.
    """
    gps = tags.gps
    try:
        latitude = _degrees(gps[GPS_LATITUDE], _sign(gps[GPS_LATITUDE_REF], "N", "S"))
        longitude = _degrees(gps[GPS_LONGITUDE], _sign(gps[GPS_LONGITUDE_REF], "E", "W"))
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    height, below = gps.get(GPS_ALTITUDE), gps.get(GPS_ALTITUDE_REF) in _BELOW
    if not isinstance(height, tuple) or not height or not math.isfinite(height[0]):
        height = (math.nan,)
    place = (latitude, longitude, -height[0] if below else height[0])
    if not all(math.isfinite(v) for v in place[:2]) or place[:2] == (0.0, 0.0):
        return None
    return place if abs(latitude) <= 90.0 and abs(longitude) <= 180.0 else None


def _degrees(value: Value, sign: float) -> float:
    """Signed degrees. Parts below zero, which EXIF does not have, are of the south or west."""
    if not isinstance(value, tuple) or len(value) != 3:
        raise ValueError("degrees have three parts")
    if min(value) < 0.0 < sign:
        raise ValueError("degrees below zero of the north or east")
    degrees, minutes, seconds = map(abs, value)
    if not (minutes <= 60.0 and seconds <= 60.0):
        raise ValueError("more than 60 minutes or seconds")
    return sign * (degrees + minutes / 60.0 + seconds / 3600.0)


def _sign(value: Value, positive: str, negative: str) -> float:
    if value not in (positive, negative):
        raise ValueError(f"{positive} or {negative}")
    return 1.0 if value == positive else -1.0


def pitch_mm_of(tags: ImageTags) -> float | None:
    """Pixel pitch from the focal plane's resolution, for the pixels there are.

    The tags describe the image as taken (PixelXDimension). An image of other size and the same
    proportions was reduced: its pixels are larger by that. Cropped images have no known pitch.
    """
    per_unit = tags.number(FOCAL_PLANE_X)
    unit = _MM_PER_UNIT.get(int(tags.number(FOCAL_PLANE_UNIT) or 2))
    if per_unit is None or per_unit <= 0.0 or unit is None:
        return None
    width = tags.number(PIXEL_X) or tags.width_px
    height = tags.number(PIXEL_Y) or tags.height_px
    scale = width / tags.width_px
    if abs(scale - height / tags.height_px) > 2.0 / min(tags.width_px, tags.height_px) * scale:
        return None
    return unit / per_unit * scale


def focal_length_px_of(tags: ImageTags) -> tuple[float, str] | None:
    """Focal length in pixels of the file and where it comes from; None where no tag gives it.

    Source: CIPA DC-008 (EXIF 2.32), 4.6.5: FocalLengthIn35mmFilm compares diagonals, 43.27 mm.
    """
    focal, pitch = tags.number(FOCAL_LENGTH), pitch_mm_of(tags)
    if focal and pitch and 0.1 < focal < 10_000.0 and 1e-4 < pitch < 0.1:
        return focal / pitch, "FocalLength and FocalPlaneXResolution"
    film = tags.number(FOCAL_LENGTH_35)
    if film and 1.0 < film < 10_000.0:
        diagonal = math.hypot(tags.width_px, tags.height_px)
        return film / 43.2666 * diagonal, "FocalLengthIn35mmFilm"
    return None
