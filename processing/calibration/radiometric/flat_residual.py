"""Residual noise of a corrected flat frame, compared with photon and quantisation noise.

The frame goes through the same pass as in flight; the ratio is one when the calibration adds
nothing to the noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from processing.radiometry.calibration import RadiometricCalibration
from processing.radiometry.corrector import corrector_for
from processing.radiometry.level1 import level1_counts_per_dn, level1_from_level0
from processing.rig import Sensor


@dataclass(frozen=True)
class FlatResidual:
    """Signal and residual standard deviation in DN, and the residual over the prediction."""

    FIGURES: ClassVar[tuple[str, ...]] = ("mean_dn", "residual_dn", "ratio")

    mean_dn: float
    residual_dn: float
    ratio: float


def flat_residual(
    sensor: Sensor,
    calibration: RadiometricCalibration,
    raw: NDArray[np.uint16],
    *,
    exposure_time_s: float,
    temperature_c: float,
    tdi_shifts: int,
    gain_dn_per_e: float,
    dark_dn2: float,
) -> FlatResidual:
    """Correct a frame and compare its noise with the prediction.

    Nothing smooth is taken off: a corner that is corrected wrongly counts. Defects, partly exposed
    rows and saturated pixels do not.

    Args:
        sensor: that took the frame.
        calibration: of the sensor.
        raw: even light, shape (height, width), DN.
        exposure_time_s: of the frame.
        temperature_c: of the sensor.
        tdi_shifts: N of the frame.
        gain_dn_per_e: system gain, from photon transfer.
        dark_dn2: temporal variance without light, from photon transfer.

    Returns:
        Mean signal, residual, and the residual over the prediction.

    Source: docs/explanation/mathematics/radiometry.md#noise-model.
    """
    out = np.empty_like(raw)
    level1_from_level0(
        corrector_for(sensor, calibration),
        raw,
        temperature_c=temperature_c,
        exposure_time_s=exposure_time_s,
        tdi_shifts=tdi_shifts,
        out=out,
    )
    per_dn = level1_counts_per_dn(sensor.bits)
    response = _over_path(1.0 / calibration.gain, tdi_shifts, sensor.tdi_row_sign)
    defective = _over_path(calibration.defect.astype(np.float32), tdi_shifts, sensor.tdi_row_sign)
    used = (out != 0) & ((out & 1) == 0) & (defective == 0.0) & (raw < sensor.full_scale_dn)
    value = (out & 0xFFFE)[used].astype(np.float64) / per_dn
    mean = float(value.mean())
    own = response[used].astype(np.float64)
    # Both corrected words and raw counts are rounded; the raw rounding is in the dark noise.
    rounded = (2.0 / per_dn) ** 2 / 12.0
    variance = (gain_dn_per_e * mean * own + dark_dn2) / own**2 + rounded
    squares = (value - mean) ** 2
    return FlatResidual(
        mean_dn=mean,
        residual_dn=math.sqrt(float(np.mean(squares))),
        ratio=math.sqrt(float(np.mean(squares / variance))),
    )


def _over_path(values: Any, shifts: int, row_sign: int) -> NDArray[np.float32]:
    """Mean over the pixels a charge visited; rows it reached from outside have what is there."""
    padded = np.cumsum(values, axis=0, dtype=np.float64)
    height = len(values)
    rows = np.arange(height)
    first = np.maximum(rows - shifts, 0) if row_sign > 0 else rows
    last = rows if row_sign > 0 else np.minimum(rows + shifts, height - 1)
    below = np.vstack([np.zeros((1, values.shape[1])), padded])
    total = below[last + 1] - below[first]
    return np.asarray(total / (last - first + 1)[:, None], dtype=np.float32)
