"""Residuals of the stitching as few numbers: vectors to lay over a picture, figures per overlap.

The full drawing is in `processing.mosaic.mosaic_plots`.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import vip_mm_from_raw, vip_px_from_mm
from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic.free_mosaic import Mosaic
from processing.rig import Rig, VirtualImage

VECTORS_MAX: Final = 600


def residual_vectors(rig: Rig, tie_points: TiePoints, mosaic: Mosaic) -> dict[str, Any]:
    """JSON-ready: positions of tie points in the virtual image and their residuals.

    Args:
        rig: the camera.
        tie_points: those the mosaic is of.
        mosaic: the adjustment.

    Returns:
        `width_px`, `height_px` of the virtual image; `overlaps`, for every searched pair of
        sensors: `sensors`, `sought`, `found`, `used`, `rms_px` (of used points, null without any);
        `vectors`, at most VECTORS_MAX, evenly thinned: [column, row, right, down, kind], pixels of
        the virtual image, kind 0 between PAN sensors, 1 PAN to colour, 2 left out by data snooping.

    Raises:
        ValueError: a rig without virtual image.
    """
    image = rig.virtual_image
    if image is None:
        raise ValueError(f"rig {rig.name} has no virtual image to lay residuals over")
    known = np.isfinite(mosaic.residuals_px).all(axis=1)
    used = known & ~mosaic.outliers
    step = max(1, math.ceil(int(known.sum()) / VECTORS_MAX))
    chosen = np.flatnonzero(known)[::step]
    at = places_px(image, tie_points, mosaic, chosen)
    kinds = np.where(tie_points.kind == PAN_TO_PAN, 0, 1)
    kinds[mosaic.outliers] = 2
    return {
        "width_px": image.width_px,
        "height_px": image.height_px,
        "overlaps": [
            _overlap(tie_points, mosaic, index, used) for index in range(len(tie_points.pairs))
        ],
        "vectors": [
            [round(float(c)), round(float(r)), round(float(dx), 3), round(float(-dy), 3), int(kind)]
            for (c, r), (dx, dy), kind in zip(
                at, mosaic.residuals_px[chosen], kinds[chosen], strict=True
            )
        ],
    }


def places_px(
    image: VirtualImage, tie_points: TiePoints, mosaic: Mosaic, chosen: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Where some tie points are in the virtual image, by the first of their two sensors.

    Args:
        image: the virtual image.
        tie_points: those the mosaic is of.
        mosaic: the adjustment.
        chosen: numbers of the points, (n,).

    Returns:
        Column and row, (n, 2), px.
    """
    at = np.zeros((len(chosen), 2))
    sensors = tie_points.sensor_a[chosen]
    for index in np.unique(sensors):
        rows = sensors == index
        placement = mosaic.placements[tie_points.names[index]]
        raw = tie_points.raw_a[chosen[rows]]
        at[rows] = vip_px_from_mm(image, vip_mm_from_raw(placement, raw))
    return at


def _overlap(tie_points: TiePoints, mosaic: Mosaic, index: int, used: Any) -> dict[str, Any]:
    rows = tie_points.overlap == index
    residuals = mosaic.residuals_px[rows & used]
    rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))) if len(residuals) else None
    return {
        "sensors": list(tie_points.pairs[index]),
        "sought": int(tie_points.attempted[index]),
        "found": int(rows.sum()),
        "used": len(residuals),
        "rms_px": None if rms is None else round(rms, 4),
    }
