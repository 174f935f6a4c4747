"""What a running service says of itself, for `syntopic check`: devices are held, and not opened."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from daemon.configuration.model import Configuration
from daemon.mission.layout import Mission
from daemon.onboard.monitoring.access.control_socket import ControlError, ask
from daemon.onboard.preflight.findings import Finding, Outcome, failed, passed

STATES = {"ready": Outcome.PASS, "found": Outcome.PASS}
"""Of a device; others are failures."""


def ask_service(configuration: Configuration, mission: Mission) -> list[Finding]:
    """The findings of the service that flies a mission, over its control socket."""
    runs = f"mission {mission.id} is held by another process, the running service"
    control = None if configuration.watch is None else configuration.watch.control
    if control is None:
        sentence = (
            f"{runs}; it cannot be asked without [watch] control = PATH. Look at its page, or "
            "stop it and check again"
        )
        return [Finding("service", mission.id, Outcome.WAITING, sentence)]
    try:
        state = ask(control)
    except ControlError as error:
        return [failed("service", mission.id, f"{runs}, and does not answer: {error}")]
    return [
        passed("service", mission.id, f"the service flies, phase {state.get('phase')}"),
        *_told(state),
    ]


def _told(state: Mapping[str, Any]) -> list[Finding]:
    found = []
    for device in state.get("devices", []):
        name, is_there = str(device.get("name")), device.get("state")
        outcome = STATES.get(str(is_there), Outcome.FAIL)
        told = "" if outcome is Outcome.PASS else str(device.get("sentence") or is_there)
        found.append(Finding(str(device.get("kind") or "device"), name, outcome, told))
    found += [
        Finding("arming", "missing", Outcome.WAITING, str(sentence))
        for sentence in state.get("missing", [])
    ]
    found += [
        failed("fault", str(fault.get("device")), str(fault.get("sentence")))
        for fault in state.get("faults", [])
        if fault.get("stands")
    ]
    return found
