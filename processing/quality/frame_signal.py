"""Brightness, saturation and sharpness of the frames of one exposure, in figures of the report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.image.sharpness import bright_level, sharpness
from processing.quality.figures import FigureGroup
from processing.quality.figures.image import SaturationFigures, SharpnessFigures, SignalFigures
from processing.radiometry.level1 import FrameStatistics
from processing.rig import Sensor

Array = NDArray[Any]


def signal_figures(
    sensors: Sequence[Sensor],
    frames: Mapping[str, Array],
    statistics: Mapping[str, FrameStatistics],
) -> tuple[FigureGroup, ...]:
    """Brightness and saturation of the sensors that are there.

    Args:
        sensors: those with a frame.
        frames: Level-1 words by sensor name, (h, w) uint16.
        statistics: of the correction, by sensor name.

    Returns:
        Mean, brightness and saturation; no groups without a sensor.
    """
    if not sensors:
        return ()
    shares = {s.name: statistics[s.name].saturated_fraction for s in sensors}
    worst = max(shares, key=lambda name: shares[name])
    bright = bright_level(sensors, [frames[s.name] for s in sensors])
    return (
        SignalFigures(
            mean_dn=float(np.mean([statistics[s.name].mean_dn for s in sensors])),
            bright_fraction=bright,
            bright_snr=None if bright is None else min(_snr(s, bright) for s in sensors),
        ),
        SaturationFigures(
            saturated_fraction=float(np.mean(list(shares.values()))),
            saturated_worst_fraction=shares[worst],
            saturated_worst_sensor=worst,
        ),
    )


def _snr(sensor: Sensor, share: float) -> float:
    """Signal of a share of full scale over its noise of photons and read-out."""
    electrons = max(share, 0.0) * sensor.full_scale_dn * sensor.electrons_per_dn
    return electrons / max(math.hypot(math.sqrt(electrons), sensor.read_noise_e), 1.0)


def sharpness_figures(
    sensors: Sequence[Sensor],
    frames: Mapping[str, Array],
    rows: Mapping[str, tuple[int, int]],
) -> SharpnessFigures | None:
    """Share of the finest detail over the sensors.

    Args:
        sensors: those with a frame.
        frames: Level-1 words by sensor name, (h, w) uint16.
        rows: first and last exposed row by sensor name.

    Returns:
        The poorer of both directions, median over the sensors; None without a sensor.
    """
    if not sensors:
        return None
    detail = [sharpness(s, frames[s.name], rows[s.name]) for s in sensors]
    ways = [[pair[k] for pair in detail if pair[k] is not None] for k in (0, 1)]
    medians = [float(np.median(np.array(way, np.float64))) for way in ways if way]
    return SharpnessFigures(min(medians) if medians else None)
