"""Wrong inputs of lens, read-out and transfer that change over a frame or exchange a part of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import cv2
import numpy as np

from benchmarks.silent_errors.exposures import EmulatedExposure
from benchmarks.silent_errors.planting import (
    Array,
    Fault,
    FaultInjector,
    Random,
    any_of,
    any_sign,
    colour_sensors,
    of_frame,
    pan_sensors,
    scaled,
)
from benchmarks.silent_errors.slip_faults import row_inserted
from processing.rig import Sensor

SMEARS: Final = 8
"""Strips of a smear that grows over the frame, each of one length."""


def _exposure_half(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    name = any_of(random, pan_sensors(emulated.rig))
    sensor = emulated.rig.sensor(name)
    return of_frame(emulated, name, lambda f: scaled(sensor, f, 0.5), "exposed half as long")


def _stuck_column(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    name = any_of(random, [s.name for s in emulated.rig.sensors])
    sensor = emulated.rig.sensor(name)
    signal = float(np.median(emulated.frames[name])) - sensor.black_dn
    column = int(random.integers(8, sensor.width_px - 8))
    level = np.uint16(round(sensor.black_dn + float(random.uniform(0.0, 2.0)) * signal))

    def change(frame: Array) -> Array:
        frame[:, column] = level
        return frame

    return of_frame(emulated, name, change, f"column {column} stuck at {level} DN")


def _oblique_step(emulated: EmulatedExposure, name: str, percent: float, random: Random) -> Fault:
    sensor, off = emulated.rig.sensor(name), any_sign(random) * percent
    degrees = float(random.uniform(10.0, 80.0)) + 90.0 * int(random.integers(0, 2))
    way = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    middle = random.uniform(0.35, 0.65, 2) * (sensor.width_px, sensor.height_px)
    columns, rows = np.meshgrid(np.arange(sensor.width_px), np.arange(sensor.height_px))
    beyond = (columns - middle[0]) * way[0] + (rows - middle[1]) * way[1] > 0.0
    factor = np.where(beyond, 1.0 + off / 100.0, 1.0)
    description = f"signal {off:+.1f} % beyond a line at {degrees:.0f} degrees"
    return of_frame(emulated, name, lambda f: scaled(sensor, f, factor), description)


def _gain_step_oblique(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    return _oblique_step(emulated, any_of(random, pan_sensors(emulated.rig)), percent, random)


def _gain_step_oblique_colour(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    return _oblique_step(emulated, any_of(random, colour_sensors(emulated.rig)), percent, random)


def _vignetting(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    name = any_of(random, pan_sensors(emulated.rig))
    sensor = emulated.rig.sensor(name)
    factor = 1.0 - percent / 100.0 * _from_middle(sensor) ** 2
    description = f"corners darker by {percent:.1f} %"
    return of_frame(emulated, name, lambda f: scaled(sensor, f, factor), description)


def _from_middle(sensor: Sensor) -> Array:
    """Distance of pixels from the middle, 1 in the corners."""
    columns, rows = np.meshgrid(
        np.linspace(-1.0, 1.0, sensor.width_px), np.linspace(-1.0, 1.0, sensor.height_px)
    )
    return np.asarray(np.hypot(columns, rows) / np.sqrt(2.0))


def _smear_varying(emulated: EmulatedExposure, px: float, random: Random) -> Fault:
    name, along = any_of(random, pan_sensors(emulated.rig)), bool(random.integers(0, 2))

    def change(frame: Array) -> Array:
        height, smeared = len(frame), frame.copy()
        for strip in range(SMEARS):
            # Of an even length the content would shift by half a pixel, too.
            length = 1 + 2 * round(px * (strip + 0.5) / SMEARS / 2.0)
            rows = slice(strip * height // SMEARS, (strip + 1) * height // SMEARS)
            size = (1, length) if along else (length, 1)
            smeared[rows] = cv2.blur(frame, size)[rows]
        return smeared

    way = "along" if along else "across"
    return of_frame(emulated, name, change, f"smeared {way}, from nothing to {px:.1f} px")


def _rows_stale(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    """The last rows are those of another exposure: a buffer that was not written to its end."""
    name = any_of(random, pan_sensors(emulated.rig))
    height, other = emulated.rig.sensor(name).height_px, emulated.other()[name]
    count = round(height * min(percent, 90.0) / 100.0)

    def change(frame: Array) -> Array:
        frame[-count:] = other[-count:]
        return frame

    fault = of_frame(emulated, name, change, f"last {count} rows of the next exposure")
    return replace(fault, emulated=replace(fault.emulated, elsewhere=frozenset({name})))


def _of_one_size(emulated: EmulatedExposure, random: Random) -> tuple[Sensor, Sensor]:
    """Two sensors whose frames look alike to whatever counts their pixels."""

    def size(sensor: Sensor) -> Any:
        return sensor.width_px, sensor.height_px, sensor.colour_filter_array

    every = emulated.rig.sensors
    pairs = [(a, b) for a in every for b in every if a.name != b.name and size(a) == size(b)]
    return any_of(random, pairs)


def _heads_swapped(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    a, b = _of_one_size(emulated, random)
    frames = {**emulated.frames, a.name: emulated.frames[b.name], b.name: emulated.frames[a.name]}
    cones = {emulated.rig.cone_of(sensor.name).name for sensor in (a, b)}
    changed = replace(emulated, frames=frames, elsewhere=frozenset({a.name, b.name}))
    return Fault(
        changed, frozenset({a.name, b.name, *cones}), f"frames of {a.name} and {b.name} swapped"
    )


def _frame_copied(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    a, b = _of_one_size(emulated, random)
    fault = of_frame(
        emulated, a.name, lambda _: emulated.frames[b.name].copy(), f"that of {b.name}"
    )
    return replace(
        fault,
        true_causes=fault.true_causes | {b.name, emulated.rig.cone_of(b.name).name},
        emulated=replace(fault.emulated, elsewhere=frozenset({a.name})),
    )


def _frame_flipped(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    name = any_of(random, [s.name for s in emulated.rig.sensors])
    fault = of_frame(emulated, name, lambda f: f[::-1].copy(), "flipped, last row first")
    return replace(fault, emulated=replace(fault.emulated, elsewhere=frozenset({name})))


FRAME_FAULTS: Final[Mapping[str, FaultInjector]] = {
    "exposure-half": _exposure_half,
    "row-inserted": row_inserted,
    "stuck-column": _stuck_column,
    "gain-step-oblique": _gain_step_oblique,
    "gain-step-oblique-colour": _gain_step_oblique_colour,
    "vignetting": _vignetting,
    "smear-varying": _smear_varying,
    "rows-stale": _rows_stale,
    "heads-swapped": _heads_swapped,
    "frame-copied": _frame_copied,
    "frame-flipped": _frame_flipped,
}
"""How these kinds of `benchmarks.silent_errors.limits` are planted."""
