"""Texture of windows of a frame against the noise that its light and read-out explain."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import Sensor

TEXTURE_OVER_NOISE: Final = 4.0
"""Standard deviation of a window over that of photons and read-out."""


def has_texture(
    frame: NDArray[Any], sensor: Sensor, at: NDArray[np.int64], window_px: int
) -> NDArray[np.bool_]:
    """Tell windows whose grey values vary clearly more than noise makes them.

    Args:
        frame: Level-1 words, (h, w) uint16.
        sensor: the sensor it is of; its gain and read-out noise count.
        at: middles of the windows, (n, 2) column and row; they are cut at the frame's border.
        window_px: side of a window, pixels.

    Returns:
        True where the standard deviation is `TEXTURE_OVER_NOISE` times that of noise, (n,).
    """
    per_dn = level1_counts_per_dn(sensor.bits)
    half = window_px // 2
    result = np.zeros(len(at), np.bool_)
    for i, (column, row) in enumerate(at):
        rows = slice(max(row - half, 0), max(row + half + 1, 0))
        columns = slice(max(column - half, 0), max(column + half + 1, 0))
        window = frame[rows, columns].astype(np.float32)
        if window.size:
            photons = float(window.mean()) / per_dn / sensor.electrons_per_dn
            read_dn = sensor.read_noise_e / sensor.electrons_per_dn
            noise_dn = np.sqrt(max(photons, 0.0) + read_dn**2)
            result[i] = float(window.std()) / per_dn > TEXTURE_OVER_NOISE * noise_dn
    return result
