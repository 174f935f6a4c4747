"""Tiles of the web map grid as ground grids: levels by GSD, and the surface under a tile.

Places are in pixels of one level, from its north-west corner, x to the east, y to the south.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.onboard.live_orthomosaic.map_ground import MapGround
from daemon.onboard.monitoring.maps.tiles import EARTH_HALF_M, TILE_PX, ZOOM_MAX
from daemon.orientation.local_frame import LocalFrame
from processing.image.orthoimage.ground_grid import GroundGrid, GroundSurface, ground_surface

Array = NDArray[np.float64]

HEIGHT_STEP_PX: Final = 4
"""Heights are read at every so many pixels; bilinear between."""
_RADIUS_M: Final = EARTH_HALF_M / math.pi


def pixel_m(zoom: int) -> float:
    """Size of a pixel of a level in metres of the web Mercator plane."""
    return 2.0 * EARTH_HALF_M / TILE_PX / (1 << zoom)


def gsd_m(zoom: int, latitude_deg: float) -> float:
    """Ground sampling distance of a level at a latitude, m."""
    return pixel_m(zoom) * math.cos(math.radians(latitude_deg))


def zoom_of(wanted_gsd_m: float, latitude_deg: float) -> int:
    """The level whose ground sampling distance is nearest to one, by ratio."""
    return min(max(round(math.log2(gsd_m(0, latitude_deg) / wanted_gsd_m)), 0), ZOOM_MAX)


def map_px(zoom: int, latitude_deg: Array, longitude_deg: Array, near_deg: float = 0.0) -> Array:
    """Places in pixels of a level, (n, 2); integers are corners of pixels.

    Columns go on beyond the antimeridian from the longitude `near_deg` on.
    """
    turns = np.round((near_deg - np.asarray(longitude_deg)) / 360.0)
    x_m = np.radians(longitude_deg + 360.0 * turns) * _RADIUS_M
    y_m = np.arcsinh(np.tan(np.radians(latitude_deg))) * _RADIUS_M
    return np.stack([x_m + EARTH_HALF_M, EARTH_HALF_M - y_m], axis=-1) / pixel_m(zoom)


def geodetic_of_mercator(east_m: Array, north_m: Array) -> tuple[Array, Array]:
    """Latitude and longitude, deg, of places in the web Mercator plane."""
    latitude = np.degrees(np.arctan(np.sinh(north_m / _RADIUS_M)))
    return latitude, np.degrees(east_m / _RADIUS_M)


def map_grid(zoom: int, column_px: int, row_px: int, width: int, height: int) -> GroundGrid:
    """Pixels of a level as a grid in the web Mercator plane."""
    size = pixel_m(zoom)
    east = (column_px + 0.5) * size - EARTH_HALF_M
    return GroundGrid(east, EARTH_HALF_M - (row_px + 0.5) * size, size, width, height)


def map_surface(grid: GroundGrid, ground: MapGround, frame: LocalFrame) -> GroundSurface:
    """Surface under a grid of the web Mercator plane, in the local frame."""
    steps = [-(-(n - 1) // HEIGHT_STEP_PX) + 1 for n in (grid.height_px, grid.width_px)]
    rows, columns = (np.arange(max(n, 2)) * HEIGHT_STEP_PX * grid.gsd_m for n in steps)
    east, north = np.meshgrid(grid.east_m + columns, grid.north_m - rows)
    nodes = ground.heights_m(*geodetic_of_mercator(east, north))
    heights = _between(nodes, grid)
    reference_m = float(heights.mean())

    def cartesian(points_m: Array) -> Array:
        latitude, longitude = geodetic_of_mercator(points_m[:, 0], points_m[:, 1])
        return frame.from_geodetic(latitude, longitude, points_m[:, 2])

    surface = ground_surface(grid, reference_m, cartesian)
    return replace(surface, above_m=(heights - reference_m).astype(np.float32))


def _between(nodes: Array, grid: GroundGrid) -> Array:
    """Heights of all pixels, (height, width), bilinear between nodes."""
    rows, columns = (np.arange(n, dtype=np.float32) / HEIGHT_STEP_PX
                     for n in (grid.height_px, grid.width_px))  # fmt: skip
    x, y = np.meshgrid(columns, rows)
    low = float(nodes.mean())
    # Single precision holds millimetres of what lies about the mean.
    found = cv2.remap(
        (nodes - low).astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(found, dtype=np.float64) + low
