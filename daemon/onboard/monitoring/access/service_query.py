"""Query of a running service for `syntopic check`, which opens no device that the service holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from daemon.configuration.model import Configuration
from daemon.mission.layout import Mission
from daemon.onboard.monitoring.access.control_socket import ControlError, query_state
from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult, failed, passed

STATES = {"ready": CheckOutcome.PASS, "found": CheckOutcome.PASS}
"""State of a device; others are failures."""


def query_service(configuration: Configuration, mission: Mission) -> list[CheckResult]:
    """The findings of the service that flies a mission, over its control socket."""
    runs = f"mission {mission.id} is held by another process, the running service"
    control = None if configuration.watch is None else configuration.watch.control
    if control is None:
        sentence = (
            f"{runs}; it cannot be queried without [watch] control = PATH. See its page, or "
            "stop it and check again"
        )
        return [CheckResult("service", mission.id, CheckOutcome.WAITING, sentence)]
    try:
        state = query_state(control)
    except ControlError as error:
        return [failed("service", mission.id, f"{runs}, and does not answer: {error}")]
    return [
        passed("service", mission.id, f"the service flies, phase {state.get('phase')}"),
        *_results_of(state),
    ]


def _results_of(state: Mapping[str, Any]) -> list[CheckResult]:
    found = []
    for device in state.get("devices", []):
        name, device_state = str(device.get("name")), device.get("state")
        outcome = STATES.get(str(device_state), CheckOutcome.FAIL)
        details = (
            "" if outcome is CheckOutcome.PASS else str(device.get("sentence") or device_state)
        )
        found.append(CheckResult(str(device.get("kind") or "device"), name, outcome, details))
    found += [
        CheckResult("arming", "missing", CheckOutcome.WAITING, str(sentence))
        for sentence in state.get("missing", [])
    ]
    found += [
        failed("fault", str(fault.get("device")), str(fault.get("sentence")))
        for fault in state.get("faults", [])
        if fault.get("stands")
    ]
    return found
