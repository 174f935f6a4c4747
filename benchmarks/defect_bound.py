"""`python -m benchmarks.defect_bound`: how well could anybody fill a defect from its neighbours?

What is left of missing pixels by the best linear prediction from all other pixels, however many,
follows from the power spectrum of light and noise: the covariance of missing pixels given the rest
is the inverse of their block of the inverse covariance, which is the spectrum's reciprocal
transformed (Kolmogorov 1941; Grenander and Rosenblatt, Statistical Analysis of Stationary Time
Series, 1957). Next to it: the error the pipeline leaves at defects put into the same frames.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import rendered
from benchmarks.seam_radiometry import RIG, SEED, Head, heads_of, light_of
from daemon.cli.benchmark.measurement import machine
from processing.radiometry.corrector import corrector_for
from processing.radiometry.level1 import level1_counts_per_dn, level1_from_level0
from sim_hw.world.scene import open_scene
from sim_hw.world.seeding import random_stream
from sim_hw.world.world import World

Array = NDArray[np.float64]

KINDS: Final = ("single", "column", "3 x 3")
LIGHTS: Final[Mapping[str, tuple[str, float]]] = {
    "real imagery, 20%": ("real imagery", 0.2),
    "real imagery, 50%": ("real imagery", 0.5),
    "real imagery, 80%": ("real imagery", 0.8),
    "real imagery, own contrast": ("own", 0.0),
}
BLOCK_PX: Final = 96
NEAR_PX: Final = 6
STEP_PX: Final = 17
"""From one defect that is put in to the next."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.defect_bound", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--seed", type=int, default=SEED, help="of scene, flight and noise")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="syntopic-defects-") as folder:
        found = measure(Path(folder), seed=options.seed)
    if options.json:
        print(json.dumps({"machine": machine(), "lights": found}))
        return
    print("| light | " + " | ".join(f"{kind}: ours, bound" for kind in KINDS) + " |")
    print("|---|---|---|---|")
    for light, row in found.items():
        cells = (f"{row[kind][0]:.2f}, {row[kind][1]:.2f}" for kind in KINDS)
        print(f"| {light} | " + " | ".join(cells) + " |")


def measure(scenes: Path, *, seed: int = SEED) -> dict[str, dict[str, tuple[float, float]]]:
    """By light and kind of defect: RMS of what the pipeline leaves and the least of any linear
    prediction, in standard deviations of a good pixel's noise, over all PAN sensors."""
    world = World(rendered.world_settings(RIG, seed))
    exposure = rendered.take(world, scenes, scene=open_scene(world.scene_settings, scenes))
    conditions = rendered.conditions_of(exposure, seed=seed)
    heads = heads_of(world, changed=False)
    found = {}
    for light_name, (what, level) in LIGHTS.items():
        light = exposure.snapshot.light
        if level:
            light = light_of(world, heads, exposure.snapshot, what, level)
        spectra: list[Array] = []
        left: dict[str, list[Array]] = {kind: [] for kind in KINDS}
        for cone in world.rig.pan_cones:
            for sensor in cone.sensors:
                head, look = heads[sensor.name], exposure.snapshot.parameters_by_sensor[sensor.name]
                temperature_c = conditions.temperatures_c[sensor.probe]
                assert temperature_c is not None
                frame = NoisyFrame(head, light[sensor.name], look.exposure_time_us, temperature_c)
                spectra += frame.spectra()
                for kind, errors in left.items():
                    errors.append(frame.left_by(kind))
        minimum = bounds(np.mean(spectra, axis=0))
        found[light_name] = {
            kind: (float(np.sqrt(np.mean(np.concatenate(left[kind]) ** 2))), minimum[kind])
            for kind in KINDS
        }
    return found


class NoisyFrame:
    """One frame without TDI, so that a defect spoils itself alone; all in its noise's sigmas."""

    def __init__(self, head: Head, light: Any, exposure_time_us: float, temperature_c: float):
        self._head, self._time_us, self._temperature_c = head, exposure_time_us, temperature_c
        sensor, truth = head.sensor, head.truth
        self._ideal = np.asarray(head.electronics.linear_dn(light, exposure_time_us), np.float64)
        electrons = self._ideal * truth.response * sensor.electrons_per_dn + sensor.read_noise_e**2
        self._sigma = np.sqrt(electrons) / sensor.electrons_per_dn / truth.response
        self._raw = head.electronics.frame(
            light,
            exposure_time_us=exposure_time_us,
            tdi_shifts=0,
            gain_db=0.0,
            temperature_c=temperature_c,
            random=random_stream(SEED, "noise", sensor.name),
        )
        pixels = self._level1(truth.defect)
        spoilt = (truth.defect != 0) | (pixels == 0) | ((pixels & 1) != 0)
        spoilt[[0, -1]] = spoilt[:, [0, -1]] = True
        near = np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8)
        self._good = cv2.dilate(spoilt.astype(np.uint8), near) == 0

    def _level1(self, defect: NDArray[np.uint8]) -> NDArray[np.uint16]:
        sensor = self._head.sensor
        pixels = np.zeros((sensor.height_px, sensor.width_px), np.uint16)
        level1_from_level0(
            corrector_for(sensor, replace(self._head.calibration, defect=defect)),
            self._raw,
            temperature_c=self._temperature_c,
            exposure_time_s=self._time_us * 1e-6,
            tdi_shifts=0,
            out=pixels,
        )
        return pixels

    def left_by(self, kind: str) -> Array:
        """Errors of the pipeline at defects of this kind that are put in."""
        put = np.zeros(self._ideal.shape, np.bool_)
        if kind == "single":
            put[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX] = True
        elif kind == "column":
            put[:, STEP_PX // 2 :: STEP_PX] = True
        else:
            for row, column in np.ndindex(3, 3):
                put[STEP_PX // 2 + row :: STEP_PX, STEP_PX // 2 + column :: STEP_PX] = True
        pixels = self._level1(((self._head.truth.defect != 0) | put).astype(np.uint8))
        seen = (pixels & 0xFFFE) / level1_counts_per_dn(self._head.sensor.bits)
        compared = put & self._good
        return np.asarray(((seen - self._ideal) / self._sigma)[compared])

    def spectra(self) -> list[Array]:
        """Power spectra of the light, block by block."""
        hann = np.hanning(BLOCK_PX + 1)[:-1]
        window = np.outer(hann, hann)
        window /= np.sqrt(np.sum(window**2))
        found = []
        height, width = self._ideal.shape
        for row in range(NEAR_PX, height - BLOCK_PX - NEAR_PX, BLOCK_PX // 2):
            for column in range(NEAR_PX, width - BLOCK_PX - NEAR_PX, BLOCK_PX // 2):
                part = (slice(row, row + BLOCK_PX), slice(column, column + BLOCK_PX))
                block = self._ideal[part] / np.mean(self._sigma[part])
                found.append(np.abs(np.fft.fft2((block - block.mean()) * window)) ** 2)
        return found


def bounds(spectrum: Array) -> dict[str, float]:
    """Least RMS error against the light, by kind, where light has this power spectrum.

    Args:
        spectrum: (n, n), light in units of the noise, which is white and one.
    """
    total_power = spectrum + 1.0
    precision = np.fft.ifft2(1.0 / total_power).real
    column = float(np.mean(1.0 / np.mean(1.0 / total_power, axis=1)))
    places = [(row, k) for row in range(3) for k in range(3)]
    of_dust = np.array([[precision[a - c, b - d] for c, d in places] for a, b in places])
    dust = float(np.mean(np.diag(np.linalg.inv(of_dust))))
    variances = (1.0 / float(precision[0, 0]), column, dust)
    # A missing pixel's own noise is in these, and no error against the light.
    return {k: math.sqrt(max(v - 1.0, 0.0)) for k, v in zip(KINDS, variances, strict=True)}


if __name__ == "__main__":
    main()
