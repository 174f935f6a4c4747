"""Pixels of a frame that were not read out. Without light a pixel still shows its black level.

Pixels that were not read out are no data: they are left out of the image and of its valid area.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.quality.report import Figure
from processing.rig import Rig, Sensor

Array = NDArray[Any]

_NOISES: Final = 10.0
_STEP: Final = (1, 256)
"""Of rows and columns looked at: every line, by a few of its pixels; a lost packet is longer."""
_SHARE: Final = 1e-3
"""Of the pixels looked at; fewer below black are defects, which calibration interpolates."""
_RUN_PX: Final = 16
"""Along a row: what a lost packet takes is longer, a cluster of defects is shorter."""


def unread_figures(rig: Rig, frames: Mapping[str, Array]) -> dict[str, Figure]:
    """The sensor with the largest share of words far below black, and that share.

    Lines that were lost on the way, and a head without pixels, are zeros. Sensors whose black level
    is not above the noise are skipped.

    Args:
        rig: the camera.
        frames: Level-0 frames by sensor name, (h, w) uint16, DN.
    """
    shares = {
        sensor.name: share
        for sensor in rig.sensors
        if sensor.name in frames
        and (share := _unread_share(sensor, frames[sensor.name])) is not None
    }
    if not shares:
        return {}
    worst = max(shares, key=lambda name: shares[name])
    return {"unread_worst_fraction": shares[worst], "unread_worst_sensor": worst}


def blank_unread(sensor: Sensor, frame: Array, *level1: Array) -> None:
    """Write no data (0) into corrected frames where the raw frame was not read out.

    Looks at every pixel only where a sample of them shows that lines are missing.

    Args:
        frame: Level-0, (h, w) uint16, DN.
        level1: corrected frames of the same shape, changed in place.
    """
    if (_unread_share(sensor, frame) or 0.0) < _SHARE:
        return
    low = (frame < _min_raw_value(sensor)).astype(np.uint8)
    run = np.ones((1, _RUN_PX), np.uint8)
    # OpenCV's own opening with an even length moves the result by one pixel.
    lost = cv2.dilate(cv2.erode(low, run), run, anchor=((_RUN_PX - 1) // 2, 0)) != 0
    for corrected in level1:
        corrected[lost] = 0


def _unread_share(sensor: Sensor, frame: Array) -> float | None:
    least = _min_raw_value(sensor)
    if least <= 0:
        return None
    seen = frame[:: _STEP[0], :: _STEP[1]]
    return float(np.count_nonzero(seen < least)) / seen.size


def _min_raw_value(sensor: Sensor) -> int:
    noise_dn = sensor.read_noise_e / sensor.electrons_per_dn
    least_dn = int(sensor.black_dn - _NOISES * max(noise_dn, 1.0))
    return least_dn * sensor.raw_units_per_dn
