"""Image figures from samples of Level-1 frames: brightness and the share of the finest detail."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.matching.prefetch import fetch_ahead
from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import Sensor

Array = NDArray[Any]

_EVERY_ROW: Final = 16
_ROWS: Final = 512
"""Of taller frames only every second, third .. row is looked at."""
_PLACES: Final = 8
"""Pixels of a row, evenly over it, that show whether it holds data."""
_BUNDLE: Final = 32
_AHEAD: Final = 2
"""Rows looked at between the one whose pixels are fetched and the one that is measured."""
_MIN_LENGTH: Final = 34
_MIN_SIGNAL: Final = 4.0
"""Detail at two pixels' distance must exceed its noise so many times before sharpness is
reported."""


def sharpness(
    sensor: Sensor,
    frame: Array,
    rows: tuple[int, int],
    columns: tuple[int, int] | None = None,
) -> tuple[float | None, float | None]:
    """Share of the finest detail along track (columns of pixels) and across.

    The ratio of the mean squared difference of direct neighbours to that of pixels two apart, both
    less the photon and read noise the sensor is known to have.

    Args:
        sensor: bits, gain and read-out noise count.
        frame: Level-1 words, (h, w) uint16.
        rows: first and last exposed row.
        columns: first and last column looked at; None takes all.

    Returns:
        Along and across: 0.25 for a surface without detail at this scale, 0.5 for sharp landscapes,
        1 for pixels without any correlation. None where the image is too poor in contrast to say.

    Source: docs/explanation/mathematics/quality.md#sharpness.
    """
    first, last = rows
    left, right = columns or (0, frame.shape[1] - 1)
    if last - first + 1 < _MIN_LENGTH or right - left + 1 < _MIN_LENGTH:
        return None, None
    height = last - first + 1
    pace = max(1, height // _ROWS)
    sums = np.zeros((-(-height // pace), 2, 4))
    _difference_sums(frame[first : last + 1], left, right + 1, pace, sums)
    # Where data end, as next to lines that were not read out, there is an edge and no detail.
    lines = np.minimum(first + pace * np.arange(len(sums))[:, None] + np.arange(3), last)
    places = np.linspace(left, right, _PLACES).astype(np.int64)
    sums[(frame[lines[:, :, None], places] == 0).any(axis=(1, 2))] = 0.0
    along, across = sums.sum(axis=0)
    counts = level1_counts_per_dn(sensor.bits)
    return _share(sensor, along, counts), _share(sensor, across, counts)


def bright_level(sensors: Sequence[Sensor], frames: Sequence[Array]) -> float | None:
    """The 95th percentile of signal above black, without pixels of no data.

    Args:
        sensors: bits and full scale count.
        frames: Level-1 words of each sensor, (h, w) uint16.

    Returns:
        Share of full scale; None without any data.
    """
    samples = []
    for sensor, frame in zip(sensors, frames, strict=True):
        pace = _EVERY_ROW * max(1, len(frame) // _ROWS)
        sample = frame[::pace, ::_EVERY_ROW].ravel()
        full = level1_counts_per_dn(sensor.bits) * sensor.full_scale_dn
        samples.append(sample[sample > 0] / full)
    if not samples or not sum(len(sample) for sample in samples):
        return None
    return float(np.percentile(np.concatenate(samples), 95.0))


def _share(sensor: Sensor, sums: Array, counts: float) -> float | None:
    """The share of one direction, from its sums over pixels as `_difference_sums` makes them."""
    near, far, signal, pixels = (float(value) for value in sums)
    if pixels == 0:
        return None
    near, far = near / pixels, far / pixels
    electrons = max(signal / pixels / counts, 0.0) * sensor.electrons_per_dn
    # Black and rounding are part of the read noise; a calibrated gain is near one here.
    noise_dn2 = (electrons + sensor.read_noise_e**2) / sensor.electrons_per_dn**2
    noise = 2.0 * noise_dn2 * counts**2
    if far < _MIN_SIGNAL * noise or far - noise <= 0.0:
        return None
    return (near - noise) / (far - noise)


@compiled_kernel(parallel=True, fastmath={"reassoc", "contract"})
def _difference_sums(frame, left, end, pace, sums):
    """Sums of squared differences to the next pixel and to the one after it, of signal, of pixels.

    Columns from `left` to before `end` are looked at. `sums` is (rows, 2, 4): by every `pace`-th
    row, along track from bundles of neighbouring columns (single ones would each cost a line of
    cache), across track from every `_EVERY_ROW`-th of these rows.
    """
    height, width = frame.shape[0], end - left
    for r in prange(len(sums)):
        top = r * pace
        if top + 2 < height:
            here, next_row = frame[top, left:end], frame[top + 1, left:end]
            after = frame[top + 2, left:end]
            near = far = signal = 0.0
            for first in range(0, width - _BUNDLE + 1, _BUNDLE * _EVERY_ROW):
                fetch_ahead(frame, left + first, top + _AHEAD * pace, _BUNDLE, 3)
                for c in range(first, first + _BUNDLE):
                    signal_here = np.int32(here[c])
                    one = np.float64(np.int32(next_row[c]) - signal_here)
                    two = np.float64(np.int32(after[c]) - signal_here)
                    near += one * one
                    far += two * two
                    signal += np.float64(signal_here)
                sums[r, 0, 3] += _BUNDLE
            sums[r, 0, 0], sums[r, 0, 1], sums[r, 0, 2] = near, far, signal
        if r % _EVERY_ROW == 0:
            line = frame[top, left:end]
            near = far = signal = 0.0
            for c in range(width - 2):
                signal_here = np.int32(line[c])
                one = np.float64(np.int32(line[c + 1]) - signal_here)
                two = np.float64(np.int32(line[c + 2]) - signal_here)
                near += one * one
                far += two * two
                signal += np.float64(signal_here)
            sums[r, 1, 0], sums[r, 1, 1], sums[r, 1, 2] = near, far, signal
            sums[r, 1, 3] = width - 2
