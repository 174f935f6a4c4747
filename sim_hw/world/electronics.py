"""The sensor: conversion of irradiance to counts, with all defects of its pixels.

Responsivity, vignetting, dark signal, defects, time-delay integration, noise and the converter.
`rendering` computes the irradiance; the laboratory measurements are in
`laboratory`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from processing.rig import Cone, Sensor
from sim_hw.world.seeding import random_stream

Map = NDArray[np.float32]

PRNU_SIGMA = 0.01
SENSOR_SIGMA = 0.01
"""Responsivity of one sensor against the next."""
DARK_E_PER_S = 150.0
DARK_REFERENCE_C = 20.0
DARK_DOUBLING_K = 7.0
HOT_SHARE = 5e-5
HOT_FACTOR = 1500.0
DEAD_SHARE = 5e-5
DEAD_RESPONSE = 0.25
DEFECT_COLUMNS = 2
COLUMN_RESPONSE = 0.55
COLUMN_BIAS_DN = 0.5
PIXEL_BIAS_DN = 0.3
CORNER_LOSS = 0.25
"""Light lost at the corner of the field, on top of the fourth power of the cosine."""


@dataclass(frozen=True)
class SensorTruth:
    """Maps of one sensor, shape (height, width).

    `response` is dimensionless, one for an ideal pixel on the axis, vignetting included; `dark` in
    e/s at `DARK_REFERENCE_C`; `bias_dn` with the black level; `defect` is one where a pixel or a
    column is not to be used. Rows and columns are those of the pixel itself: with TDI a signal
    visits several of them.
    """

    response: Map
    dark_e_per_s: Map
    bias_dn: Map
    defect: NDArray[np.uint8]


def true_sensor(cone: Cone, sensor: Sensor, seed: int, *, field_radius_mm: float) -> SensorTruth:
    """Draw a sensor. `field_radius_mm` is where `CORNER_LOSS` holds, from the axis of the lens."""
    random = random_stream(seed, "electronics", sensor.name)
    shape = (sensor.height_px, sensor.width_px)
    response = 1 + PRNU_SIGMA * random.standard_normal(shape, dtype=np.float32)
    response *= 1 + SENSOR_SIGMA * float(random.standard_normal())
    response *= vignetting(cone, sensor, field_radius_mm)
    dark = DARK_E_PER_S * random.lognormal(0, 0.2, shape).astype(np.float32)
    bias = sensor.black_dn + PIXEL_BIAS_DN * random.standard_normal(shape, dtype=np.float32)
    bias += COLUMN_BIAS_DN * random.standard_normal((1, shape[1]), dtype=np.float32)
    defect = np.zeros(shape, dtype=np.uint8)
    pixels = shape[0] * shape[1]
    dead = random.choice(pixels, round(DEAD_SHARE * pixels), replace=False)
    hot = random.choice(pixels, round(HOT_SHARE * pixels), replace=False)
    response.ravel()[dead] *= DEAD_RESPONSE
    dark.ravel()[hot] *= HOT_FACTOR
    defect.ravel()[dead] = 1
    defect.ravel()[hot] = 1
    for column in random.choice(np.arange(8, shape[1] - 8), DEFECT_COLUMNS, replace=False):
        # A trap: what is read out through it is lost in part, so the column ends there.
        first = int(random.integers(0, shape[0] // 2))
        response[first:, column] *= COLUMN_RESPONSE
        defect[first:, column] = 1
    return SensorTruth(response=response, dark_e_per_s=dark, bias_dn=bias, defect=defect)


def vignetting(cone: Cone, sensor: Sensor, field_radius_mm: float) -> Map:
    """Relative illumination over a sensor, one on the axis."""
    pitch = sensor.pitch_um * 1e-3
    x = sensor.x_mm + (np.arange(sensor.width_px) - (sensor.width_px - 1) / 2) * pitch
    y = sensor.y_mm + ((sensor.height_px - 1) / 2 - np.arange(sensor.height_px)) * pitch
    r2 = x[None, :] ** 2 + y[:, None] ** 2
    cos2 = 1 / (1 + r2 / cone.lens.f_mm**2)
    return np.asarray(cos2**2 * (1 - CORNER_LOSS * r2 / field_radius_mm**2), dtype=np.float32)


def over_tdi_path(values: Map, *, shifts: int, row_sign: int) -> Map:
    """Means of a map over the pixels a charge visits on its way to each row.

    A charge that ends in row R came from row R - row_sign * shifts. Rows that it reached from
    outside the array contribute nothing there: the first (or last) rows are partly exposed.
    """
    if shifts == 0:
        return values
    total = np.zeros_like(values)
    for step in range(shifts + 1):
        if step == 0:
            total += values
        elif row_sign > 0:
            total[step:] += values[:-step]
        else:
            total[:-step] += values[step:]
    return np.asarray(total / np.float32(shifts + 1), dtype=np.float32)


class Electronics:
    """Turns radiance into numbers, as one sensor does.

    `electrons_per_radiance_s` is the sensitivity of the head: electrons per second in an ideal
    pixel on the axis for radiance 1. Not for several threads at once: it keeps buffers.
    """

    def __init__(self, sensor: Sensor, truth: SensorTruth, electrons_per_radiance_s: float) -> None:
        self.sensor = sensor
        self.truth = truth
        self.electrons_per_radiance_s = electrons_per_radiance_s
        self._shifts = -1
        self._response = truth.response
        self._dark = truth.dark_e_per_s

    def frame(
        self,
        radiance: Map,
        *,
        exposure_time_us: float,
        tdi_shifts: int,
        gain_db: float,
        temperature_c: float,
        random: np.random.Generator,
    ) -> NDArray[np.uint16]:
        """One frame of raw values, shape (height, width).

        Args:
            radiance: light on the pixels at mid-exposure, shape (height, width).
        """
        sensor = self.sensor
        if tdi_shifts != self._shifts:
            path = {"shifts": tdi_shifts, "row_sign": sensor.tdi_row_sign}
            self._response = over_tdi_path(self.truth.response, **path)
            self._dark = over_tdi_path(self.truth.dark_e_per_s, **path)
            self._shifts = tdi_shifts
        seconds = exposure_time_us * 1e-6
        warm = 2.0 ** ((temperature_c - DARK_REFERENCE_C) / DARK_DOUBLING_K)
        normal = random.standard_normal(radiance.shape, dtype=np.float32)
        out = np.empty(radiance.shape, dtype=np.uint16)
        _convert(
            radiance,
            self._response,
            self._dark,
            self.truth.bias_dn,
            normal,
            np.float32(self.electrons_per_radiance_s * seconds),
            np.float32(warm * seconds),
            np.float32(sensor.read_noise_e**2),
            np.float32(10 ** (gain_db / 20) / sensor.electrons_per_dn),
            np.float32(sensor.full_scale_dn),
            out,
        )
        return out

    def linear_dn(self, radiance: Map, exposure_time_us: float) -> Map:
        """What an ideal pixel on the axis would give above black, without noise."""
        factor = self.electrons_per_radiance_s * exposure_time_us * 1e-6
        return np.asarray(radiance * np.float32(factor / self.sensor.electrons_per_dn))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _convert(
    radiance: Map,
    response: Map,
    dark: Map,
    bias: Map,
    normal: Map,
    light_factor: np.float32,
    dark_factor: np.float32,
    read_variance: np.float32,
    dn_per_electron: np.float32,
    full_scale: np.float32,
    out: NDArray[np.uint16],
) -> None:
    height, width = radiance.shape
    for i in range(height):
        for j in range(width):
            mean = radiance[i, j] * response[i, j] * light_factor + dark[i, j] * dark_factor
            # Photon noise as a normal deviate: right to the eye of any statistic above 20 e.
            electrons = mean + math.sqrt(mean + read_variance) * normal[i, j]
            level = bias[i, j] + electrons * dn_per_electron + np.float32(0.5)
            out[i, j] = np.uint16(min(max(level, np.float32(0.0)), full_scale))
