"""Single lines of a frame that show no ground: a column or row stuck at a value, or far off.

Calibration fills the defects it knows; a line that failed since then differs from both neighbours
in nearly every part of it, while these differ little from each other and from their own ones. A
narrow line on the ground is spread by the lens, and an edge differs on one side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.image.line_means import LineMeans
from processing.quality.figures.image import DefectLineFigures
from processing.quality.ground_steps import Axis
from processing.rig import Sensor

Array = NDArray[Any]

MIN_BUNDLES: Final = 15
MIN_LINES: Final = 8
MIN_SHARE: Final = 0.04
"""Of the signal, by which a line differs from its neighbours: median over its bundles."""
_USUAL_STEP: Final = 8
TIMES_USUAL: Final = 5.0
"""So many times what lines of the frame usually differ from their neighbours. Ground without roads
along a line reaches 3.3."""
MAX_SPREAD: Final = 0.5
"""Of that difference, by which the neighbours differ from each other and from their own ones; in
healthy frames, roads along a line among them, 1.5 and more where the difference is large."""
MIN_PARTS: Final = 0.5
"""Share of the bundles that show the line by themselves, by half of the limit at least: a narrow
road that goes over from one line to the next did so in 0.28."""


@dataclass(frozen=True)
class DefectLine:
    """Line `at` along `axis` differs from its neighbours by `relative` of their signal."""

    sensor: str
    axis: Axis
    at: int
    relative: float


def defect_lines(
    sensors: Sequence[Sensor], means: Mapping[str, LineMeans]
) -> tuple[DefectLine, ...]:
    """Search frames for lines that show no ground.

    Args:
        sensors: those to look at.
        means: of their Level-1 lines, by sensor name.

    Returns:
        The worst line of each frame and axis that has one, the worst first.
    """
    found = []
    for sensor in sensors:
        if sensor.name not in means:
            continue
        lines = means[sensor.name]
        axes: tuple[tuple[Axis, Array, int], ...] = (
            ("rows", lines.by_row, lines.first_row),
            ("columns", lines.by_column, 0),
        )
        for axis, by_line, offset in axes:
            worst = _worst(by_line)
            if worst is not None:
                found.append(DefectLine(sensor.name, axis, worst[0] + offset, worst[1]))
    return tuple(sorted(found, key=lambda line: -line.relative))


def defect_line_figures(lines: Sequence[DefectLine]) -> DefectLineFigures | None:
    """The worst line in figures of the quality report.

    Args:
        lines: of the frames of one exposure, the worst first.

    Returns:
        None without a line.
    """
    if not lines:
        return None
    worst = lines[0]
    return DefectLineFigures(worst.relative, worst.sensor, worst.axis, worst.at)


def _worst(means: Array) -> tuple[int, float] | None:
    """Number of the worst line and its relative difference; None without one."""
    bundles, count = means.shape
    if bundles < MIN_BUNDLES or count < MIN_LINES:
        return None
    average = _average_differences(means)
    # Of most frames no line is looked at: this spares them the median.
    if average.max() <= MIN_SHARE:
        return None
    limit = max(MIN_SHARE, TIMES_USUAL * float(np.median(average[::_USUAL_STEP])))
    lines = np.flatnonzero(average > limit) + 2
    if not len(lines):
        return None
    own = means[:, lines]
    before2, before, after, after2 = (means[:, lines + k] for k in (-2, -1, 1, 2))
    near, far = 0.5 * (before + after), 0.5 * (before2 + after2)
    signal = np.maximum(near, 1.0)
    apart = np.abs(own - near) / signal
    spread, aside = (np.abs(off) / signal for off in (near - far, after - before))
    parts = (apart > 0.5 * limit) & (np.maximum(spread, aside) <= MAX_SPREAD * apart)
    differs, spread, aside = (np.median(one, axis=0) for one in (apart, spread, aside))
    alone = (differs > limit) & (np.maximum(spread, aside) <= MAX_SPREAD * differs)
    alone &= np.mean(parts, axis=0) >= MIN_PARTS
    if not alone.any():
        return None
    best = int(np.argmax(np.where(alone, differs, 0.0)))
    return int(lines[best]), float(differs[best])


@compiled_kernel(fastmath=True)
def _average_differences(means: Array) -> Array:
    """Mean relative difference of each line from both neighbours, from the third line on."""
    bundles, count = means.shape
    inside = count - 4
    off = np.zeros(inside, np.float32)
    signal = np.zeros(inside, np.float32)
    for k in range(bundles):
        row = means[k]
        for i in range(inside):
            near = np.float32(0.5) * (row[i + 1] + row[i + 3])
            off[i] += abs(row[i + 2] - near)
            signal[i] += near
    for i in range(inside):
        off[i] /= max(signal[i], np.float32(1.0))
    return off
