"""A radiometric calibration made ready for the pass over the pixels of a frame.

Maps become fixed point, of which `processing.radiometry.level1` reads a quarter of the bytes; a
calibration that is the same for all pixels becomes scalars.

Source: docs/explanation/mathematics/radiometry.md#offset-and-gain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.radiometry.calibration import (
    RadiometricCalibration,
    check_radiometry,
    neutral_radiometry,
)
from processing.radiometry.defects import spread_defects
from processing.radiometry.fixed_point import fixed_point, quantised
from processing.rig import Sensor

Array = NDArray[Any]

RESPONSE_UNIT: Final = 16384
"""Fixed-point word of a response of one. Integer running sums are exact, so the result does not
depend on how many threads shared the rows."""
_KEPT_SHIFTS: Final = 8
"""Numbers of TDI shifts whose defects are kept: in flight they change with speed and height."""
_AT_A_TIME: Final = 2
"""Calibrations as floating-point maps, which are four times what is kept of them."""
_BIAS_STEP_DN: Final = 1.0 / 32.0
_DARK_STEP_DN_PER_S: Final = 0.5
"""Steps of the maps: rounded to at most a sixty-fourth of a DN, where a Level-1 word is a quarter
(12 bits); dark signal to as much in a sixteenth of a second."""


@dataclass(frozen=True)
class Corrector:
    """A calibration made ready for the pass: maps as fixed point of 8 or 16 bits, scalars where it
    is flat.

    `bias` and `dark` count in units above their least value, `response` is one over gain; they are
    None together, where the calibration is the same for all pixels. `defects` are (row, column) of
    the defects, (n, 2) int32; `defects_by_shifts` keeps them as spread by so many TDI shifts, a few
    numbers of shifts at a time.
    """

    sensor: Sensor
    bias: Array | None
    dark: Array | None
    response: Array | None
    bias_unit_dn: float
    dark_unit_dn_per_s: float
    min_bias_dn: float
    min_dark_dn_per_s: float
    flat_gain: float
    doubling_k: float
    reference_c: float
    response_per_k: float
    defects: Array
    defects_by_shifts: dict[int, tuple[Array, Array]] = field(default_factory=dict)

    def spread_defects(self, shifts: int) -> tuple[Array, Array]:
        """The defects after so many TDI shifts, kept for the next frame; pipelines share them.

        Args:
            shifts: N of the frame, 0 to the height of the sensor.

        Returns:
            As `processing.radiometry.defects.spread_defects`.
        """
        sensor, known = self.sensor, self.defects_by_shifts
        found = known.get(shifts)
        if found is None:
            shape = (sensor.height_px, sensor.width_px)
            found = spread_defects(self.defects, shape, shifts, sensor.tdi_row_sign)
            if len(known) >= _KEPT_SHIFTS:
                known.clear()
            known[shifts] = found
        return found


def correctors_for(
    sensors: Sequence[Sensor], radiometry: Mapping[str, RadiometricCalibration]
) -> dict[str, Corrector]:
    """Make the calibrations of several sensors ready, some at a time: reading them takes seconds.

    Args:
        sensors: whose frames are corrected.
        radiometry: by sensor name; a sensor without one is taken as neutral. Read in threads.

    Returns:
        Correctors by sensor name.

    Raises:
        CalibrationError: as `corrector_for`.
    """
    with ThreadPoolExecutor(_AT_A_TIME, thread_name_prefix="calibration") as pool:
        correctors = pool.map(
            lambda sensor: corrector_for(sensor, radiometry.get(sensor.name)), sensors
        )
        return dict(zip((sensor.name for sensor in sensors), correctors, strict=True))


def corrector_for(sensor: Sensor, calibration: RadiometricCalibration | None) -> Corrector:
    """Make a calibration ready for the pass.

    Args:
        sensor: whose frames are corrected.
        calibration: of the sensor; None takes the neutral one.

    Returns:
        Maps as fixed point, or scalars where all pixels have the same calibration.

    Raises:
        CalibrationError: the maps are not of the sensor's size, or out of range.
    """
    calibration = calibration or neutral_radiometry(sensor)
    check_radiometry(f"radiometry of {sensor.name}", calibration, sensor=sensor)
    maps = (calibration.bias_dn, calibration.dark_dn_per_s, calibration.gain)
    flat = all(float(np.min(m)) == float(np.max(m)) for m in maps)
    bias = dark = response = None
    least_bias, bias_unit = float(calibration.bias_dn.flat[0]), 0.0
    least_dark, dark_unit = float(calibration.dark_dn_per_s.flat[0]), 0.0
    if not flat:
        good = calibration.defect == 0
        bias, least_bias, bias_unit = quantised(calibration.bias_dn, good, _BIAS_STEP_DN)
        dark, least_dark, dark_unit = quantised(
            calibration.dark_dn_per_s, good, _DARK_STEP_DN_PER_S
        )
        response = fixed_point(1.0 / calibration.gain, 1.0 / RESPONSE_UNIT)
    return Corrector(
        sensor=sensor,
        bias=bias,
        dark=dark,
        response=response,
        bias_unit_dn=bias_unit,
        dark_unit_dn_per_s=dark_unit,
        min_bias_dn=least_bias,
        min_dark_dn_per_s=least_dark,
        flat_gain=float(calibration.gain.flat[0]),
        doubling_k=calibration.doubling_k,
        reference_c=calibration.reference_c,
        response_per_k=calibration.response_per_k,
        defects=np.argwhere(calibration.defect != 0).astype(np.int32),
    )
