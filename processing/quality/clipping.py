"""Frames whose signal ends below the converter's full scale: a pile of pixels at the highest value.

Light has no highest value: noise alone spreads the brightest surface over many DN. A head with a
wrong gain, a converter of fewer bits or a lookup table cuts off at one value.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.quality.figures.image import ClippingFigures
from processing.rig import Rig, Sensor

Array = NDArray[Any]

STEP: Final = (16, 8)
"""Of the rows and columns looked at, of rows at least."""
ROWS: Final = 64
"""Looked at, about."""
MIN_SHARE: Final = 0.003
"""Of the pixels of a frame at the value where it ends."""
MIN_PILE: Final = 8.0
"""Pixels there over those of the values below it, each."""
BELOW_DN: Final = 40
MAX_SHARE_ABOVE: Final = 0.001
"""Of the pixels: defects may lie beyond the level."""


def clipping_figures(rig: Rig, frames: Mapping[str, Array]) -> ClippingFigures | None:
    """Name the frame that is cut off below full scale, the one with most pixels there.

    Args:
        rig: the camera.
        frames: Level-0 frames by sensor name, (h, w) uint16, DN.

    Returns:
        That frame's sensor, all that are cut off, level in DN and share of pixels; None for none.
    """
    found = {
        s.name: cut
        for s in rig.sensors
        if s.name in frames and (cut := _clipped_at(s, frames[s.name])) is not None
    }
    if not found:
        return None
    worst = max(found, key=lambda name: found[name][1])
    level_dn, share = found[worst]
    return ClippingFigures(worst, tuple(found), level_dn, share)


def _clipped_at(sensor: Sensor, frame: Array) -> tuple[int, float] | None:
    """The value where a frame ends, DN, and the share of its pixels there; None for none."""
    step = max(STEP[0], len(frame) // ROWS)
    sample = frame[::step, :: STEP[1]].ravel()
    if sensor.raw_units_per_dn != 1:
        sample = sample // sensor.raw_units_per_dn
    counts = np.bincount(sample, minlength=sensor.full_scale_dn + 1)
    above = np.cumsum(counts[::-1])[::-1]
    # The highest value that more than a few defects reach.
    top = int(np.flatnonzero(above > MAX_SHARE_ABOVE * len(sample))[-1])
    share = float(counts[top]) / len(sample)
    if top >= sensor.full_scale_dn - 1 or share < MIN_SHARE:
        return None
    below = counts[max(top - BELOW_DN, 0) : top]
    # Frames of one value throughout are no images: nothing is cut off them.
    if not below.any() or counts[top] < MIN_PILE * max(float(below.mean()), 1.0):
        return None
    return top, share
