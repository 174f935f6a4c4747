"""Lines of a raw frame that repeat the line before, word by word: read-out or transfer stood still.

Noise differs from line to line, so that two lines of ground are never the same over a whole frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.quality.figures.image import RepeatedLineFigures
from processing.rig import Rig

Array = NDArray[Any]

STEP: Final = 4
"""Every so many lines one is compared with the next; a run of as many is not missed."""
WORDS: Final = 8
"""Words compared at first, in the middle of a line; where these are equal, the whole line is."""
MIN_LINES: Final = 4
"""Fewer lines are a defect of single lines."""


@dataclass(frozen=True)
class RepeatedLines:
    """`count` lines from `first` on are the line before `first`."""

    sensor: str
    first: int
    count: int


def repeated_line_figures(rig: Rig, frames: Mapping[str, Array]) -> RepeatedLineFigures | None:
    """The longest run of repeated lines of all frames.

    Args:
        rig: the camera.
        frames: Level-0 frames by sensor name, (h, w) uint16, DN.

    Returns:
        None where no frame has one.
    """
    found = [
        run
        for s in rig.sensors
        if s.name in frames and (run := repeated_lines(s.name, frames[s.name]))
    ]
    if not found:
        return None
    longest = max(found, key=lambda run: run.count)
    return RepeatedLineFigures(longest.count, longest.sensor, longest.first)


def repeated_lines(sensor: str, frame: Array) -> RepeatedLines | None:
    """The longest run of lines that are the line before them.

    Lines of one value, which were not read out or are saturated, are not looked at.

    Args:
        sensor: name of the sensor.
        frame: Level-0, (h, w) uint16.

    Returns:
        None without a run of `MIN_LINES`.
    """
    longest = RepeatedLines(sensor, 0, 0)
    last = 0
    for line in _alike(frame).tolist():
        if line < last or not _repeats(frame, line + 1):
            continue
        first, last = line + 1, line + 2
        while first > 1 and _repeats(frame, first - 1):
            first -= 1
        while last < len(frame) and _repeats(frame, last):
            last += 1
        if last - first > longest.count:
            longest = RepeatedLines(sensor, first, last - first)
    return longest if longest.count >= MIN_LINES else None


def _repeats(frame: Array, line: int) -> bool:
    own = frame[line]
    return bool(np.array_equal(own, frame[line - 1]) and own.min() < own.max())


def _alike(frame: Array) -> Array:
    """Lines, of every so many, whose words in the middle are those of the next line."""
    first = max((frame.shape[1] - WORDS) // 2, 0)
    middle = frame[:, first : first + WORDS]
    own, following = middle[:-1:STEP], middle[1::STEP]
    return np.flatnonzero((own == following).all(axis=1)) * STEP
