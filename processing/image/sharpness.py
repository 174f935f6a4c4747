"""Image figures from samples of Level-1 frames: brightness and the share of the finest detail."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
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
_TILE_ROWS: Final = 32
_TILE_COLUMNS: Final = 64
_TILES: Final = 8
"""Each way, and the square of it in all: of narrow regions there are more along the longer side."""
_PART: Final = 8
"""Tiles that one thread measures in a row; the next one is fetched meanwhile."""
_EVERY_ROW: Final = 4
"""Of a tile one of so many rows is looked at across track; along track all are."""
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
    corners = np.add((first, left), _tiles(last - first + 1, right - left + 1))
    size = min(_TILE_ROWS, last - first - 1), min(_TILE_COLUMNS, right - left - 1)
    sums = np.zeros((len(corners), 2, 4))
    _difference_sums(frame, corners, size[0], size[1], sums)
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


@lru_cache(maxsize=1024)
def _tiles(height: int, width: int) -> Array:
    """First row and column of tiles evenly over a region, (n, 2).

    Regions of two heads on the same ground have tiles on the same ground.
    """
    fit_down, fit_across = max((height - 2) // _TILE_ROWS, 1), max((width - 2) // _TILE_COLUMNS, 1)
    down = min(fit_down, _TILES**2 // min(fit_across, _TILES))
    across = min(fit_across, _TILES**2 // min(fit_down, _TILES))
    rows = np.linspace(0, max(height - 2 - _TILE_ROWS, 0), down).astype(np.int64)
    columns = np.linspace(0, max(width - 2 - _TILE_COLUMNS, 0), across).astype(np.int64)
    return np.stack([grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij")], axis=1)


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
def _difference_sums(frame, corners, rows, columns, sums):
    """Sums of squared differences to the next pixel and to the one after it, of signal, of pixels.

    `sums` is (n, 2, 4): of each tile along track and across. Lines with pixels of no data are left
    out: where data end, as next to lines that were not read out, there is an edge and no detail.
    """
    for part in prange((len(corners) + _PART - 1) // _PART):
        signal = np.empty((rows + 2, columns + 2), np.float32)
        has_data = np.empty(rows + 2, np.bool_)
        last = min((part + 1) * _PART, len(corners))
        for i in range(part * _PART, last):
            top, left = corners[i, 0], corners[i, 1]
            if i + 1 < last:
                fetch_ahead(frame, corners[i + 1, 1], corners[i + 1, 0], columns + 2, rows + 2)
            for r in range(rows + 2):
                line, into = frame[top + r, left : left + columns + 2], signal[r]
                least = line[0]
                for c in range(len(into)):
                    least = min(least, line[c])
                    into[c] = np.float32(line[c])
                has_data[r] = least > 0
            for r in range(rows):
                here = signal[r]
                if has_data[r] and has_data[r + 1] and has_data[r + 2]:
                    _add_line(here, signal[r + 1], signal[r + 2], columns, sums[i, 0])
                if r % _EVERY_ROW == 0 and has_data[r]:
                    _add_line(here, here[1:], here[2:], columns, sums[i, 1])


@compiled_kernel(fastmath={"reassoc", "contract"})
def _add_line(here, following, after, length, sums):
    near = far = signal = np.float32(0.0)
    for c in range(length):
        one, two = following[c] - here[c], after[c] - here[c]
        near += one * one
        far += two * two
        signal += here[c]
    sums[0] += near
    sums[1] += far
    sums[2] += signal
    sums[3] += length
