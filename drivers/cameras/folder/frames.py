"""Reading frames of a folder: which files there are, and what one of them holds.

When a frame is due, and into which slot it goes, is in `drivers.cameras.folder.folder_head`.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers import DriverError
from drivers.cameras.tiff_layout import layout_problem

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_DESCRIPTION: Final = 1 << 20
_DIGITS: Final = re.compile(r"(\d+)")


class FrameFileError(DriverError):
    """A file is no frame; the message contains the reason. Internal to this driver."""


@dataclass(frozen=True)
class FrameFile:
    """A frame and its metadata, as read from its file.

    `pixels` has shape (height, width), uint16. The rest is what the head knew when the frame was
    captured, from a Level-0 file of ours; None and empty for files of others.
    """

    path: Path
    pixels: NDArray[np.uint16]
    head_serial: str
    pixel_format: str
    device_ns: int | None
    counter: int | None
    exposure_time_us: float | None
    temperature_c: float | None
    settings: Mapping[str, float | int | str]


def frame_files(folder: Path, pattern: str) -> list[Path]:
    """The files of a folder that match a pattern.

    Args:
        folder: where the pattern begins.
        pattern: as of `pathlib.Path.glob`.

    Returns:
        The files, sorted by name; numbers within names are compared as numbers.

    Raises:
        OSError: the folder cannot be read.
    """
    found = [path for path in folder.glob(pattern) if path.is_file()]
    return sorted(found, key=lambda path: _order(path.relative_to(folder).as_posix()))


def _order(name: str) -> list[tuple[int, str]]:
    parts = _DIGITS.split(name)
    return [(int(part[:18]), part) if at % 2 else (-1, part) for at, part in enumerate(parts)]


def read_frame(path: Path, *, max_nbytes: int) -> FrameFile:
    """Read a TIFF of one plane and 16 bits.

    Args:
        path: the file.
        max_nbytes: nothing larger than this is unpacked.

    Returns:
        The pixels, and the metadata if the file is a Level-0 frame.

    Raises:
        FrameFileError: it is none, is damaged, or does not fit.
    """
    from tifffile import TiffFile, TiffFileError

    try:
        with TiffFile(path) as tiff:
            if problem := layout_problem(tiff):
                raise FrameFileError(problem)
            page = tiff.pages[0]
            shape, dtype = page.shape, page.dtype
            if len(shape) != 2 or str(dtype) != "uint16":
                raise FrameFileError(f"has shape {shape} of {dtype}; one plane of uint16 is needed")
            nbytes = shape[0] * shape[1] * 2
            if not 0 < nbytes <= max_nbytes:
                raise FrameFileError(
                    f"has {shape[1]} x {shape[0]} px; the head's memory holds {max_nbytes // 2}"
                )
            pixels = page.asarray()
            description = str(page.description)[:MAX_DESCRIPTION]
    # Quirk: tifffile raises many kinds of exceptions for damaged files, not only its own.
    # Upstream: cgohlke/tifffile#227.
    except (
        TiffFileError,
        OSError,
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        AttributeError,
        ArithmeticError,
        AssertionError,
        MemoryError,
        RuntimeError,
        struct.error,
        zlib.error,
    ) as error:
        raise FrameFileError(f"cannot be read as a TIFF ({error})") from error
    if pixels.shape != shape:
        raise FrameFileError(f"ends before its {shape[1]} x {shape[0]} px do")
    known = _parse_description(description)
    settings = known.get("settings")
    return FrameFile(
        path=path,
        pixels=pixels,
        head_serial=str(known.get("head_serial") or "")[:80],
        pixel_format=str(known.get("pixel_format") or "Mono16")[:40],
        device_ns=_integer_or_none(known.get("device_ns")),
        counter=_integer_or_none(known.get("counter")),
        exposure_time_us=_finite(known.get("exposure_time_us")),
        temperature_c=_finite(known.get("temperature_c")),
        settings={
            str(key)[:80]: value if not isinstance(value, str) else value[:200]
            for key, value in (settings.items() if isinstance(settings, dict) else ())
            if isinstance(value, int | str) or _finite(value) is not None
        },
    )


def _parse_description(description: str) -> Mapping[str, Any]:
    try:
        content = json.loads(description)
    except (ValueError, RecursionError):
        return {}
    ours = isinstance(content, dict) and content.get("syntopic") == 1
    return content if ours else {}


def _integer_or_none(value: object) -> int | None:
    """A whole number below 2^63, or such a one in decimal digits as instants are written."""
    if isinstance(value, str) and re.fullmatch(r"\d{1,19}", value, re.ASCII):
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 1 << 63:
        return None
    return value


def _finite(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e12:
        return None
    return float(value) if value == value else None
