"""A GeoTIFF as a base map: windows are warped to the web Mercator grid, one tile at a time.

GDAL sees one open plain file, reads it as GeoTIFF only, and looks at nothing next to it. Levels at
which a tile would cover too many source pixels are not served unless the file has overviews.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.foreign_files import ForeignFileError, open_regular_file
from daemon.onboard.monitoring.maps.pictures import encode
from daemon.onboard.monitoring.maps.tiles import (
    EARTH_HALF_M,
    TILE_PX,
    ZOOM_MAX,
    BaseMapError,
    MapDescription,
    Tile,
    checked_bounds,
    mercator_bounds_m,
)
from drivers.base.extras import MissingExtraError, require

FILE_MAX_BYTES: Final = 1 << 42
SOURCE_PX_MAX: Final = 4096
"""Largest side of the source window of a tile, in pixels of the overview that is read."""
BLOCK_MAX_BYTES: Final = 64_000_000
"""A strip or tile of the file is decoded whole."""
CACHE_BYTES: Final = 32_000_000
STRETCH: Final = (2.0, 98.0)
_ENVIRONMENT: Final[dict[str, Any]] = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_GEOREF_SOURCES": "INTERNAL",
    "GDAL_NUM_THREADS": "1",
    "GDAL_CACHEMAX": CACHE_BYTES,
}
Array = NDArray[Any]


class GeotiffMap:
    """A map in one GeoTIFF, grey or colour, read-only.

    Raises:
        BaseMapError: no GeoTIFF with a coordinate system, or its blocks are too large.
    """

    def __init__(self, path: Path) -> None:
        try:
            require("geotiff")
        except MissingExtraError as error:
            raise BaseMapError(f"base map {path}: {error}") from error
        import os

        import rasterio

        self._name = f"base map {path.name}"
        try:
            with open_regular_file(path, FILE_MAX_BYTES) as descriptor:
                self._descriptor = os.dup(descriptor)
        except ForeignFileError as error:
            raise BaseMapError(f"base map {error}") from error
        opened = f"/proc/self/fd/{self._descriptor}"
        try:
            with rasterio.Env(**_ENVIRONMENT):
                self._raster = rasterio.open(opened, driver="GTiff", sharing=False)
                self.description = self._described(path)
                self._low, self._high = self._stretch()
        except (rasterio.errors.RasterioError, ValueError, MemoryError) as error:
            os.close(self._descriptor)
            found = str(error).replace(opened, path.name)
            raise BaseMapError(
                f"{self._name}: no GeoTIFF that can be read ({found}); write it with "
                "gdal_translate -of GTiff -co TILED=YES"
            ) from error
        except BaseMapError:
            os.close(self._descriptor)
            raise

    def tile(self, zoom: int, x: int, y: int) -> Tile | None:
        """The tile, as JPEG, or PNG at the border of the map.

        Raises:
            BaseMapError: the file is damaged.
        """
        import rasterio
        from rasterio.enums import Resampling
        from rasterio.transform import from_bounds
        from rasterio.vrt import WarpedVRT

        if not self.description.min_zoom <= zoom <= self.description.max_zoom:
            return None
        bounds = mercator_bounds_m(zoom, x, y)
        transform = from_bounds(*bounds, TILE_PX, TILE_PX)
        try:
            with (
                rasterio.Env(**_ENVIRONMENT),
                WarpedVRT(
                    self._raster,
                    crs="EPSG:3857",
                    transform=transform,
                    width=TILE_PX,
                    height=TILE_PX,
                    resampling=Resampling.bilinear,
                    add_alpha=not self._has_alpha,
                    warp_mem_limit=64,
                ) as warped,
            ):
                count = 3 if self._raster.count - self._has_alpha >= 3 else 1
                pixels = warped.read([*range(1, count + 1)])
                alpha = warped.read(warped.count)
        except (rasterio.errors.RasterioError, MemoryError) as error:
            raise BaseMapError(f"{self._name}: {error}; copy the file again") from error
        if not alpha.any():
            return None
        if pixels.dtype != np.uint8:
            span = max(self._high - self._low, 1e-9)
            scaled = (np.nan_to_num(pixels.astype(np.float32)) - self._low) * (255.0 / span)
            pixels = np.clip(scaled, 0, 255).astype(np.uint8)
        return encode(np.moveaxis(pixels, 0, -1), (alpha > 0).astype(np.uint8) * 255)

    def close(self) -> None:
        """Close the file."""
        import os

        self._raster.close()
        os.close(self._descriptor)

    def _described(self, path: Path) -> MapDescription:
        from rasterio.warp import transform_bounds

        raster = self._raster
        if raster.crs is None:
            raise BaseMapError(
                f"{self._name}: has no coordinate system; assign it with gdal_edit.py "
                "-a_srs EPSG:..."
            )
        rows, columns = raster.block_shapes[0]
        nbytes = rows * columns * raster.count * np.dtype(raster.dtypes[0]).itemsize
        if nbytes > BLOCK_MAX_BYTES:
            raise BaseMapError(
                f"{self._name}: its blocks have {nbytes} bytes, {BLOCK_MAX_BYTES} are allowed; "
                "write it with gdal_translate -co TILED=YES"
            )
        kinds = [item.name for item in raster.colorinterp]
        self._has_alpha = "alpha" in kinds
        west, south, east, north = transform_bounds(raster.crs, "EPSG:4326", *raster.bounds)
        bounds = checked_bounds((west, south, east, north), self._name)
        left, bottom, right, top = transform_bounds(
            "EPSG:4326", "EPSG:3857", *bounds, densify_pts=21
        )
        side_px = max(raster.width, raster.height)
        pixel_m = max((right - left) / raster.width, (top - bottom) / raster.height, 1e-3)
        last = zoom_of(pixel_m)
        overviews = raster.overviews(1)
        reach = SOURCE_PX_MAX * max(overviews, default=1) / TILE_PX
        first = max(0, last - int(math.log2(max(reach, 1.0))))
        if side_px <= SOURCE_PX_MAX * max(overviews, default=1):
            first = 0
        return MapDescription(path.stem[:100], "raster", first, last, bounds)

    def _stretch(self) -> tuple[float, float]:
        """Values shown as black and white, for other than 8 bits, from a thin sample."""
        raster = self._raster
        if raster.dtypes[0] == "uint8":
            return 0.0, 255.0
        from rasterio.windows import Window

        rows = np.linspace(0, raster.height - 1, 16).astype(int)
        samples = []
        for row in rows:
            window = Window(0, int(row), raster.width, 1)
            values = raster.read(1, window=window, masked=True, out_shape=(1, 256))
            samples.append(np.ma.compressed(values).astype(np.float64))
        known = np.concatenate(samples)
        known = known[np.isfinite(known)]
        if not len(known):
            return 0.0, 1.0
        low, high = np.percentile(known, STRETCH)
        return float(low), float(max(high, low + 1e-9))


def zoom_of(pixel_m: float) -> int:
    """The level whose pixels are as large, or the next finer one.

    Args:
        pixel_m: size of a pixel in EPSG:3857, m.

    Returns:
        The level.

    Example:
        >>> zoom_of(2 * 20037508.342789244 / 256), zoom_of(1.0)
        (0, 18)
    """
    exact = math.log2(2 * EARTH_HALF_M / TILE_PX / pixel_m)
    return min(max(math.ceil(exact - 1e-6), 0), ZOOM_MAX)
