"""Raster files as this program writes them: uncompressed TIFF whose pixels are one block.

Writing needs no library and no copy of the pixels; reading takes any 16-bit TIFF that tifffile
reads. The files of an exposure are defined in `daemon.mission.store.store`.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.canonical_json import canonical_bytes
from drivers.cameras.tiff_layout import layout_problem

PIXEL_ALIGNMENT = 4096
"""Pixels start on a page, so that a file can be mapped and read with aligned words."""

TIFF_MAX_BYTES = 4_000_000_000
"""Offsets of a classic TIFF have 32 bits."""

PART_ALLOWANCE_BYTES = 1 << 20
"""Tiles at the edges of a small image reach beyond it."""

DEFLATE_MAX_RATIO = 1032
"""How many times its size Deflate can unpack to (zlib, technical details)."""

_DEFLATE = (8, 32946)
_SHORT, _LONG, _ASCII = 3, 4, 2
_SOFTWARE = b"Syntopic\0"


class RasterError(DaemonError, ValueError):
    """Pixels or a TIFF that cannot be taken; the message names file, finding and remedy."""


def tiff_parts(
    planes: Sequence[NDArray[np.uint16]], description: Mapping[str, Any]
) -> list[bytes | memoryview]:
    """The bytes of a TIFF, header first, pixels as views of the arrays given.

    Args:
        planes: one array of shape (height, width) per band, uint16, C-contiguous.
        description: goes into the tag ImageDescription as canonical JSON in ASCII.

    Raises:
        RasterError: arrays of other type, shape or layout, or too large for a TIFF.
    """
    height, width = _common_shape(planes)
    plane_nbytes = height * width * 2
    if plane_nbytes * len(planes) > TIFF_MAX_BYTES:
        raise RasterError(f"{width} x {height} x {len(planes)} px exceed what a TIFF can hold")
    header = _tiff_header(width, height, len(planes), _ascii_json(description))
    return [header, *(plane.data.cast("B") for plane in planes)]


@dataclass(frozen=True)
class DecodedFrame:
    """A frame as it was read at once: pixels (height, width), hash of the file, ImageDescription.

    `pixels` may be read-only; `description` is empty for a file of others.
    """

    pixels: NDArray[np.uint16]
    sha256: str
    description: Mapping[str, Any]


def read_frame(
    path: Path,
    *,
    width_px: int,
    height_px: int,
    read: Callable[[Path], bytes] = Path.read_bytes,
) -> DecodedFrame:
    """Read a frame's file once: what is hashed is what is decoded.

    Args:
        path: of the file.
        width_px: of the sensor.
        height_px: of the sensor.
        read: content of the file.

    Raises:
        RasterError: as `read_tiff`.
    """
    try:
        data = read(path)
    except OSError as error:
        raise RasterError(f"{path}: cannot be read ({error.strerror})") from error
    with _first_page(path, BytesIO(data)) as page:
        _refuse_other_pixels(page, path, page.shape, width_px, height_px)
        text = page.description
        if page.compression == 1 and page.is_final:
            kind = np.dtype(np.uint16).newbyteorder(page.parent.byteorder)
            samples = np.frombuffer(data, kind, page.size, page.dataoffsets[0])
            pixels = np.asarray(samples, np.uint16).reshape(page.shape)
        else:
            pixels = page.asarray()
    if pixels.shape != (height_px, width_px):
        raise RasterError(f"{path.name}: its pixels end early")
    return DecodedFrame(pixels, hashlib.sha256(data).hexdigest(), _described(text))


def read_tiff(
    path: Path,
    *,
    width_px: int | None = None,
    height_px: int | None = None,
    plane: int | None = None,
) -> NDArray[np.uint16]:
    """Pixels of a single-plane 16-bit TIFF, shape (height, width); any writer's will do.

    `plane` takes that one of several planes, one after another in the file.

    Raises:
        RasterError: not a TIFF, damaged, not one plane of uint16, not of the size given, or one
            that would unpack to more than its stated size.
    """
    with _first_page(path) as page:
        shape = page.shape if plane is None else page.shape[1:]
        if plane is not None and plane >= page.shape[0]:
            shape = page.shape
        _refuse_other_pixels(page, path, shape, width_px, height_px)
        pixels: NDArray[np.uint16] = page.asarray()
        pixels = pixels if plane is None else pixels[plane]
    if pixels.shape != shape:
        raise RasterError(f"{path.name}: its pixels end early")
    return pixels


def read_tiff_rows(
    path: Path,
    first_row: int,
    rows: int,
    *,
    width_px: int,
    height_px: int,
    planes: Sequence[int] | None = None,
) -> NDArray[np.uint16]:
    """Some rows of a 16-bit TIFF; only their bytes are read if its pixels are one plain block.

    `planes` takes these of several planes, shape (planes, rows, width); None: the only one, shape
    (rows, width).

    Raises:
        RasterError: as `read_tiff`.
    """
    with _first_page(path) as page:
        shape = page.shape if planes is None else page.shape[1:]
        if planes is not None and max(planes, default=0) >= page.shape[0]:
            shape = page.shape
        _refuse_other_pixels(page, path, shape, width_px, height_px)
        cut = np.s_[first_row : first_row + rows]
        if not (page.is_contiguous and page.is_final):
            pixels = page.asarray()
            return np.ascontiguousarray(
                pixels[cut] if planes is None else pixels[list(planes), cut]
            )
        kind = np.dtype(np.uint16).newbyteorder(page.parent.byteorder)
        file, nbytes = page.parent.filehandle, rows * width_px * 2
        found = np.empty((1 if planes is None else len(planes), rows, width_px), np.uint16)
        for out, plane in zip(found, (0,) if planes is None else planes, strict=True):
            file.seek(page.dataoffsets[0] + (plane * height_px + first_row) * width_px * 2)
            data = file.read(nbytes)
            if len(data) != nbytes:
                raise RasterError(f"{path.name}: its pixels end early")
            out[:] = np.frombuffer(data, kind).reshape(rows, width_px)
    return found[0] if planes is None else found


def check_tiff(path: Path, *, width_px: int, height_px: int) -> None:
    """Whether a raster of one or more planes can be read, without taking its pixels into memory.

    Raises:
        RasterError: as `read_tiff`.
    """
    with _first_page(path) as page:
        _refuse_other_pixels(page, path, page.shape[-2:], width_px, height_px)


@contextmanager
def _first_page(path: Path, file: BytesIO | None = None) -> Iterator[Any]:
    """The first page of a TIFF whose pixels may be unpacked; what tifffile raises is translated."""
    from tifffile import TiffFile

    try:
        with TiffFile(path if file is None else file) as tiff:
            if problem := layout_problem(tiff):
                raise RasterError(f"{path.name}: {problem}")
            page = tiff.pages[0]
            refuse_decompression_bomb(page, path)
            yield page
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise RasterError(f"{path}: cannot be read ({reason})") from error
    except RasterError:
        raise
    except tiff_errors() as error:
        raise RasterError(f"{path.name}: not a usable TIFF ({error})") from error


def _refuse_other_pixels(
    page: Any,
    path: Path,
    shape: tuple[int, ...],
    width_px: int | None,
    height_px: int | None,
) -> None:
    if len(shape) != 2 or page.dtype != np.uint16:
        raise RasterError(
            f"{path.name}: holds {page.dtype} of shape {page.shape}; "
            "a frame is one plane of 16-bit words"
        )
    found = (shape[1], shape[0])
    wanted = (width_px or found[0], height_px or found[1])
    if found != wanted:
        raise RasterError(
            f"{path.name}: {found[0]} x {found[1]} px; the sensor has {wanted[0]} x {wanted[1]} px"
        )


def tiff_errors() -> tuple[type[Exception], ...]:
    """Errors of tifffile on bytes that are no TIFF, or a malformed one."""
    from tifffile import TiffFileError

    return (
        TiffFileError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        ArithmeticError,
        AssertionError,
        RuntimeError,
        MemoryError,
        struct.error,
        zlib.error,
    )


def refuse_decompression_bomb(page: Any, path: Path) -> None:
    """Refuse a page of tifffile's whose pixels need more memory than its file or size warrant.

    Raises:
        RasterError: compressed otherwise than by Deflate; pixels that the file does not hold; parts
            that unpack to more than they may.
    """
    file = page.parent.filehandle
    file_nbytes = file.size
    ratio = 1 if page.compression == 1 else DEFLATE_MAX_RATIO
    max_ratio = min(TIFF_MAX_BYTES, ratio * file_nbytes)
    if page.nbytes > max_ratio:
        raise RasterError(
            f"{path.name}: states {page.nbytes} bytes of pixels; it holds {max_ratio}"
        )
    part_nbytes = math.prod(page.chunks) * page.dtype.itemsize
    if part_nbytes > page.nbytes + PART_ALLOWANCE_BYTES:
        raise RasterError(f"{path.name}: one of its parts states {part_nbytes} bytes; that is more")
    places = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    is_listed = math.prod(page.chunked) == len(places)
    if not is_listed or any(offset + count > file_nbytes for offset, count in places):
        raise RasterError(f"{path.name}: its pixels end early")
    if page.compression == 1:
        return
    if page.compression not in _DEFLATE:
        raise RasterError(
            f"{path.name}: compression {int(page.compression)}; none or Deflate (8) is read"
        )
    for offset, count in places:
        file.seek(offset)
        unpacked = zlib.decompressobj()
        unpacked.decompress(file.read(count), part_nbytes)
        if unpacked.unconsumed_tail and unpacked.decompress(unpacked.unconsumed_tail, 1):
            raise RasterError(f"{path.name}: a part unpacks to more than its pixels")


def read_description(path: Path) -> dict[str, Any]:
    """ImageDescription of our own TIFF; empty for a foreign file."""
    from tifffile import TiffFile

    try:
        with TiffFile(path) as tiff:
            return _described(tiff.pages[0].description)
    except OSError:
        return {}
    except tiff_errors():
        return {}


def _described(text: str) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _common_shape(planes: Sequence[NDArray[np.uint16]]) -> tuple[int, int]:
    if not planes:
        raise RasterError("no plane given; a raster has at least one")
    for plane in planes:
        if plane.dtype != np.uint16 or plane.ndim != 2 or plane.shape != planes[0].shape:
            raise RasterError(
                f"a plane is {plane.dtype} of shape {plane.shape}; "
                f"uint16 of shape (height, width) like the first, {planes[0].shape}, is needed"
            )
        if not plane.flags.c_contiguous or plane.size == 0:
            raise RasterError("a plane is empty or not contiguous; rows follow each other unpadded")
    height, width = planes[0].shape
    return int(height), int(width)


def _ascii_json(description: Mapping[str, Any]) -> bytes:
    content = json.loads(canonical_bytes(description))
    return json.dumps(content, sort_keys=True, separators=(",", ":")).encode("ascii") + b"\0"


def _tiff_header(width: int, height: int, planes: int, text: bytes) -> bytes:
    """Everything before the pixels, padded to `PIXEL_ALIGNMENT`.

    Source: TIFF 6.0, sections 2 (image file header) and 8 (baseline fields).
    """
    order = "<" if sys.byteorder == "little" else ">"
    plane_nbytes = width * height * 2
    extra = b""
    tags: list[tuple[int, int, int, bytes]] = []

    def tag(code: int, kind: int, values: Sequence[int]) -> None:
        letter = "H" if kind == _SHORT else "I"
        tags.append(
            (code, kind, len(values), struct.pack(f"{order}{len(values)}{letter}", *values))
        )

    # Grey, or red-green-blue with further bands behind; fewer than three planes stay grey.
    is_colour = planes >= 3
    further = planes - 3 if is_colour else planes - 1
    tag(256, _LONG, [width])
    tag(257, _LONG, [height])
    tag(258, _SHORT, [16] * planes)
    tag(259, _SHORT, [1])
    tag(262, _SHORT, [2 if is_colour else 1])
    tags.append((270, _ASCII, len(text), text))
    tag(273, _LONG, [0] * planes)
    tag(277, _SHORT, [planes])
    tag(278, _LONG, [height])
    tag(279, _LONG, [plane_nbytes] * planes)
    tag(284, _SHORT, [2 if planes > 1 else 1])
    tags.append((305, _ASCII, len(_SOFTWARE), _SOFTWARE))
    if further:
        tag(338, _SHORT, [0] * further)
    tag(339, _SHORT, [1] * planes)

    directory_nbytes = 2 + 12 * len(tags) + 4
    position = 8 + directory_nbytes
    outside = sum(len(value) + len(value) % 2 for *_, value in tags if len(value) > 4)
    pixels_at = -(-(position + outside) // PIXEL_ALIGNMENT) * PIXEL_ALIGNMENT
    offsets = [pixels_at + plane * plane_nbytes for plane in range(planes)]
    body = struct.pack(f"{order}H", len(tags))
    for code, kind, count, value in tags:
        if code == 273:
            value = struct.pack(f"{order}{planes}I", *offsets)
        if len(value) > 4:
            body += struct.pack(f"{order}HHII", code, kind, count, position + len(extra))
            extra += value + b"\0" * (len(value) % 2)
        else:
            body += struct.pack(f"{order}HHI", code, kind, count) + value.ljust(4, b"\0")
    body += struct.pack(f"{order}I", 0)
    magic = b"II*\0" if order == "<" else b"MM\0*"
    return (magic + struct.pack(f"{order}I", 8) + body + extra).ljust(pixels_at, b"\0")
