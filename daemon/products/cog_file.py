"""Cloud Optimized GeoTIFFs, written window by window.

GDAL makes a COG from a plain GeoTIFF, which is written first.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.base.extras import require

_RGB: Final = ("red", "green", "blue")


@dataclass(frozen=True)
class CogLayout:
    """Size, place and bands of a COG; 0 is no data.

    Attributes:
        crs: EPSG code or WKT.
        west_m, north_m: corner of the first pixel, in units of the coordinate system.
        pixel_m: size of a pixel.
        bands: names, in order; red, green and blue are interpreted as colours.
        block_px: side of an inner tile.
        is_sparse: inner tiles without data are left out.
        cache_mb: memory of GDAL for blocks.
    """

    width_px: int
    height_px: int
    crs: str
    west_m: float
    north_m: float
    pixel_m: float
    bands: Sequence[str]
    dtype: Literal["uint8", "uint16"] = "uint16"
    block_px: int = 512
    is_sparse: bool = False
    cache_mb: int = 128


class WindowWriter(Protocol):
    """Writes planes (bands, h, w) with the first pixel at a column and row."""

    def __call__(self, planes: NDArray[Any], column: int, row: int) -> None: ...


@contextmanager
def new_cog(
    final: Path, plain: Path, layout: CogLayout, tags: Mapping[str, str]
) -> Iterator[WindowWriter]:
    """A COG that is made when the block ends.

    Args:
        final: the COG; an unfinished file under a name that is not published yet.
        plain: the plain GeoTIFF; it is removed.
        layout: of the COG.
        tags: texts of the file.

    Yields:
        Writes a window.

    Raises:
        MissingExtraError: rasterio is not installed.
        OSError: the disk refused.
    """
    require("geotiff")
    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.enums import ColorInterp
    from rasterio.errors import RasterioError
    from rasterio.shutil import copy
    from rasterio.transform import Affine
    from rasterio.windows import Window

    settings = {"GDAL_CACHEMAX": layout.cache_mb, "GDAL_PAM_ENABLED": "NO"}
    size, names = layout.pixel_m, tuple(layout.bands)
    try:
        with (
            rasterio.Env(**settings),
            rasterio.open(
                plain, "w", driver="GTiff", width=layout.width_px, height=layout.height_px,
                count=len(names), dtype=layout.dtype, nodata=0, crs=layout.crs, tiled=True,
                blockxsize=layout.block_px, blockysize=layout.block_px,
                SPARSE_OK=layout.is_sparse,
                transform=Affine(size, 0.0, layout.west_m, 0.0, -size, layout.north_m),
                photometric="RGB" if len(names) == len(_RGB) else "MINISBLACK",
                BIGTIFF="IF_SAFER",
            ) as raster,
        ):  # fmt: skip
            if names == _RGB:
                raster.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
            for number, name in enumerate(names, 1):
                raster.set_band_description(number, name)
            raster.update_tags(**tags)

            def write(planes: NDArray[Any], column: int, row: int) -> None:
                height, width = planes.shape[-2:]
                raster.write(np.asarray(planes), window=Window(column, row, width, height))

            yield write
        sparse = {"SPARSE_OK": "TRUE"} if layout.is_sparse else {}
        with rasterio.Env(**settings):
            copy(
                str(plain), str(final), driver="COG", COMPRESS="DEFLATE", PREDICTOR="2",
                LEVEL="1", BLOCKSIZE=str(layout.block_px), OVERVIEW_RESAMPLING="AVERAGE",
                BIGTIFF="IF_SAFER", **sparse,
            )  # fmt: skip
    except (RasterioError, CPLE_BaseError) as error:
        # GDAL's own errors, such as those of a full disk, are no OSError.
        raise OSError(f"the GeoTIFF cannot be written ({error}); check the disk's space") from error
    finally:
        plain.unlink(missing_ok=True)
