"""Files of the live orthomosaic at landing: a COG of its signals, a PMTiles file of its pictures.

Both are in the web Mercator plane (EPSG:3857) and marked preliminary.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from daemon.mission.store import durable
from daemon.onboard.live_orthomosaic.live_orthomosaic import LiveOrthomosaic
from daemon.onboard.live_orthomosaic.map_layout import TileId, tile_file, world_tile
from daemon.onboard.live_orthomosaic.pmtiles_file import write_pmtiles
from daemon.onboard.live_orthomosaic.web_tiles import pixel_m
from daemon.onboard.monitoring.maps.tiles import EARTH_HALF_M, TILE_PX, Bounds, tile_bounds
from daemon.orientation.antimeridian import HALF_DEG
from daemon.products.cog_file import CogLayout, new_cog

COG_FILE: Final = "orthomosaic.tif"
PMTILES_FILE: Final = "orthomosaic.pmtiles"
BLOCK_PX: Final = 256
CACHE_MB: Final = 64


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
    tiles = live.tiles
    left, top = min(t[1] for t in tiles), min(t[2] for t in tiles)
    size = pixel_m(live.zoom)
    layout = CogLayout(
        width_px=(max(t[1] for t in tiles) - left + 1) * TILE_PX,
        height_px=(max(t[2] for t in tiles) - top + 1) * TILE_PX,
        crs="EPSG:3857",
        west_m=left * TILE_PX * size - EARTH_HALF_M,
        north_m=EARTH_HALF_M - top * TILE_PX * size,
        pixel_m=size,
        bands=("pan",),
        block_px=BLOCK_PX,
        is_sparse=True,
        cache_mb=CACHE_MB,
    )
    # In the folder of what is computed again after a restart: a killed process leaves nothing.
    plain = live.files.work / "plain.tif"
    with durable.new_file(path) as part, new_cog(part, plain, layout, tags) as write:
        for tile in tiles:
            signal = live.files.signal(tile)
            if signal is not None:
                write(signal[None], (tile[1] - left) * TILE_PX, (tile[2] - top) * TILE_PX)
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
        world_tile(tile): tile_file(live.files.folder, world_tile(tile))
        for tile, state in live.files.states.items()
        if state.version
    }
    return write_pmtiles(path, tiles, bounds_of(live.tiles), metadata)


def bounds_of(tiles: list[TileId]) -> Bounds:
    """West, south, east and north of tiles, deg; the whole circle across the antimeridian."""
    each = [tile_bounds(*tile) for tile in tiles]
    west, east = min(b[0] for b in each), max(b[2] for b in each)
    if west < -HALF_DEG or east > HALF_DEG:
        west, east = -HALF_DEG, HALF_DEG
    return west, min(b[1] for b in each), east, max(b[3] for b in each)
