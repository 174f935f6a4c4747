"""Fixed patterns: what differs from pixel to pixel, split into columns, rows and single pixels.

What is smooth (vignetting, the lamp) is filtered out first. Source: EMVA Standard 1288, release
4.0, section 8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_BOXES: Final = (7, 11)
_BINOMIAL: Final = np.array([0.25, 0.5, 0.25])


@dataclass(frozen=True)
class SpatialNoise:
    """Standard deviations in the map's unit: all together, and the three parts.

    `sigma` is that of `total` by temporal noise: how well the same pattern is found again.
    """

    total: float
    sigma: float
    column: float
    row: float
    pixel: float


def _low_pass() -> NDArray[np.float64]:
    kernel = np.ones(1)
    for size in _BOXES:
        kernel = np.convolve(kernel, np.full(size, 1.0 / size))
    return np.convolve(kernel, _BINOMIAL)


def _high_passed(values: Array, good: Array) -> Array:
    """A map (height, width) less its smooth part, zero where `good` is not; float32."""
    kernel = _low_pass()
    mask = good.astype(np.float32)
    filled = np.where(good, values, 0.0).astype(np.float32)
    border = {"borderType": cv2.BORDER_REFLECT}
    sums = cv2.sepFilter2D(filled, cv2.CV_32F, kernel, kernel, **border)
    counts = cv2.sepFilter2D(mask, cv2.CV_32F, kernel, kernel, **border)
    smooth = sums / np.maximum(counts, 1e-6)
    return np.asarray((filled - smooth) * mask, dtype=np.float32)


def spatial_noise(values: Array, good: Array, *, temporal_variance: float) -> SpatialNoise:
    """Spread of a map over its good pixels.

    Args:
        values: a mean of several frames, shape (height, width).
        good: pixels that count, shape (height, width), bool.
        temporal_variance: what is left of temporal noise in `values`, its unit squared.

    Returns:
        Standard deviations in the unit of `values`.

    Source: EMVA Standard 1288, release 4.0, section 8.
    """
    height, width = values.shape
    flat = _high_passed(values, good)
    kernel = _low_pass()
    middle = float(kernel[len(kernel) // 2])
    power = float(np.sum(kernel**2))
    one_way = 1.0 - 2.0 * middle + power
    both_ways = 1.0 - 2.0 * middle**2 + power**2
    rows, columns = good.sum(axis=1), good.sum(axis=0)
    by_column = flat.sum(axis=0)[columns > 0] / columns[columns > 0]
    by_row = flat.sum(axis=1)[rows > 0] / rows[rows > 0]
    # White noise averaged down a column is filtered across only: down it, the mean stays.
    seen = np.array(
        [
            float(np.mean(flat[good].astype(float) ** 2)),
            float(np.mean(by_column.astype(float) ** 2)),
            float(np.mean(by_row.astype(float) ** 2)),
        ]
    )
    left = np.array(
        [
            [one_way, one_way, both_ways],
            [one_way, 0.0, one_way / height],
            [0.0, one_way, one_way / width],
        ]
    )
    parts = np.linalg.solve(left, seen - left[:, 2] * temporal_variance)
    column, row, pixel = (math.sqrt(max(p, 0.0)) for p in parts)
    total = math.sqrt(max(float(parts.sum()), 0.0))
    squares = 4.0 * total**2 * temporal_variance + 2.0 * temporal_variance**2
    sigma = math.sqrt(squares / float(good.sum())) / (2.0 * max(total, 1e-12))
    return SpatialNoise(total, sigma, column, row, pixel)
