"""Wrong inputs of whole frames and of the record: no light, another response, counts lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

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

SHUT_NOISE_DN: Final = 3.0


def _dark_head(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    name = any_of(random, [s.name for s in emulated.rig.sensors])
    sensor = emulated.rig.sensor(name)

    def change(frame: Array) -> Array:
        noise = random.normal(sensor.black_dn, SHUT_NOISE_DN, frame.shape)
        return np.asarray(np.clip(np.rint(noise), 0, sensor.full_scale_dn), np.uint16)

    fault = of_frame(emulated, name, change, "no light")
    return replace(fault, emulated=replace(fault.emulated, elsewhere=frozenset({name})))


def _block_repeated(emulated: EmulatedExposure, lines: float, random: Random) -> Fault:
    name = any_of(random, [s.name for s in emulated.rig.sensors])
    height = emulated.rig.sensor(name).height_px
    count = min(max(1, round(lines)), height // 3)
    source = int(random.integers(0, height - 2 * count))
    first = int(random.integers(source + count, height - count + 1))

    def change(frame: Array) -> Array:
        frame[first : first + count] = frame[source : source + count]
        return frame

    fault = of_frame(emulated, name, change, f"{count} rows from {first} are those from {source}")
    return replace(fault, emulated=replace(fault.emulated, elsewhere=frozenset({name})))


def _tdi_lost(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    conditions = replace(emulated.conditions, tdi_shifts={})
    sensors = {s.name for s in emulated.rig.sensors}
    names = sensors | {cone.name for cone in emulated.rig.cones}
    return Fault(
        replace(emulated, conditions=conditions), frozenset(names), "no TDI counts in the record"
    )


def _group_other(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    group = any_of(random, (pan_sensors(emulated.rig), colour_sensors(emulated.rig)))
    other = emulated.other()
    changed = replace(
        emulated,
        frames={**emulated.frames, **{name: other[name] for name in group}},
        elsewhere=frozenset(group),
    )
    cones = {emulated.rig.cone_of(name).name for name in group}
    return Fault(changed, frozenset({*group, *cones}), f"{', '.join(group)} of the next exposure")


def _offset_pan(emulated: EmulatedExposure, dn: float, random: Random) -> Fault:
    name = any_of(random, pan_sensors(emulated.rig))
    sensor, off = emulated.rig.sensor(name), dn * 2.0 ** (emulated.rig.sensor(name).bits - 12)

    def change(frame: Array) -> Array:
        return np.asarray(np.clip(frame + round(off), 0, sensor.full_scale_dn), np.uint16)

    return of_frame(emulated, name, change, f"{off:.0f} DN more: dark signal not subtracted")


def _tone_pan(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    """Another tone curve that keeps the brightest percent where it is."""
    name = any_of(random, pan_sensors(emulated.rig))
    sensor, exponent = emulated.rig.sensor(name), 1.0 + any_sign(random) * percent / 100.0

    def change(frame: Array) -> Array:
        signal = np.maximum(frame.astype(np.float64) - sensor.black_dn, 0.0)
        bright = max(float(np.percentile(signal, 99.0)), 1.0)
        signal = bright * (signal / bright) ** exponent + sensor.black_dn
        return np.asarray(np.clip(np.rint(signal), 0, sensor.full_scale_dn), np.uint16)

    return of_frame(emulated, name, change, f"tone curve with an exponent of {exponent:.2f}")


def _slope_pan(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    name, axis = any_of(random, pan_sensors(emulated.rig)), int(random.integers(0, 2))
    sensor, off = emulated.rig.sensor(name), any_sign(random) * percent / 100.0
    shape = (sensor.height_px, 1) if axis == 0 else (1, sensor.width_px)
    factor = 1.0 + off * np.linspace(-0.5, 0.5, max(shape)).reshape(shape)
    along = ("rows", "columns")[axis]
    description = f"signal changes slowly by {100 * off:+.1f} % along {along}"
    return of_frame(emulated, name, lambda f: scaled(sensor, f, factor), description)


EXPOSURE_FAULTS: Final[Mapping[str, FaultInjector]] = {
    "dark-head": _dark_head,
    "block-repeated": _block_repeated,
    "tdi-lost": _tdi_lost,
    "group-other": _group_other,
    "offset-pan": _offset_pan,
    "tone-pan": _tone_pan,
    "slope-pan": _slope_pan,
}
"""How these kinds of `benchmarks.silent_errors.limits` are planted."""
