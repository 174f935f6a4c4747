"""Patterns of displacements that stitching may have left in one image.

The covariance of the adjusted placements of its sensors, evaluated over the image, is reduced to a
few patterns for the bundle adjustment. Calibration and temperature of the datum are common to all
images of a camera and are not in it.

Source: docs/explanation/mathematics/bundle.md#patterns-of-stitched-images.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from processing.bundle.frame_patterns import MAX_PATTERNS, FramePatterns, patterns_of
from processing.bundle.self_calibration import parts_of
from processing.bundle.terms import Part
from processing.geometry.placement import vip_mm_from_raw
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.precision import placed_design_px
from processing.rig import Rig

PATTERNS_KEY: Final = "patterns"
"""In `mosaic.json`."""
_DIGITS: Final = 7
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
    values, vectors = np.linalg.eigh(mosaic.covariance)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    return patterns_of(
        parts,
        np.concatenate(owner),
        np.concatenate(places),
        placed_design_px(mosaic, points) @ root * mosaic.model.pitch_mm,
        mosaic.model.half_size_mm,
    )


def patterns_json(patterns: FramePatterns) -> dict[str, Any]:
    """Patterns as JSON-ready data, lengths in mm.

    Args:
        patterns: of one image.

    Returns:
        Half size of the image, share of the variance, parts, and coefficients by pattern, part,
        power and axis.
    """
    return {
        "half_size_mm": patterns.half_size_mm,
        "share": float(f"{patterns.share:.{_DIGITS}g}"),
        "parts": [
            {"sensor": part.sensor, "cone": part.cone, "mm": [
                part.x_min_mm, part.y_min_mm, part.x_max_mm, part.y_max_mm]}
            for part in patterns.parts
        ],
        "coefficients": [
            [[[float(f"{v:.{_DIGITS}g}") for v in power] for power in part] for part in pattern]
            for pattern in patterns.coefficients
        ],
    }  # fmt: skip


def patterns_from_json(content: Mapping[str, Any]) -> FramePatterns:
    """Read what `patterns_json` made.

    Args:
        content: parsed JSON.

    Returns:
        The patterns.

    Raises:
        ValueError: a key is missing, a value is none, or sizes do not fit.
    """
    try:
        parts = tuple(
            Part(str(one["sensor"]), str(one["cone"]), *(float(v) for v in one["mm"]))
            for one in content["parts"]
        )
        shape = (-1, len(parts), 6, 2)
        coefficients = np.array(content["coefficients"], dtype=np.float64).reshape(shape)
        half_size_mm, share = float(content["half_size_mm"]), float(content["share"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"patterns of stitching cannot be used: {error!r}") from error
    if not parts or not np.isfinite(coefficients).all() or not half_size_mm > 0.0:
        raise ValueError("patterns of stitching cannot be used: no parts, or values out of range")
    if len(coefficients) > MAX_PATTERNS:
        raise ValueError(f"{len(coefficients)} patterns of stitching; at most {MAX_PATTERNS}")
    return FramePatterns(parts, coefficients, half_size_mm, share)
