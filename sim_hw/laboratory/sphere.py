"""Heads in front of an emulated integrating sphere: `python -m sim_hw.laboratory.sphere RIG`.

Writes dark and flat series as a laboratory would take them (frames and `series.json`), and apart
from them, in `truth/`, what the sensors really are. The frames come from the sensor model of
`electronics` with defects of its own in every strength, a diaphragm, a filter and a converter that
need not be straight.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import tifffile
from numpy.typing import NDArray

from processing.rig import Cone, Rig, Sensor
from sim_hw.laboratory.instrument_series import command, new_series, run, write_list
from sim_hw.world import electronics
from sim_hw.world.electronics import Map, over_tdi_path, true_sensor, vignetting
from sim_hw.world.seeding import random_stream

NONE, DEAD, HOT, COLUMN, CLUSTER, NOISY = range(6)

DEAD_PIXELS: Final = 60
HOT_PIXELS: Final = 60
NOISY_PIXELS: Final = 20
COLUMNS: Final = 4
CLUSTERS: Final = 8
CLUSTER_RADIUS_PX: Final = (1.5, 6.0)
NOISY_E: Final = 1500.0
FILTER_LOSS: Final = 0.12
"""What an interference filter loses at the corner of the field, where rays pass it aslant."""
MONITOR_NOISE: Final = 2e-4
PROBE_NOISE_K: Final = 0.05
REFERENCE_TIME_S: Final = 8e-3
STOPS: Final = (1.0, 1.4286, 2.0)
"""Apertures, as multiples of the f-number the head flies with."""
DARK_TIMES_S: Final = (0.001, 0.5, 2.0)
EXPOSURE_SHARES: Final = (
    0.015,
    0.04,
    0.08,
    0.14,
    0.2,
    0.28,
    0.36,
    0.44,
    0.52,
    0.6,
    0.68,
    0.76,
    0.84,
    0.9,
)
NEAR_FULL: Final = (0.94, 0.96, 0.98, 1.0, 1.02, 1.05, 1.1)
CHECKS: Final = (0.2, 0.5, 0.8)
TDI_SHIFTS: Final = (6, 12, 24)


@dataclass(frozen=True)
class HeadTruth:
    """What a sensor behind its lens is: maps (height, width).

    `response` without the lens, one for an ideal pixel; `natural` and `mechanical` make the
    vignetting 'natural * (1 - mechanical * (stop)^-2)'; `kind` names planted defects.
    """

    response: Map
    dark_e_per_s: Map
    bias_dn: Map
    noisy: NDArray[np.bool_]
    natural: Map
    mechanical: Map
    kind: NDArray[np.uint8]
    nonlinearity: float
    response_per_k: float = 0.0

    def lit(self, stop: float) -> Map:
        """Relative signal of even light at a multiple of the base f-number."""
        fall = self.natural * (1 - self.mechanical / np.float32(stop * stop))
        return np.asarray(self.response * fall, dtype=np.float32)


def head_truth(cone: Cone, sensor: Sensor, seed: int, *, nonlinearity: float = 0.0) -> HeadTruth:
    """Draw a head and plant defects in it: single pixels, columns, clusters, in every strength.

    A planted pixel answers with 80 % or less of its light, or has 20 times the dark signal or
    more, or is ten times as noisy as its neighbours; a column loses 6 % or more.
    """
    random = random_stream(seed, "sphere", sensor.name)
    radius = float(np.hypot(sensor.width_px, sensor.height_px)) / 2 * sensor.pitch_um * 1e-3
    radius += float(np.hypot(sensor.x_mm, sensor.y_mm))
    plain = true_sensor(cone, sensor, seed, field_radius_mm=radius)
    shape = plain.response.shape
    response = 1 + electronics.PRNU_SIGMA * random.standard_normal(shape, dtype=np.float32)
    response *= np.float32(1 + electronics.SENSOR_SIGMA * float(random.standard_normal()))
    dark = electronics.DARK_E_PER_S * random.lognormal(0, 0.2, shape).astype(np.float32)
    kind = np.zeros(shape, dtype=np.uint8)
    places = random.permutation(shape[0] * shape[1])[: DEAD_PIXELS + HOT_PIXELS + NOISY_PIXELS]
    dead, hot, noisy = np.split(places, [DEAD_PIXELS, DEAD_PIXELS + HOT_PIXELS])
    response.ravel()[dead] *= random.uniform(0.0, 0.8, len(dead)).astype(np.float32)
    dark.ravel()[hot] *= np.exp(random.uniform(np.log(20), np.log(3000), len(hot)))
    for index, name in ((dead, DEAD), (hot, HOT), (noisy, NOISY)):
        kind.ravel()[index] = name
    _plant_clusters(random, response, kind)
    _plant_columns(random, response, dark, kind)
    x2 = (sensor.x_mm + _offsets(sensor.width_px, sensor.pitch_um)) ** 2
    y2 = (sensor.y_mm - _offsets(sensor.height_px, sensor.pitch_um)) ** 2
    r2 = (x2[None, :] + y2[:, None]) / radius**2
    loss = electronics.CORNER_LOSS * r2
    natural = vignetting(cone, sensor, radius) / (1 - loss)
    if cone.role == "colour":
        natural = natural * (1 - FILTER_LOSS * r2)
    return HeadTruth(
        response=response,
        dark_e_per_s=dark,
        bias_dn=plain.bias_dn,
        noisy=kind == NOISY,
        natural=np.asarray(natural, dtype=np.float32),
        mechanical=np.asarray(loss, dtype=np.float32),
        kind=kind,
        nonlinearity=nonlinearity,
    )


def _offsets(count: int, pitch_um: float) -> NDArray[np.float64]:
    return np.asarray((np.arange(count) - (count - 1) / 2) * pitch_um * 1e-3)


def _plant_clusters(random: np.random.Generator, response: Map, kind: NDArray[np.uint8]) -> None:
    """Dust on the sensor's window, as discs with a shadow of one depth."""
    height, width = response.shape
    row, column = np.mgrid[:height, :width]
    for _ in range(CLUSTERS):
        at = random.uniform((0, 0), (height, width))
        disc = np.hypot(row - at[0], column - at[1]) < random.uniform(*CLUSTER_RADIUS_PX)
        response[disc] *= np.float32(random.uniform(0.2, 0.75))
        kind[disc] = CLUSTER


def _plant_columns(
    random: np.random.Generator, response: Map, dark: Map, kind: NDArray[np.uint8]
) -> None:
    """Traps that cost all that is read out through them a share, and one column that glows."""
    height, width = response.shape
    chosen = random.choice(np.arange(4, width - 4), COLUMNS, replace=False)
    for k, column in enumerate(chosen):
        first = int(random.integers(0, height // 2))
        if k == 0:
            dark[first:, column] *= np.float32(random.uniform(15, 60))
        else:
            response[first:, column] *= np.float32(random.uniform(0.4, 0.94))
        kind[first:, column] = COLUMN


@dataclass(frozen=True)
class SphereExposure:
    """One condition of a series and how many frames are taken in it."""

    light: str
    share: float
    exposure_time_s: float
    stop: float
    tdi_shifts: int
    temperature_c: float
    frames: int
    use: str = "fit"


def sphere_exposures(sensor: Sensor, frames: float) -> Iterator[SphereExposure]:
    """The series of one head. `frames` scales how many frames a condition has."""

    def of(count: int) -> int:
        return max(3, round(count * frames))

    base = electronics.DARK_REFERENCE_C
    half = 0.5 * REFERENCE_TIME_S
    for temperature in (base - 10, base, base + 15):
        for time in DARK_TIMES_S:
            yield SphereExposure("dark", 0.0, time, 1.0, 0, temperature, of(8))
    for share in (*EXPOSURE_SHARES, *NEAR_FULL):
        yield SphereExposure("flat", 1.0, share * REFERENCE_TIME_S, 1.0, 0, base, of(4))
    yield SphereExposure("flat", 1.0, half, 1.0, 0, base, of(48))
    for stop in STOPS[1:]:
        yield SphereExposure("flat", 1.0, half * stop * stop, stop, 0, base, of(6))
    for temperature in (base - 10, base + 15):
        yield SphereExposure("flat", 1.0, half, 1.0, 0, temperature, of(6))
    # A head of a Bayer sensor has no TDI: it would mix the colours.
    for shifts in TDI_SHIFTS if sensor.colour_filter_array == "none" else ():
        yield SphereExposure("flat", 1.0, half, 1.0, shifts, base + 5, 3, "check")
    for share in CHECKS:
        yield SphereExposure("flat", 1.0, share * REFERENCE_TIME_S, 1.0, 0, base + 5, 3, "check")
    yield SphereExposure("flat", 1.0, half * STOPS[1] ** 2, STOPS[1], 0, base + 5, 3, "check")


def frame(
    sensor: Sensor,
    truth: HeadTruth,
    shot: SphereExposure,
    random: np.random.Generator,
    *,
    temperature_c: float,
    lamp: float,
) -> NDArray[np.uint16]:
    """One frame of raw values, (height, width). `lamp` is the light now, one as it should be."""
    full = (sensor.full_scale_dn - sensor.black_dn) * sensor.electrons_per_dn
    seconds = np.float32(shot.exposure_time_s)
    light = shot.share * lamp * full / REFERENCE_TIME_S / shot.stop**2
    warm = 2.0 ** ((temperature_c - electronics.DARK_REFERENCE_C) / electronics.DARK_DOUBLING_K)
    light *= 1.0 + truth.response_per_k * (temperature_c - electronics.DARK_REFERENCE_C)
    rate = truth.lit(shot.stop) * np.float32(light) + truth.dark_e_per_s * np.float32(warm)
    mean = over_tdi_path(rate, shifts=shot.tdi_shifts, row_sign=sensor.tdi_row_sign) * seconds
    variance = mean + np.float32(sensor.read_noise_e**2)
    deviate = random.standard_normal(mean.shape, dtype=np.float32)
    electrons = mean + np.sqrt(variance) * deviate
    where = np.nonzero(truth.noisy)
    electrons[where] += np.float32(NOISY_E) * random.choice([-1, 1], len(where[0]))
    dn = electrons / np.float32(sensor.electrons_per_dn)
    if truth.nonlinearity:
        span = np.float32(sensor.full_scale_dn - sensor.black_dn)
        dn = dn * (1 - np.float32(truth.nonlinearity) * dn / span)
    level = np.floor(truth.bias_dn + dn + np.float32(0.5))
    return np.asarray(np.clip(level, 0, sensor.full_scale_dn), dtype=np.uint16)


def write_series(
    rig: Rig,
    rig_file: Path,
    out: Path,
    *,
    seed: int,
    take: int = 1,
    sensors: Sequence[str],
    frames: float = 1.0,
    nonlinearity: float = 0.0,
    response_per_k: float = 0.0,
) -> Path:
    """Take the series of the named sensors; returns the folder with `series.json`.

    `seed` draws the sensors, `take` what happens while the series is taken: two takes of one seed
    are the same camera, calibrated twice.
    """
    series = new_series(out, rig_file)
    images = []
    for name in sensors:
        sensor, cone = rig.sensor(name), rig.cone_of(name)
        truth = head_truth(cone, sensor, seed, nonlinearity=nonlinearity)
        truth = replace(truth, response_per_k=response_per_k)
        random = random_stream(seed, "sphere frames", take, name)
        (series / name).mkdir()
        number = 0
        for index, shot in enumerate(sphere_exposures(sensor, frames)):
            for _ in range(shot.frames):
                temperature = shot.temperature_c + float(random.uniform(-0.3, 0.3))
                lamp = 1 + float(random.normal(0, 0.003))
                pixels = frame(sensor, truth, shot, random, temperature_c=temperature, lamp=lamp)
                file = f"{name}/{number:04d}.tif"
                tifffile.imwrite(series / file, pixels)
                number += 1
                images.append(
                    {
                        "file": file,
                        "sensor": name,
                        "set": f"{name}/{index}",
                        "light": shot.light,
                        "use": shot.use,
                        "monitor": shot.share * lamp * (1 + float(random.normal(0, MONITOR_NOISE))),
                        "exposure_time_us": round(shot.exposure_time_s * 1e6, 3),
                        "f_number": round(cone.lens.f_number * shot.stop, 1),
                        "tdi_shifts": shot.tdi_shifts,
                        "temperature_c": temperature + float(random.normal(0, PROBE_NOISE_K)),
                    }
                )
        np.savez(
            out / "truth" / f"{name}.npz",
            lit=truth.lit(1.0),
            kind=truth.kind,
            dark_e_per_s=truth.dark_e_per_s,
            bias_dn=truth.bias_dn,
        )
        print(f"{name}: {number} frames", file=sys.stderr)
    write_list(
        series,
        "radiometric",
        source="emulated integrating sphere",
        serials={"sphere": "SIM-SPHERE-1", "monitor": "SIM-DIODE-1", "probe": "SIM-PT100-1"},
        temperature_sigma_c=PROBE_NOISE_K,
        monitor_sigma=MONITOR_NOISE,
        images=images,
    )
    return series


def main(arguments: Sequence[str] | None = None) -> int:
    line = command("sphere", __doc__)
    line.add_argument("--sensor", action="append", help="only this sensor; may be repeated")
    line.add_argument("--frames", type=float, default=1.0, help="scales frames per condition")
    line.add_argument("--response-per-k", type=float, default=0.0, help="relative, 0.0005")
    line.add_argument("--nonlinearity", type=float, default=0.0, help="loss at full scale, 0.02")

    def take(rig: Rig, file: Path, given: argparse.Namespace) -> Path:
        return write_series(
            rig,
            file,
            given.out,
            seed=given.seed,
            take=given.take,
            sensors=given.sensor or [s.name for s in rig.sensors],
            frames=given.frames,
            nonlinearity=given.nonlinearity,
            response_per_k=given.response_per_k,
        )

    return run(line, arguments, take)


if __name__ == "__main__":
    sys.exit(main())
