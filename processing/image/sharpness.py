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

_BRIGHT_ROWS: Final = 32
_BRIGHT_COLUMN: Final = 16
"""So many rows, and one of so many columns, show how bright a frame is."""
_EVERY_ROW: Final = 8
_BUNDLES: Final = 5
"""Across track one of so many rows is looked at, along track at most so many bundles of each."""
_ROWS: Final = 128
"""Of taller frames only every third, fifth .. row is looked at: an odd step takes even rows and odd
ones."""
_BUNDLE: Final = 64
"""Pixels side by side: two lines of cache."""
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
    pace = height // _ROWS | 1
    sums = np.zeros((-(-height // pace), 2, 4))
    _difference_sums(frame[first : last + 1], left, right + 1, pace, sums)
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
        sample = frame[:: max(1, len(frame) // _BRIGHT_ROWS), ::_BRIGHT_COLUMN].ravel()
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


@compiled_kernel(parallel=True)
def _difference_sums(frame, left, end, pace, sums):
    """Sums of squared differences to the next pixel and to the one after it, of signal, of pixels.

    Columns from `left` to before `end` are looked at. `sums` is (rows, 2, 4): by every `pace`-th
    row, along track from some bundles of neighbouring columns (single ones would each cost a line
    of cache), across track from all bundles of every `_EVERY_ROW`-th of these rows.
    """
    height, width = frame.shape[0], end - left
    for r in prange(len(sums)):
        top = r * pace
        if top + 2 < height:
            here, following = frame[top, left:end], frame[top + 1, left:end]
            after = frame[top + 2, left:end]
            size = min(_BUNDLE, width)
            step = max(size, (width - size) // (_BUNDLES - 1))
            for first in range(0, width - size + 1, step):
                fetch_ahead(frame, left + first, top + _AHEAD * pace, size, 3)
                _add_bundle(here, following, after, first, first + size, sums[r, 0])
        if r % _EVERY_ROW == 0:
            line = frame[top, left:end]
            size = min(_BUNDLE, width - 2)
            for first in range(0, width - 2 - size + 1, size):
                _add_bundle(line[:-2], line[1:-1], line[2:], first, first + size, sums[r, 1])


@compiled_kernel(fastmath={"reassoc", "contract"})
def _add_bundle(here, following, after, first, end, sums):
    """Add the pixels from `first` to before `end`, or none where any of them has no data.

    Where data end, as next to lines that were not read out, there is an edge and no detail.
    """
    near = far = signal = np.float32(0.0)
    missing = np.uint16(0)
    for c in range(first, end):
        word, next_word, after_word = here[c], following[c], after[c]
        missing |= np.uint16((word == 0) | (next_word == 0) | (after_word == 0))
        one = np.float32(np.int32(next_word) - np.int32(word))
        two = np.float32(np.int32(after_word) - np.int32(word))
        near += one * one
        far += two * two
        signal += np.float32(word)
    if missing == 0:
        sums[0] += near
        sums[1] += far
        sums[2] += signal
        sums[3] += end - first
