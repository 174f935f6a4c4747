"""Radiometric calibration of a sensor: what it is, and the file that holds it.

The pass that applies it to pixels is in `processing.radiometry.level1`; balancing between heads,
which needs the overlaps, is in `processing.image.balance`. Source:
docs/explanation/mathematics/radiometry.md#offset-and-gain; Heier et al. (2002), 5.2.
"""

from __future__ import annotations

import math
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError
from processing.rig import Rig, Sensor

Array = NDArray[Any]

RADIOMETRY_FILE_MAX_BYTES: Final = 2_000_000_000
RADIOMETRY_MAX_PIXELS: Final = 120_000_000
GAIN_LIMITS: Final = (0.3, 10.0)
OFFSET_LIMIT_DN: Final = 65535.0

_KINDS: Final = {
    "bias_dn": "f",
    "dark_dn_per_s": "f",
    "doubling_k": "fiu",
    "reference_c": "fiu",
    "gain": "f",
    "defect": "ub",
    "response_per_k": "fiu",
}
_SCALARS: Final = ("doubling_k", "reference_c", "response_per_k")
_OPTIONAL: Final = "response_per_k"
RESPONSE_LIMIT_PER_K: Final = 0.01


class CalibrationError(ProcessingError, ValueError):
    """A calibration that cannot be used; the message names file, finding and remedy."""


@dataclass(frozen=True)
class RadiometricCalibration:
    """One sensor's response: signal = (DN - offset) * gain(T), pixel by pixel.

    offset(T, t) = bias_dn + dark_dn_per_s * t * 2**((T - reference_c) / doubling_k), t the exposure
    time in seconds; gain(T) = gain / (1 + response_per_k * (T - reference_c)). All maps have the
    shape of the sensor, (height, width). `defect` is not zero where a pixel's word means nothing.
    `gain` holds vignetting and filter too, where it was calibrated on the finished head.
    """

    bias_dn: Array
    dark_dn_per_s: Array
    doubling_k: float
    reference_c: float
    gain: Array
    defect: Array
    response_per_k: float = 0.0


def neutral_radiometry(sensor: Sensor) -> RadiometricCalibration:
    """The calibration of an uncalibrated sensor: the rig's black level, gain one, no defect.

    Args:
        sensor: size, black level and calibration temperature are used.

    Returns:
        Maps of the sensor's shape that share one value each.

    Example:
        >>> from processing.rig import find_rig
        >>> calibration = neutral_radiometry(find_rig("ultracam-x-mini").sensor("SU00"))
        >>> calibration.gain.shape, float(calibration.bias_dn[0, 0])
        ((832, 1248), 64.0)
    """
    shape = (sensor.height_px, sensor.width_px)
    return RadiometricCalibration(
        bias_dn=np.broadcast_to(np.float32(sensor.black_dn), shape),
        dark_dn_per_s=np.broadcast_to(np.float32(0.0), shape),
        doubling_k=6.0,
        reference_c=sensor.calibration_c,
        gain=np.broadcast_to(np.float32(1.0), shape),
        defect=np.broadcast_to(np.uint8(0), shape),
    )


def load_radiometry(path: Path) -> RadiometricCalibration:
    """Read `<sensor>.npz`, which holds the names of `RadiometricCalibration`; the last is optional.

    Nothing is unpickled, and no array is read before its announced size was checked.

    Args:
        path: of the file.

    Returns:
        The calibration, maps float32 and uint8.

    Raises:
        CalibrationError: the file is missing, too large, damaged, or holds other than it should.
    """
    try:
        if path.stat().st_size > RADIOMETRY_FILE_MAX_BYTES:
            raise CalibrationError(
                f"{path.name}: larger than {RADIOMETRY_FILE_MAX_BYTES} bytes; not a radiometry file"
            )
        with zipfile.ZipFile(path) as archive:
            values = _read_members(path.name, archive)
    except CalibrationError:
        raise
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise CalibrationError(f"{path}: cannot be read ({reason}); give an .npz file") from error
    except (
        zipfile.BadZipFile,
        zlib.error,
        ValueError,
        LookupError,
        TypeError,
        ArithmeticError,
        EOFError,
        SyntaxError,
        tokenize.TokenError,
        NotImplementedError,
        RuntimeError,
        MemoryError,
    ) as error:
        raise CalibrationError(
            f"{path.name}: damaged ({error}); write it with numpy.savez, keys {', '.join(_KINDS)}"
        ) from error
    calibration = RadiometricCalibration(
        bias_dn=values["bias_dn"].astype(np.float32, copy=False),
        dark_dn_per_s=values["dark_dn_per_s"].astype(np.float32, copy=False),
        doubling_k=float(values["doubling_k"]),
        reference_c=float(values["reference_c"]),
        gain=values["gain"].astype(np.float32, copy=False),
        defect=values["defect"].astype(np.uint8, copy=False),
        response_per_k=float(values.get(_OPTIONAL, 0.0)),
    )
    check_radiometry(path.name, calibration)
    return calibration


def check_radiometry(
    name: str, calibration: RadiometricCalibration, *, sensor: Sensor | None = None
) -> None:
    """Refuse maps of unlike shapes or impossible values; with a sensor, maps of another size.

    Args:
        name: what the sentences begin with.
        calibration: to be checked.
        sensor: whose size the maps have; None: any size.

    Raises:
        CalibrationError: what was found and what would be right, beginning with `name`.
    """
    shape = np.shape(calibration.gain)
    if sensor is not None and shape != (sensor.height_px, sensor.width_px):
        raise CalibrationError(
            f"{name}: maps are {shape}, sensor {sensor.name} is "
            f"{(sensor.height_px, sensor.width_px)} (rows, columns); calibrate this sensor"
        )
    for key in ("bias_dn", "dark_dn_per_s", "defect"):
        found = np.shape(getattr(calibration, key))
        if found != shape:
            raise CalibrationError(f"{name}: {key} is {found}, gain is {shape}; all maps are alike")
    limits = {
        "bias_dn": (0.0, OFFSET_LIMIT_DN),
        # A measured dark signal near zero is below it as often as not.
        "dark_dn_per_s": (-OFFSET_LIMIT_DN, OFFSET_LIMIT_DN * 1000.0),
        "gain": GAIN_LIMITS,
    }
    for key, (low, high) in limits.items():
        values = getattr(calibration, key)
        least, most = float(np.min(values)), float(np.max(values))
        if not (low <= least and most <= high):
            raise CalibrationError(
                f"{name}: {key} runs from {least:g} to {most:g}; it stays within {low:g}..{high:g}"
            )
    if not (math.isfinite(calibration.doubling_k) and calibration.doubling_k > 0):
        raise CalibrationError(f"{name}: doubling_k is {calibration.doubling_k}; it is positive")
    if not abs(calibration.response_per_k) <= RESPONSE_LIMIT_PER_K:
        raise CalibrationError(
            f"{name}: response_per_k is {calibration.response_per_k}; it stays within "
            f"{RESPONSE_LIMIT_PER_K:g} either way"
        )
    if not math.isfinite(calibration.reference_c):
        raise CalibrationError(f"{name}: reference_c is {calibration.reference_c}; it is finite")


def _read_members(file: str, archive: zipfile.ZipFile) -> dict[str, Array]:
    members = sorted(member.filename for member in archive.infolist())
    wanted = sorted(f"{key}.npy" for key in _KINDS if key != _OPTIONAL)
    keys = [key for key in _KINDS if key != _OPTIONAL or f"{key}.npy" in members]
    if members != sorted(f"{key}.npy" for key in keys):
        raise CalibrationError(
            f"{file}: holds {', '.join(members)[:200] or 'nothing'}; it holds {', '.join(wanted)}"
        )
    return {key: _read_array(file, key, archive) for key in keys}


def _read_array(file: str, key: str, archive: zipfile.ZipFile) -> Array:
    with archive.open(f"{key}.npy") as member:
        shape, dtype = _header(member)
    pixels = math.prod(shape)
    dimensions = 0 if key in _SCALARS else 2
    if dtype.kind not in _KINDS[key] or dtype.itemsize > 8:
        raise CalibrationError(f"{file}: {key} is of type {dtype}; see docs for the type it has")
    if len(shape) != dimensions or min(shape, default=1) < 1:
        raise CalibrationError(f"{file}: {key} has shape {shape}; it has {dimensions} dimensions")
    if pixels > RADIOMETRY_MAX_PIXELS:
        raise CalibrationError(
            f"{file}: {key} announces {pixels} pixels; a sensor has {RADIOMETRY_MAX_PIXELS} at most"
        )
    with archive.open(f"{key}.npy") as member:
        array: Array = np.lib.format.read_array(member, allow_pickle=False)
    return array


def _header(member: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(member)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read is None:
        raise ValueError(f"array format {version} is not read here")
    shape, _, dtype = read(member)
    return shape, dtype


class RadiometryFolder(Mapping[str, RadiometricCalibration]):
    """Calibrations `<sensor>.npz` by sensor, read on demand; a sensor without a file is not in it.

    As floating-point maps they are four times what a pipeline keeps of them; nothing is kept here.

    Raises:
        CalibrationError: when a requested file cannot be read.
    """

    def __init__(self, folder: Path, rig: Rig) -> None:
        paths = {sensor.name: folder / f"{sensor.name}.npz" for sensor in rig.sensors}
        self._paths = {name: path for name, path in paths.items() if path.exists()}

    def __getitem__(self, name: str) -> RadiometricCalibration:
        return load_radiometry(self._paths[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)
