"""Exposures rendered by the emulator, processed by the pipeline, compared with the truth.

What the benchmarks of geometry, hard scenes and flags have in common. Rendering and judging are the
emulator's and share no code with the pipeline.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import for_sensors
from processing.pipelines.stitched import Conditions, Pipeline, Product
from processing.radiometry.calibration import RadiometricCalibration
from processing.rig import shipped_rigs
from sim_hw.truth_comparison import compare
from sim_hw.world import snapshots
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.scene import Scene, open_scene
from sim_hw.world.snapshots import RigElectronics, Snapshot
from sim_hw.world.world import World, WorldSettings

EPOCH_GPS_NS = 1_447_000_000_000_000_000
FIRST_AFTER_S = 20.0
MARK_SIGMA_NS = 60.0
ATTITUDE_SIGMA_RAD = math.radians(0.02)
RATE_STEP_NS = 1_000_000
"""Angular rates are differences over twice this."""


_CONE_ROTATION = re.compile(r"^rotation_rad = \[.*?\]", re.MULTILINE)


@dataclass(frozen=True)
class RenderedExposure:
    """One exposure as the emulator took it, and the flight it belongs to."""

    world: World
    flight: SimulatedFlight
    snapshot: Snapshot


def world_settings(rig: str | Path, seed: int, **others: Any) -> WorldSettings:
    """Settings of a world with one exposure; `rig` is a shipped rig's name or a file."""
    file = shipped_rigs()[rig] if isinstance(rig, str) else rig
    plain = WorldSettings(rig_file=str(file), seed=seed, epoch_gps_ns=EPOCH_GPS_NS, exposures=1)
    return replace(plain, **others)


def take(
    world: World,
    scenes: Path,
    *,
    place: int = 0,
    scene: Scene | None = None,
    without: Collection[str] = (),
) -> RenderedExposure:
    """Take exposure number `place` of the first line.

    Args:
        world: the world; its scene is built in the folder `scenes` unless one is given.
        without: sensors that do not look.
    """
    scene = scene or open_scene(world.scene_settings, scenes)
    flight, mark_ns = flight_and_mark(world, place)
    snapshot = snapshots.take(world, scene, flight, mark_ns, without=without)
    return RenderedExposure(world, flight, snapshot)


def flight_and_mark(world: World, place: int) -> tuple[SimulatedFlight, int]:
    """The flight whose first line begins under the first exposure, and the strobe of another."""
    first_ns = EPOCH_GPS_NS + round(FIRST_AFTER_S * 1e9)
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first_ns))
    period_ns = round(world.plan.distance_m / world.plan.ground_speed_mps * 1e9)
    return flight, first_ns + place * period_ns


def radiometry_of(heads: RigElectronics) -> dict[str, RadiometricCalibration]:
    """What the laboratory measured, as the pipeline takes it."""
    return {
        name: RadiometricCalibration(**measured.arrays())
        for name, measured in heads.radiometry.items()
    }


def conditions_of(exposure: RenderedExposure, *, seed: int) -> Conditions:
    """What the service would know: probes, plan, attitude, rates; with the instruments' noise."""
    world, mark = exposure.world, exposure.snapshot.mark_gps_ns
    noise = np.random.default_rng([seed, 7])
    pose, speed = exposure.flight.pose(mark), world.plan.ground_speed_mps
    before, after = (exposure.flight.pose(mark + s * RATE_STEP_NS) for s in (-1, 1))
    track = math.atan2(pose.velocity_enu_mps[0], pose.velocity_enu_mps[1])
    step_s = 2 * RATE_STEP_NS * 1e-9
    return Conditions(
        temperatures_c=snapshots.probe_readings(world, mark, seed=seed),
        temperature_age_s=dict.fromkeys(world.rig.probes, float(noise.uniform(0.0, 2.0))),
        exposure_time_s=for_sensors(
            world.rig, {name: us * 1e-6 for name, us in world.plan.exposure_time_us.items()}
        ),
        tdi_shifts=for_sensors(world.rig, world.plan.tdi_shifts),
        ground_speed_mps=speed + float(noise.normal(0.0, 0.05)),
        height_above_ground_m=world.plan.height_above_ground_m,
        roll_rad=pose.roll_rad + float(noise.normal(0.0, ATTITUDE_SIGMA_RAD)),
        pitch_rad=pose.pitch_rad + float(noise.normal(0.0, ATTITUDE_SIGMA_RAD)),
        angular_rate_rad_per_s=(
            (after.roll_rad - before.roll_rad) / step_s,
            (after.pitch_rad - before.pitch_rad) / step_s,
            _rotated(after.heading_rad - before.heading_rad) / step_s,
        ),
        crab_rad=_rotated(pose.heading_rad - track) + float(noise.normal(0.0, ATTITUDE_SIGMA_RAD)),
        time_sigma_ns=MARK_SIGMA_NS,
    )


def process(
    pipeline: Pipeline,
    heads: RigElectronics,
    exposure: RenderedExposure,
    *,
    seed: int,
    conditions: Conditions | None = None,
) -> Product:
    """One exposure through the pipeline; noise of sensors and instruments follows from `seed`."""
    frames = heads.frames(exposure.world, exposure.snapshot, seed=seed)
    return pipeline.process(frames, conditions or conditions_of(exposure, seed=seed))


def errors_of(
    geometry: Mapping[str, NDArray[np.generic]], snapshot: Snapshot
) -> dict[str, float | int]:
    """Evaluation figures for the PAN image of one exposure, PAN pixels."""
    return compare(geometry, snapshot.truth)["methods"].figures


def with_random_rotations(rig_file: Path, out: Path, *, seed: int, sigma_rad: float) -> Path:
    """A rig file whose cones, except the master's, have newly drawn angles."""
    random = np.random.default_rng([seed, 11])
    text = rig_file.read_text(encoding="utf-8")
    cones = text.split("\n[[cone]]\n")
    master = re.search(r'^master_cone = "(.+?)"', cones[0], re.MULTILINE)
    if master is None:
        raise ValueError(f"{rig_file}: names no master_cone; give a stitched rig")
    for k, cone in enumerate(cones[1:], start=1):
        angles = random.normal(0.0, sigma_rad, 3)
        if re.search(rf'^name = "{re.escape(master[1])}"', cone, re.MULTILINE):
            continue
        values = ", ".join(f"{angle:.7f}" for angle in angles)
        cones[k] = re.sub(
            r"^rotation_rad = \[.*?\]",
            f"rotation_rad = [{values}]",
            cone,
            count=1,
            flags=re.MULTILINE,
        )
    out.write_text("\n[[cone]]\n".join(cones), encoding="utf-8")
    return out


def _rotated(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi
