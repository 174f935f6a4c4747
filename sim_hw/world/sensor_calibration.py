"""The emulated calibration laboratory: measures the emulated sensors and writes the results.

What it writes is what a laboratory can know: averages of a stated number of frames with their
noise, never the truth itself. The files are those the pipeline reads (docs/reference/formats.md).
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.rig import Sensor
from sim_hw.world import electronics
from sim_hw.world.atomic_file import atomic_file
from sim_hw.world.electronics import Map, SensorTruth
from sim_hw.world.seeding import random_stream

BIAS_FRAMES = 64
DARK_FRAMES = 16
DARK_EXPOSURE_S = 2.0
FLAT_FRAMES = 100
FLAT_LEVEL = 0.5
"""Light on the flat field, as a share of the converter's range."""
QUANTISATION_DN = 12**-0.5
MEDIAN_PX = 5


@dataclass(frozen=True)
class Radiometry:
    """What the laboratory found: signal = (DN - bias - dark(T) t) gain, maps (height, width)."""

    bias_dn: Map
    dark_dn_per_s: NDArray[np.float16]
    reference_c: float
    doubling_k: float
    gain: Map
    defect: NDArray[np.uint8]

    def arrays(self) -> dict[str, Any]:
        """As they are stored."""
        return {
            "bias_dn": self.bias_dn,
            "dark_dn_per_s": self.dark_dn_per_s,
            "reference_c": np.array(self.reference_c),
            "doubling_k": np.array(self.doubling_k),
            "gain": self.gain,
            "defect": self.defect,
        }


def measure(sensor: Sensor, truth: SensorTruth, seed: int) -> Radiometry:
    """Bias, dark and flat series of one head, without TDI, at its reference temperature.

    Bias from 64 frames of no exposure, dark signal from 16 of 2 s, gain from 100 at half range.
    """
    random = random_stream(seed, "laboratory", sensor.name)
    shape = truth.response.shape
    epd = sensor.electrons_per_dn

    def noise(variance_e: Map | float, frames: int) -> Map:
        sigma = np.sqrt((variance_e / epd**2 + QUANTISATION_DN**2) / frames)
        deviate = random.standard_normal(shape, dtype=np.float32)
        return np.asarray(deviate * sigma, dtype=np.float32)

    read_variance = sensor.read_noise_e**2
    bias = truth.bias_dn + noise(read_variance, BIAS_FRAMES)
    charge = truth.dark_e_per_s * np.float32(DARK_EXPOSURE_S)
    dark = truth.bias_dn + charge / np.float32(epd) + noise(charge + read_variance, DARK_FRAMES)
    # A hot pixel saturates within the exposure: the converter shows no more.
    dark = np.minimum(dark, np.float32(sensor.full_scale_dn))
    dark_rate = (dark - bias) / np.float32(DARK_EXPOSURE_S)
    light = FLAT_LEVEL * sensor.full_scale_dn * epd
    flat_signal = truth.response * np.float32(light)
    flat = flat_signal / np.float32(epd) + noise(flat_signal + read_variance, FLAT_FRAMES)
    good = np.where(truth.defect > 0, np.nan, flat)
    gain = np.float32(light / epd) / _without_gaps(good)
    return Radiometry(
        bias_dn=np.asarray(bias, dtype=np.float32),
        dark_dn_per_s=dark_rate.astype(np.float16),
        reference_c=electronics.DARK_REFERENCE_C,
        doubling_k=electronics.DARK_DOUBLING_K,
        gain=np.asarray(gain, dtype=np.float32),
        defect=truth.defect,
    )


def _without_gaps(flat: Map) -> Map:
    """Give defect pixels their neighbours' flat field, so that every gain is a sane one."""
    filled = np.where(np.isnan(flat), np.float32(np.nanmedian(flat)), flat).astype(np.float32)
    smooth = cv2.medianBlur(filled, MEDIAN_PX)
    return np.asarray(np.where(np.isnan(flat), smooth, flat), dtype=np.float32)


def write_rig(rig_file: Path, folder: Path) -> None:
    """Put the rig file, which holds the geometric calibration, into the calibration folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_file(folder / "rig.toml") as part:
        shutil.copyfile(rig_file, part)


def write_radiometry(folder: Path, sensor: Sensor, radiometry: Radiometry) -> None:
    """Write `radiometry/<sensor>.npz`."""
    (folder / "radiometry").mkdir(parents=True, exist_ok=True)
    path = folder / "radiometry" / f"{sensor.name}.npz"
    with atomic_file(path) as part, part.open("wb") as file:
        np.savez(file, **radiometry.arrays())
