"""`python -m benchmarks.flags`: false alarms of clean exposures, and misses where a fault is twice
what its flag's threshold allows.

Light falls on `ultracam-x-mini` at another place of the scene, attitude, dC and mounting each time,
and serves a few exposures, each with noise of sensors, probes and instruments of its own and with
places as another laboratory would have calibrated them. Faults are put into the light, the true
camera, the probes or the instruments, never into figures. The emulated mount's tremor does smear
now and then; such exposures are no clean ones and are drawn again.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.rendered import (
    RenderedExposure,
    conditions_of,
    flight_and_mark,
    process,
    radiometry_of,
    take,
    world_settings,
)
from daemon.cli.benchmark.measurement import machine
from processing.pipelines.stitched import Conditions, Pipeline, PipelineSettings, Product
from processing.quality.report import NO_FLAGS, Flag, Thresholds
from processing.rig import Rig
from sim_hw.world.rendering import residual_smear_px
from sim_hw.world.scene import open_scene
from sim_hw.world.snapshots import RigElectronics, exposure_parameters_of
from sim_hw.world.world import World

RIG = "ultracam-x-mini"
PLACES = 6
DRAWS = 5
"""Exposures made of one light."""
LARGEST_DC_K = 20.0
MAX_TRUE_SMEAR_PX = 0.6
"""True smear above which an exposure is no clean one: three quarters of the threshold."""
ATTEMPTS, ATTEMPT_SEEDS = 20, 1_000_000
THRESHOLDS = Thresholds()


@dataclass(frozen=True)
class Fault:
    """What is done to an exposure, and the flag it must raise.

    `world` are settings of the world that differ, by seed; `light` and `conditions` change what
    the sensors see and what the instruments say.
    """

    flag: Flag
    description: str
    world: Callable[[int], Mapping[str, object]] = lambda seed: {}
    light: Callable[[RenderedExposure], RenderedExposure] = lambda exposure: exposure
    conditions: Callable[[Conditions], Conditions] = lambda conditions: conditions


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.flags")
    add = parser.add_argument
    add("--clean", type=int, default=1000, help="clean exposures")
    add("--faulty", type=int, default=100, help="exposures of each fault")
    add("--fault", action="append", choices=sorted(FAULTS), help="only these; repeat")
    add("--first-seed", type=int, default=0, help="go on from an earlier run")
    add("--within-s", type=float, default=math.inf, help="stop after so long, and say how far")
    add("--scene-cache", type=Path, help="folder where built scenes are kept")
    add("--json", action="store_true", help="print one JSON object")
    given = parser.parse_args()
    until = time.monotonic() + given.within_s
    with tempfile.TemporaryDirectory(prefix="syntopic-flags-") as folder:
        camera = Camera(given.scene_cache or Path(folder))
        seeds = range(given.first_seed, given.first_seed + given.clean)
        clean = raised(camera, seeds, None, until)
        faulty = {
            name: raised(camera, range(50_000, 50_000 + given.faulty), FAULTS[name], until)
            for name in given.fault or FAULTS
        }
    result = {
        "machine": machine(),
        "clean": clean,
        "faults": {
            name: found | {"missed": missed(FAULTS[name], found)} for name, found in faulty.items()
        },
    }
    print(json.dumps(result) if given.json else table(result))


class Camera:
    """One emulated camera over one long scene; worlds differ by seed."""

    def __init__(self, scenes: Path, *, places: int = PLACES) -> None:
        self.places = places
        first = World(world_settings(RIG, 1, exposures=places))
        self.scene = open_scene(first.scene_settings, scenes)
        self.heads = RigElectronics(first, seed=1)
        settings = PipelineSettings(geometry=False, threads=1)
        self.pipeline = Pipeline(first.rig, radiometry_of(self.heads), settings)
        self._taken: tuple[int, Fault | None, RenderedExposure] | None = None

    def product(self, seed: int, fault: Fault | None) -> Product:
        """One exposure, processed; all that is random follows from the seed."""
        exposure = self._exposure(seed // DRAWS, fault)
        self.pipeline.rig = recalibrated(exposure.world, seed)
        conditions = conditions_of(exposure, seed=seed)
        if fault is not None:
            exposure, conditions = fault.light(exposure), fault.conditions(conditions)
        return process(self.pipeline, self.heads, exposure, seed=seed, conditions=conditions)

    def _exposure(self, seed: int, fault: Fault | None) -> RenderedExposure:
        """The light of one seed; the last one is kept."""
        if self._taken is not None and self._taken[:2] == (seed, fault):
            return self._taken[2]
        random = np.random.default_rng([seed, 3])
        others: dict[str, object] = {
            "dc_k": float(random.uniform(-LARGEST_DC_K, LARGEST_DC_K)),
            "exposures": self.places,
        }
        others |= fault.world(seed) if fault else {}
        place = int(random.integers(0, self.places))
        for attempt in range(ATTEMPTS):
            world = World(world_settings(RIG, seed + ATTEMPT_SEEDS * attempt, **others))
            if true_smear_px(world, place) < MAX_TRUE_SMEAR_PX:
                break
        else:
            raise ValueError(
                f"{ATTEMPTS} worlds smear more than {MAX_TRUE_SMEAR_PX} px; place {place}"
            )
        exposure = take(world, Path(), place=place, scene=self.scene)
        self._taken = (seed, fault, exposure)
        return exposure


def recalibrated(world: World, seed: int) -> Rig:
    """The rig as a laboratory would state it whose errors follow from the seed; truth stays."""
    random = np.random.default_rng([seed, 13])
    cones = []
    for cone in world.rig.cones:
        sensors = []
        for sensor in cone.sensors:
            moved = world.settings.displaced_px.get(sensor.name, (0.0, 0.0))
            right, up = (
                wrong - px * sensor.pitch_um * 1e-3
                for wrong, px in zip(world.camera.place_error_mm[sensor.name], moved, strict=True)
            )
            x, y = random.normal(0.0, sensor.position_sigma_um * 1e-3, 2)
            stated = replace(
                sensor,
                x_mm=sensor.x_mm + right - float(x),
                y_mm=sensor.y_mm + up - float(y),
            )
            sensors.append(stated)
        cones.append(replace(cone, sensors=tuple(sensors)))
    return replace(world.rig, cones=tuple(cones))


def true_smear_px(world: World, place: int) -> float:
    """The largest smear in the middle of any PAN sensor, by the emulator's own mapping."""
    flight, mark_ns = flight_and_mark(world, place)
    return max(
        math.hypot(
            *residual_smear_px(world, flight, c, s, exposure_parameters_of(world, c, mark_ns))
        )
        for c in world.rig.pan_cones
        for s in c.sensors
    )


def raised(
    camera: Camera, seeds: Sequence[int], fault: Fault | None, until: float
) -> dict[str, Any]:
    """How many exposures raised each flag, and the seeds of those that did on their own accord."""
    counts: Counter[str] = Counter()
    alarms: list[tuple[int, str]] = []
    done = 0
    for seed in seeds:
        if time.monotonic() > until:
            break
        flags = camera.product(seed, fault).report.flags
        done += 1
        for flag in flags:
            counts[str(flag.name)] += 1
        unexpected = flags & ~(fault.flag if fault else NO_FLAGS)
        if unexpected:
            alarms.append((seed, str(unexpected.name)))
        if done % 10 == 0:
            print(
                fault.description if fault else "clean",
                done,
                dict(counts),
                alarms[-3:],
                file=sys.stderr,
            )
            sys.stderr.flush()
    return {"exposures": done, "raised": dict(counts), "others": alarms}


def missed(fault: Fault, found: Mapping[str, Any]) -> int:
    """Faulty exposures that did not raise the flag of their fault."""
    return int(found["exposures"] - found["raised"].get(str(fault.flag.name), 0))


def table(result: Mapping[str, Any]) -> str:
    """Markdown: false alarms by flag, then misses by fault."""
    clean = result["clean"]
    lines = [
        f"{clean['exposures']} clean exposures; flags raised: {clean['raised'] or 'none'}",
        "",
        "| fault | flag | exposures | missed |",
        "|---|---|---|---|",
    ]
    for name, found in result["faults"].items():
        fault = FAULTS[name]
        lines.append(
            f"| {fault.description} | `{fault.flag.name}` | {found['exposures']} | "
            f"{found['missed']} |"
        )
    return "\n".join(lines)


def _displaced(seed: int) -> Mapping[str, object]:
    random = np.random.default_rng([seed, 5])
    angle = float(random.uniform(0.0, 2 * math.pi))
    name = str(random.choice(["SU00", "SU01", "SU02", "SU03"]))
    return {"displaced_px": {name: (0.3 * math.cos(angle), 0.3 * math.sin(angle))}}


def _lit(exposure: RenderedExposure, factor: float) -> RenderedExposure:
    light = {
        name: np.asarray(seen * np.float32(factor), np.float32)
        for name, seen in exposure.snapshot.light.items()
    }
    return replace(exposure, snapshot=replace(exposure.snapshot, light=light))


def _pan(exposure: RenderedExposure) -> Iterator[tuple[str, Any]]:
    for cone in exposure.world.rig.pan_cones:
        for sensor in cone.sensors:
            yield sensor.name, exposure.snapshot.light[sensor.name]


def _dark(exposure: RenderedExposure) -> RenderedExposure:
    """The 95th percentile of the signal at half of the threshold."""
    light = np.concatenate([seen[::16, ::16].ravel() for _, seen in _pan(exposure)])
    planned = 0.8 * float(np.percentile(light, 95.0))
    return _lit(exposure, 0.5 * THRESHOLDS.bright_fraction / planned)


def _saturated(exposure: RenderedExposure) -> RenderedExposure:
    """Twice the threshold's share of the pixels at or above full scale, on the axis of the lens."""
    light = np.concatenate([seen[::4, ::4].ravel() for _, seen in _pan(exposure)])
    share = 100.0 * (1.0 - 2.0 * THRESHOLDS.saturated_fraction)
    # A quarter of the light is lost towards the corners: what saturates there is brighter still.
    return _lit(exposure, 1.3 / (0.8 * float(np.percentile(light, share))))


def _defocused(exposure: RenderedExposure) -> RenderedExposure:
    light = {
        name: np.asarray(cv2.GaussianBlur(seen, (0, 0), 2.0), np.float32)
        for name, seen in exposure.snapshot.light.items()
    }
    return replace(exposure, snapshot=replace(exposure.snapshot, light=light))


def _clouded(exposure: RenderedExposure) -> RenderedExposure:
    """Half an image without any detail: every overlap of one side."""
    light = dict(exposure.snapshot.light)
    for name in ("SU00", "SU02", "SU20"):
        light[name] = np.full_like(light[name], 0.7)
    return replace(exposure, snapshot=replace(exposure.snapshot, light=light))


def _stuck(conditions: Conditions) -> Conditions:
    """Probe 0 off by four kelvin: twice 4.5 standard deviations of a typical estimate."""
    read = dict(conditions.temperatures_c)
    read["0"] = (read["0"] or 0.0) + 4.0
    return replace(conditions, temperatures_c=read)


def _rotating(conditions: Conditions) -> Conditions:
    """A pitch rate that smears by twice the threshold during the exposure of PAN."""
    time_s = conditions.exposure_time_s["SU00"]
    rate = 2.0 * THRESHOLDS.smear_px / (time_s * 100.5 / 7.2e-3)
    return replace(conditions, angular_rate_rad_per_s=(0.0, rate, 0.0))


FAULTS: Mapping[str, Fault] = {
    "displaced": Fault(Flag.DISPLACED_SENSOR, "a master sensor off by 0.3 px", world=_displaced),
    "stuck-probe": Fault(Flag.DC_DISAGREEMENT, "a probe off by 4 K", conditions=_stuck),
    "dark": Fault(Flag.UNDEREXPOSED, "half of the least brightness", light=_dark),
    "saturated": Fault(Flag.OVEREXPOSED, "twice the saturated pixels", light=_saturated),
    "defocused": Fault(Flag.BLUR, "defocused by 2 px", light=_defocused),
    "turning": Fault(Flag.BLUR, "twice the smear", conditions=_rotating),
    "no-detail": Fault(Flag.TIE_POINTS, "three sensors see no detail", light=_clouded),
    "tilted": Fault(
        Flag.TILT,
        "twice the tilt",
        conditions=lambda conditions: replace(conditions, roll_rad=2 * THRESHOLDS.tilt_rad),
    ),
    "drifting": Fault(
        Flag.DRIFT,
        "twice the crab",
        conditions=lambda conditions: replace(conditions, crab_rad=-2 * THRESHOLDS.crab_rad),
    ),
}


if __name__ == "__main__":
    main()
