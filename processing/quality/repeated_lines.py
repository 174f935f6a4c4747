"""Lines of a raw frame that repeat earlier ones, word by word: read-out or transfer.

A read-out that stands still repeats the line before; a buffer that is sent twice repeats a block of
lines. Noise differs from line to line, so that two lines of ground are never the same over a whole
frame.
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

WORDS: Final = 8
"""Words of a line compared at first; where these are equal, those of the next place are."""
PLACES: Final = (0.5, 0.25, 0.75)
"""Of these words, as shares of the width: lines that are equal in all are compared as a whole."""
MIN_LINES: Final = 4
"""Fewer lines are a defect of single lines."""
_MIX: Final = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True)
class RepeatedLines:
    """`count` lines from `first` on are those from `source` on, one by one."""

    sensor: str
    first: int
    count: int
    source: int


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
    return RepeatedLineFigures(longest.count, longest.sensor, longest.first, longest.source)


def repeated_lines(sensor: str, frame: Array) -> RepeatedLines | None:
    """The longest run of lines that repeat earlier lines of the frame in their order.

    Lines of one value, which were not read out or are saturated, are not looked at.

    Args:
        sensor: name of the sensor.
        frame: Level-0, (h, w) uint16.

    Returns:
        None without a run of `MIN_LINES`.
    """
    seen: dict[bytes, int] = {}
    longest = run = RepeatedLines(sensor, 0, 0, 0)
    for line in _alike(frame).tolist():
        own = frame[line]
        if own.min() == own.max():
            continue
        content = own.tobytes()
        source = seen.get(content)
        seen[content] = line
        if source is None:
            continue
        goes_on = (line, source) == (run.first + run.count, run.source + run.count)
        first, count, start = (run.first, run.count, run.source) if goes_on else (line, 0, source)
        run = RepeatedLines(sensor, first, count + 1, start)
        if run.count > longest.count:
            longest = run
    return longest if longest.count >= MIN_LINES else None


def _alike(frame: Array) -> Array:
    """Lines whose words at all `PLACES` are those of another line, in order."""
    height, width = frame.shape
    lines = np.arange(height)
    for share in PLACES:
        first = round(share * (width - WORDS))
        rows = frame if len(lines) == height else frame[lines]
        words = np.ascontiguousarray(rows[:, first : first + WORDS]).view(np.uint64)
        keys = words[:, 0] * _MIX ^ words[:, 1]
        in_order = np.sort(keys)
        repeated = in_order[1:][in_order[1:] == in_order[:-1]]
        if not len(repeated):
            return lines[:0]
        lines = lines[np.isin(keys, repeated)]
    return lines
