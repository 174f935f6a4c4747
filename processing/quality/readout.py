"""Pixels of a frame that were not read out. Without light a pixel still shows its black level.

Pixels that were not read out are no data: they are left out of the image and of its valid area.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.quality.figures.image import UnreadFigures
from processing.radiometry.level1 import min_raw_value
from processing.rig import Sensor

Array = NDArray[Any]

_SHARE: Final = 1e-3
"""Of the pixels looked at; fewer below black are defects, which calibration interpolates."""
_RUN_PX: Final = 16
"""Along a row: what a lost packet takes is longer, a cluster of defects is shorter."""


def unread_figures(unread_fraction: Mapping[str, float | None]) -> UnreadFigures | None:
    """The sensor with the largest share of words far below black, and that share.

    Lines that were lost on the way, and a head without pixels, are zeros.

    Args:
        unread_fraction: `processing.radiometry.level1.FrameStatistics.unread_fraction` by sensor
            name; sensors without one are skipped.

    Returns:
        Share, 0 to 1, and sensor; None where no sensor has one.
    """
    shares = {name: share for name, share in unread_fraction.items() if share is not None}
    if not shares:
        return None
    worst = max(shares, key=lambda name: shares[name])
    return UnreadFigures(shares[worst], worst)


def blank_unread(
    sensor: Sensor, frame: Array, unread_fraction: float | None, *level1: Array
) -> bool:
    """Write no data (0) into corrected frames where the raw frame was not read out.

    Looks at every pixel only where a sample of them shows that lines are missing.

    Args:
        sensor: of the frame.
        frame: Level-0, (h, w) uint16, DN.
        unread_fraction: share of its words far below black among those compared, None for unknown.
        level1: corrected frames of the same shape, changed in place.

    Returns:
        Whether they were changed.
    """
    if (unread_fraction or 0.0) < _SHARE:
        return False
    low = (frame < min_raw_value(sensor)).astype(np.uint8)
    run = np.ones((1, _RUN_PX), np.uint8)
    # OpenCV's own opening with an even length moves the result by one pixel.
    lost = cv2.dilate(cv2.erode(low, run), run, anchor=((_RUN_PX - 1) // 2, 0)) != 0
    for corrected in level1:
        corrected[lost] = 0
    return bool(lost.any())
