"""Files of the live orthomosaic at landing: a COG of its signals, a PMTiles file of its pictures.

Both are in the web Mercator plane (EPSG:3857) and marked preliminary.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from daemon.mission.store import durable
from daemon.onboard.live_orthomosaic.live_orthomosaic import LiveOrthomosaic
from daemon.onboard.live_orthomosaic.map_layout import TileId, tile_file
from daemon.onboard.live_orthomosaic.pmtiles_file import write_pmtiles
from daemon.onboard.live_orthomosaic.web_tiles import pixel_m
from daemon.onboard.monitoring.maps.tiles import EARTH_HALF_M, TILE_PX, Bounds, tile_bounds
from drivers.base.extras import require

COG_FILE: Final = "orthomosaic.tif"
PMTILES_FILE: Final = "orthomosaic.pmtiles"
BLOCK_PX: Final = 256
_SETTINGS: Final = {"GDAL_CACHEMAX": 64, "GDAL_PAM_ENABLED": "NO"}


def write_cog(live: LiveOrthomosaic, path: Path, tags: Mapping[str, str]) -> int:
    """Write the finest tiles as one Cloud Optimized GeoTIFF, 16 bits, linear, 0 is no data.

    Args:
        live: with at least one tile.
        path: final name of the file.
        tags: texts of the file.

    Returns:
        Its size in bytes.

    Raises:
        MissingExtraError: rasterio is not installed.
        OSError: the disk refused.
    """
    require("geotiff")
    import rasterio
    from rasterio.shutil import copy
    from rasterio.transform import Affine
    from rasterio.windows import Window

    tiles = live.tiles
    left, top = min(t[1] for t in tiles), min(t[2] for t in tiles)
    width = (max(t[1] for t in tiles) - left + 1) * TILE_PX
    height = (max(t[2] for t in tiles) - top + 1) * TILE_PX
    size = pixel_m(live.zoom)
    corner = (left * TILE_PX * size - EARTH_HALF_M, EARTH_HALF_M - top * TILE_PX * size)
    with durable.new_file(path) as part:
        plain = part.with_suffix(".plain.tif")
        try:
            with (
                rasterio.Env(**_SETTINGS),
                rasterio.open(
                    plain, "w", driver="GTiff", width=width, height=height, count=1,
                    dtype="uint16", nodata=0, crs="EPSG:3857", tiled=True,
                    blockxsize=BLOCK_PX, blockysize=BLOCK_PX, SPARSE_OK=True,
                    transform=Affine(size, 0.0, corner[0], 0.0, -size, corner[1]),
                    photometric="MINISBLACK", BIGTIFF="IF_SAFER",
                ) as raster,
            ):  # fmt: skip
                raster.set_band_description(1, "pan")
                raster.update_tags(**tags)
                for tile in tiles:
                    signal = live.files.signal(tile)
                    if signal is None:
                        continue
                    column, row = (tile[1] - left) * TILE_PX, (tile[2] - top) * TILE_PX
                    raster.write(signal, 1, window=Window(column, row, TILE_PX, TILE_PX))
            with rasterio.Env(**_SETTINGS):
                copy(
                    str(plain), str(part), driver="COG", COMPRESS="DEFLATE", PREDICTOR="2",
                    LEVEL="1", BLOCKSIZE=str(BLOCK_PX), OVERVIEW_RESAMPLING="AVERAGE",
                    BIGTIFF="IF_SAFER", SPARSE_OK="TRUE",
                )  # fmt: skip
        finally:
            plain.unlink(missing_ok=True)
    return path.stat().st_size


def write_map(live: LiveOrthomosaic, path: Path, metadata: Mapping[str, Any]) -> int:
    """Write all published pictures as one PMTiles file.

    Args:
        live: with at least one published tile.
        path: final name of the file.
        metadata: name, attribution and more.

    Returns:
        Its size in bytes.

    Raises:
        OSError: the disk refused.
    """
    tiles = {
        tile: tile_file(live.files.folder, tile)
        for tile, state in live.files.states.items()
        if state.version
    }
    return write_pmtiles(path, tiles, bounds_of(live.tiles), metadata)


def bounds_of(tiles: list[TileId]) -> Bounds:
    """West, south, east and north of tiles, deg."""
    each = [tile_bounds(*tile) for tile in tiles]
    return (
        min(b[0] for b in each), min(b[1] for b in each),
        max(b[2] for b in each), max(b[3] for b in each),
    )  # fmt: skip
