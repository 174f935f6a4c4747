"""Lines of a raw frame that do not follow from their neighbours: exchanged, or of two exposures.

Ground differs the more, the farther lines lie apart. Where the next line differs more than the one
after it, or pairs of lines differ in turn, the read-out made it. Of a Bayer pattern the green
pixels are compared, which lie in every line: another pattern than the rig file's shows, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.quality.figures.image import LineOrderFigures
from processing.radiometry.demosaic import is_bayer
from processing.rig import Rig, Sensor

Array = NDArray[Any]

BLOCKS: Final = 8
LINES: Final = 16
WORDS: Final = 100
"""Blocks of lines over a frame, lines of a block and words of a line, about, that are compared."""
MAX_RATIO: Final = 1.35
"""Of differences: 1.04 at most in healthy frames, 1.5 and more where lines are exchanged."""
IMBALANCE: Final = 0.05
"""Of the signal of odd and even lines: green in lines of red and of blue, or two read-outs, differ
by a few per cent in healthy sensors, over water by more than the ground does."""
MIN_DIFFERENCE: Final = 1.0
"""DN, of single words: less is no ground."""


def line_order_figures(rig: Rig, frames: Mapping[str, Array]) -> LineOrderFigures | None:
    """The frame whose lines follow least from their neighbours.

    Args:
        rig: the camera.
        frames: Level-0 frames by sensor name, (h, w) uint16, words as stored.

    Returns:
        None where the lines of all frames follow from each other.
    """
    found = [
        (disorder(s, frames[s.name], axis), s.name, name)
        for s in rig.sensors
        if s.name in frames
        for axis, name in enumerate(("rows", "columns"))
    ]
    worst = max(found, default=(0.0, "", ""))
    if worst[0] <= MAX_RATIO:
        return None
    return LineOrderFigures(*worst)


def disorder(sensor: Sensor, frame: Array, axis: int) -> float:
    """How much more lines differ than their place explains.

    Args:
        sensor: gives the colour filter array.
        frame: Level-0, (h, w) uint16.
        axis: 0 compares rows, 1 columns.

    Returns:
        The larger of two ratios of mean absolute differences over blocks of lines, after a usual
        imbalance of odd and even ones is taken out: of lines at odd distances over those at even
        ones, and of pairs of lines in turn, the larger over the smaller. Zero without ground.
    """
    lines = frame if axis == 0 else frame.T
    green = _green(sensor, axis)
    size = len(lines) - len(lines) % 2
    if size < 2 * LINES:
        return 0.0
    unit = MIN_DIFFERENCE * sensor.raw_units_per_dn
    # Green lies in every second word.
    step = 2 * max(1, lines.shape[1] // (2 * WORDS))
    count = (lines.shape[1] - 1) // step
    firsts = np.linspace(0, size - LINES, BLOCKS).astype(int) // 2 * 2
    at = (firsts[:, None] + np.arange(LINES)).reshape(-1, 1)
    words = np.empty((BLOCKS * LINES, count), np.float32)
    for odd in (0, 1):
        words[odd::2] = lines[at[odd::2], green[odd] + step * np.arange(count)]
    words = words.reshape(BLOCKS, LINES, count)
    of_even, of_odd = (words[:, start::2].mean(axis=(1, 2)) for start in (0, 1))
    balance = np.clip(of_even / np.maximum(of_odd, unit), 1.0 - IMBALANCE, 1.0 + IMBALANCE)
    words[:, 1::2] *= balance[:, None, None]
    apart = [np.abs(words[:, k:] - words[:, :-k]).mean(axis=2) for k in (1, 2, 3, 4)]
    means = np.array([of_lines.mean(axis=1) for of_lines in apart])
    blocks = np.flatnonzero((means > 0.0).all(axis=0))
    if len(blocks) <= BLOCKS // 2 or float(np.median(means[0])) < unit:
        return 0.0
    first, second, third, fourth = means[:, blocks]
    # Rows of plants may be as narrow as the pattern of a few lines, but not of all.
    distances = np.minimum(first, third) / np.maximum(second, fourth)
    # Medians: a step of the signal, as in banding, is between two lines of many.
    within, between = (np.median(apart[0][blocks, start::2], axis=1) for start in (0, 1))
    inside = float(np.median(within / (within + between)))
    return max(float(np.median(distances)), inside / (1.0 - inside), (1.0 - inside) / inside)


def _green(sensor: Sensor, axis: int) -> tuple[int, int]:
    """The first green word of even and of odd lines; of a sensor without a pattern the first."""
    if not is_bayer(sensor):
        return 0, 0
    pattern = np.array(list(sensor.colour_filter_array)).reshape(2, 2)
    pattern = pattern if axis == 0 else pattern.T
    even, odd = (int(np.flatnonzero(line == "G")[0]) for line in pattern)
    return even, odd
