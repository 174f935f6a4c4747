"""Exposures of an emulated rig in memory: frames, readings of the probes, and the truth.

For tests and benchmarks that need many exposures and no devices; exposures on disk are written by
`exposures`, devices are emulated by `simulator`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.rig import Cone, Sensor
from sim_hw.world import sensor_calibration
from sim_hw.world.electronics import Electronics, true_sensor
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.rendering import ExposureParameters, Map, light_on_sensor
from sim_hw.world.scene import Scene
from sim_hw.world.seeding import random_stream
from sim_hw.world.sensor_calibration import Radiometry
from sim_hw.world.truth import SensorExposure, exposure_truth
from sim_hw.world.world import World

PROBE_SIGMA_C = 0.1


@dataclass(frozen=True)
class Snapshot:
    """Light on every sensor at one exposure, before the electronics.

    `light` are radiances (height, width) by sensor, `truth` the arrays of `truth.exposure_truth`.
    """

    mark_gps_ns: int
    light: Mapping[str, Map]
    parameters_by_sensor: Mapping[str, ExposureParameters]
    truth: Mapping[str, Any]


class RigElectronics:
    """The electronics of the rig's sensors, and what the laboratory measured of each.

    Keeps the maps of all sensors, about 20 bytes a pixel; with `keep=False` it draws them again for
    each exposure, which takes about a tenth of a second per million pixels.
    """

    def __init__(
        self, world: World, *, seed: int, without: Collection[str] = (), keep: bool = True
    ) -> None:
        self._seed = seed
        self._electronics: dict[str, Electronics] = {}
        self.radiometry: dict[str, Radiometry] = {}
        for cone, sensor in sensors_of(world, without):
            head = self._drawn(world, cone, sensor)
            self.radiometry[sensor.name] = sensor_calibration.measure(sensor, head.truth, seed)
            if keep:
                self._electronics[sensor.name] = head

    def frames(
        self, world: World, snapshot: Snapshot, *, seed: int
    ) -> dict[str, NDArray[np.uint16]]:
        """What the sensors make of the light, with noise that follows from `seed`."""
        frames = {}
        for name, light in snapshot.light.items():
            parameters = snapshot.parameters_by_sensor[name]
            cone, sensor = world.rig.cone_of(name), world.rig.sensor(name)
            head = self._electronics.get(name) or self._drawn(world, cone, sensor)
            frames[name] = head.frame(
                light,
                exposure_time_us=parameters.exposure_time_us,
                tdi_shifts=parameters.tdi_shifts,
                gain_db=0.0,
                temperature_c=world.temperature_c(sensor.probe, parameters.mid_gps_ns),
                random=random_stream(seed, "noise", name),
            )
        return frames

    def _drawn(self, world: World, cone: Cone, sensor: Sensor) -> Electronics:
        radius_mm = world.field_radius_mm(cone)
        faults = true_sensor(cone, sensor, self._seed, field_radius_mm=radius_mm)
        return Electronics(sensor, faults, world.electrons_per_radiance_s(cone))


def sensors_of(world: World, without: Collection[str] = ()) -> Iterator[tuple[Cone, Sensor]]:
    """The rig's sensors with their cones, less some."""
    for cone in world.rig.cones:
        for sensor in cone.sensors:
            if sensor.name not in without:
                yield cone, sensor


def take(
    world: World,
    scene: Scene,
    flight: SimulatedFlight,
    mark_gps_ns: int,
    *,
    without: Collection[str] = (),
) -> Snapshot:
    """Let every sensor look at its own instant of the exposure whose strobe is at `mark_gps_ns`."""
    light, parameters_by_sensor, taken = {}, {}, {}
    for cone, sensor in sensors_of(world, without):
        parameters = exposure_parameters_of(world, cone, mark_gps_ns)
        light[sensor.name] = light_on_sensor(world, scene, flight, cone, sensor, parameters)
        parameters_by_sensor[sensor.name] = parameters
        taken[sensor.name] = SensorExposure(sensor.name, 1, parameters)
    return Snapshot(mark_gps_ns, light, parameters_by_sensor, exposure_truth(world, flight, taken))


def exposure_parameters_of(world: World, cone: Cone, mark_gps_ns: int) -> ExposureParameters:
    """Syntopic: every cone looks when it is where the reference cone is at the mark."""
    reference_mm = world.rig.cone(world.rig.reference_cone).position_mm[0]
    ahead_m = (cone.position_mm[0] - reference_mm) * 1e-3
    if world.rig.timing != "syntopic":
        ahead_m = 0.0
    return ExposureParameters(
        mid_gps_ns=mark_gps_ns - round(ahead_m / world.plan.ground_speed_mps * 1e9),
        exposure_time_us=world.plan.exposure_time_us[cone.name],
        tdi_shifts=world.plan.tdi_shifts[cone.name],
    )


def probe_readings(world: World, mark_gps_ns: int, *, seed: int) -> dict[str, float]:
    """What the probes read at an instant, each with an error of its own, degC."""
    random = random_stream(seed, "probes")
    return {
        probe: world.temperature_c(probe, mark_gps_ns) + float(random.normal(0.0, PROBE_SIGMA_C))
        for probe in world.rig.probes
    }
