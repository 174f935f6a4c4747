"""Frames of no flight: a texture every sensor sees, so that each step can be exercised beforehand.

Only for compiling and warming up; nothing is measured with them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, vip_mm_from_raw, vip_px_from_mm
from processing.radiometry.calibration import RadiometricCalibration, neutral_radiometry
from processing.rig import Rig, Sensor

Array = NDArray[Any]

_TILE_PX: Final = 256
_SEED: Final = 20


def synthetic_frames(rig: Rig) -> dict[str, Array]:
    """Level-0 frames by sensor, (h, w) uint16, good to a pixel: enough for matching to succeed."""
    image = rig.virtual_image
    if image is None:
        return {}
    tile = _tile()
    placements = nominal_placements(rig, {}, {})
    frames = {}
    for sensor in rig.sensors:
        ends = np.array([[0.0, 0.0], [sensor.width_px - 1.0, sensor.height_px - 1.0]])
        px = vip_px_from_mm(image, vip_mm_from_raw(placements[sensor.name], ends))
        columns = np.linspace(px[0, 0], px[1, 0], sensor.width_px)
        rows = np.linspace(px[0, 1], px[1, 1], sensor.height_px)
        signal = _periodic(tile, rows, columns) * (sensor.full_scale_dn - sensor.black_dn)
        frames[sensor.name] = (sensor.black_dn + signal).astype(np.uint16)
    return frames


def synthetic_head_frames(rig: Rig) -> dict[str, Array]:
    """Level-0 frames by sensor, (h, w) uint16, for rigs whose images lie in no common plane."""
    tile = _tile()
    frames = {}
    for sensor in rig.sensors:
        rows, columns = np.arange(sensor.height_px) * 0.5, np.arange(sensor.width_px) * 0.5
        signal = _periodic(tile, rows, columns) * (sensor.full_scale_dn - sensor.black_dn)
        raw = (sensor.black_dn + signal) * sensor.raw_units_per_dn
        frames[sensor.name] = raw.astype(np.uint16)
    return frames


def synthetic_radiometry(sensor: Sensor) -> RadiometricCalibration:
    """A calibration with maps and a defect, for a sensor of no flight."""
    shape = (sensor.height_px, sensor.width_px)
    gain = np.ones(shape, np.float32)
    gain[0] = 1.01
    defect = np.zeros(shape, np.uint8)
    defect[shape[0] // 2, shape[1] // 2] = 1
    return replace(neutral_radiometry(sensor), gain=gain, defect=defect)


def _tile() -> Array:
    """Periodic noise between 0.2 and 0.8, smooth over two pixels of the colour raster."""
    noise = np.random.default_rng(_SEED).standard_normal((_TILE_PX, _TILE_PX))
    f = np.hypot(np.fft.fftfreq(_TILE_PX)[:, None], np.fft.fftfreq(_TILE_PX)[None, :])
    smooth = np.fft.ifft2(np.fft.fft2(noise) * np.exp(-((f / 0.08) ** 2))).real
    low, high = smooth.min(), smooth.max()
    tile: Array = (0.2 + 0.6 * (smooth - low) / (high - low)).astype(np.float32)
    return tile


def _periodic(tile: Array, rows: Array, columns: Array) -> Array:
    """The tile's value at every row and column, linear, repeated without end."""
    r, c = np.floor(rows).astype(np.intp), np.floor(columns).astype(np.intp)
    fr = (rows - r).astype(np.float32)[:, None]
    fc = (columns - c).astype(np.float32)[None, :]
    r0, r1, c0, c1 = r % _TILE_PX, (r + 1) % _TILE_PX, c % _TILE_PX, (c + 1) % _TILE_PX
    upper = tile[np.ix_(r0, c0)] * (1 - fc) + tile[np.ix_(r0, c1)] * fc
    lower = tile[np.ix_(r1, c0)] * (1 - fc) + tile[np.ix_(r1, c1)] * fc
    value: Array = upper * (1 - fr) + lower * fr
    return value
