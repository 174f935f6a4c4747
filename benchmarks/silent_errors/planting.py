"""What every planted wrong input has in common: its truth, and draws of heads and regions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.silent_errors.exposures import EmulatedExposure
from processing.rig import Cone, Rig, Sensor

Array = NDArray[Any]
Random = np.random.Generator
T = TypeVar("T")


@dataclass(frozen=True)
class Fault:
    """What was planted: the exposure, what may rightly be named as the cause, and a description."""

    emulated: EmulatedExposure
    true_causes: frozenset[str]
    description: str


FaultInjector = Callable[[EmulatedExposure, float, Random], Fault]


def of_cone(
    emulated: EmulatedExposure, cone: Cone, change: Callable[[Cone], Cone], description: str
) -> Fault:
    names = frozenset({cone.name, *(s.name for s in cone.sensors)})
    return Fault(emulated.with_cone(cone.name, change), names, f"cone {cone.name}: {description}")


def of_sensor(
    emulated: EmulatedExposure, name: str, change: Callable[[Sensor], Sensor], description: str
) -> Fault:
    names = frozenset({name, emulated.rig.cone_of(name).name})
    return Fault(emulated.with_sensor(name, change), names, f"{name}: {description}")


def of_frame(
    emulated: EmulatedExposure, name: str, change: Callable[[Array], Array], description: str
) -> Fault:
    names = frozenset({name, emulated.rig.cone_of(name).name})
    return Fault(emulated.with_frame(name, change), names, f"{name}: {description}")


def any_of(random: Random, some: Sequence[T]) -> T:
    return some[int(random.integers(0, len(some)))]


def any_sign(random: Random) -> float:
    return float(any_of(random, (-1.0, 1.0)))


def pan_sensors(rig: Rig) -> list[str]:
    """PAN sensors; all where there is no PAN."""
    pan = [s.name for cone in rig.pan_cones for s in cone.sensors]
    return pan or [s.name for s in rig.sensors]


def colour_sensors(rig: Rig) -> list[str]:
    return [s.name for cone in rig.cones if cone.role == "colour" for s in cone.sensors]


def sensors_of_several(rig: Rig) -> list[str]:
    """Sensors of cones of several."""
    return [s.name for cone in rig.pan_cones if len(cone.sensors) > 1 for s in cone.sensors]


def any_part(sensor: Sensor, parts: int, random: Random) -> tuple[tuple[slice, slice], str]:
    """One of `parts` x `parts` regions of a frame."""
    height, width = sensor.height_px // parts, sensor.width_px // parts
    top = int(random.integers(0, sensor.height_px - height + 1))
    left = int(random.integers(0, sensor.width_px - width + 1))
    where = f"rows {top} to {top + height - 1}, columns {left} to {left + width - 1}"
    return (slice(top, top + height), slice(left, left + width)), where


def scaled(sensor: Sensor, frame: Array, factor: Any) -> Array:
    signal = (frame.astype(np.float64) - sensor.black_dn) * factor + sensor.black_dn
    return np.asarray(np.clip(np.rint(signal), 0, sensor.full_scale_dn), np.uint16)
