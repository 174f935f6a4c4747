"""Hill shade from the height model of the plan, as a transparent layer over the base map.

Source: Horn (1981), slope by third-order differences; light from the north-west, 45 deg high.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.onboard.monitoring.maps.pictures import encode
from daemon.onboard.monitoring.maps.tiles import (
    TILE_PX,
    ZOOM_MAX,
    MapDescription,
    Tile,
    checked_bounds,
    mercator_bounds_m,
    tile_bounds,
)
from daemon.orientation.geodesy import GEOGRAPHIC, Transformer
from daemon.planning.relief import TerrainRelief

AZIMUTH_DEG: Final = 315.0
ELEVATION_DEG: Final = 45.0
EXAGGERATION: Final = 1.5
Array = NDArray[np.float64]


class HillShadeMap:
    """Shades of a height model.

    Args:
        relief: the height model and its system.
    """

    def __init__(self, relief: TerrainRelief) -> None:
        self._model = relief.model
        plan = relief.system.crs
        plan = plan.sub_crs_list[0] if plan.is_compound else plan
        self._from_mercator = Transformer.from_crs("EPSG:3857", plan, always_xy=True)
        to_geographic = Transformer.from_crs(plan, GEOGRAPHIC, always_xy=True)
        height, width = self._model.height_m.shape
        x = (self._model.x_m, self._model.x_m + (width - 1) * self._model.step_x_m)
        y = (self._model.y_m, self._model.y_m + (height - 1) * self._model.step_y_m)
        bounds = to_geographic.transform_bounds(min(x), min(y), max(x), max(y))
        cell_m = min(abs(self._model.step_x_m), abs(self._model.step_y_m))
        latitude = math.radians((bounds[1] + bounds[3]) / 2)
        last = math.ceil(math.log2(40075016.7 * math.cos(latitude) / TILE_PX / max(cell_m, 0.1)))
        self.description = MapDescription(
            "hill shade",
            "raster",
            0,
            min(max(last, 0), ZOOM_MAX),
            checked_bounds(bounds, "the height model"),
        )

    def tile(self, zoom: int, x: int, y: int) -> Tile | None:
        """The tile: black where light is missing, white where it is more, else transparent."""
        left, _, right, top = mercator_bounds_m(zoom, x, y)
        pixel_m = (right - left) / TILE_PX
        columns = left + (np.arange(-1, TILE_PX + 1) + 0.5) * pixel_m
        rows = top - (np.arange(-1, TILE_PX + 1) + 0.5) * pixel_m
        east, north = np.meshgrid(columns, rows)
        xy = np.column_stack(self._from_mercator.transform(east.ravel(), north.ravel()))
        finite = np.isfinite(xy).all(axis=1)
        heights = np.full(len(xy), np.nan)
        if finite.any():
            heights[finite] = self._model.at(xy[finite])
        _, south, _, north_deg = tile_bounds(zoom, x, y)
        scale = math.cos(math.radians((south + north_deg) / 2))
        light = shade(heights.reshape(east.shape), pixel_m * scale)
        known = np.isfinite(light)
        if not known.any():
            return None
        flat = math.sin(math.radians(ELEVATION_DEG))
        contrast = np.nan_to_num(light - flat)
        white = (contrast > 0).astype(np.uint8) * 255
        alpha = np.clip(np.abs(contrast) * 255, 0, 170) * known
        return encode(white, np.minimum(alpha, 254).astype(np.uint8))

    def close(self) -> None:
        """Nothing is open."""


def shade(heights: Array, cell_m: float) -> NDArray[Any]:
    """Brightness of a surface, 0 to 1.

    Args:
        heights: shape (h + 2, w + 2), m, north up, NaN where not known.
        cell_m: distance of two heights, m.

    Returns:
        Shape (h, w); NaN where a height is missing.

    Example:
        >>> shade(np.zeros((3, 3)), 10.0).round(3)
        array([[0.707]])
    """
    z = heights * EXAGGERATION
    west = z[:-2, :-2] + 2 * z[1:-1, :-2] + z[2:, :-2]
    east = z[:-2, 2:] + 2 * z[1:-1, 2:] + z[2:, 2:]
    north = z[:-2, :-2] + 2 * z[:-2, 1:-1] + z[:-2, 2:]
    south = z[2:, :-2] + 2 * z[2:, 1:-1] + z[2:, 2:]
    rise_east, rise_north = (east - west) / (8 * cell_m), (north - south) / (8 * cell_m)
    azimuth, elevation = math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG)
    to_light = (
        math.cos(elevation) * math.sin(azimuth),
        math.cos(elevation) * math.cos(azimuth),
        math.sin(elevation),
    )
    normal = 1.0 / np.sqrt(rise_east**2 + rise_north**2 + 1.0)
    light = (to_light[2] - to_light[0] * rise_east - to_light[1] * rise_north) * normal
    return np.clip(light, 0.0, 1.0)
