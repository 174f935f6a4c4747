"""Rasters of a mission as STAC assets: bands, size, hash, and the place of orthoimages.

Only the tags of a file are read, and its bytes for the hash.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from daemon import DaemonError

COG_TYPE = "image/tiff; application=geotiff; profile=cloud-optimized"
GEOTIFF_TYPE = "image/tiff; application=geotiff"
_SHA256_MULTIHASH = "1220"
"""Code of SHA-256 and its length, before the digest: the file extension has multihashes."""
_BLOCK_BYTES = 4 << 20
_USER_DEFINED = 32767


class AssetError(DaemonError):
    """A raster cannot be described; the message names the file."""


def raster_asset(
    path: Path,
    href: str,
    *,
    media_type: str,
    title: str,
    roles: Sequence[str],
    bands: Sequence[str],
) -> dict[str, Any]:
    """An asset with the common `bands`, `data_type`, shape, size and hash of a TIFF.

    `proj:transform`, `proj:bbox` and `proj:code` are those of an orthoimage. A perspective image
    with control points has the `proj:code` of these and no transform.

    Args:
        path: the file.
        href: of the asset.
        media_type: of the asset.
        title: of the asset.
        roles: of the asset.
        bands: names, one a plane.

    Raises:
        AssetError: the file is no TIFF, or has another number of planes.

    Source: STAC 1.1.0 common metadata; extensions projection 2.0.0 and file 2.1.0.
    """
    from tifffile import TiffFile, TiffFileError

    try:
        with TiffFile(path) as tiff:
            page = tiff.pages[0]
            tags = dict(page.geotiff_tags or {})
            rows, columns = int(page.imagelength), int(page.imagewidth)
            planes = int(page.samplesperpixel)
            planes = max(planes, len(tiff.pages)) if planes == 1 and len(bands) > 1 else planes
            data_type = str(page.dtype)
    except (TiffFileError, OSError, ValueError, IndexError) as error:
        raise AssetError(f"{path}: cannot be read as TIFF ({error}); export it again") from error
    if planes != len(bands):
        raise AssetError(f"{path}: has {planes} planes and {len(bands)} bands; export it again")
    return {
        "href": href,
        "type": media_type,
        "title": title,
        "roles": list(roles),
        "bands": [{"name": band} for band in bands],
        "data_type": data_type,
        "proj:shape": [rows, columns],
        **_placed(tags, rows, columns),
        **file_fields(path),
    }


def file_fields(path: Path) -> dict[str, Any]:
    """`file:size` and `file:checksum`, a SHA-256 as multihash."""
    digest, nbytes = hashlib.sha256(), 0
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
            nbytes += len(block)
    return {"file:size": nbytes, "file:checksum": _SHA256_MULTIHASH + digest.hexdigest()}


def _placed(tags: Mapping[str, Any], rows: int, columns: int) -> dict[str, Any]:
    """Coordinate system, and of an orthoimage also its affine transform and bounds."""
    code = tags.get("ProjectedCSTypeGeoKey")
    number = int(code) if code is not None else _USER_DEFINED
    placed: dict[str, Any] = {}
    if number != _USER_DEFINED:
        placed["proj:code"] = f"EPSG:{number}"
    scale, tie = tags.get("ModelPixelScale"), tags.get("ModelTiepoint")
    if scale is None or tie is None or len(tie) != 6:
        return placed
    east, north = float(tie[3]) - float(tie[0]) * scale[0], float(tie[4]) + float(tie[1]) * scale[1]
    if tags.get("GTRasterTypeGeoKey") == 2:  # the tie point is the centre of a pixel
        east, north = east - scale[0] / 2, north + scale[1] / 2
    placed["proj:transform"] = [float(scale[0]), 0.0, east, 0.0, -float(scale[1]), north]
    placed["proj:bbox"] = [
        *(east, north - rows * float(scale[1])),
        *(east + columns * float(scale[0]), north),
    ]
    return placed
