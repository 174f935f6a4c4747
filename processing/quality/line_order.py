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

from processing.image.compiled_kernel import compiled_kernel
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
_LEAST_SHARE: Final = 0.01
"""Of both differences, the ratio of which is therefore 99 at most."""


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
    if len(lines) < 2 * LINES:
        return 0.0
    even, odd = _green(sensor, axis)
    unit = MIN_DIFFERENCE * sensor.raw_units_per_dn
    return float(_disorder(lines, even, odd, np.float32(unit)))


@compiled_kernel(fastmath={"reassoc", "contract"})
def _disorder(lines: Array, even: int, odd: int, unit: float) -> float:
    """See `disorder`; in even and odd lines, words from `even` and `odd` on are compared."""
    # Green lies in every second word.
    step = 2 * max(1, lines.shape[1] // (2 * WORDS))
    words = np.empty((LINES, (lines.shape[1] - 1) // step), np.float32)
    # Mean differences of lines one to four apart, and of neighbours within and between pairs.
    means = np.zeros((4, BLOCKS))
    inside = np.zeros(BLOCKS)
    used = 0
    for block in range(BLOCKS):
        first = (len(lines) // 2 * 2 - LINES) * block // (BLOCKS - 1) // 2 * 2
        # Of columns, neighbouring ones are side by side in memory.
        for j in range(words.shape[1]):
            for i in range(0, LINES, 2):
                words[i, j] = np.float32(lines[first + i, even + step * j])
                words[i + 1, j] = np.float32(lines[first + i + 1, odd + step * j])
        of_even, of_odd = words[::2].mean(), words[1::2].mean()
        balance = min(max(of_even / max(of_odd, unit), 1.0 - IMBALANCE), 1.0 + IMBALANCE)
        words[1::2] *= np.float32(balance)
        apart = np.zeros((4, LINES))
        for k in range(4):
            for i in range(LINES - k - 1):
                total = np.float32(0.0)
                here, there = words[i], words[i + k + 1]
                for j in range(len(here)):
                    total += abs(there[j] - here[j])
                apart[k, i] = total / words.shape[1]
            means[k, used] = apart[k].sum() / (LINES - k - 1)
        if means[:, used].min() > 0.0:
            # Medians: a step of the signal, as in banding, is between two lines of many.
            within = np.median(apart[0, 0 : LINES - 1 : 2])
            between = np.median(apart[0, 1 : LINES - 1 : 2])
            inside[used] = within / (within + between) if within + between > 0.0 else 0.5
            used += 1
    if used <= BLOCKS // 2 or np.median(means[0, :used]) < unit:
        return 0.0
    # Rows of plants may be as narrow as the pattern of a few lines, but not of all.
    less, more = np.minimum(means[0], means[2]), np.maximum(means[1], means[3])
    distances = np.median(less[:used] / more[:used])
    # Where lines are repeated, those within or between pairs do not differ at all.
    usual = min(max(np.median(inside[:used]), _LEAST_SHARE), 1.0 - _LEAST_SHARE)
    return float(max(distances, usual / (1.0 - usual), (1.0 - usual) / usual))


def _green(sensor: Sensor, axis: int) -> tuple[int, int]:
    """The first green word of even and of odd lines; of a sensor without a pattern the first."""
    if not is_bayer(sensor):
        return 0, 0
    pattern = np.array(list(sensor.colour_filter_array)).reshape(2, 2)
    pattern = pattern if axis == 0 else pattern.T
    even, odd = (int(np.flatnonzero(line == "G")[0]) for line in pattern)
    return even, odd
