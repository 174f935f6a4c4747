"""`python -m benchmarks.seam_radiometry`: how far the heads disagree along the seams.

Even light and real imagery go through the emulated electronics and back through the laboratory's
calibration and the balance of the heads; then both sides of every seam are compared before they are
faded into each other, in squares of 32 px along its whole length. Also reported is how far
interpolated defects are from the light that was there.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import rendered
from daemon.cli.benchmark.measurement import machine
from processing.image.composition import PanComposer, pan_cell_px
from processing.image.kernels import DEFAULT_INTERPOLATION
from processing.pipelines.stitched import Conditions, Pipeline, PipelineSettings, Product
from processing.radiometry.calibration import RadiometricCalibration
from processing.radiometry.corrector import corrector_for
from processing.radiometry.level1 import exposed_rows, level1_counts_per_dn, level1_from_level0
from processing.rig import Cone, Sensor
from sim_hw.world import sensor_calibration
from sim_hw.world.electronics import Electronics, SensorTruth, over_tdi_path, true_sensor
from sim_hw.world.rendering import ExposureParameters
from sim_hw.world.scene import open_scene
from sim_hw.world.seeding import random_stream
from sim_hw.world.snapshots import Snapshot
from sim_hw.world.world import World

Map = NDArray[np.float32]
Array = NDArray[np.float64]

RIG = "ultracam-x-mini"
SEED = 5
STRIP_PX = 32
LEVELS = (0.2, 0.5, 0.8)
TEXTURE = 0.25
"""How much of its own contrast an image keeps at one level, so that its lights do not burn out."""
BRIGHTEST = 0.97
MIN_COLUMN_PX = 64
"""Length from which spoilt pixels above each other are a defect column."""
DUST = 12
DUST_PX = 3
"""Grains on every sensor in addition to its own defects, and the side of one."""
GAIN_CHANGE = 0.01
BLACK_CHANGE_DN = 2.0
"""What heads may have changed by since the laboratory saw them (standard deviations)."""


@dataclass(frozen=True)
class Seams:
    """|L - R| / mean of all strips of one scene, in per cent of the signal."""

    scene: str
    level: float
    strips: int
    rms: float
    p99: float
    largest: float
    inside: float
    noise: float


@dataclass(frozen=True)
class Defects:
    """Interpolated pixels against the light, in standard deviations of a good pixel's noise.

    `single`, `column` and `dust` are the root mean squares of the three kinds.
    """

    scene: str
    pixels: int
    rms: float
    single: float
    column: float
    dust: float
    median: float
    inside_1: float
    good_rms: float
    rms_of_contrast: float


@dataclass(frozen=True)
class Head:
    """One sensor: what it is now, and what the laboratory found before."""

    cone: Cone
    sensor: Sensor
    electronics: Electronics
    truth: SensorTruth
    calibration: RadiometricCalibration


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.seam_radiometry")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rig", default=RIG, help="a shipped rig")
    parser.add_argument("--scenes", type=Path, help="folder where built scenes are kept")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="syntopic-seams-") as folder:
        seams, defects = measure(options.scenes or Path(folder), rig=options.rig)
    if options.json:
        result = {"seams": [asdict(s) for s in seams], "defects": [asdict(d) for d in defects]}
        print(json.dumps({"machine": machine(), **result}))
        return
    print("| scene | level | strips | RMS % | 99 % below | largest % | within 0.2 % | noise % |")
    print("|---|---|---|---|---|---|---|---|")
    for s in seams:
        print(
            f"| {s.scene} | {s.level:.0%} | {s.strips} | {s.rms:.3f} | {s.p99:.3f} "
            f"| {s.largest:.3f} | {s.inside:.1%} | {s.noise:.3f} |"
        )
    print(
        "\n| defects of | pixels | RMS | single | column | dust | median | within 1 "
        "| good pixels RMS | RMS of contrast |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for d in defects:
        print(
            f"| {d.scene} | {d.pixels} | {d.rms:.2f} | {d.single:.2f} | {d.column:.2f} "
            f"| {d.dust:.2f} | {d.median:.2f} | {d.inside_1:.1%} | {d.good_rms:.2f} "
            f"| {d.rms_of_contrast:.2f} |"
        )


def measure(
    scenes: Path,
    *,
    rig: str = RIG,
    levels: Sequence[float] = LEVELS,
    changes: Sequence[bool] = (False, True),
    own_contrast: bool = True,
) -> tuple[list[Seams], list[Defects]]:
    """Even light and real imagery at some levels, heads as calibrated and changed since.

    Args:
        scenes: folder where built scenes are kept.
        rig: a shipped rig.
        levels: shares of full scale.
        changes: whether the heads have changed since their calibration.
        own_contrast: real imagery as it is, too.
    """
    world = World(rendered.world_settings(rig, SEED))
    scene = open_scene(world.scene_settings, scenes)
    exposure = rendered.take(world, scenes, scene=scene)
    conditions = rendered.conditions_of(exposure, seed=SEED)
    seams: list[Seams] = []
    defects: list[Defects] = []
    for changed in changes:
        heads = heads_of(world, changed=changed)
        calibrations = {name: head.calibration for name, head in heads.items()}
        pipeline = Pipeline(world.rig, calibrations, PipelineSettings(geometry=False))
        label = ", heads changed since calibration" if changed else ""
        lights: dict[tuple[str, float], Mapping[str, Map]] = {
            (f"{kind}{label}", level): light_of(world, heads, exposure.snapshot, kind, level)
            for level in levels
            for kind in ("even light", "real imagery")
        }
        if own_contrast:
            lights[f"real imagery, own contrast{label}", 0.0] = exposure.snapshot.light
        for (name, level), light in lights.items():
            frames = frames_of(world, heads, exposure.snapshot, light)
            product = pipeline.process(frames, conditions)
            seams.append(seams_of(world, heads, frames, conditions, product, name, level))
            if not changed:
                result = f"{name}, {level:.0%}" if level else name
                defects.append(
                    defects_of(world, heads, frames, exposure.snapshot, conditions, light, result)
                )
    return seams, defects


def heads_of(world: World, *, changed: bool) -> dict[str, Head]:
    """Measured by the laboratory; then, where `changed`, of another gain and black each."""
    heads = {}
    for cone in world.rig.cones:
        for sensor in cone.sensors:
            truth = true_sensor(cone, sensor, SEED, field_radius_mm=world.field_radius_mm(cone))
            truth = replace(truth, defect=dusty(truth.defect, sensor.name))
            measured = sensor_calibration.measure(sensor, truth, SEED)
            if changed:
                gain, black = random_stream(SEED, "change", sensor.name).normal(0.0, 1.0, 2)
                truth = replace(
                    truth,
                    response=truth.response * np.float32(1.0 + GAIN_CHANGE * gain),
                    bias_dn=truth.bias_dn + np.float32(BLACK_CHANGE_DN * black),
                )
            heads[sensor.name] = Head(
                cone,
                sensor,
                Electronics(sensor, truth, world.electrons_per_radiance_s(cone)),
                truth,
                RadiometricCalibration(**measured.arrays()),
            )
    return heads


def dusty(defect: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """A map of defects with grains of dust."""
    found = defect.copy()
    random = random_stream(SEED, "dust", name)
    rows = random.integers(0, found.shape[0] - DUST_PX, DUST)
    columns = random.integers(0, found.shape[1] - DUST_PX, DUST)
    for row, column in zip(rows, columns, strict=True):
        found[row : row + DUST_PX, column : column + DUST_PX] = 1
    return found


def light_of(
    world: World, heads: Mapping[str, Head], snapshot: Snapshot, kind: str, level: float
) -> dict[str, Map]:
    """Light on every sensor with a mean of `level` of full scale for an ideal pixel on the axis."""
    mean = np.mean([float(np.mean(snapshot.light[name])) for name in heads])
    light = {}
    for name, head in heads.items():
        look = snapshot.parameters_by_sensor[name]
        unit = float(
            head.electronics.linear_dn(np.ones((1, 1), np.float32), look.exposure_time_us)[0, 0]
        )
        full = head.sensor.full_scale_dn / unit
        seen = snapshot.light[name]
        if kind == "even light":
            light[name] = np.full(seen.shape, level * full, np.float32)
            continue
        contrast = np.float32(TEXTURE) * (seen / np.float32(mean) - np.float32(1.0))
        wanted = np.float32(level * full) * (np.float32(1.0) + contrast)
        light[name] = np.clip(wanted, 0.0, BRIGHTEST * full).astype(np.float32)
    return light


def frames_of(
    world: World, heads: Mapping[str, Head], snapshot: Snapshot, light: Mapping[str, Map]
) -> dict[str, NDArray[np.uint16]]:
    frames = {}
    for name, head in heads.items():
        look = snapshot.parameters_by_sensor[name]
        frames[name] = head.electronics.frame(
            light[name],
            exposure_time_us=look.exposure_time_us,
            tdi_shifts=look.tdi_shifts,
            gain_db=0.0,
            temperature_c=world.temperature_c(head.sensor.probe, look.mid_gps_ns),
            random=random_stream(SEED, "noise", name),
        )
    return frames


def level1_of(
    head: Head, raw: NDArray[np.uint16], look: ExposureParameters, conditions: Conditions, out: Any
) -> None:
    """The Level-1 words of a frame as the pipeline makes them."""
    level1_from_level0(
        corrector_for(head.sensor, head.calibration),
        raw,
        temperature_c=conditions.temperatures_c.get(head.sensor.probe),
        exposure_time_s=look.exposure_time_us * 1e-6,
        tdi_shifts=look.tdi_shifts,
        out=out,
    )


def seams_of(
    world: World,
    heads: Mapping[str, Head],
    frames: Mapping[str, NDArray[np.uint16]],
    conditions: Conditions,
    product: Product,
    scene: str,
    level: float,
) -> Seams:
    """Every sensor resampled alone, with the gain and offset of the balance, along all seams."""
    owner = (product.valid & 0x7F).astype(np.int64)
    sides = []
    for name in product.sensors:
        head = heads[name]
        composer = PanComposer(world.image, [head.sensor], cell_px=pan_cell_px(world.rig))
        look = ExposureParameters(
            0, conditions.exposure_time_s[name] * 1e6, conditions.tdi_shifts[name]
        )
        level1_of(head, frames[name], look, conditions, composer.frame(name))
        alone = composer.compose(
            product.mosaic.placements, [name], feather_px=16, interpolation=DEFAULT_INTERPOLATION
        )
        gain = product.balance.gains[name]
        offset = product.balance.offsets.get(name, 0.0)
        value = alone.pan.astype(np.float32) * np.float32(gain) + np.float32(offset)
        sides.append(np.where(alone.pan > 0, value, np.float32(np.nan)))
    found = []
    for upright in (True, False):
        whose = owner if upright else owner.T
        images = sides if upright else [side.T for side in sides]
        found += _strips(whose, images)
    off = np.array([100.0 * abs(a - b) / (0.5 * (a + b)) for a, b in found])
    signal = np.array([0.5 * (a + b) for a, b in found])
    sensor = heads[product.sensors[0]].sensor
    dn = signal / level1_counts_per_dn(sensor.bits)
    electrons = np.maximum(dn, 1.0) * sensor.electrons_per_dn
    noise = np.sqrt(electrons + sensor.read_noise_e**2) / electrons / STRIP_PX * np.sqrt(2.0)
    return Seams(
        scene=scene,
        level=level,
        strips=len(off),
        rms=float(np.sqrt(np.mean(off**2))),
        p99=float(np.percentile(off, 99.0)),
        largest=float(off.max()),
        inside=float(np.mean(off <= 0.2)),
        noise=float(100.0 * np.sqrt(np.mean(noise**2))),
    )


def _strips(owner: NDArray[np.int64], images: Sequence[Map]) -> list[tuple[float, float]]:
    """Means of both sides over squares of 32 px along all upright seams of an image."""
    left, right = owner[:, :-1], owner[:, 1:]
    rows, columns = np.nonzero((left != right) & (left > 0) & (right > 0))
    pairs = np.stack([left[rows, columns], right[rows, columns]], axis=1)
    half = STRIP_PX // 2
    found = []
    for a, b in np.unique(pairs, axis=0):
        own_side = (pairs[:, 0] == a) & (pairs[:, 1] == b)
        for strip in np.unique(rows[own_side] // STRIP_PX):
            here = own_side & (rows // STRIP_PX == strip)
            if np.count_nonzero(here) < STRIP_PX:
                continue
            sums, pixels = np.zeros(2), 0
            for row, column in zip(rows[here], columns[here], strict=True):
                window = slice(max(column + 1 - half, 0), column + 1 + half)
                one, other = images[a - 1][row, window], images[b - 1][row, window]
                good = np.isfinite(one) & np.isfinite(other)
                sums += (float(one[good].sum()), float(other[good].sum()))
                pixels += int(good.sum())
            if pixels >= STRIP_PX * STRIP_PX // 2:
                found.append((sums[0] / pixels, sums[1] / pixels))
    return found


def defects_of(
    world: World,
    heads: Mapping[str, Head],
    frames: Mapping[str, NDArray[np.uint16]],
    snapshot: Snapshot,
    conditions: Conditions,
    light: Mapping[str, Map],
    scene: str,
) -> Defects:
    """Interpolated pixels of all PAN sensors against the light that fell on them."""
    off, spread, good = [], [], []
    kinds: list[NDArray[np.uint8]] = []
    for cone in world.rig.pan_cones:
        for sensor in cone.sensors:
            head, look = heads[sensor.name], snapshot.parameters_by_sensor[sensor.name]
            out = np.zeros(frames[sensor.name].shape, np.uint16)
            level1_of(head, frames[sensor.name], look, conditions, out)
            ideal = head.electronics.linear_dn(light[sensor.name], look.exposure_time_us)
            path = {"shifts": look.tdi_shifts, "row_sign": sensor.tdi_row_sign}
            response = over_tdi_path(head.truth.response, **path)
            electrons = ideal * response * sensor.electrons_per_dn + sensor.read_noise_e**2
            sigma = np.sqrt(electrons) / sensor.electrons_per_dn / response
            error = out / level1_counts_per_dn(sensor.bits) - ideal
            inner = np.zeros(out.shape, np.bool_)
            first, last = exposed_rows(sensor, look.tdi_shifts)
            inner[first + 8 : last - 7, 8:-8] = True
            inner &= (out > 0) & ((out & 1) == 0)
            spoilt = over_tdi_path(head.truth.defect.astype(np.float32), **path) > 0
            kinds.append(kinds_of(spoilt, look.tdi_shifts)[inner & spoilt])
            off.append((error / sigma)[inner & spoilt])
            good.append((error / sigma)[inner & ~spoilt][::50])
            mean = _box(ideal)
            local = np.sqrt(np.maximum(_box(ideal * ideal) - mean * mean, 0.0) + sigma**2)
            spread.append((error / local)[inner & spoilt])
    z, contrast, kind = np.concatenate(off), np.concatenate(spread), np.concatenate(kinds)
    single, column, dust = (float(np.sqrt(np.mean(z[kind == k] ** 2))) for k in range(3))
    return Defects(
        scene=scene,
        pixels=len(z),
        rms=float(np.sqrt(np.mean(z**2))),
        single=single,
        column=column,
        dust=dust,
        median=float(np.median(np.abs(z))),
        inside_1=float(np.mean(np.abs(z) < 1.0)),
        good_rms=float(np.sqrt(np.mean(np.concatenate(good) ** 2))),
        rms_of_contrast=float(np.sqrt(np.mean(contrast**2))),
    )


def kinds_of(spoilt: NDArray[np.bool_], tdi_shifts: int) -> NDArray[np.uint8]:
    """0 where a single pixel spoils, 1 where a column, 2 where more side by side."""
    _, labels, found, _ = cv2.connectedComponentsWithStats(spoilt.astype(np.uint8), connectivity=8)
    width, height, area = (found[:, k] for k in (2, 3, 4))
    kind = np.where(height >= MIN_COLUMN_PX, 1, np.where(area > tdi_shifts + 1, 2, 0))
    kind[(kind == 2) & (width == 1)] = 0
    return np.asarray(kind.astype(np.uint8)[labels])


def _box(values: Map) -> Map:
    """Means over 7 x 7 pixels."""
    padded = np.pad(values.astype(np.float64), ((4, 3), (4, 3)), mode="edge")
    sums = padded.cumsum(axis=0).cumsum(axis=1)
    box = sums[7:, 7:] - sums[:-7, 7:] - sums[7:, :-7] + sums[:-7, :-7]
    return np.asarray(box / 49.0, np.float32)


if __name__ == "__main__":
    main()
