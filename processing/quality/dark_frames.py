"""Frames without light while other heads of the same exposure are lit: shutter, cover or head."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.quality.figures.image import DarkFrameFigures
from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import Rig, Sensor

Array = NDArray[Any]

ROWS: Final = 52
COLUMNS: Final = 52
"""Looked at, about, evenly over the frame."""
MIN_PIXELS: Final = 100
PERCENTILE: Final = 95.0
MAX_NOISES: Final = 8.0
"""Of read-out, up to which a frame's bright pixels may come from noise: closed shutters with twice
the stated noise reach 4; healthy near infrared over water has 27 at least."""
MIN_NOISE_SHARE: Final = 2.0**-12
"""Of full scale: read noise is no less, a rig file without one included."""
MAX_SHARE: Final = 0.05
"""Of the signal of the median frame: near infrared over water has 0.146 at least."""


def dark_frames(
    rig: Rig, frames: Mapping[str, Array], scales: Mapping[str, float]
) -> dict[str, float]:
    """Find frames whose bright pixels are noise while those of most frames are lit.

    Args:
        rig: the camera.
        frames: Level-1 words by sensor name, (h, w) uint16; 0 is no data.
        scales: what the words of a frame were multiplied by for its exposure time.

    Returns:
        The 95th percentile of the signal by sensor name, in standard deviations of read noise;
        empty where all frames are lit, or most are dark.
    """
    sensors = [sensor for sensor in rig.sensors if sensor.name in frames]
    bright = {
        sensor.name: level
        for sensor in sensors
        if (level := _bright_share(sensor, frames[sensor.name])) is not None
    }
    if not bright:
        return {}
    usual = float(np.median(list(bright.values())))
    found = {}
    for sensor in sensors:
        share = bright.get(sensor.name)
        if share is None or share >= MAX_SHARE * usual:
            continue
        noises = share / (_noise_share(sensor) * scales.get(sensor.name, 1.0))
        if noises < MAX_NOISES:
            found[sensor.name] = noises
    return found


def dark_frame_figures(dark: Mapping[str, float]) -> DarkFrameFigures | None:
    """Dark frames in figures of the quality report.

    Args:
        dark: of `dark_frames`.

    Returns:
        None without one.
    """
    return DarkFrameFigures(tuple(dark), max(dark.values())) if dark else None


def _bright_share(sensor: Sensor, frame: Array) -> float | None:
    """The 95th percentile of signal above black as a share of full scale."""
    height, width = frame.shape
    sample = frame[:: max(1, height // ROWS), :: max(1, width // COLUMNS)]
    read = sample[sample > 0]
    if len(read) < MIN_PIXELS:
        return None
    at = int(PERCENTILE / 100.0 * (len(read) - 1))
    full_scale = level1_counts_per_dn(sensor.bits) * sensor.full_scale_dn
    return float(np.partition(read, at)[at]) / full_scale


def _noise_share(sensor: Sensor) -> float:
    """Read noise as a share of full scale."""
    noise_dn = sensor.read_noise_e / sensor.electrons_per_dn
    return max(noise_dn / sensor.full_scale_dn, MIN_NOISE_SHARE)
