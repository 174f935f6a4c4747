"""Were the pixels of a frame read out at all? Without light a pixel still shows its black level."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.quality.report import Figure
from processing.rig import Rig, Sensor

Array = NDArray[Any]

_NOISES: Final = 10.0
_STEP: Final = (32, 8)
"""Of the rows and columns looked at: lost lines are told by a few of their pixels."""


def unread_figures(rig: Rig, frames: Mapping[str, Array]) -> dict[str, Figure]:
    """The sensor with the largest share of words far below black, and that share.

    Lines that were lost on the way, and a head without pixels, are zeros. Sensors whose black level
    is not above the noise cannot tell and are passed over.

    Args:
        rig: the camera.
        frames: Level-0 frames by sensor name, (h, w) uint16, DN.
    """
    shares = {}
    for sensor in rig.sensors:
        least = _least_dn(sensor)
        if sensor.name in frames and least > 0:
            seen = frames[sensor.name][:: _STEP[0], :: _STEP[1]]
            shares[sensor.name] = float(np.count_nonzero(seen < least)) / seen.size
    if not shares:
        return {}
    worst = max(shares, key=lambda name: shares[name])
    return {"unread_worst_fraction": shares[worst], "unread_worst_sensor": worst}


def _least_dn(sensor: Sensor) -> int:
    noise_dn = sensor.read_noise_e / sensor.electrons_per_dn
    return int(sensor.black_dn - _NOISES * max(noise_dn, 1.0))
