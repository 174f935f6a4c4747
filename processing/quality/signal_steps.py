"""Steps of signal along whole rows or columns of a frame: the read-out makes them, ground does not.

A gain or an offset that changes from one line on, or banding, moves every part of two neighbouring
lines alike. An edge on the ground would have to run along one line of pixels over the frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.image.line_means import LineMeans
from processing.quality.figures.image import SignalStepFigures
from processing.quality.ground_steps import (
    Axis,
    GroundView,
    LineStep,
    is_ground,
    read_out_frames,
)
from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import Sensor

Array = NDArray[Any]

QUANTILE: Final = 0.2
"""A step holds in all but this share of the bundles of a line."""
MIN_BUNDLES: Final = 15
MIN_STEP: Final = 0.055
BANDING_STEP: Final = 0.03
BANDING_LINES: Final = 16
"""Of the signal: of one line, and of so many lines of a frame. Edges of clouds reach 0.046."""
MAX_BLUR: Final = 0.2
"""Of the step, beyond the usual change, in the lines before and after it: read-out steps from one
line to the next, a lens spreads rows of plants and eaves and leaves 0.35 and more."""
MAX_FRAMES: Final = 2
"""Steps in more frames of one exposure may be rows of plants or roofs along the track."""
MIN_STEP_DN: Final = 6.0
SIGMAS: Final = 8.0
ALL: Final = 2000
SAMPLES: Final = 400
"""The usual change is found by all lines of frames of fewer than `ALL`, else by about so many."""
_MAD_TO_SIGMA: Final = 1.4826


@dataclass(frozen=True)
class SignalStep:
    """Between line `at` and the next along `axis` the signal changes by `relative` of itself.

    `lines` counts the lines of the frame where it steps: more than a few are banding; `every` are
    all of them.
    """

    sensor: str
    axis: Axis
    at: int
    relative: float
    lines: int
    every: tuple[LineStep, ...] = field(default=(), compare=False, repr=False)


def signal_steps(
    sensors: Sequence[Sensor], means: Mapping[str, LineMeans], view: GroundView | None = None
) -> tuple[SignalStep, ...]:
    """Search frames for steps along whole lines.

    Args:
        sensors: those to look at.
        means: of their lines, by sensor name.
        view: frames and places; None where heads share no ground.

    Returns:
        The largest step of each frame and axis that has one and that other heads do not show, the
        largest first. Where more than `MAX_FRAMES` frames have one, only those that the ground
        cannot be the cause of.
    """
    found = []
    for sensor in sensors:
        if sensor.name not in means:
            continue
        lines = means[sensor.name]
        least = MIN_STEP_DN * level1_counts_per_dn(sensor.bits)
        axes: tuple[tuple[Axis, Array, int], ...] = (
            ("rows", lines.by_row, lines.first_row),
            ("columns", lines.by_column, 0),
        )
        for axis, by_line, offset in axes:
            step = _largest(sensor.name, axis, by_line, offset, least)
            if step is not None:
                found.append(step)
    if len({step.sensor for step in found}) > MAX_FRAMES:
        found = _of_read_out(found, view)
    elif view is not None:
        found = [step for step in found if not is_ground(step.every, view)]
    return tuple(sorted(found, key=lambda step: -abs(step.relative)))


def _of_read_out(steps: Sequence[SignalStep], view: GroundView | None) -> list[SignalStep]:
    axes: tuple[Axis, ...] = ("rows", "columns")
    named = {
        axis: read_out_frames({s.sensor: s.every for s in steps if s.axis == axis}, view)
        for axis in axes
    }
    return [step for step in steps if step.sensor in named[step.axis]]


def without_edges(
    sensors: Sequence[Sensor], steps: Sequence[SignalStep], rows: int
) -> tuple[SignalStep, ...]:
    """Leave out steps in the rows that a wrong TDI count leaves partly exposed.

    Args:
        sensors: those that were looked at.
        steps: of their frames.
        rows: at the first and at the last end of a frame, that may be partly exposed.

    Returns:
        Steps between rows of which any lies elsewhere, and those between columns.
    """
    heights = {sensor.name: sensor.height_px for sensor in sensors}

    def is_edge(step: SignalStep) -> bool:
        last = heights[step.sensor] - 1 - rows
        return step.axis == "rows" and all(not rows <= line.at < last for line in step.every)

    return tuple(step for step in steps if not is_edge(step))


def step_figures(steps: Sequence[SignalStep]) -> SignalStepFigures:
    """The largest step in figures of the quality report.

    Args:
        steps: of the frames of one exposure, the largest first.

    Returns:
        Figures of the first; empty without a step.
    """
    if not steps:
        return SignalStepFigures()
    worst = steps[0]
    return SignalStepFigures(
        signal_step=worst.relative,
        signal_step_sensor=worst.sensor,
        signal_step_axis=worst.axis,
        signal_step_at=worst.at,
        signal_step_lines=worst.lines,
        signal_step_frames=len({step.sensor for step in steps}),
    )


def _largest(
    sensor: str,
    axis: Axis,
    means: Array,
    offset: int,
    min_counts: float,
) -> SignalStep | None:
    if len(means) < MIN_BUNDLES:
        return None
    # A step needs nearly all bundles of one sign: only such lines are looked at closely.
    often = len(means) - math.ceil(QUANTILE * (len(means) - 1))
    rising, falling = _signs(means)
    lines = np.flatnonzero((rising >= often) | (falling >= often))
    if not len(lines):
        return None
    bright, low, middle, high = _quantiles(means, lines, QUANTILE)
    # What nearly all bundles of a line share; nothing where they differ in sign.
    common = np.where(low > 0.0, low, np.where(high < 0.0, high, 0.0))
    least = min_counts / np.maximum(bright, 1.0)
    shared = np.abs(middle) * (np.abs(common) > 0.5 * np.abs(middle))
    if not np.any(shared > np.maximum(BANDING_STEP, least)):
        return None
    slope, spread = _usual_change(means)
    noise = np.maximum(SIGMAS * spread, least)
    candidates = np.flatnonzero(shared > np.maximum(BANDING_STEP, noise))
    is_sharp = np.zeros(len(lines), np.bool_)
    is_sharp[candidates] = _are_sharp(
        means, lines[candidates], middle[candidates] - slope, slope, spread
    )
    shared = np.where(is_sharp, shared, 0.0)
    steps = shared > np.maximum(BANDING_STEP, noise)
    if np.count_nonzero(steps) < BANDING_LINES:
        steps = shared > np.maximum(MIN_STEP, noise)
    if not steps.any():
        return None
    best = int(np.argmax(np.where(steps, np.abs(middle), 0.0)))
    every = tuple(
        LineStep(sensor, axis, int(lines[k]) + offset, float(middle[k]))
        for k in np.flatnonzero(steps)
    )
    return SignalStep(
        sensor, axis, int(lines[best]) + offset, float(middle[best]), len(every), every
    )


def _are_sharp(means: Array, lines: Array, steps: Array, slope: float, spread: float) -> Array:
    """Whether the signal changes between these lines and the next alone, not around them too."""
    allowed = MAX_BLUR * np.abs(steps) + spread
    is_sharp = np.ones(len(lines), np.bool_)
    for side in (-1, 1):
        neighbours = lines + side
        inside = (neighbours >= 0) & (neighbours < means.shape[1] - 1)
        around = np.full(len(lines), slope)
        around[inside] = _medians(means, neighbours[inside])
        is_sharp &= np.abs(around - slope) <= allowed
    return is_sharp


def _usual_change(means: Array) -> tuple[float, float]:
    """Median of the relative change between lines, and its standard deviation by the median."""
    count = means.shape[1]
    usual = _medians(means, np.arange(0, count - 1, 1 if count < ALL else count // SAMPLES))
    middle = float(np.median(usual))
    return middle, _MAD_TO_SIGMA * float(np.median(np.abs(usual - middle)))


@compiled_kernel()
def _signs(means: Array) -> tuple[Array, Array]:
    """How many bundles rise and how many fall between each line and the next."""
    bundles, lines = means.shape
    # Bytes, of which vectors hold many: there are fewer bundles than a byte counts.
    rising = np.zeros(lines - 1, np.uint8)
    falling = np.zeros(lines - 1, np.uint8)
    for k in range(bundles):
        here, following = means[k, :-1], means[k, 1:]
        for i in range(len(here)):
            rising[i] += following[i] > here[i]
            falling[i] += following[i] < here[i]
    return rising, falling


@compiled_kernel()
def _quantiles(means: Array, lines: Array, share: float) -> Array:
    """Over the bundles, between some lines and the next, (4, lines): the median signal, and of its
    relative change the quantile of a share, the median, and the quantile of the other share."""
    bundles = means.shape[0]
    found = np.empty((4, len(lines)), np.float32)
    signal = np.empty(bundles, np.float32)
    change = np.empty(bundles, np.float32)
    for j in range(len(lines)):
        at = lines[j]
        for k in range(bundles):
            before, after = means[k, at], means[k, at + 1]
            signal[k] = np.float32(0.5) * (before + after)
            change[k] = (after - before) / max(signal[k], np.float32(1.0))
        signal.sort()
        change.sort()
        found[0, j] = _quantile(signal, 0.5)
        found[1, j] = _quantile(change, share)
        found[2, j] = _quantile(change, 0.5)
        found[3, j] = _quantile(change, 1.0 - share)
    return found


@compiled_kernel()
def _quantile(values: Array, share: float) -> float:
    """Of values in rising order, between the two nearest."""
    place = share * (len(values) - 1)
    below = int(place)
    above = min(below + 1, len(values) - 1)
    return float(values[below] + (place - below) * (values[above] - values[below]))


@compiled_kernel()
def _medians(means: Array, lines: Array) -> Array:
    """Medians over the bundles of the relative change between some lines and the next."""
    bundles = means.shape[0]
    found = np.empty(len(lines), np.float32)
    values = np.empty(bundles, np.float32)
    for j in range(len(lines)):
        at = lines[j]
        for k in range(bundles):
            before, after = means[k, at], means[k, at + 1]
            values[k] = (after - before) / max(np.float32(0.5) * (before + after), np.float32(1.0))
        values.sort()
        found[j] = np.float32(0.5) * (values[(bundles - 1) // 2] + values[bundles // 2])
    return found
