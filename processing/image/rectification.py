"""One sensor's frame as another sensor would have seen it, so that a shift is all that is left.

Frames of converging heads, or of heads whose pixels are no whole multiple of each other, differ by
more than a shift; matching needs one of them in the raw geometry of the other. What is found there
goes back through the very lattice it was fetched by.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, raw_from_vip_mm, vip_mm_from_raw
from processing.image.kernels import DEFAULT_INTERPOLATION
from processing.image.lattice import OUTSIDE, interpolate_lattice
from processing.image.resampling import (
    SATURATED_SOURCE,
    WEIGHT_STEP_PX,
    WEIGHT_UNIT,
    resample,
    usable_area,
)
from processing.radiometry.level1 import exposed_rows

Array = NDArray[Any]

_CELL_PX: Final = 32
_BAD_BIT: Final = np.uint16(1)


@dataclass(frozen=True)
class RectifiedFrame:
    """Words of sensor a on pixels of sensor b, each divided into `step` by `step`.

    `pixels` (h, w) uint16 are Level-1 words, 0 where a has nothing usable. Its first pixels divide
    pixel `first` (column, row) of b.
    """

    pixels: Array
    first: tuple[int, int]
    step: int
    _lattice: Array

    def at(self, colrow_b: Array) -> Array:
        """The first of the pixels that divide pixels of b.

        Args:
            colrow_b: column and row in b, (n, 2), whole pixels.

        Returns:
            Column and row in `pixels`, (n, 2) int64.
        """
        return np.asarray((colrow_b - np.array(self.first)) * self.step, np.int64)

    def raw_a(self, colrow: Array) -> Array:
        """Raw coordinates in a of positions in `pixels`.

        Args:
            colrow: column and row in `pixels`, (n, 2).

        Returns:
            Raw column and row in a, (n, 2); NaN where b sees nothing of a.
        """
        return interpolate_lattice(self._lattice, _CELL_PX, colrow)


def rectify_to_sensor(
    a: SensorPlacement,
    b: SensorPlacement,
    frame_a: Array,
    *,
    region: tuple[int, int, int, int],
    step: int,
) -> RectifiedFrame:
    """The frame of a on the pixels of b, by one resampling.

    Args:
        a: predicted place of the sensor whose frame is resampled.
        b: predicted place of the other sensor.
        frame_a: Level-1 words, (h, w) uint16.
        region: first and last column, first and last row of b.
        step: pixels of the result to a pixel of b along each axis.

    Returns:
        The resampled region and its lattice.

    Raises:
        ValueError: a frame of another type than words.
    """
    if frame_a.dtype != np.uint16:
        raise ValueError(f"frame {a.sensor.name} is {frame_a.dtype}; give Level-1 words, uint16")
    width = (region[1] - region[0] + 1) * step
    height = (region[3] - region[2] + 1) * step
    rows, columns = math.ceil(height / _CELL_PX) + 1, math.ceil(width / _CELL_PX) + 1
    c, r = np.meshgrid(np.arange(columns) * float(_CELL_PX), np.arange(rows) * float(_CELL_PX))
    middle = (step - 1) / 2.0
    at_b = np.stack(
        [region[0] + (c.ravel() - middle) / step, region[2] + (r.ravel() - middle) / step], axis=1
    )
    raw = raw_from_vip_mm(a, vip_mm_from_raw(b, at_b))
    far = 2.0 * _CELL_PX * max(1.0, _magnification(raw.reshape(rows, columns, 2)))
    size = np.array([a.sensor.width_px, a.sensor.height_px])
    with np.errstate(invalid="ignore"):
        near = ((raw > -far) & (raw < size + far)).all(axis=1)
    raw[~near] = OUTSIDE
    lattice = raw.reshape(1, rows, columns, 2)
    per_cell = _CELL_PX // WEIGHT_STEP_PX
    weights = np.full(
        (1, (rows - 1) * per_cell + 1, (columns - 1) * per_cell + 1), WEIGHT_UNIT, np.uint8
    )
    pixels = np.zeros((height, width), np.uint16)
    source = np.zeros((height, width), np.uint8)
    resample(
        frame_a[None],
        np.array([usable_area(a, exposed_rows(a.sensor, a.tdi_shifts))]),
        lattice,
        _CELL_PX,
        weights,
        np.ones(1, np.float32),
        interpolation=DEFAULT_INTERPOLATION,
        out=pixels,
        source=source,
    )
    pixels &= ~_BAD_BIT
    pixels[source & SATURATED_SOURCE != 0] = 0
    return RectifiedFrame(pixels, (region[0], region[2]), step, lattice[0])


def _magnification(raw: Array) -> float:
    """Pixels of a to a pixel of the result, the largest near the middle."""
    i, j = raw.shape[0] // 2, raw.shape[1] // 2
    steps = [raw[i, j] - raw[max(i - 1, 0), j], raw[i, j] - raw[i, max(j - 1, 0)]]
    found = max(float(np.abs(step).max()) for step in steps) / _CELL_PX
    return found if math.isfinite(found) else 1.0
