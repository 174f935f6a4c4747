"""Levels of the colour bands of one exposure against PAN on the same ground.

What follows over a flight is in `processing.quality.level_steps`.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from processing.quality.common_windows import CommonWindows
from processing.quality.figures.image import BandLevelFigures
from processing.rig import Rig

MIN_WINDOWS: Final = 100


def level_figures(rig: Rig, ground: CommonWindows | None) -> BandLevelFigures | None:
    """Level of each band against PAN on the same ground.

    Args:
        rig: the camera.
        ground: windows that heads share; None where there are none.

    Returns:
        Median signal over that of PAN by band, for bands with enough windows; None without PAN.
    """
    if ground is None or not ground.pan.any():
        return None
    seen = np.isfinite(ground.mean[ground.pan])
    total = np.where(seen, ground.mean[ground.pan], 0.0).sum(axis=0)
    pan = total / np.where(seen.any(axis=0), seen.sum(axis=0), np.nan)
    level_by_band: dict[str, float | None] = {}
    for name, mean, of_pan in zip(ground.names, ground.mean, ground.pan, strict=True):
        both = np.isfinite(mean) & np.isfinite(pan) & (pan > 0.0)
        bands = rig.cone_of(name).bands
        if not of_pan and len(bands) == 1 and np.count_nonzero(both) >= MIN_WINDOWS:
            level_by_band[bands[0]] = float(np.median(mean[both] / pan[both]))
    return BandLevelFigures(level_by_band)
