"""The truth on disk: every true parameter, and the exact geometry of each exposure.

Only `truth_comparison` and tests may read these files.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.rig import Cone, Sensor
from sim_hw.world import true_camera
from sim_hw.world.atomic_file import atomic_file
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.rendering import ExposureParameters, content_rows, grid_axis, sensor_directions
from sim_hw.world.world import CABIN_C, World, WorldSettings

Array = NDArray[np.float64]

GRID_PX = 16
WAIT_FOR_SENSORS_S = 3.0
"""How long an exposure waits for the sensors that have not exposed yet before it is written."""


@dataclass(frozen=True)
class SensorExposure:
    """An exposure that one sensor took on a pulse of the bus."""

    sensor: str
    pulse_count: int
    parameters: ExposureParameters


def true_vip(
    world: World,
    flight: SimulatedFlight,
    sensor_name: str,
    parameters: ExposureParameters,
    *,
    columns: Array,
    rows: Array,
    master_mid_gps_ns: int,
) -> tuple[Array, Array]:
    """Where the ideal master camera would see the rays of raw pixels.

    The ray leaves the sensor's own cone at the cone's own mid-exposure, from where the content of
    the raw pixel was then, meets flat ground at the mean height of the terrain, and is projected
    by the ideal master camera as it stood at `master_mid_gps_ns`.

    Args:
        columns, rows: raw pixel positions, any one shape.

    Returns:
        (columns, rows) in the virtual image, same shape.
    """
    cone, sensor = world.rig.cone_of(sensor_name), world.rig.sensor(sensor_name)
    at = content_rows(sensor, rows, parameters.tdi_shifts)
    pose = flight.pose(parameters.mid_gps_ns)
    directions = sensor_directions(world, cone, sensor, columns, at, parameters.mid_gps_ns)
    rays = true_camera.world_directions(directions, pose)
    ground = on_flat_ground(true_camera.projection_centre_m(cone, pose), rays)
    return true_camera.ideal_pixels(ground, world.rig, flight.pose(master_mid_gps_ns))


def on_flat_ground(origin_m: Array, directions: Array) -> Array:
    """Where rays meet the plane up = 0, shape (..., 3)."""
    return np.asarray(origin_m - directions * (origin_m[2] / directions[..., 2:]))


class TruthWriter:
    """Gathers what the sensors took, pulse by pulse, and writes one file for each."""

    def __init__(self, world: World, folder: Path) -> None:
        self._world = world
        self._folder = folder
        self._open: dict[int, dict[str, SensorExposure]] = {}
        self._touched_s: dict[int, float] = {}
        folder.mkdir(parents=True, exist_ok=True)

    def write_parameters(self) -> None:
        """`parameters.json`: what holds for the whole flight."""
        _write_atomically(
            self._folder / "parameters.json",
            json.dumps(true_parameters(self._world), indent=1).encode(),
        )

    def add(self, taken: SensorExposure, flight: SimulatedFlight) -> None:
        """Note a sensor's exposure; the file is written once all sensors of the rig are in."""
        sensors = self._open.setdefault(taken.pulse_count, {})
        sensors[taken.sensor] = taken
        self._touched_s[taken.pulse_count] = time.monotonic()
        if len(sensors) == len(self._world.rig.sensors):
            self._write(taken.pulse_count, flight)

    def write_overdue(self, flight: SimulatedFlight, *, wait_s: float = WAIT_FOR_SENSORS_S) -> None:
        """Write exposures whose missing sensors are not coming any more."""
        now_s = time.monotonic()
        for count in [c for c, t in self._touched_s.items() if now_s - t >= wait_s]:
            self._write(count, flight)

    def _write(self, count: int, flight: SimulatedFlight) -> None:
        taken = self._open.pop(count)
        del self._touched_s[count]
        content = exposure_truth(self._world, flight, taken)
        path = self._folder / f"{count:06d}.npz"
        with atomic_file(path) as part, part.open("wb") as file:
            np.savez(file, **content)


def exposure_truth(
    world: World, flight: SimulatedFlight, taken: Mapping[str, SensorExposure]
) -> dict[str, Any]:
    """The arrays of one exposure's file; see docs/reference/emulator.md for each."""
    mark = _mid_of_cone(world, world.rig.reference_cone, taken)
    master = _mid_of_cone(world, world.rig.master_cone, taken)
    known = [m for m in (mark, master) if m is not None]
    any_mid = known[0] if known else next(iter(taken.values())).parameters.mid_gps_ns
    mark_ns = any_mid if mark is None else mark
    master_ns = any_mid if master is None else master
    pose = flight.pose(mark_ns)
    probes = world.rig.probes
    content: dict[str, Any] = {
        "mark_gps_ns": np.array(mark_ns, dtype=np.int64),
        "master_mid_gps_ns": np.array(master_ns, dtype=np.int64),
        "first_line_at_m": np.array(flight.first_line_at_m),
        "position_enu_m": pose.position_enu_m,
        "velocity_enu_mps": pose.velocity_enu_mps,
        "roll_pitch_heading_rad": np.array([pose.roll_rad, pose.pitch_rad, pose.heading_rad]),
        "latitude_longitude_height": np.array(flight.geodetic(pose.position_enu_m)),
        "probes": np.array(probes),
        "temperatures_c": np.array([world.temperature_c(p, mark_ns) for p in probes]),
        "sensors": np.array(sorted(taken)),
        "pan_sensors": np.array([s.name for c in world.rig.pan_cones for s in c.sensors]),
    }
    is_stitched = world.rig.virtual_image is not None
    if is_stitched:
        content["image"] = np.array(_image(world))
        content["inner"] = np.array("similarity" if world.rig.master_cone else "rotations")
    for name, exposure in taken.items():
        sensor, parameters = world.rig.sensor(name), exposure.parameters
        content |= {
            f"{name}.mid_gps_ns": np.array(parameters.mid_gps_ns, dtype=np.int64),
            f"{name}.exposure_time_us": np.array(parameters.exposure_time_us),
            f"{name}.tdi_shifts": np.array(parameters.tdi_shifts),
        }
        if not is_stitched:
            content |= _head(world, flight, name, parameters)
            continue
        columns = grid_axis(sensor.width_px, GRID_PX)
        rows = grid_axis(sensor.height_px, GRID_PX)
        c, r = np.meshgrid(columns, rows)
        vip = true_vip(
            world, flight, name, parameters, columns=c, rows=r, master_mid_gps_ns=master_ns
        )
        content |= {
            f"{name}.columns": columns,
            f"{name}.rows": rows,
            f"{name}.vip_column": vip[0],
            f"{name}.vip_row": vip[1],
        }
    return content


def _head(
    world: World, flight: SimulatedFlight, name: str, parameters: ExposureParameters
) -> dict[str, Any]:
    """Where a head that is an image of its own stood and looked."""
    cone, pose = world.rig.cone_of(name), flight.pose(parameters.mid_gps_ns)
    centre = true_camera.projection_centre_m(cone, pose)
    rotation = (
        pose.enu_from_body @ true_camera.BODY_FROM_CAMERA @ world.camera.master_from_cone(cone)
    )
    return {
        f"{name}.latitude_longitude_height": np.array(flight.geodetic(centre)),
        f"{name}.enu_from_camera": rotation,
    }


def _mid_of_cone(
    world: World, cone_name: str | None, taken: Mapping[str, SensorExposure]
) -> int | None:
    if cone_name is None:
        return None
    for sensor in world.rig.cone(cone_name).sensors:
        if sensor.name in taken:
            return taken[sensor.name].parameters.mid_gps_ns
    return None


def _image(world: World) -> list[float]:
    """Width and height of the virtual image and its principal distance, all in pixels."""
    image = world.image
    return [image.width_px, image.height_px, image.f_mm / (image.pitch_um * 1e-3)]


def true_parameters(world: World) -> dict[str, Any]:
    """Every true parameter, ready for JSON: calibrated values of the rig file plus their errors."""
    true = world.camera
    return {
        "settings": asdict(world.settings) | {"epoch_gps_ns": str(world.settings.epoch_gps_ns)},
        "plan": asdict(world.plan),
        "flight": asdict(world.flight.plan),
        "temperatures": asdict(world.temperatures),
        "cones": {
            cone.name: {
                "mounting_error_rad": true.mounting_error_rad[cone.name],
                "master_from_cone": true.master_from_cone(cone).tolist(),
                "lens": asdict(cone.lens),
                "sensors": {s.name: _true_place(world, cone, s) for s in cone.sensors},
            }
            for cone in world.rig.cones
        },
        "displaced_px": {k: list(v) for k, v in world.settings.displaced_px.items()},
        "scene": asdict(world.scene_settings),
    }


def _true_place(world: World, cone: Cone, sensor: Sensor) -> dict[str, Any]:
    """A sensor's true place at its calibration temperature, and at the base of the flight's."""
    error = world.camera.place_error_mm[sensor.name]
    base_c = world.temperatures.base_c.get(sensor.probe, CABIN_C)
    middle = (np.array((sensor.width_px - 1) / 2), np.array((sensor.height_px - 1) / 2))
    placed = world.camera.layer_from_pixel(sensor, *middle, temperature_c=base_c)
    return {
        "x_mm": sensor.x_mm + error[0],
        "y_mm": sensor.y_mm + error[1],
        "place_error_mm": list(error),
        "rotation_rad": sensor.rotation_rad,
        "scale": sensor.scale,
        "skew_ppm_per_mm": [sensor.skew_x_ppm_per_mm, sensor.skew_y_ppm_per_mm],
        "drift": asdict(sensor.drift),
        "x_at_base_temperature_mm": float(placed[0]),
        "y_at_base_temperature_mm": float(placed[1]),
        "f_at_base_temperature_mm": true_camera.principal_distance_mm(
            cone, world.temperatures.base_c.get(cone.probe, CABIN_C)
        ),
    }


def world_of(folder: Path) -> World:
    """The world again that wrote a folder of truth."""
    content = json.loads((folder / "parameters.json").read_text())["settings"]
    displaced = {k: (float(v[0]), float(v[1])) for k, v in content.pop("displaced_px").items()}
    epoch = int(content.pop("epoch_gps_ns"))
    return World(WorldSettings(epoch_gps_ns=epoch, displaced_px=displaced, **content))


def _write_atomically(path: Path, content: bytes) -> None:
    with atomic_file(path) as part:
        part.write_bytes(content)
