"""An emulated exposure over real imagery: rendered by code that shares nothing with the pipeline.

Relief, syntopic firing, attitude that changes between the cones, lens, drift, TDI, PRNU, dark
signal, defects, vignetting and noise are the emulator's; so is the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import Conditions, for_sensors
from processing.rig import shipped_rigs
from sim_hw.world.electronics import Electronics, SensorTruth, true_sensor
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.rendering import ExposureParameters, light_on_sensor
from sim_hw.world.scene import open_scene
from sim_hw.world.seeding import random_stream
from sim_hw.world.snapshots import exposure_parameters_of, sensors_of
from sim_hw.world.truth import true_vip
from sim_hw.world.world import World, WorldSettings

Array = NDArray[np.float64]

EPOCH = 1_400_000_000_000_000_000
SEED = 3


@dataclass(frozen=True)
class EmulatedExposure:
    """Frames of one exposure, and the world they were taken of; `sensors` as they truly are."""

    frames: Mapping[str, NDArray[np.uint16]]
    conditions: Conditions
    world: World
    flight: SimulatedFlight
    parameters_by_sensor: Mapping[str, ExposureParameters]
    sensors: Mapping[str, SensorTruth]

    def errors_px(self, geometry: Mapping[str, Array]) -> tuple[Array, Array]:
        """Absolute and inner errors of all VIP nodes of a product's geometry, (n, 2) px."""
        names = [name for name in self.frames if f"{name}.vip" in geometry]
        vip = np.concatenate([geometry[f"{name}.vip"] for name in names])
        errors = np.concatenate(
            [self.errors_of(n, geometry[f"{n}.raw"], geometry[f"{n}.vip"]) for n in names]
        )
        return errors, after_similarity(vip, errors)

    def errors_of(self, name: str, raw: Array, vip: Array) -> Array:
        """Where the ideal master camera sees raw pixels less where they were put, (n, 2) px."""
        column, row = true_vip(
            self.world,
            self.flight,
            name,
            self.parameters_by_sensor[name],
            columns=raw[:, 0],
            rows=raw[:, 1],
            master_mid_gps_ns=self.parameters_by_sensor["SU00"].mid_gps_ns,
        )
        return np.stack([column, row], axis=1) - vip


def expose(
    rig: str,
    folder: Path,
    *,
    height_px: int,
    displaced_px: Mapping[str, tuple[float, float]] | None = None,
) -> EmulatedExposure:
    """One exposure 12 K above the calibration temperature; `height_px` of ground are built."""
    world = World(
        WorldSettings(
            rig_file=str(shipped_rigs()[rig]),
            seed=SEED,
            epoch_gps_ns=EPOCH,
            dc_k=12.0,
            displaced_px=dict(displaced_px or {}),
        )
    )
    plan = world.plan
    scene = open_scene(replace(world.scene_settings, height_px=height_px), folder / "scene")
    flight = world.flight.beginning_first_line_at(1100.0)
    mark_ns = EPOCH + 20_000_000_000
    frames, parameters_by_sensor, sensors = {}, {}, {}
    for cone, sensor in sensors_of(world):
        look = exposure_parameters_of(world, cone, mark_ns)
        truth = true_sensor(cone, sensor, SEED, field_radius_mm=world.field_radius_mm(cone))
        head = Electronics(sensor, truth, world.electrons_per_radiance_s(cone))
        frames[sensor.name] = head.frame(
            light_on_sensor(world, scene, flight, cone, sensor, look),
            exposure_time_us=look.exposure_time_us,
            tdi_shifts=look.tdi_shifts,
            gain_db=0.0,
            temperature_c=world.temperature_c(sensor.probe, look.mid_gps_ns),
            random=random_stream(SEED, "noise", sensor.name, 1),
        )
        parameters_by_sensor[sensor.name], sensors[sensor.name] = look, truth
    noise = np.random.default_rng(1)
    conditions = Conditions(
        temperatures_c={
            probe: world.temperature_c(probe, mark_ns) + noise.normal(0, 0.1)
            for probe in world.rig.probes
        },
        exposure_time_s=for_sensors(
            world.rig, {name: t * 1e-6 for name, t in plan.exposure_time_us.items()}
        ),
        tdi_shifts=for_sensors(world.rig, plan.tdi_shifts),
        ground_speed_mps=plan.ground_speed_mps,
        height_above_ground_m=plan.height_above_ground_m,
    )
    return EmulatedExposure(frames, conditions, world, flight, parameters_by_sensor, sensors)


def rms(vectors: Array) -> float:
    """Root of the mean square of the lengths of (n, 2) vectors."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def after_similarity(vip: Array, errors: Array) -> Array:
    """What the best similarity of the whole leaves of errors at places, both (n, 2)."""
    a = (vip + errors) @ [1, 1j]
    b = vip @ [1, 1j]
    a, b = a - a.mean(), b - b.mean()
    left = a - np.vdot(b, a) / np.vdot(b, b) * b
    return np.stack([left.real, left.imag], axis=1)
