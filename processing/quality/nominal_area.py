"""The valid area of an image by the calibration of its heads, without the image itself.

Missions recorded before quality reports held the valid area are counted by this, too.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache

import numpy as np

from processing.geometry.placement import nominal_placements, vip_mm_from_px, vip_mm_from_raw
from processing.quality.valid_area import Mask, ValidArea, area_of, grid_of
from processing.rig import Rig, VirtualImage


def nominal_area(rig: Rig, missing: Collection[str]) -> ValidArea:
    """What the image of a rig holds while some heads gave no frame.

    Args:
        rig: the camera.
        missing: sensors without a frame; names that the rig does not know are passed over.

    Returns:
        The valid area with its gaps by band.
    """
    return _nominal_area(rig, frozenset(missing))


@lru_cache(maxsize=64)
def _nominal_area(rig: Rig, missing: frozenset[str]) -> ValidArea:
    image = rig.virtual_image
    if image is not None:
        return _stitched(rig, image, missing)
    # Without a virtual image every band is a frame of its own.
    sensor = rig.cone(rig.image_cone_name).sensors[0]
    columns, rows = grid_of(sensor.width_px, sensor.height_px)
    cones = [c for c in rig.cones if c.name == rig.image_cone_name or len(c.bands) == 1]
    return area_of(
        {
            band: np.full((rows, columns), cone.sensors[0].name in missing)
            for cone in cones
            for band in cone.bands
        }
    )


def _stitched(rig: Rig, image: VirtualImage, missing: Collection[str]) -> ValidArea:
    columns, rows = grid_of(image.width_px, image.height_px)
    gaps: dict[str, Mask] = {"pan": np.ones((rows, columns), np.bool_)}
    across = (np.arange(columns) + 0.5) * image.width_px / columns - 0.5
    down = (np.arange(rows) + 0.5) * image.height_px / rows - 0.5
    middles = vip_mm_from_px(image, np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    placements = nominal_placements(rig, {}, {})
    for cone in rig.pan_cones:
        for sensor in cone.sensors:
            if sensor.name in missing:
                continue
            right, low = sensor.width_px - 0.5, sensor.height_px - 0.5
            around = np.array([[-0.5, -0.5], [right, -0.5], [right, low], [-0.5, low]])
            outline = vip_mm_from_raw(placements[sensor.name], around)
            gaps["pan"] &= ~_inside(outline, middles).reshape(rows, columns)
    for cone in rig.colour_cones:
        is_missing = all(sensor.name in missing for sensor in cone.sensors)
        gaps |= {band: np.full((rows, columns), is_missing) for band in cone.bands}
    return area_of(gaps)


def _inside(outline: np.ndarray, points: np.ndarray) -> Mask:
    """Which points lie inside a convex polygon, whichever way round it is given."""
    sides = np.roll(outline, -1, axis=0) - outline
    away = points[:, None, :] - outline
    orientation_signs = sides[:, 0] * away[..., 1] - sides[:, 1] * away[..., 0]
    inside: Mask = np.all(orientation_signs >= 0.0, axis=1) | np.all(
        orientation_signs <= 0.0, axis=1
    )
    return inside
