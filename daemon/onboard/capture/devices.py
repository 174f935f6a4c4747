"""The devices of a configuration, and their agreement with the rig."""

from __future__ import annotations

import re
from collections.abc import Mapping

from daemon.configuration.model import Configuration
from daemon.onboard.service.messages import DeviceSpec
from drivers.contract import CHUNK_ALLOWANCE_NBYTES
from processing.rig import Rig

_FRAME = re.compile(r"(\d+) x (\d+) (\S+)")
"""Format of a head's property `frame`."""


def device_specs(configuration: Configuration, rig: Rig) -> tuple[DeviceSpec, ...]:
    """Every device; the trigger last, since it may fire the heads."""
    trigger = configuration.trigger
    heads = [
        DeviceSpec("head", h.driver, h.sensor, h.settings, output=rig.cone_of(h.sensor).name)
        for h in configuration.head
    ]
    thermometers = [
        DeviceSpec("thermometer", t.driver, t.name, t.settings) for t in configuration.thermometer
    ]
    navigators = [
        DeviceSpec("navigator", n.driver, n.name, n.settings) for n in configuration.navigator
    ]
    seconds = [DeviceSpec("pps", p.driver, p.name, p.settings) for p in configuration.pps]
    fires = DeviceSpec("trigger", trigger.driver, "trigger", dict(trigger.model_extra or {}))
    return (*heads, *thermometers, *navigators, *seconds, fires)


def frame_nbytes(rig: Rig, sensor_name: str) -> int:
    """Bytes of a sensor's frame in memory, 16 bit, with space for chunk data."""
    sensor = rig.sensor(sensor_name)
    return sensor.width_px * sensor.height_px * 2 + CHUNK_ALLOWANCE_NBYTES


def serial_problem(rig: Rig, head: str, found: Mapping[str, str]) -> str | None:
    """A sentence where the connected head is not the calibrated one."""
    calibrated = rig.sensor(head).serial
    connected = found.get("serial", "")
    if not calibrated or not connected or calibrated == connected:
        return None
    return (
        f"head {head} has serial number {connected}, the calibration {rig.calibration_id} is of "
        f"{calibrated}; connect that head, or fly with a calibration of this one"
    )


def bound_problem(rig: Rig, kind: str, name: str, found: Mapping[str, str]) -> str | None:
    """A sentence where a device that answered cannot be flown with this rig: another head, another
    frame, a trigger unit without an output for a cone.
    """
    if kind == "head":
        return serial_problem(rig, name, found) or frame_problem(rig, name, found)
    if kind == "trigger" and "unit" in found:
        outputs = found.get("outputs", "").split()
        without = [cone.name for cone in rig.cones if cone.name not in outputs]
        if without:
            return (
                f"the trigger unit {found['unit']} has the outputs {', '.join(outputs) or 'none'} "
                f"and none for cone {', '.join(without)}; wire the cone to an output of its name"
            )
    return None


def frame_problem(rig: Rig, head: str, found: Mapping[str, str]) -> str | None:
    """A sentence where a head's frames do not have the size or depth of the rig's sensor."""
    frame_format = _FRAME.match(found.get("frame", ""))
    if frame_format is None:
        return None
    sensor = rig.sensor(head)
    width, height, pixel_format = int(frame_format[1]), int(frame_format[2]), frame_format[3]
    if (width, height) != (sensor.width_px, sensor.height_px):
        return (
            f"head {head} sends frames of {width} x {height} px, the rig has {sensor.width_px} x "
            f"{sensor.height_px}; set width_px and height_px, or fly with the rig of this head"
        )
    depth = re.search(r"\d+", pixel_format)
    if depth is not None and int(depth[0]) < sensor.bits:
        return (
            f"head {head} sends {pixel_format}, the rig's sensor has {sensor.bits} bits; set a "
            "pixel_format of that depth"
        )
    return None


def stated_serial_problems(configuration: Configuration, rig: Rig) -> list[str]:
    """A sentence for each lens and probe that is stated to be another than the calibrated one."""
    calibrated = rig.serials
    return [
        f"{part} is stated to be {serial!r}, the calibration {rig.calibration_id} is of "
        f"{calibrated[part]!r}"
        for part, serial in configuration.serials.parts.items()
        if calibrated.get(part, serial) != serial
    ]


def exposure_times_ns(configuration: Configuration, rig: Rig) -> dict[str, int]:
    """Exposure time by cone, as configured for its heads; zero where a cone has none."""
    times = {cone.name: 0 for cone in rig.cones}
    for head in configuration.head:
        microseconds = float(head.settings.get("exposure_time_us", 0.0))
        times[rig.cone_of(head.sensor).name] = round(microseconds * 1000)
    return times
