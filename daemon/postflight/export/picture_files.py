"""Raster files of pictures: Cloud Optimized GeoTIFF, tiled TIFF, JPEG 2000, JPEG.

Pixels are written as they are; a JPEG has 8 bits and three bands at most, and its remark names
what is left out. Each band has its name and its colour interpretation.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.store.durable import new_file, sync_file
from daemon.mission.store.level0 import refuse_decompression_bomb
from daemon.mission.store.level2 import jpeg_bytes
from daemon.postflight.export.embedded_exif import append_to_jp2, embed_in_tiff, placeholders
from daemon.postflight.export.exif import PictureMetadata, metadata_texts
from daemon.postflight.export.xmp_packet import xmp_bytes
from drivers.base.extras import require

SUFFIXES: Final = {"cog": ".tif", "tiff": ".tif", "jp2": ".jp2", "jpeg": ".jpg"}
"""Formats by name, and the suffix of their files."""
JPEG_QUALITY: Final = 92
BLOCK_PX: Final = 512
SIDECAR: Final = ".aux.xml"
_RGB: Final = ("red", "green", "blue")
_INTERPRETATIONS: Final = {"pan": "gray", "nir": "nir", "red_edge": "rededge"}

Planes = NDArray[np.uint16] | NDArray[np.uint8]


def read_planes(path: Path) -> Planes:
    """Planes (bands, h, w) of a product; of 16-bit Level-2 the saturation bit is taken out.

    Raises:
        RasterError: the file would be too large in memory.
    """
    from tifffile import TiffFile

    with TiffFile(path) as tiff:
        page = tiff.pages[0]
        refuse_decompression_bomb(page, path)
        planes = np.asarray(page.asarray())
        is_interleaved = planes.ndim == 3 and page.planarconfig == 1
    planes = np.moveaxis(planes, -1, 0) if is_interleaved else planes
    planes = planes if planes.ndim == 3 else planes[None]
    if planes.dtype == np.uint8:
        return np.ascontiguousarray(planes)
    return np.asarray(planes & np.uint16(0xFFFE), np.uint16)


def colour_interpretation(bands: Sequence[str]) -> list[str]:
    """GDAL's interpretation of each band; false colour is shown in the order of its bands."""
    if set(bands) == {"nir", "red", "green"}:
        return ["red", "green", "blue"]
    if len(bands) == 1:
        return ["gray"]
    return [_INTERPRETATIONS.get(band, band) for band in bands]


def write_raster(
    kind: str,
    final: Path,
    planes: Planes,
    shot: PictureMetadata,
    *,
    control_points: Sequence[Any] = (),
    crs: str | None = None,
) -> None:
    """Write a COG, a tiled TIFF or a lossless JPEG 2000 with bands, tags and XMP.

    Args:
        kind: "cog", "tiff" or "jp2".
        final: its name, with the suffix of the format.
        planes: (bands, h, w); the bands' names are those of `shot`.
        shot: metadata of the picture.
        control_points: of rasterio, in `crs` (WKT).

    Raises:
        MissingExtraError: rasterio is not installed.
        OSError: the disk refused.
    """
    require("geotiff")
    from rasterio.enums import ColorInterp
    from rasterio.io import MemoryFile
    from rasterio.shutil import copy

    count, height, width = planes.shape
    interpretation = colour_interpretation(shot.bands)
    photometric = "RGB" if interpretation[:3] == list(_RGB) else "MINISBLACK"
    options = {
        "cog": {
            "driver": "COG", "COMPRESS": "DEFLATE", "PREDICTOR": "2", "BLOCKSIZE": str(BLOCK_PX),
            "OVERVIEW_RESAMPLING": "AVERAGE",
        },
        "tiff": {
            "driver": "GTiff", "TILED": "YES", "BLOCKXSIZE": str(BLOCK_PX),
            "BLOCKYSIZE": str(BLOCK_PX), "COMPRESS": "DEFLATE", "PREDICTOR": "2",
        },
        "jp2": {
            "driver": "JP2OpenJPEG", "QUALITY": "100", "REVERSIBLE": "YES", "CODEC": "JP2",
            "WRITE_METADATA": "YES",
        },
    }[kind]  # fmt: skip
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff", width=width, height=height, count=count, dtype=planes.dtype.name,
            nodata=0, gcps=list(control_points), crs=crs if control_points else None,
            photometric=photometric,
        ) as raster:  # fmt: skip
            raster.write(planes)
            raster.colorinterp = [getattr(ColorInterp, name) for name in interpretation]
            raster.update_tags(**metadata_texts(shot), **placeholders(shot))
            raster.update_tags(ns="xml:XMP", **{"xml:XMP": xmp_bytes(shot).decode()})
            for number, band in enumerate(shot.bands, 1):
                raster.set_band_description(number, band)
        with memory.open() as raster, new_file(final) as part:
            copy(raster, str(part), **options)
            if kind == "jp2":
                append_to_jp2(part, shot)
            else:
                embed_in_tiff(part, shot)
            # What JPEG 2000 cannot hold (control points, names and interpretation of bands)
            # GDAL writes next to the file, named after it.
            sidecar = part.with_name(part.name + SIDECAR)
            if sidecar.exists():
                sync_file(sidecar)
                sidecar.rename(final.with_name(final.name + SIDECAR))


def jpeg_picture(planes: Planes, bands: Sequence[str]) -> bytes:
    """8 bits: the first three bands, else grey; one stretch for all of 16-bit pixels."""
    chosen = planes[:3] if len(planes) >= 3 else planes[:1]
    if chosen.dtype == np.uint8:
        grey = np.asarray(chosen, np.uint8)
    else:
        sample = chosen[:, ::8, ::8]
        seen = sample[sample > 0]
        low, high = np.percentile(seen, (0.5, 99.5)) if seen.size else (0.0, 1.0)
        unit = np.clip((chosen.astype(np.float32) - low) / max(float(high - low), 1.0), 0.0, 1.0)
        grey = (255.0 * unit**0.6).astype(np.uint8)
    picture = grey[0] if len(grey) == 1 else np.ascontiguousarray(np.moveaxis(grey, 0, -1))
    return jpeg_bytes(picture, quality=JPEG_QUALITY)


def left_out_of_jpeg(bands: Sequence[str]) -> tuple[str, ...]:
    """Bands that a JPEG of three bands cannot hold."""
    return tuple(bands[3:]) if len(bands) >= 3 else tuple(bands[1:])
