"""Texture of windows of a frame against the noise that its light and read-out explain.

Differences of near pixels count, not the spread of grey values: shading matches nowhere.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import Sensor

TEXTURE_OVER_NOISE: Final = 3.0
"""Mean square of the differences of pixels `PIXEL_SPACING_PX` apart over that of photons and
read-out."""
PIXEL_SPACING_PX: Final = 2
SECOND_OVER_NOISE: Final = 1.5
"""The same along the direction of least texture, where a single edge has noise alone."""


def has_texture(
    frame: NDArray[Any], sensor: Sensor, at: NDArray[np.int64], window_px: int
) -> NDArray[np.bool_]:
    """Mark windows whose near pixels differ clearly more than by noise, in every direction.

    A single edge matches anywhere along itself, and is no texture.

    Args:
        frame: Level-1 words, (h, w) uint16.
        sensor: the sensor it is of; its gain and read-out noise count.
        at: middles of the windows, (n, 2) column and row; they are cut at the frame's border.
        window_px: side of a window, pixels.

    Returns:
        True where the mean squared difference is `TEXTURE_OVER_NOISE` times that of noise, and
        `SECOND_OVER_NOISE` times along the direction in which it is least, (n,).
    """
    per_dn = level1_counts_per_dn(sensor.bits)
    half = window_px // 2
    result = np.zeros(len(at), np.bool_)
    for i, (column, row) in enumerate(at):
        rows = slice(max(row - half, 0), max(row + half + 1, 0))
        columns = slice(max(column - half, 0), max(column + half + 1, 0))
        window = frame[rows, columns].astype(np.float32)
        if min(window.shape) > PIXEL_SPACING_PX:
            photons = float(window.mean()) / per_dn / sensor.electrons_per_dn
            read_dn = sensor.read_noise_e / sensor.electrons_per_dn
            noise_dn2 = 2.0 * (max(photons, 0.0) + read_dn**2)
            across = np.mean((window[:, PIXEL_SPACING_PX:] - window[:, :-PIXEL_SPACING_PX]) ** 2)
            along = np.mean((window[PIXEL_SPACING_PX:] - window[:-PIXEL_SPACING_PX]) ** 2)
            seen_dn2 = 0.5 * float(across + along) / per_dn**2
            least_dn2 = _least_difference(window) / per_dn**2
            result[i] = (
                seen_dn2 > TEXTURE_OVER_NOISE * noise_dn2
                and least_dn2 > SECOND_OVER_NOISE * noise_dn2
            )
    return result


def _least_difference(window: NDArray[np.float32]) -> float:
    """Mean squared difference along the direction in which it is least.

    The differences along rows and along columns have no pixel in common, so that noise is in both
    alike and in no product.
    """
    gap = PIXEL_SPACING_PX // 2
    across = window[gap:-gap, 2 * gap :] - window[gap:-gap, : -2 * gap]
    along = window[2 * gap :, gap:-gap] - window[: -2 * gap, gap:-gap]
    a, b, c = (
        float(np.mean(x * y)) for x, y in ((across, across), (along, along), (across, along))
    )
    return 0.5 * (a + b) - float(np.hypot(0.5 * (a - b), c))
