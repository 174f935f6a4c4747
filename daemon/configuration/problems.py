"""Errors between sections of a configuration: devices, triggers, ports, the rig.

Each is a key, and its value with the correction. The rules of a single section are in
`daemon.configuration.model`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from drivers.base import registry
from drivers.contract import DeviceError
from processing.rig import Rig
from processing.rig.problem_sentences import Finding, Location, key_of


def device_problems(content: Mapping[str, Any], trigger_keys: frozenset[str]) -> list[Finding]:
    """Errors in the devices of a configuration, independent of the rig.

    Args:
        content: parsed TOML.
        trigger_keys: keys of `[trigger]` that are not the driver's.
    """
    return [
        *_driver_problems(content, trigger_keys),
        *_name_problems(content),
        *_trigger_problems(content),
        *_port_problems(content),
        *_probe_problems(content),
    ]


def rig_problems(content: Mapping[str, Any], rig: Rig) -> list[Finding]:
    """Conflicts between the devices of a configuration and the rig."""
    return [
        *_sensor_problems(content, rig),
        *_serial_problems(content, rig),
        *_tdi_problems(content, rig),
    ]


def nested_value(content: Mapping[str, Any], *keys: str) -> Any:
    """The value below these keys; None where there is none."""
    value: Any = content
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _driver_problems(content: Mapping[str, Any], trigger_keys: frozenset[str]) -> Iterator[Finding]:
    """Errors that the drivers find in their settings."""
    own_keys = {
        "head": {"driver", "sensor"},
        "thermometer": {"driver", "name"},
        "navigator": {"driver", "name"},
        "pps": {"driver", "name"},
        "trigger": set(trigger_keys),
    }
    for kind, own in own_keys.items():
        sections = content.get(kind)
        listed = sections if isinstance(sections, list) else [sections]
        for index, section in enumerate(listed):
            if not isinstance(section, Mapping) or not isinstance(section.get("driver"), str):
                continue
            place = (kind,) if kind == "trigger" else (kind, index)
            settings = {name: value for name, value in section.items() if name not in own}
            for problem in registry.problems(kind, section["driver"], settings):
                key, _, text = problem.partition(" ")
                yield (*place, key), text


def _sensor_problems(content: Mapping[str, Any], rig: Rig) -> Iterator[Finding]:
    """Conflicts between the heads and the sensors of the rig."""
    heads = content.get("head")
    given = [
        head["sensor"]
        for head in (heads if isinstance(heads, list) else [])
        if isinstance(head, Mapping) and isinstance(head.get("sensor"), str)
    ]
    known = {sensor.name for sensor in rig.sensors}
    for index, name in enumerate(given):
        place = ("head", index, "sensor")
        if name not in known:
            yield place, f"is {name!r}; {rig.name} has {', '.join(sorted(known))}"
        elif name in given[:index]:
            yield place, f"is {name!r} for the second time; give each head a sensor of its own"


def _sections(content: Mapping[str, Any], kind: str) -> list[Mapping[str, Any]]:
    listed = content.get(kind)
    return [one for one in listed if isinstance(one, Mapping)] if isinstance(listed, list) else []


def _name_problems(content: Mapping[str, Any]) -> Iterator[Finding]:
    """Devices of one name: records of one would be taken for the other's."""
    used_by: dict[str, Location] = {}
    for kind, key in (("head", "sensor"), ("thermometer", "name"), ("navigator", "name")):
        for index, section in enumerate(_sections(content, kind)):
            name, place = section.get(key), (kind, index, key)
            if not isinstance(name, str):
                continue
            # A sensor named twice is reported with the rig's sensors.
            if name in used_by and not (kind == "head" and used_by[name][0] == "head"):
                other = key_of(used_by[name])
                yield place, f"is {name!r}, as is {other}; give each device a name of its own"
            used_by.setdefault(name, place)


def _probe_problems(content: Mapping[str, Any]) -> Iterator[Finding]:
    """Probes that two devices read: readings of one would be taken for the other's."""
    used_by: dict[str, Location] = {}
    for kind, key in (("thermometer", "channels"), ("head", "temperature_probe")):
        for index, section in enumerate(_sections(content, kind)):
            value, place = section.get(key), (kind, index, key)
            for name in value if isinstance(value, list) else [value]:
                if not isinstance(name, str) or not name:
                    continue
                if name in used_by and used_by[name] != place:
                    other = key_of(used_by[name])
                    yield (
                        place,
                        f"names the probe {name!r}, as does {other}; one device reads a probe",
                    )
                used_by.setdefault(name, place)


def _trigger_problems(content: Mapping[str, Any]) -> Iterator[Finding]:
    """Heads that wait for another start of exposure than the trigger gives."""
    driver_name = nested_value(content, "trigger", "driver")
    try:
        trigger: Any = registry.driver_for("trigger", str(driver_name))
    except DeviceError:
        return
    for index, section in enumerate(_sections(content, "head")):
        try:
            head: Any = registry.driver_for("head", str(section.get("driver")))
        except DeviceError:
            continue
        source = section.get("trigger_source", head.trigger_source.default)
        choices = head.trigger_source.choices
        if source not in choices or source == trigger.head_trigger_source:
            continue
        if trigger.head_trigger_source in choices:
            cure = f'set trigger_source = "{trigger.head_trigger_source}"'
        else:
            cure = f"a head of driver {section.get('driver')} has {', '.join(choices)}"
        yield (
            ("head", index, "trigger_source"),
            f"is {source!r}, and trigger.driver {driver_name!r} starts exposures by "
            f"{trigger.head_trigger_source!r}; {cure}, or choose another trigger.driver",
        )


def _port_problems(content: Mapping[str, Any]) -> Iterator[Finding]:
    """Two devices at one port or address."""
    used_by: dict[tuple[str, str], Location] = {}
    for kind, key in (
        ("head", "address"),
        ("head", "device"),
        ("thermometer", "port"),
        ("navigator", "port"),
        ("pps", "device"),
    ):
        for index, section in enumerate(_sections(content, kind)):
            value, place = section.get(key), (kind, index, key)
            if not isinstance(value, str) or section.get("driver") == "gpsd":
                continue
            if (key, value) in used_by:
                other = key_of(used_by[key, value])
                yield place, f"is {value!r}, as is {other}; one of them is wrong"
            used_by.setdefault((key, value), place)


def _serial_problems(content: Mapping[str, Any], rig: Rig) -> list[Finding]:
    """Parts that the rig does not have."""
    available = {"lens": [cone.name for cone in rig.cones], "probe": list(rig.probes)}
    return [
        (("serials", kind, name), f"is of nothing {rig.name} has: {', '.join(names) or 'none'}")
        for kind, names in available.items()
        if isinstance(given := nested_value(content, "serials", kind), Mapping)
        for name in given
        if name not in names
    ]


def mirror_problems(
    root: Path, mirror: Path, timeout_s: float, exposures_in_memory: int, rig: Rig
) -> Iterator[Finding]:
    """Whether the mirror is another place, and is given up before the memory for frames is full."""
    one, other = root.resolve(), mirror.resolve()
    if one == other or one in other.parents or other in one.parents:
        yield (
            ("mission", "mirror"),
            f"is {mirror}, which is mission.root, in it or around it; give a folder on another "
            "disk",
        )
    # One exposure is being written when a disk stalls; the others find room in memory meanwhile.
    bridged_s = (exposures_in_memory - 1) * rig.frame_interval_s
    if timeout_s >= bridged_s:
        required_depth = 2 + int(timeout_s / rig.frame_interval_s)
        yield (
            ("limits", "mirror_timeout_s"),
            f"is {timeout_s:g}; memory for {exposures_in_memory} exposures bridges "
            f"{bridged_s:g} s at one every {rig.frame_interval_s:g} s: give a shorter time, or set "
            f"limits.exposures_in_memory to {required_depth}",
        )


def _tdi_problems(content: Mapping[str, Any], rig: Rig) -> list[Finding]:
    """TDI moves charge from row to row, and on a Bayer head from colour to colour."""
    heads = content.get("head")
    bayer = {s.name: s for s in rig.sensors if s.colour_filter_array != "none"}
    return [
        (
            ("head", index, "tdi_shifts"),
            f"is {head['tdi_shifts']}; {head['sensor']} is a Bayer head "
            f"({bayer[head['sensor']].colour_filter_array}), where moving charge would mix "
            "colours: set 0 and expose shorter",
        )
        for index, head in enumerate(heads if isinstance(heads, list) else [])
        if isinstance(head, Mapping)
        and head.get("sensor") in bayer
        and isinstance(head.get("tdi_shifts"), int)
        and head["tdi_shifts"] > 0
    ]
