"""One rendered exposure, and what is planted in it: the frames, the rig file or the conditions.

The emulator renders and judges; it shares no code with the pipeline.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.rendered import conditions_of, errors_of, radiometry_of, take, world_settings
from processing.geometry.conditions import Conditions
from processing.pipelines.stitched import Pipeline, PipelineSettings, Product
from processing.quality.figures.stitching import PrecisionFigures
from processing.radiometry.calibration import RadiometricCalibration
from processing.rig import Cone, Rig, Sensor
from sim_hw.world.snapshots import RigElectronics, Snapshot
from sim_hw.world.world import World

Frames = Mapping[str, NDArray[Any]]

BLACK_DN = 64


@dataclass(frozen=True)
class InjectedExposure:
    """An exposure as the pipeline gets it, with the emulator's truth."""

    rig: Rig
    frames: Frames
    conditions: Conditions
    radiometry: Mapping[str, RadiometricCalibration]
    truth: Snapshot

    def outcome(self) -> Outcome:
        """What the pipeline makes of it."""
        pipeline = Pipeline(self.rig, self.radiometry, PipelineSettings(threads=1))
        product = pipeline.process(self.frames, self.conditions)
        errors = errors_of(product.geometry["free"], self.truth)
        return Outcome(product, float(errors["absolute_rms_px"]), float(errors["inner_rms_px"]))

    def with_frame(self, name: str, change: Callable[[Any], Any]) -> InjectedExposure:
        """The same with one frame changed."""
        return replace(self, frames={**self.frames, name: change(self.frames[name].copy())})

    def with_cone(self, name: str, change: Callable[[Cone], Cone]) -> InjectedExposure:
        """The same with another calibration of one cone: the camera itself is as it was."""
        cones = tuple(change(c) if c.name == name else c for c in self.rig.cones)
        return replace(self, rig=replace(self.rig, cones=cones))

    def with_sensor(self, name: str, change: Callable[[Sensor], Sensor]) -> InjectedExposure:
        """The same with another calibration of one sensor."""

        def changed(cone: Cone) -> Cone:
            sensors = tuple(change(s) if s.name == name else s for s in cone.sensors)
            return replace(cone, sensors=sensors)

        return self.with_cone(self.rig.cone_of(name).name, changed)

    def with_probes(self, off_k: float) -> InjectedExposure:
        """The same with all probes reading too much."""
        read = {
            p: None if c is None else c + off_k for p, c in self.conditions.temperatures_c.items()
        }
        return replace(self, conditions=replace(self.conditions, temperatures_c=read))


@dataclass(frozen=True)
class Outcome:
    """A product and the length of its errors by the emulator's truth (RMS, PAN pixels)."""

    product: Product
    absolute_px: float
    inner_px: float

    @property
    def true_sigma_px(self) -> float:
        """RMS of one coordinate of the absolute error."""
        return self.absolute_px / np.sqrt(2.0)

    @property
    def stated_sigma_px(self) -> float:
        value = self.product.report.figures.of(PrecisionFigures).stitched_sigma_px
        assert isinstance(value, float)
        return value

    @property
    def flags(self) -> set[str]:
        return {str(flag.name) for flag in self.product.report.flags}

    @property
    def verdict(self) -> str:
        return self.product.report.verdict.value

    @property
    def sentences(self) -> str:
        return " ".join(finding.sentence for finding in self.product.report.findings)

    def figure(self, name: str) -> Any:
        return self.product.report.figures.as_json().get(name)


@cache
def rendered(
    rig: str, *, seed: int = 11, dc_k: float = 8.0, ground: str = "landscape"
) -> InjectedExposure:
    """A healthy exposure over the emulator's photographs or a ground; rendered once a process."""
    world = World(world_settings(rig, seed, dc_k=dc_k, ground=ground))
    with TemporaryDirectory(prefix="syntopic-planted-") as scenes:
        exposure = take(world, Path(scenes))
    heads = RigElectronics(world, seed=seed)
    return InjectedExposure(
        rig=world.rig,
        frames=heads.frames(world, exposure.snapshot, seed=seed),
        conditions=conditions_of(exposure, seed=seed),
        radiometry=radiometry_of(heads),
        truth=replace(exposure.snapshot, light={}),
    )


def slipped(axis: str, first: int, by: int, length: int | None = None) -> Callable[[Any], Any]:
    """Rows or columns from `first` on, `length` of them, repeat those `by` further on."""

    def change(frame: Any) -> Any:
        lines = frame if axis == "rows" else frame.T
        source = lines.copy()
        last = len(lines) if length is None else first + length
        lines[first:last] = source[np.clip(np.arange(first, last) + by, 0, len(lines) - 1)]
        return frame

    return change


def with_platform_rotation(
    x_rad: float = 0.0, y_rad: float = 0.0, z_rad: float = 0.0
) -> Callable[[Cone], Cone]:
    """A platform calibration that is off by these angles."""
    off: Sequence[float] = (x_rad, y_rad, z_rad)

    def change(cone: Cone) -> Cone:
        x, y, z = (angle + more for angle, more in zip(cone.rotation_rad, off, strict=True))
        return replace(cone, rotation_rad=(x, y, z))

    return change


def with_f(factor: float) -> Callable[[Cone], Cone]:
    """A principal distance that is off by a factor."""
    return lambda cone: replace(cone, lens=replace(cone.lens, f_mm=cone.lens.f_mm * factor))


def moved(x_px: float, y_px: float) -> Callable[[Sensor], Sensor]:
    """A calibrated place that is off by so many pixels."""
    return lambda s: replace(s, x_mm=s.x_mm + x_px * s.pitch_mm, y_mm=s.y_mm + y_px * s.pitch_mm)


def gain(factor: float, first: int = 0, axis: int = 0) -> Callable[[Any], Any]:
    """Signal above black times a factor, from one line on."""

    def change(frame: Any) -> Any:
        lines = frame if axis == 0 else frame.T
        signal = (lines[first:].astype(np.float64) - BLACK_DN) * factor + BLACK_DN
        lines[first:] = np.clip(np.rint(signal), 0, 4095)
        return frame

    return change


def banded(dn: int, period: int) -> Callable[[Any], Any]:
    """More DN in every other band of `period` rows."""

    def change(frame: Any) -> Any:
        bands = dn * ((np.arange(len(frame)) // period) % 2)
        return np.clip(frame.astype(np.int32) + bands[:, None], 0, 4095).astype(np.uint16)

    return change


def block(dn: int, rows: slice, columns: slice) -> Callable[[Any], Any]:
    """More DN in a rectangle."""

    def change(frame: Any) -> Any:
        frame[rows, columns] = np.minimum(frame[rows, columns] + dn, 4095)
        return frame

    return change


def clipped(level_dn: int) -> Callable[[Any], Any]:
    """No signal above a level."""
    return lambda frame: np.minimum(frame, level_dn)


def in_part(change: Callable[[Any], Any], rows: slice, columns: slice) -> Callable[[Any], Any]:
    """A change that holds in a rectangle only."""

    def partly(frame: Any) -> Any:
        frame[rows, columns] = change(frame.copy())[rows, columns]
        return frame

    return partly
