"""Level-2 on disk: a finished exposure's images, geometry and quality report, in one folder.

The folder appears whole, in place of an earlier one. What goes into it is made by `processing`;
this runs in a worker, the only place where the quick look is encoded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, PlainValidator

from daemon import DaemonError
from daemon.mission.canonical_json import (
    RecordError,
    canonical_bytes,
    parse_record,
    plain_name,
)
from daemon.mission.layout import Mission
from daemon.mission.record_types import LongText, read_record
from daemon.mission.store import direct_io
from daemon.mission.store.level0 import tiff_parts
from daemon.mission.store.publication import published, sweep

Verdict = Literal["good", "usable", "refly"]
BAND_ORDER = ("red", "green", "blue", "nir")
QUICKLOOK_QUALITY = 85
THUMBNAIL_WIDTH_PX, THUMBNAIL_QUALITY = 200, 60


class ProductError(DaemonError, ValueError):
    """Products that cannot be written as they are; disk faults come as OSError instead."""


SIMULATED = "SIMULATED"
UNCALIBRATED = "UNCALIBRATED"
"""Flags of a quality report that every product states."""

_COMMENTS = {
    SIMULATED: b"SIMULATED: emulated hardware, no survey",
    UNCALIBRATED: b"UNCALIBRATED: the geometry of the camera is nominal",
}


@dataclass(frozen=True)
class Level2Record:
    """Written files: name to size in bytes, and the verdict of quality.json."""

    number: int
    files: Mapping[str, int]
    verdict: str | None


def level2_contents(
    number: int,
    *,
    pan: NDArray[np.uint16] | None,
    colour: Mapping[str, NDArray[np.uint16]],
    quicklook: NDArray[np.uint8] | None,
    report_json: Mapping[str, Any],
    geometry: Mapping[str, Mapping[str, NDArray[Any]]] | None = None,
    residuals_svg: str | None = None,
    residuals_json: Mapping[str, Any] | None = None,
    histogram_json: Mapping[str, Any] | None = None,
    mosaic_json: Mapping[str, Any] | None = None,
) -> dict[str, Sequence[bytes | memoryview]]:
    """The files of an exposure's products: parts by name. Pixels are not copied.

    Args:
        number: the exposure.
        pan: stitched image, shape (height, width); None for a rig or an exposure without one.
        colour: by band, all of one shape; written in the order red, green, blue, nir.
        quicklook: shape (height, width) or (height, width, 3) in the order red, green, blue.
        report_json: content of quality.json.
        geometry: by method ("free", "fixed", "fixed-no-tdm"), arrays by name.
        residuals_svg: a drawing of the residual vectors.
        residuals_json: the same as numbers, with figures for every overlap.
        histogram_json: counts of raw DN by sensor.
        mosaic_json: content of mosaic.json, the sensors' places as stitched.

    Raises:
        ProductError: arrays of wrong type or shape, or an unknown band.
        RecordError: a report that JSON cannot hold.
    """
    contents: dict[str, Sequence[bytes | memoryview]] = {}
    mark = product_marks(report_json)
    if pan is not None:
        contents["pan.tif"] = tiff_parts([pan], {"bands": ["pan"], "exposure": number, **mark})
    if colour:
        bands = _ordered(colour)
        about = {"bands": bands, "exposure": number, **mark}
        contents["rgbn.tif"] = tiff_parts([colour[band] for band in bands], about)
    if quicklook is not None:
        contents |= pictures(quicklook, report_json)
    for method, arrays in (geometry or {}).items():
        contents[_geometry_name(method)] = [_npz(arrays)]
    if residuals_svg is not None:
        contents["residuals.svg"] = [residuals_svg.encode("utf-8")]
    if residuals_json is not None:
        contents["residuals.json"] = [canonical_bytes({**residuals_json, **mark})]
    if histogram_json is not None:
        contents["histogram.json"] = [canonical_bytes(histogram_json)]
    if mosaic_json is not None:
        contents["mosaic.json"] = [canonical_bytes({**mosaic_json, **mark})]
    contents["quality.json"] = [canonical_bytes(report_json)]
    return contents


def write_level2(
    mission: Mission, number: int, *, report_json: Mapping[str, Any], **products: Any
) -> Level2Record:
    """Write the products of an exposure; they are durable on return.

    Args:
        mission: where to.
        number: the exposure.
        report_json: content of quality.json.
        products: as in `level2_contents`.

    Raises:
        ProductError, RecordError: as `level2_contents`.
        OSError: the disk refused; an earlier result is still there.
    """
    contents = level2_contents(number, report_json=report_json, **products)
    files = write_folder(mission.level2(number), contents)
    verdict = report_json.get("verdict")
    return Level2Record(number, files, verdict if isinstance(verdict, str) else None)


def write_folder(
    final: Path, contents: Mapping[str, Sequence[bytes | memoryview]]
) -> dict[str, int]:
    """Write a product folder whole, in place of an earlier one; it is durable on return.

    Args:
        final: the folder; the one above it is made where it is missing.
        contents: bytes by file name.

    Returns:
        Sizes in bytes by file name.

    Raises:
        OSError: the disk refused; an earlier folder is still there.
    """
    with published(final) as part:
        return write_files(part, contents)


def write_files(
    folder: Path, contents: Mapping[str, Sequence[bytes | memoryview]]
) -> dict[str, int]:
    """Write files into a folder; each is durable on return.

    Args:
        folder: it exists.
        contents: bytes by file name.

    Returns:
        Sizes in bytes by file name.

    Raises:
        OSError: the disk refused.
    """
    return {
        name: direct_io.create_file(folder / name, parts, mode=0o644)
        for name, parts in contents.items()
    }


def _figure(value: Any) -> Any:
    if value is None or isinstance(value, str | int | float):
        return value
    raise ValueError("a number or a text is needed")


class _ReportFinding(BaseModel):
    sentence: LongText
    flag: LongText = ""
    verdict: Verdict = "good"


class _Report(BaseModel):
    verdict: Verdict
    findings: tuple[_ReportFinding, ...] = ()
    figures: dict[str, Annotated[Any, PlainValidator(_figure)]] = {}


def read_report(folder: Path) -> dict[str, Any] | None:
    """The quality.json of a product folder, None where there is none.

    Raises:
        RecordError: it is damaged: no JSON, or a verdict, finding or figure of a wrong type.
    """
    name = f"{folder.name}/quality.json"
    try:
        content = parse_record((folder / "quality.json").read_bytes(), name)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordError([f"{name}: cannot be read ({error.strerror})"]) from error
    read_record(_Report, content, name)
    return content


def verdict_of(folder: Path) -> str | None:
    """The verdict in a product folder's quality.json, None where it cannot be read."""
    try:
        content = parse_record((folder / "quality.json").read_bytes(), "quality.json")
    except (OSError, RecordError):
        return None
    verdict = content.get("verdict")
    return verdict if isinstance(verdict, str) else None


def recover_level2(mission: Mission) -> list[str]:
    """Clear what an interrupted `write_level2` left; returns messages about what was done.

    Args:
        mission: it must be held by the caller (`Mission.held`).
    """
    return sweep(mission.level2_root)


def _ordered(colour: Mapping[str, NDArray[np.uint16]]) -> list[str]:
    unknown = [band for band in colour if band not in BAND_ORDER]
    if unknown:
        raise ProductError(f"band {unknown[0]!r}; a colour band is one of {', '.join(BAND_ORDER)}")
    return [band for band in BAND_ORDER if band in colour]


def _geometry_name(method: str) -> str:
    if not plain_name(method):
        raise ProductError(f"method {method!r} cannot name a file")
    return "geometry.npz" if method == "free" else f"geometry-{method}.npz"


def _npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise ProductError(f"geometry array {name!r} holds objects; numbers are needed")
    buffer = BytesIO()
    named: dict[str, Any] = {name: arrays[name] for name in sorted(arrays)}
    np.savez(buffer, **named)
    return buffer.getvalue()


def product_marks(report_json: Mapping[str, Any]) -> dict[str, bool]:
    """What every product of emulated hardware, and of an uncalibrated rig, states of itself."""
    flags = report_json.get("flags")
    return {
        name.lower(): True
        for name in (SIMULATED, UNCALIBRATED)
        if isinstance(flags, list) and name in flags
    }


def jpeg_comment(text: bytes) -> bytes:
    """A comment segment; it follows the marker that begins an image.

    Source: ITU-T T.81, B.2.4.5.
    """
    return b"\xff\xfe" + (len(text) + 2).to_bytes(2, "big") + text


def pictures(
    quicklook: NDArray[np.uint8], report_json: Mapping[str, Any]
) -> dict[str, Sequence[bytes | memoryview]]:
    """The quick look and its thumbnail; comments have what `product_marks` states."""
    full_size, small = jpeg_bytes(quicklook), thumbnail_bytes(quicklook)
    comments = b"".join(
        jpeg_comment(text)
        for name, text in _COMMENTS.items()
        if name.lower() in product_marks(report_json)
    )
    full_size, small = (jpeg[:2] + comments + jpeg[2:] for jpeg in (full_size, small))
    return {"quicklook.jpg": [full_size], "thumbnail.jpg": [small]}


def thumbnail_bytes(quicklook: NDArray[np.uint8]) -> bytes:
    """A quick look made small enough for a thin link, a few kB."""
    import cv2

    height, width = quicklook.shape[:2]
    scale = min(1.0, THUMBNAIL_WIDTH_PX / width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(quicklook, size, interpolation=cv2.INTER_AREA)
    return jpeg_bytes(np.asarray(small, dtype=np.uint8), quality=THUMBNAIL_QUALITY)


def jpeg_bytes(quicklook: NDArray[np.uint8], *, quality: int = QUICKLOOK_QUALITY) -> bytes:
    """A quick look, (height, width) or (height, width, 3) in the order red, green, blue, as JPEG.

    Raises:
        ProductError: another type or shape.
    """
    import cv2

    shape_fits = quicklook.ndim == 2 or (quicklook.ndim == 3 and quicklook.shape[2] == 3)
    if quicklook.dtype != np.uint8 or not shape_fits:
        raise ProductError(
            f"quick look is {quicklook.dtype} of shape {quicklook.shape}; "
            "uint8 of shape (height, width) or (height, width, 3) is needed"
        )
    image = quicklook if quicklook.ndim == 2 else np.ascontiguousarray(quicklook[:, :, ::-1])
    is_encoded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not is_encoded:
        raise ProductError(f"quick look of shape {quicklook.shape} cannot be encoded")
    return bytes(data)
