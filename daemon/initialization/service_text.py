"""Text of `service.toml` for a new rig: heads, receivers, software trigger or a trigger unit."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from daemon.configuration.schemas import schema_line
from daemon.initialization.answers import Answers
from daemon.initialization.mounting import mounting_of
from daemon.initialization.rig_text import sensor_names
from drivers.cameras.head_description import HeadDescription
from drivers.detection.port_search import DetectionResult

EXPOSURE_TIME_US = 1000.0


@dataclass(frozen=True)
class TriggerUnit:
    """Address of a trigger unit (driver `pulse-bus`)."""

    host: str
    port: int


def service_text(
    answers: Answers,
    receivers: Sequence[DetectionResult],
    *,
    written_by: str,
    trigger_unit: TriggerUnit | None = None,
    has_page: bool = True,
) -> str:
    """The service configuration.

    Args:
        answers: heads and their order.
        receivers: ports with a receiver.
        written_by: the command, for the comment at the top.
        trigger_unit: triggers the heads; without one, software does.
        has_page: whether the operator's page is served.
    """
    lines = [
        schema_line("service"),
        f"# Service configuration of {answers.name}. Written by `{written_by}`.",
        "# Every key: docs/reference/configuration.md",
        "",
        "[mission]",
        'root = "missions"        # folder of the missions, on a disk that is fast enough',
        'rig = "rig.toml"',
        "",
        "[plan]",
        "height_above_ground_m = 1000.0    # P: planned values until navigation arrives",
        "ground_speed_mps = 60.0           # P",
        "",
        *_mount(answers),
        *_trigger(answers, trigger_unit),
    ]
    for name, head in zip(sensor_names(answers), answers.heads, strict=True):
        lines += ["", *_head(name, head, trigger_unit)]
    for number, receiver in enumerate(receivers, start=1):
        lines += ["", *_navigator(receiver, number)]
    if not receivers:
        lines += [
            "",
            "# No receiver was found: exposures have the time of this computer and no position.",
            "# syntopic check --find PORT prints the section of a receiver.",
        ]
    if has_page:
        lines += ["", "[watch]", "port = 8470              # http://127.0.0.1:8470/"]
    return "\n".join(lines) + "\n"


def _mount(answers: Answers) -> list[str]:
    boresight = mounting_of(answers).boresight_deg
    return [
        "[mount]",
        "antenna_m = [0.0, 0.0, 0.0]       # P: antenna from the master: forward, right, down",
        f"boresight_deg = {json.dumps(list(boresight))}   # P: roll, pitch, heading",
        "",
    ]


def _trigger(answers: Answers, unit: TriggerUnit | None) -> list[str]:
    lines = ["[trigger]"]
    if unit is None:
        lines += [
            'driver = "software"      # each head by its own command: some milliseconds apart'
        ]
    else:
        lines += [
            'driver = "pulse-bus"',
            f"host = {json.dumps(unit.host)}",
            f"port = {unit.port}",
        ]
    return [
        *lines,
        'mode = "interval"',
        f"interval_s = {answers.interval_s!r}",
        'start = "immediate"      # "on command": waits for syntopic send start-line',
    ]


def _head(name: str, head: HeadDescription, unit: TriggerUnit | None) -> list[str]:
    settings: dict[str, Any] = {**head.settings}
    if unit is None:
        settings.setdefault("trigger_source", "software")
    else:
        settings["trigger_source"] = "line"
        settings.pop("trigger_control", None)
    return [
        f"[[head]]{f'    # {head.model}' if head.model.isascii() else ''}",
        f"sensor = {json.dumps(name)}",
        f"driver = {json.dumps(head.driver)}",
        # JSON's texts and numbers are TOML's.
        *(f"{key} = {json.dumps(value)}" for key, value in settings.items()),
        f"exposure_time_us = {EXPOSURE_TIME_US}    # P",
    ]


def _navigator(found: DetectionResult, number: int) -> list[str]:
    detected = found.detected
    assert detected is not None
    port = found.port.removeprefix("tcp://") if detected.driver == "gpsd" else found.port
    settings: dict[str, Any] = {
        "name": "gnss" + (str(number) if number > 1 else ""),
        "driver": detected.driver,
        "port": port,
    }
    if found.baudrate is not None:
        settings |= {"baudrate": found.baudrate, "parity": found.parity}
    settings |= detected.settings
    return [
        f"[[navigator]]    # {detected.protocol}",
        *(f"# to do: the receiver has to send {text}" for text in [detected.missing] if text),
        *(f"{key} = {json.dumps(value)}" for key, value in settings.items()),
    ]
