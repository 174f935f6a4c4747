"""Image figures from samples of Level-1 frames: brightness and the share of the finest detail."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.level1 import level1_counts_per_dn
from processing.rig import Sensor

Array = NDArray[Any]

_EVERY_ROW: Final = 16
_LEAST_SIGNAL: Final = 4.0
"""Detail at two pixels' distance must exceed its noise so many times before sharpness is told."""


def sharpness(
    sensor: Sensor, frame: Array, rows: tuple[int, int]
) -> tuple[float | None, float | None]:
    """Share of the finest detail along track (columns of pixels) and across.

    The ratio of the mean squared difference of direct neighbours to that of pixels two apart, both
    less the photon and read noise the sensor is known to have: 0.25 for a surface without detail at
    this scale, 0.5 for sharp landscapes, 1 for pixels without any correlation. None where the image
    is too poor in contrast to say.

    Args:
        frame: Level-1 words, (h, w) uint16.
        rows: first and last exposed row.
    """
    first, last = rows
    counts = level1_counts_per_dn(sensor.bits)
    across = frame[first : last + 1 : _EVERY_ROW].astype(np.float32)
    along = frame[first : last + 1, ::_EVERY_ROW].astype(np.float32).T
    return _share(sensor, along, counts), _share(sensor, across, counts)


def bright_level(sensors: Sequence[Sensor], frames: Sequence[Array]) -> float | None:
    """The 95th percentile of signal above black as a share of full scale; no data left out."""
    samples = []
    for sensor, frame in zip(sensors, frames, strict=True):
        sample = frame[::_EVERY_ROW, ::_EVERY_ROW].ravel()
        full = level1_counts_per_dn(sensor.bits) * sensor.full_scale_dn
        samples.append(sample[sample > 0] / full)
    if not samples or not sum(len(sample) for sample in samples):
        return None
    return float(np.percentile(np.concatenate(samples), 95.0))


def _share(sensor: Sensor, lines: Array, counts: float) -> float | None:
    if lines.shape[1] < 8 or not lines.size:
        return None
    near = float(np.mean(np.square(lines[:, 1:] - lines[:, :-1])))
    far = float(np.mean(np.square(lines[:, 2:] - lines[:, :-2])))
    electrons = max(float(lines.mean()) / counts, 0.0) * sensor.electrons_per_dn
    # Black and rounding are part of the read noise; a calibrated gain is near one here.
    noise_dn2 = (electrons + sensor.read_noise_e**2) / sensor.electrons_per_dn**2
    noise = 2.0 * noise_dn2 * counts**2
    if far < _LEAST_SIGNAL * noise or far - noise <= 0.0:
        return None
    return (near - noise) / (far - noise)
