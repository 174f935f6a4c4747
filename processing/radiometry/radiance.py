"""Radiance: calibrated heads' counts to W/m2/sr/nm, and the file that holds such a calibration.

For heads whose maker states an absolute calibration; relative calibration of our own heads is in
`processing.radiometry.calibration`. Source: MicaSense, "RedEdge camera radiometric calibration
model".
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.radiometry.calibration import CalibrationError
from processing.rig import Sensor

Array = NDArray[Any]

RADIANCE_FILE_MAX_BYTES: Final = 100_000
POWER_MAX: Final = 8
"""Highest power of a two-dimensional vignetting polynomial."""
_TERMS_MAX: Final = 64
_VALUE_RANGE: Final = 65536.0


@dataclass(frozen=True)
class RadianceCalibration:
    """One head's absolute response.

    L = V R (word - black) a1 / (gain t 65536) with words of 16 bits, t the exposure time in s,
    V = 1 / (1 + sum k_i r^i), i from 1, r the distance in px from the vignetting centre (column,
    row), and R = 1 / (1 + a2 row / t - a3 row), the rows being read one after another. Where
    `vignetting_powers` has a pair (p, q) for each k, V = 1 / sum k_i x^p_i y^q_i, x and y being
    column and row in widths and heights of the frame.
    """

    a1: float
    a2: float
    a3: float
    vignetting_centre_px: tuple[float, float]
    vignetting: tuple[float, ...]
    wavelength_nm: float
    bandwidth_nm: float
    vignetting_powers: tuple[tuple[int, int], ...] = ()


def radiance_from_raw(
    sensor: Sensor,
    calibration: RadianceCalibration,
    raw: Array,
    *,
    exposure_time_s: float,
    gain: float = 1.0,
    black: float | None = None,
) -> Array:
    """Radiance of a raw frame in its own geometry.

    Args:
        sensor: format of its words, and the black level where `black` is None.
        calibration: of the head.
        raw: words as stored, shape (h, w), uint16.
        exposure_time_s: of this exposure, positive.
        gain: of this exposure, linear, positive.
        black: word without light, as the head reports it for this frame.

    Returns:
        Shape (h, w), float32, W/m2/sr/nm. Noise may leave it below zero.

    Raises:
        ValueError: a frame of the wrong shape or type, or a time or gain that is not positive.

    Source: MicaSense, "RedEdge camera radiometric calibration model".

    Example:
        L = (word - black) a1 / (gain t 65536): half of the range at a1 = 1e-4, 1 ms.

        >>> from dataclasses import replace
        >>> from processing.rig import find_rig
        >>> sensor = replace(find_rig("rededge").sensor("G"), width_px=2, height_px=1)
        >>> response = RadianceCalibration(1e-4, 0.0, 0.0, (0.5, 0.0), (), 560.0, 20.0)
        >>> words = np.full((1, 2), 32768 + 4800, np.uint16)
        >>> radiance_from_raw(sensor, response, words, exposure_time_s=0.001)
        array([[0.05, 0.05]], dtype=float32)
    """
    shape = (sensor.height_px, sensor.width_px)
    if raw.shape != shape or raw.dtype != np.uint16:
        raise ValueError(
            f"frame of {sensor.name} is {raw.dtype} of shape {raw.shape}; uint16 of {shape}"
        )
    if not (exposure_time_s > 0.0 and gain > 0.0):
        raise ValueError(
            f"{sensor.name}: exposure time {exposure_time_s:g} s and gain {gain:g}; radiance needs "
            f"both, and positive"
        )
    if black is None:
        black = sensor.black_dn * sensor.raw_units_per_dn
    # A right-justified word is carried to the 16 bits the calibration is made for.
    unit = (1 << (16 - sensor.bits)) / sensor.raw_units_per_dn
    row = np.arange(sensor.height_px, dtype=np.float64)[:, None]
    fall_off = _fall_off(calibration, shape)
    rows = 1.0 + calibration.a2 * row / exposure_time_s - calibration.a3 * row
    scale = unit * calibration.a1 / (gain * exposure_time_s * _VALUE_RANGE)
    radiance: Array = ((raw - black) * scale / (fall_off * rows)).astype(np.float32)
    return radiance


def _fall_off(calibration: RadianceCalibration, shape: tuple[int, int]) -> Array:
    """1 / V of each pixel, shape (h, w)."""
    column = np.arange(shape[1], dtype=np.float64)[None, :]
    row = np.arange(shape[0], dtype=np.float64)[:, None]
    if not calibration.vignetting_powers:
        centre = calibration.vignetting_centre_px
        r = np.hypot(column - centre[0], row - centre[1])
        return np.polynomial.polynomial.polyval(r, (1.0, *calibration.vignetting))
    x, y = column / shape[1], row / shape[0]
    terms = zip(calibration.vignetting, calibration.vignetting_powers, strict=True)
    return np.asarray(sum(k * x**p * y**q for k, (p, q) in terms))


def saturated_pixels(sensor: Sensor, raw: Array) -> Array:
    """Where a raw frame is at full scale.

    Args:
        sensor: format of its words.
        raw: words as stored, shape (h, w), uint16.

    Returns:
        Shape (h, w), bool.

    Example:
        12 bits, left-justified: 4095 * 16.

        >>> from processing.rig import find_rig
        >>> saturated_pixels(find_rig("rededge").sensor("G"), np.array([[65504, 65520]], np.uint16))
        array([[False,  True]])
    """
    full: Array = raw >= sensor.full_scale_dn * sensor.raw_units_per_dn
    return full


def radiance_as_json(calibration: RadianceCalibration) -> dict[str, Any]:
    """The content of `<sensor>.json`.

    Args:
        calibration: to be written.

    Returns:
        The fields by name, tuples as lists.
    """
    content = asdict(calibration)
    if not calibration.vignetting_powers:
        del content["vignetting_powers"]
    return {
        key: list(value) if isinstance(value, tuple) else value for key, value in content.items()
    }


def load_radiance(path: Path) -> RadianceCalibration:
    """Read `<sensor>.json`, which holds exactly the fields of `RadianceCalibration`.

    Args:
        path: of the file.

    Returns:
        The calibration.

    Raises:
        CalibrationError: the file is missing, too large, damaged, or holds other than it should.
    """
    try:
        if path.stat().st_size > RADIANCE_FILE_MAX_BYTES:
            raise CalibrationError(
                f"{path.name}: larger than {RADIANCE_FILE_MAX_BYTES} bytes; not a calibration"
            )
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise CalibrationError(f"{path}: cannot be read ({reason}); give a JSON file") from error
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path.name}: not valid JSON ({error})") from error
    return _radiance_from_mapping(content, path.name)


def _radiance_from_mapping(content: Any, name: str) -> RadianceCalibration:
    """Build a calibration from parsed JSON; `name` begins the error sentences.

    Raises:
        CalibrationError: a key is missing, unknown, or no finite number.
    """
    keys = [field.name for field in fields(RadianceCalibration)]
    if isinstance(content, Mapping):
        content = {"vignetting_powers": [], **content}
    if not isinstance(content, Mapping) or sorted(content) != sorted(keys):
        raise CalibrationError(f"{name}: holds other keys than it should: {', '.join(keys)}")
    centre = _numbers(content, "vignetting_centre_px", name)
    if len(centre) != 2:
        raise CalibrationError(f"{name}: vignetting_centre_px has two numbers, column and row")
    vignetting = _numbers(content, "vignetting", name)
    calibration = RadianceCalibration(
        vignetting_centre_px=(centre[0], centre[1]),
        vignetting=vignetting,
        vignetting_powers=_powers(content["vignetting_powers"], len(vignetting), name),
        **{key: _number(content[key], key, name) for key in keys if "vignetting" not in key},
    )
    if calibration.a1 <= 0.0:
        raise CalibrationError(f"{name}: a1 is {calibration.a1:g}; it is positive")
    return calibration


def _powers(values: Any, count: int, name: str) -> tuple[tuple[int, int], ...]:
    """Pairs of powers, as many as there are coefficients, or none."""
    if not isinstance(values, list) or len(values) not in (0, count):
        raise CalibrationError(f"{name}: vignetting_powers is a list with a pair for each k")
    pairs = []
    for pair in values:
        if not (
            isinstance(pair, list)
            and len(pair) == 2
            and all(type(power) is int and 0 <= power <= POWER_MAX for power in pair)
        ):
            raise CalibrationError(
                f"{name}: vignetting_powers has {pair!r}; two whole numbers from 0 to {POWER_MAX} "
                "are needed"
            )
        pairs.append((pair[0], pair[1]))
    return tuple(pairs)


def _numbers(content: Mapping[str, Any], key: str, name: str) -> tuple[float, ...]:
    values = content[key]
    if not isinstance(values, list) or len(values) > _TERMS_MAX:
        raise CalibrationError(f"{name}: {key} is a list of at most {_TERMS_MAX} numbers")
    return tuple(_number(value, key, name) for value in values)


def _number(value: Any, key: str, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CalibrationError(f"{name}: {key} is {value!r}; a finite number is needed")
    return float(value)
