"""The plan's height model in the local frame of a block, so that matches are predicted on it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.onboard.triangulation.height_model_check import read_relief
from daemon.orientation.exterior_orientation import mount_of
from daemon.orientation.local_frame import LocalFrame
from daemon.planning.relief import TerrainRelief
from daemon.postflight.triangulation.triangulation import ImageBlock
from processing.geometry.terrain_rays import HeightModel
from processing.matching.block_matching import rays_of

Array = NDArray[np.float64]

_NODES_MAX: Final = 600
"""Of the local grid along its longer side."""
_REACH: Final = 5.0
"""Ground farther from its image than so many flying heights is not covered."""


def heights_of(block: ImageBlock) -> HeightModel | None:
    """Heights under a block, by the height model of its plan.

    Args:
        block: in its local frame.

    Returns:
        Local heights; None without a height model that can be read. Ground that the model does not
        cover is as high as the plan's.
    """
    relief, _ = read_relief(mount_of(block.mission)[1])
    return None if relief is None else local_heights(relief, block.frame, _corners_m(block))


def local_heights(relief: TerrainRelief, frame: LocalFrame, places_m: Array) -> HeightModel:
    """A grid of local heights over places.

    Args:
        relief: heights above the plan's ground, by latitude and longitude.
        frame: the local frame.
        places_m: (n, 2) or (n, 3), east and north; the grid covers them.

    Returns:
        Heights by east and north, m, rows from north to south.
    """
    low, high = places_m[:, :2].min(axis=0), places_m[:, :2].max(axis=0)
    native_m = min(abs(relief.model.step_x_m), abs(relief.model.step_y_m))
    step = max(float((high - low).max()) / (_NODES_MAX - 3), native_m)
    x = np.arange(low[0] - step, high[0] + 2.0 * step, step)
    y = np.arange(high[1] + step, low[1] - 2.0 * step, -step)
    east, north = np.meshgrid(x, y)
    ground = np.full(east.shape, relief.ground_height_m)
    local = np.stack([east, north, ground], axis=-1)
    geodetic = frame.to_geodetic(local.reshape(-1, 3)).reshape(*east.shape, 3)
    height = relief.ground_height_m + relief(geodetic[..., :2])
    at = frame.from_geodetic(geodetic[..., 0].ravel(), geodetic[..., 1].ravel(), height.ravel())
    return HeightModel(at[:, 2].reshape(east.shape), float(x[0]), float(y[0]), step, -step)


def _corners_m(block: ImageBlock) -> Array:
    """Where the corners of all images meet level ground, and what is below the images."""
    image = block.image
    last = (image.width_px - 1.0, image.height_px - 1.0)
    px = np.array([(0.0, 0.0), (last[0], 0.0), (0.0, last[1]), last])
    found = [block.station_m]
    for place, rotation in zip(block.station_m, block.rotation, strict=True):
        rays = rays_of(image, rotation, px)
        above = place[2] - block.ground_m
        slope = np.hypot(rays[:, 0], rays[:, 1]) / np.maximum(-rays[:, 2], 1e-9)
        reach = above * np.minimum(slope, _REACH)
        sideways = rays[:, :2] / np.maximum(np.linalg.norm(rays[:, :2], axis=1), 1e-9)[:, None]
        at = place[:2] + sideways * reach[:, None]
        found.append(np.column_stack([at, np.full(len(at), block.ground_m)]))
    return np.concatenate(found)
