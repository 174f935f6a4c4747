"""Patterns of displacements that stitching may have left in one image.

The covariance of the adjusted placements of its sensors, evaluated over the image, is reduced to a
few patterns for the bundle adjustment. Calibration and temperature of the datum are common to all
images of a camera and are not in it.

Source: docs/explanation/mathematics/bundle.md#patterns-of-stitched-images.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from processing.bundle.frame_patterns import FramePatterns, patterns_of
from processing.bundle.self_calibration import parts_of
from processing.geometry.placement import vip_mm_from_raw
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.precision import placed_covariance_px
from processing.rig import Rig

_SIDE: Final = 7
"""Places along each side of a sensor at which the covariance is evaluated."""


def stitching_patterns(rig: Rig, mosaic: Mosaic) -> FramePatterns:
    """Patterns of one stitched image.

    Args:
        rig: the camera, with a stitched image.
        mosaic: what the image was made with.

    Returns:
        At most eight patterns, mm.

    Raises:
        ValueError: a rig without a stitched image.
    """
    parts = parts_of(rig)
    points, owner, places = {}, [], []
    for number, part in enumerate(parts):
        sensor = next(s for s in rig.sensors if s.name == part.sensor)
        placement = mosaic.placements.get(part.sensor)
        if placement is None:
            continue
        columns = (np.arange(_SIDE) + 0.5) / _SIDE * sensor.width_px - 0.5
        rows = (np.arange(_SIDE) + 0.5) / _SIDE * sensor.height_px - 0.5
        colrow = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        points[part.sensor] = colrow
        owner.append(np.full(len(colrow), number, dtype=np.int64))
        places.append(vip_mm_from_raw(placement, colrow))
    ties, _ = placed_covariance_px(rig, mosaic, points, {})
    return patterns_of(
        parts,
        np.concatenate(owner),
        np.concatenate(places),
        ties * mosaic.model.pitch_mm**2,
        mosaic.model.half_size_mm,
    )
