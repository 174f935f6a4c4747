"""Emulated exposures as the pipeline gets them, with the truth of their geometry and radiance.

Rendering and truth are the emulator's and share no code with the pipeline. What is planted is in
`benchmarks.silent_errors.faults`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from benchmarks.rendered import (
    RenderedExposure,
    conditions_of,
    flight_and_mark,
    radiometry_of,
    world_settings,
)
from benchmarks.silent_errors.scenes import SCENES, Tone
from processing.geometry.conditions import Conditions
from processing.pipelines.perspective import HeadPipeline, HeadSettings, HeadsProduct
from processing.pipelines.stitched import Pipeline, PipelineSettings, Product
from processing.radiometry.calibration import RadiometricCalibration
from processing.rig import Cone, Rig, Sensor, find_rig
from sim_hw.world import snapshots
from sim_hw.world.scene import open_scene
from sim_hw.world.snapshots import RigElectronics, Snapshot
from sim_hw.world.true_camera import MOUNTING_RESIDUAL_RAD
from sim_hw.world.world import World

RIGS = ("ultracam-x-mini", "ultracam-l-mini", "dmc-mini", "midas-mini")
PLACES = 2
LARGEST_DC_K = 15.0
DRAWN_TONE = 0.5
"""Probability of fields, and of a cloud's shadow, in a drawn exposure."""

Array = NDArray[Any]
Frames = Mapping[str, Array]
Content = Callable[[Array], Array]
"""From raw pixels (n, 2) to where on the sensor their content really was."""


@dataclass(frozen=True)
class EmulatedExposure:
    """An exposure and its truth.

    `frames`, `rig` and `conditions` are what the pipeline gets. `light` are true radiances by
    sensor, `snapshot` holds the true mapping, `content` where the pixels of a frame that was read
    out wrongly really belong, `elsewhere` names frames that hold other ground or none,
    `other` gives the frames of another exposure of the flight.
    """

    rig: Rig
    frames: Frames
    conditions: Conditions
    radiometry: Mapping[str, RadiometricCalibration]
    world: World
    snapshot: Snapshot
    other: Callable[[], Frames]
    content: Mapping[str, Content] = field(default_factory=dict)
    elsewhere: frozenset[str] = frozenset()

    @property
    def stitched(self) -> bool:
        """Whether the rig has one image of all heads."""
        return self.rig.virtual_image is not None

    def process(self) -> Product | HeadsProduct:
        """Make the image as `syntopic process` does."""
        if self.stitched:
            return Pipeline(self.rig, self.radiometry, PipelineSettings(threads=1)).process(
                self.frames, self.conditions
            )
        heads = HeadPipeline(self.rig, self.radiometry, HeadSettings(threads=1))
        return heads.process(self.frames, self.conditions)

    def with_frame(self, name: str, change: Callable[[Array], Array]) -> EmulatedExposure:
        """The same with one frame changed."""
        return replace(self, frames={**self.frames, name: change(self.frames[name].copy())})

    def with_cone(self, name: str, change: Callable[[Cone], Cone]) -> EmulatedExposure:
        """The same with another calibration of one cone; the camera itself is as it was."""
        cones = tuple(change(c) if c.name == name else c for c in self.rig.cones)
        return replace(self, rig=replace(self.rig, cones=cones))

    def with_sensor(self, name: str, change: Callable[[Sensor], Sensor]) -> EmulatedExposure:
        """The same with another calibration of one sensor."""

        def changed(cone: Cone) -> Cone:
            sensors = tuple(change(s) if s.name == name else s for s in cone.sensors)
            return replace(cone, sensors=sensors)

        return self.with_cone(self.rig.cone_of(name).name, changed)


def healthy(rig: str, number: int) -> EmulatedExposure:
    """A healthy exposure of a rig; the same number gives the same one."""
    return _read_out(rig, number, "landscape", seed=_seed(rig, number))


def remeasured(rig: str, number: int, seed: int, *, scene: str = "landscape") -> EmulatedExposure:
    """The same light with other noise and with places as another laboratory would state them."""
    emulated = _read_out(rig, number, scene, seed=seed)
    return replace(emulated, rig=recalibrated(emulated.world, seed))


def retoned(rig: str, number: int, seed: int, *, scene: str = "landscape") -> EmulatedExposure:
    """The same ground in other light, with other noise and another laboratory's places.

    Brightness, and by chance fields of even tone or the shadow of a cloud, are drawn by seed: a new
    exposure of signals without rendering one.
    """
    lit = _lit(rig, number, scene, 0)
    random = np.random.default_rng([seed, 43])
    brightness = float(np.exp(np.clip(random.normal(0.0, 0.2), -0.4, 0.4)))
    light = {name: seen * np.float32(brightness) for name, seen in lit.snapshot.light.items()}
    snapshot = replace(lit.snapshot, light=light)
    tones = [SCENES[name].tone for name in ("fields", "shadow") if random.uniform() < DRAWN_TONE]
    for k, tone in enumerate(tone for tone in tones if tone is not None):
        snapshot = replace(snapshot, light=_toned(snapshot, tone, 2 * seed + k))
    exposure = replace(lit, snapshot=snapshot)
    heads = _heads(rig)

    def before() -> Frames:
        raise ValueError("a drawn exposure has no other of its flight")

    return EmulatedExposure(
        rig=recalibrated(exposure.world, seed),
        frames=heads.frames(exposure.world, snapshot, seed=seed),
        conditions=conditions_of(exposure, seed=seed),
        radiometry=radiometry_of(heads),
        world=exposure.world,
        snapshot=snapshot,
        other=before,
    )


def world_of(rig: str, number: int, scene: str = "landscape") -> World:
    """The world of an exposure."""
    seed = _seed(rig, number)
    random = np.random.default_rng([seed, 17])
    dc_k = float(random.uniform(-LARGEST_DC_K, LARGEST_DC_K))
    return World(
        world_settings(rig, seed, dc_k=dc_k, exposures=PLACES, **_cloud(rig, scene, random))
    )


def _cloud(rig: str, scene: str, random: np.random.Generator) -> dict[str, Any]:
    others = dict(SCENES[scene].world)
    if scene == "cloud":
        sensors = [s.name for s in find_rig(rig).sensors]
        others["cloud_over"] = sensors[int(random.integers(0, len(sensors)))]
    return others


def _seed(rig: str, number: int) -> int:
    return 1000 * (RIGS.index(rig) + 1) + number


@lru_cache(maxsize=4)
def _lit(rig: str, number: int, scene: str, place: int) -> RenderedExposure:
    world = world_of(rig, number, scene)
    flight, mark_ns = flight_and_mark(world, place)
    with TemporaryDirectory(prefix="syntopic-silent-") as folder:
        ground = open_scene(world.scene_settings, Path(folder))
        snapshot = snapshots.take(world, ground, flight, mark_ns)
    tone = SCENES[scene].tone
    if tone is not None:
        snapshot = replace(snapshot, light=_toned(snapshot, tone, _seed(rig, number)))
    return RenderedExposure(world, flight, snapshot)


def _toned(snapshot: Snapshot, tone: Tone, seed: int) -> dict[str, Array]:
    """The light times a tone of the ground, which all sensors of one image see at its place.

    Heads without a common image have ground of their own, whose edges run along their pixels.
    """
    truth, light = snapshot.truth, {}
    for number, (name, seen) in enumerate(snapshot.light.items()):
        rows, columns = np.meshgrid(*(np.arange(size) for size in seen.shape), indexing="ij")
        places: list[Array] = [columns, rows]
        seeds = [seed, 31, number]
        if f"{name}.vip_column" in truth:
            seeds = [seed, 31]
            places = []
            for key in ("vip_column", "vip_row"):
                spline = RectBivariateSpline(
                    truth[f"{name}.rows"],
                    truth[f"{name}.columns"],
                    truth[f"{name}.{key}"],
                    kx=1,
                    ky=1,
                )
                places.append(spline(np.arange(seen.shape[0]), np.arange(seen.shape[1])))
        factor = tone(places[0], places[1], np.random.default_rng(seeds))
        light[name] = np.asarray(seen * factor, np.float32)
    return light


@lru_cache(maxsize=2)
def _heads(rig: str) -> RigElectronics:
    """The electronics of a rig, which all its exposures share."""
    return RigElectronics(world_of(rig, 0), seed=1 + RIGS.index(rig))


def _read_out(rig: str, number: int, scene: str, *, seed: int) -> EmulatedExposure:
    # The cloud of a scene hangs over the first exposure of the line.
    exposure, heads = _lit(rig, number, scene, 0), _heads(rig)

    def before() -> Frames:
        other = _lit(rig, number, scene, 1)
        return heads.frames(other.world, other.snapshot, seed=seed + 1)

    return EmulatedExposure(
        rig=exposure.world.rig,
        frames=heads.frames(exposure.world, exposure.snapshot, seed=seed),
        conditions=conditions_of(exposure, seed=seed),
        radiometry=radiometry_of(heads),
        world=exposure.world,
        snapshot=exposure.snapshot,
        other=before,
    )


def recalibrated(world: World, seed: int) -> Rig:
    """The rig as a laboratory would state it whose errors follow from the seed; truth stays.

    Places of the sensors and angles of all cones but the master's are drawn by their sigmas, of a
    master cone's only sensor its scale and rotation, too.
    """
    random = np.random.default_rng([seed, 13])
    random_of_single = np.random.default_rng([seed, 14])

    def rotated_rad(cone: Cone) -> tuple[float, float, float]:
        if cone.name == world.rig.master_cone:
            return cone.rotation_rad
        off = np.add(cone.rotation_rad, world.camera.mounting_error_rad[cone.name])
        x, y, z = off - random.normal(0.0, MOUNTING_RESIDUAL_RAD, 3)
        return float(x), float(y), float(z)

    def stated(sensor: Sensor) -> Sensor:
        right, up = world.camera.place_error_mm[sensor.name]
        x, y = random.normal(0.0, sensor.position_sigma_um * 1e-3, 2)
        placed = replace(
            sensor, x_mm=sensor.x_mm + right - float(x), y_mm=sensor.y_mm + up - float(y)
        )
        if [s.name for s in world.rig.master_sensors] != [sensor.name]:
            return placed
        # The datum of such a rig is the scale and rotation of this sensor, too.
        at_half_height = 2e-3 * sensor.position_sigma_um / (sensor.height_px * sensor.pitch_mm)
        scale, rotation = random_of_single.normal(0.0, at_half_height, 2)
        return replace(
            placed,
            scale=sensor.scale * (1.0 + float(scale)),
            rotation_rad=sensor.rotation_rad + float(rotation),
        )

    cones = tuple(
        replace(
            cone, rotation_rad=rotated_rad(cone), sensors=tuple(stated(s) for s in cone.sensors)
        )
        for cone in world.rig.cones
    )
    return replace(world.rig, cones=cones)
