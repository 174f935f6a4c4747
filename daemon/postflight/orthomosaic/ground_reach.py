"""How far an image reaches on the ground, from its own pixels and pose.

The grid's sampling distance has no part in it: a finer grid sees the same ground.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.terrain_rays import HeightModel
from processing.image.orthoimage.ground_resampling import ImagePose

Array = NDArray[Any]

DEPRESSION_MIN_DEG: Final = 20.0
"""An image that looks higher with a corner reaches without bound."""
_MARGIN: Final = 1.1
"""Allows for earth curvature between the axes of the frame and the vertical of an image."""


def corner_slope(pose: ImagePose) -> float:
    """Horizontal distance to the farthest corner of an image per metre of height; infinite where
    a corner looks higher than `DEPRESSION_MIN_DEG` below the horizon.

    Args:
        pose: in a frame whose third axis points up.
    """
    x, y = pose.principal
    ends = [(c, r) for c in (-0.5, pose.width_px - 0.5) for r in (-0.5, pose.height_px - 0.5)]
    rays = np.array([[c - x, y - r, -pose.f_mm / pose.pixel_mm] for c, r in ends])
    east, north, up = pose.rotation @ rays.T
    across = np.hypot(east, north)
    if (-up < across * math.tan(math.radians(DEPRESSION_MIN_DEG))).any():
        return math.inf
    return float((across / -up).max())


def ground_reach_m(
    pose: ImagePose, nadir_m: tuple[float, float], height_m: float, surface: HeightModel | float
) -> float:
    """Distance from the nadir within which an image sees ground.

    Args:
        pose: of the image.
        nadir_m: east and north in the system of the surface.
        height_m: of the camera.
        surface: heights of a model, or of a plane.
    """
    slope = corner_slope(pose) * _MARGIN
    if not isinstance(surface, HeightModel):
        return (height_m - surface) * slope
    reach = (height_m - float(np.nanmean(surface.height_m))) * slope
    # Ground that lies lower is seen farther away; ground far away that lies lower is not seen.
    for _ in range(3):
        reach = max(reach, (height_m - _lowest_m(surface, nadir_m, reach)) * slope)
    return reach


def _lowest_m(model: HeightModel, nadir_m: tuple[float, float], reach_m: float) -> float:
    """Lowest height of a model within a square; its mean where it is not known there."""
    parts = []
    for at, first, step, count in (
        (nadir_m[1], model.y_m, model.step_y_m, model.height_m.shape[0]),
        (nadir_m[0], model.x_m, model.step_x_m, model.height_m.shape[1]),
    ):
        ends = sorted((at + side * reach_m - first) / step for side in (-1.0, 1.0))
        parts.append(slice(max(math.floor(ends[0]), 0), max(min(math.ceil(ends[1]) + 1, count), 0)))
    part = model.height_m[parts[0], parts[1]]
    known = part[np.isfinite(part)]
    return float(known.min()) if known.size else float(np.nanmean(model.height_m))
