"""Wrong inputs of whole frames and of the record: no light, rows sent twice, counts lost."""

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
    colour_sensors,
    of_frame,
    pan_sensors,
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


EXPOSURE_FAULTS: Final[Mapping[str, FaultInjector]] = {
    "dark-head": _dark_head,
    "block-repeated": _block_repeated,
    "tdi-lost": _tdi_lost,
    "group-other": _group_other,
}
"""How these kinds of `benchmarks.silent_errors.limits` are planted."""
