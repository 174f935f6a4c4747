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
COLUMNS: Final = 320
"""Looked at for bits that never change, about."""
MIN_PERIODS: Final = 4
MIN_WORDS: Final = 16
"""Values that a bit divides: so many times both of its states, by so many words, and one state is
never there."""
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
    constant = {
        s.name: bits
        for s in rig.sensors
        if s.name in frames and s.name not in wrong and (bits := constant_bits(s, frames[s.name]))
    }
    if not wrong and not constant:
        return None
    return WordFormatFigures(
        word_format=tuple(dict.fromkeys(wrong.values())),
        word_format_sensors=tuple(wrong),
        constant_bits=tuple(
            str(bit) for bit in sorted({b for bits in constant.values() for b in bits})
        ),
        constant_bits_sensors=tuple(constant),
    )


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


def constant_bits(sensor: Sensor, frame: Array) -> tuple[int, ...]:
    """Bits of a frame's values that never change although the values around them do.

    A line of the read-out is stuck, or the head gives fewer bits than the rig file states.

    Args:
        sensor: as in the rig file.
        frame: Level-0, (h, w) uint16.

    Returns:
        Numbers of the bits, 0 is the lowest; empty for a frame whose values hardly differ.
    """
    step = max(1, frame.shape[1] // COLUMNS)
    values = frame[:: max(1, len(frame) // ROWS), ::step].reshape(-1) // sensor.raw_units_per_dn
    # Words that were not read out or are saturated have all bits alike.
    values = values[(values > 0) & (values < sensor.full_scale_dn)]
    if len(values) < MIN_PERIODS * MIN_WORDS:
        return ()
    if values.min() == values.max():
        # A frame of one value: no bit of it changes.
        return tuple(range(sensor.bits))
    varying = int(np.bitwise_or.reduce(values)) ^ int(np.bitwise_and.reduce(values))
    still = [bit for bit in range(varying.bit_length()) if not varying >> bit & 1]
    return tuple(
        bit
        for bit in still
        if np.count_nonzero(np.bincount(values >> (bit + 1)) >= MIN_WORDS) >= MIN_PERIODS
    )


def _share_beyond(sensor: Sensor, sample: Array) -> float:
    """Share of words that the sensor cannot have given."""
    unit = sensor.raw_units_per_dn
    beyond = sample > sensor.full_scale_dn * unit
    if unit != 1:
        beyond |= sample % unit != 0
    return float(np.count_nonzero(beyond)) / sample.size
