"""Check the words of a frame against the rig file: bits, right or left-justified."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.quality.figures.image import WordFormatFigures
from processing.rig import Rig, Sensor

Array = NDArray[Any]

STEP: Final = (16, 4)
"""Of the rows and columns looked at, of rows at least."""
ROWS: Final = 52
"""Looked at, about."""
MIN_SHARE: Final = 1e-3
"""Of the words looked at: fewer beyond the sensor's range are bits flipped on the way."""


def word_format_figures(rig: Rig, frames: Mapping[str, Array]) -> WordFormatFigures | None:
    """Name frames whose words have another format than the rig file states.

    Args:
        rig: the camera.
        frames: Level-0 frames by sensor name, (h, w) uint16, DN.

    Returns:
        The formats found and the sensors; None where all are as stated.
    """
    wrong = {
        s.name: format_
        for s in rig.sensors
        if s.name in frames and (format_ := wrong_format(s, frames[s.name])) is not None
    }
    if not wrong:
        return None
    return WordFormatFigures(tuple(dict.fromkeys(wrong.values())), tuple(wrong))


def wrong_format(sensor: Sensor, frame: Array) -> str | None:
    """The format of a frame's words where it is not the sensor's.

    Args:
        sensor: as in the rig file.
        frame: Level-0, (h, w) uint16.

    Returns:
        "byte-swapped", "left-justified", "right-justified" or "beyond N bits"; None where the
        format is the sensor's or not determinable.
    """
    if sensor.bits >= 16:
        return None
    sample = frame[:: max(STEP[0], len(frame) // ROWS), :: STEP[1]]
    unit = sensor.raw_units_per_dn
    if _share_beyond(sensor, sample) < MIN_SHARE:
        return None
    if _share_beyond(sensor, sample.byteswap()) < MIN_SHARE:
        return "byte-swapped"
    shifted = 1 << (16 - sensor.bits)
    if unit == 1 and np.mean(sample % shifted != 0) < MIN_SHARE:
        return "left-justified"
    if unit > 1 and np.mean(sample > sensor.full_scale_dn) < MIN_SHARE:
        return "right-justified"
    return f"beyond {sensor.bits} bits"


def _share_beyond(sensor: Sensor, sample: Array) -> float:
    """Share of words that the sensor cannot have given."""
    unit = sensor.raw_units_per_dn
    beyond = sample > sensor.full_scale_dn * unit
    if unit != 1:
        beyond |= sample % unit != 0
    return float(np.count_nonzero(beyond)) / sample.size
