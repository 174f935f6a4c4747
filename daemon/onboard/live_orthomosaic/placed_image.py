"""One image of the live orthomosaic: reduced pixels, pose, the cells that it covers, its gain.

A cell is a block of map pixels that is taken from one image. Cells are counted from the north-west
corner of the level, in columns to the east and rows to the south.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.onboard.live_orthomosaic.map_ground import MapGround
from daemon.onboard.live_orthomosaic.web_tiles import map_grid, map_px, map_surface
from daemon.orientation.local_frame import LocalFrame
from processing.image.orthoimage.ground_resampling import (
    ImagePose,
    reduced_image,
    resample_to_ground,
)
from processing.image.orthoimage.levelling import GainField, ImageLevels

Array = NDArray[np.float64]

CELL_PX: Final = 16
DEPRESSION_MIN_DEG: Final = 20.0
"""An image that looks higher with a corner is not placed."""
FOOTPRINT_MAX_PX: Final = 20e6
"""A larger footprint on the map would not fit into the memory of the process."""
_STRIP_ROWS: Final = 64
_MARGIN: Final = 0.15
"""Of the footprint on each side, for relief."""


@dataclass
class PlacedImage:
    """An image in the map.

    Attributes:
        number: of the exposure.
        pose: of the reduced image, in the local frame.
        ground_m: height of the ground below it.
        corners_px: (5, 2), where its corners and middle lie in the map.
        nadir_px: (2,), where the camera was, in the map.
        levels: logarithm of its signal on the cells that it covers; NaN elsewhere.
        gain: its gain and haze; rows and columns in cells.
        is_measured: its orientation is the measured one, no image ties it.
    """

    number: int
    pose: ImagePose
    ground_m: float
    corners_px: Array
    nadir_px: Array
    levels: ImageLevels
    gain: GainField
    is_measured: bool = False
    is_levelled: bool = False

    @property
    def covered(self) -> tuple[slice, slice]:
        """Rows and columns of its cells."""
        rows, columns = self.levels.log_signal.shape[1:]
        return (
            slice(self.levels.row, self.levels.row + rows),
            slice(self.levels.column, self.levels.column + columns),
        )


def reduced_by(pixels: NDArray[np.uint16], factor: int) -> NDArray[np.uint16]:
    """Means of blocks of pixels, strip by strip; 0 where a pixel of the block has no data.

    Args:
        pixels: (h, w).
        factor: pixels to a block along each axis.
    """
    if factor == 1:
        return np.ascontiguousarray(pixels)
    strips = []
    rows = factor * _STRIP_ROWS
    for first in range(0, pixels.shape[0], rows):
        strip = pixels[first : first + rows]
        if strip.shape[0] >= factor:
            strips.append(np.rint(reduced_image(strip[None], factor)[0]).astype(np.uint16))
    return np.concatenate(strips)


def corners_in_map(pose: ImagePose, ground_m: float, frame: LocalFrame, zoom: int) -> Array | None:
    """Where the corners and the middle of an image lie, (5, 2), map pixels.

    Args:
        pose: in the local frame.
        ground_m: height of level ground above the ellipsoid.
        frame: the local frame.
        zoom: level.

    Returns:
        The places; None if a corner looks nearly to the horizon, or up, or if they span more than
        `FOOTPRINT_MAX_PX`.
    """
    x, y = pose.principal
    ends = [(c, r) for r in (-0.5, pose.height_px - 0.5) for c in (-0.5, pose.width_px - 0.5)]
    ends.append(((pose.width_px - 1) / 2.0, (pose.height_px - 1) / 2.0))
    rays = np.array([[c - x, y - r, -pose.f_mm / pose.pixel_mm] for c, r in ends])
    place = frame.to_geodetic(pose.centre_m[None])[0]
    enu = frame.local_from_enu(float(place[0]), float(place[1])).T @ pose.rotation
    ways = rays @ enu.T
    slope = math.tan(math.radians(DEPRESSION_MIN_DEG))
    if (-ways[:, 2] < np.hypot(ways[:, 0], ways[:, 1]) * slope).any() or place[2] <= ground_m:
        return None
    ways *= ((place[2] - ground_m) / -ways[:, 2])[:, None]
    there = pose.centre_m + ways @ frame.local_from_enu(float(place[0]), float(place[1])).T
    geodetic = frame.to_geodetic(there)
    found = map_px(zoom, geodetic[:, 0], geodetic[:, 1], frame.longitude_deg)
    return found if np.prod(np.ptp(found, axis=0)) <= FOOTPRINT_MAX_PX else None


def covered_cells(
    small: NDArray[np.uint16],
    pose: ImagePose,
    corners_px: Array,
    zoom: int,
    ground: MapGround,
    frame: LocalFrame,
) -> ImageLevels:
    """The cells that an image covers whole, with the logarithm of their mean signal.

    Args:
        small: (h, w), the reduced image.
        pose: of it.
        corners_px: (5, 2), map pixels.
        zoom: level.
        ground: its heights.
        frame: the local frame.
    """
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    margin = _MARGIN * (high - low)
    first = np.floor((low - margin) / CELL_PX).astype(int)
    last = np.ceil((high + margin) / CELL_PX).astype(int)
    grid = map_grid(
        zoom,
        int(first[0]) * CELL_PX,
        int(first[1]) * CELL_PX,
        int(last[0] - first[0]) * CELL_PX,
        int(last[1] - first[1]) * CELL_PX,
    )
    found = resample_to_ground(
        small[None], pose, map_surface(grid, ground, frame), interpolation="bilinear"
    )[0]
    parts = found.reshape(grid.height_px // CELL_PX, CELL_PX, grid.width_px // CELL_PX, CELL_PX)
    whole = (parts > 0.0).all(axis=(1, 3))
    signal = np.log(np.maximum(parts.mean(axis=(1, 3)), 1e-3)).astype(np.float32)
    signal[~whole] = np.nan
    rows, columns = np.nonzero(whole)
    if not len(rows):
        return ImageLevels(int(first[1]), int(first[0]), np.full((1, 1, 1), np.nan, np.float32))
    part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    return ImageLevels(
        int(first[1] + rows.min()),
        int(first[0] + columns.min()),
        np.ascontiguousarray(signal[part])[None],
    )


def flat_gain(levels: ImageLevels, log_gain: float = 0.0) -> GainField:
    """One gain for a whole image, no haze."""
    rows, columns = (float(max(n - 1, 1)) for n in levels.log_signal.shape[1:])
    nodes = np.ones((1, 2, 2))
    return GainField(levels.row, levels.column, (rows, columns), log_gain * nodes, 0.0 * nodes)
