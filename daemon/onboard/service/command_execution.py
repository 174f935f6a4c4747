"""Execution of operator commands, and the conditions under which they are refused.

Each command returns an answer. Command, author and answer are written to the flight log.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeGuard

from daemon import DaemonError
from daemon.mission.log.log_records import AUDIT_TOPIC, Message, lenient_json_bytes
from daemon.mission.operator_decisions import DecisionKind
from daemon.onboard.flight.arming import MissingPrerequisite
from daemon.onboard.service.command_rules import LANDED_COMMANDS, violation
from daemon.onboard.service.message_dispatcher import Handlers
from daemon.onboard.service.messages import (
    Answer,
    AppendToLog,
    CommandRefused,
    EmitEvent,
    InvalidMessages,
    ServiceCommand,
)


class LineControl(Protocol):
    """The flight line; `daemon.onboard.service.flight_line.FlightLine`."""

    is_running: bool

    @property
    def is_flown(self) -> bool: ...
    def trigger_once(self) -> None: ...
    def trigger_at_interval(self, interval_s: float, count: int) -> None: ...
    def trigger_at_distance(self, distance_m: float) -> None: ...


class ArmingControl(Protocol):
    """Prerequisites and arming; `daemon.onboard.preflight.preflight.Preflight`."""

    def missing_prerequisites(self) -> Sequence[MissingPrerequisite]: ...
    def arm(self) -> None: ...
    def override(
        self, by: str, missing: Sequence[MissingPrerequisite], reason: str = ""
    ) -> None: ...


class ExposureCommands(Protocol):
    """Exposure settings; `daemon.onboard.capture.exposure_controller.ExposureController`."""

    def command(self, requested: Mapping[str, Any], by: str) -> str | None: ...


class DiskCommands(Protocol):
    """The disks of the mission; `daemon.onboard.storage.mirror.Mirror`."""

    def release(self, label: str) -> str | None: ...
    def accept(self, label: str) -> str | None: ...


class DecisionCommands(Protocol):
    """Decisions of operators; `daemon.onboard.service.operator_journal.OperatorJournal`."""

    def decide(
        self, kind: DecisionKind, number: int | None, reason: str, by: str, role: str
    ) -> str | None: ...
    def retake(
        self,
        line: str,
        from_m: float,
        to_m: float,
        *,
        number: int | None,
        reason: str,
        by: str,
        role: str,
    ) -> str: ...


class LandedCommands(Protocol):
    """Actions after landing; `daemon.onboard.service.landed_stage.LandedStage`."""

    @property
    def is_entered(self) -> bool: ...
    @property
    def running(self) -> str: ...
    def request(self, action: str, folder: str | None, by: str) -> str | None: ...
    def audit(self, content: Mapping[str, Any]) -> None: ...


class CommandTarget(Protocol):
    """The service commands act on."""

    is_ready: bool

    @property
    def line(self) -> LineControl: ...
    @property
    def preflight(self) -> ArmingControl: ...
    @property
    def exposure(self) -> ExposureCommands: ...
    @property
    def mirror(self) -> DiskCommands: ...
    @property
    def journal(self) -> DecisionCommands: ...
    @property
    def landed(self) -> LandedCommands: ...
    def acknowledge(self, fault: str) -> bool: ...
    def land(self, *, new_mission: bool = False) -> None: ...


class CommandHandlers:
    """Executes the commands of the page's process, and records each in flight log and events.

    Args:
        target: the service that commands act on.
        answer: sends an answer to the page's process.
        send: sends a message to a process, by its name.
        emit: emits an event.
    """

    def __init__(
        self,
        target: CommandTarget,
        answer: Callable[[Answer], None],
        send: Callable[[str, object], None],
        emit: EmitEvent,
    ) -> None:
        self._target = target
        self._answer = answer
        self._send = send
        self._emit = emit

    @property
    def handlers(self) -> Handlers:
        """The messages about commands."""
        return {
            ServiceCommand: self._on_command,
            CommandRefused: self._on_refused,
            InvalidMessages: self._on_invalid,
        }

    def _on_command(self, command: ServiceCommand) -> None:
        problem = violation(command)
        if problem is not None:
            # The page's process rejects these commands: it may be compromised.
            self._answer(Answer(command.number, False, problem))
            self._on_refused(refused_command(command, problem))
            return
        answer = execute(command, self._target)
        self._answer(answer)
        self._record(audit_message(command, answer), command_event(command, answer))

    def _on_refused(self, refused: CommandRefused) -> None:
        self._record(refusal_message(refused), refusal_event(refused))

    def _on_invalid(self, invalid: InvalidMessages) -> None:
        self._record(invalid_message(invalid), invalid_event(invalid))

    def _record(self, message: Message, event: Mapping[str, Any]) -> None:
        if self._target.landed.is_entered:
            self._target.landed.audit(json.loads(message.payload))
        else:
            self._send("writer", AppendToLog(message, is_durable=True))
        self._emit(**event)


def execute(command: ServiceCommand, flight: CommandTarget) -> Answer:
    """Execute a command, or return the reason for its refusal."""
    handler = _COMMANDS.get(command.name)
    if handler is None:
        return _rejected(command, f"there is no command {command.name}")
    if flight.landed.is_entered and command.name not in LANDED_COMMANDS:
        return _rejected(command, "the flight has ended; new-mission begins the next one")
    return handler(command, flight)


def audit_message(command: ServiceCommand, answer: Answer) -> Message:
    """The command and its answer, for the flight log."""
    content = {
        "command": command.name,
        "arguments": dict(command.arguments),
        "by": command.by,
        "role": command.role,
        "address": command.address,
        "done": answer.done,
        "sentence": answer.sentence,
    }
    return Message(AUDIT_TOPIC, time.monotonic_ns(), lenient_json_bytes(content))


def refusal_message(refused: CommandRefused) -> Message:
    """A command that was refused before the service, for the flight log."""
    content = {
        "command": refused.name,
        "by": refused.by,
        "role": refused.role,
        "address": refused.address,
        "done": False,
        "refused": True,
        "count": refused.count,
        "sentence": refused.sentence,
    }
    return Message(AUDIT_TOPIC, time.monotonic_ns(), lenient_json_bytes(content))


def command_event(command: ServiceCommand, answer: Answer) -> dict[str, Any]:
    """The event that reports a command."""
    return {
        "event": "command",
        "name": command.name,
        "by": command.by,
        "done": answer.done,
        "sentence": answer.sentence,
        "override": bool(command.arguments.get("override")),
    }


def refusal_event(refused: CommandRefused) -> dict[str, Any]:
    """The event that reports a command refused before the service."""
    return {
        "event": "command-refused",
        "name": refused.name,
        "by": refused.by,
        "address": refused.address,
        "sentence": refused.sentence,
    }


def refused_command(command: ServiceCommand, sentence: str) -> CommandRefused:
    """The record of a command that breaks the rules."""
    known = command.name if command.name in _COMMANDS else "unknown"
    return CommandRefused(known, command.by, command.role, command.address, sentence)


def invalid_message(invalid: InvalidMessages) -> Message:
    """Invalid messages of the page's process, for the flight log."""
    content = {"invalid": invalid.count, "by": "page's process", "problem": invalid.sentence}
    return Message(AUDIT_TOPIC, time.monotonic_ns(), lenient_json_bytes(content))


def invalid_event(invalid: InvalidMessages) -> dict[str, Any]:
    """The event that reports them."""
    sentence = (
        f"{invalid.count} messages of the page's process to the service were invalid "
        f"({invalid.sentence}) and dropped. That process may be compromised. Isolate its network "
        "and restart the service"
    )
    return {"event": "page-link", "fault": True, "sentence": sentence}


def _arm(command: ServiceCommand, flight: CommandTarget) -> Answer:
    refusal = _arm_or_reject(command, flight)
    return refusal or _accepted(command, "armed; the line may be started")


def _start(command: ServiceCommand, flight: CommandTarget) -> Answer:
    if flight.line.is_running and not flight.line.is_flown:
        return _rejected(command, "the line runs already")
    refusal = _arm_or_reject(command, flight)
    if refusal is not None:
        return refusal
    flight.line.is_running = True
    return _accepted(command, "the line runs")


def _stop(command: ServiceCommand, flight: CommandTarget) -> Answer:
    if not flight.line.is_running:
        return _rejected(command, "the line does not run")
    flight.line.is_running = False
    return _accepted(command, "the line is stopped; triggered exposures are completed")


def _trigger(command: ServiceCommand, flight: CommandTarget) -> Answer:
    refusal = _arm_or_reject(command, flight)
    if refusal is not None:
        return refusal
    flight.line.trigger_once()
    return _accepted(command, "one exposure is made as soon as the camera can")


def _interval(command: ServiceCommand, flight: CommandTarget) -> Answer:
    interval_s, count = command.arguments.get("interval_s"), command.arguments.get("count", 0)
    if not _is_positive(interval_s) or not isinstance(count, int) or count < 0:
        return _rejected(command, "interval needs interval_s above 0 and a count, 0 for no end")
    refusal = _arm_or_reject(command, flight)
    if refusal is not None:
        return refusal
    flight.line.trigger_at_interval(float(interval_s), count)
    return _accepted(command, f"an exposure every {interval_s:g} s, or as fast as the camera can")


def _distance(command: ServiceCommand, flight: CommandTarget) -> Answer:
    distance_m = command.arguments.get("distance_m")
    if not _is_positive(distance_m):
        return _rejected(command, "distance needs distance_m above 0")
    refusal = _arm_or_reject(command, flight)
    if refusal is not None:
        return refusal
    flight.line.trigger_at_distance(float(distance_m))
    return _accepted(command, f"an exposure every {distance_m:g} m")


def _land(command: ServiceCommand, flight: CommandTarget) -> Answer:
    flight.land()
    return _accepted(command, "no more exposures; open ones are sealed, and the mission is closed")


def _new_mission(command: ServiceCommand, flight: CommandTarget) -> Answer:
    if flight.line.is_running and not flight.line.is_flown:
        return _rejected(command, "the line runs; stop it first")
    if action := flight.landed.running:
        return _rejected(command, f"{action} runs; wait for its end")
    flight.land(new_mission=True)
    return _accepted(
        command, "this mission is closed, and the next one begins with its configuration"
    )


def _after_landing(command: ServiceCommand, flight: CommandTarget) -> Answer:
    folder = command.arguments.get("folder")
    refusal = flight.landed.request(command.name, folder, command.by)
    if refusal is not None:
        return _rejected(command, refusal)
    sentences = {"shutdown": "the computer shuts down"}
    return _accepted(command, sentences.get(command.name, f"{command.name} has begun"))


def _exposure(command: ServiceCommand, flight: CommandTarget) -> Answer:
    refusal = flight.exposure.command(command.arguments, command.by)
    if refusal is not None:
        return _rejected(command, refusal)
    return _accepted(command, "the exposures from now on are made with it")


def _acknowledge(command: ServiceCommand, flight: CommandTarget) -> Answer:
    fault = command.arguments.get("fault")
    if not isinstance(fault, str) or not flight.acknowledge(fault):
        return _rejected(command, f"no fault {fault!r} is listed")
    return _accepted(command, f"noted that {command.by} has seen {fault}")


def _release_disk(command: ServiceCommand, flight: CommandTarget) -> Answer:
    label = str(command.arguments.get("disk", ""))
    refusal = flight.mirror.release(label)
    if refusal is not None:
        return _rejected(command, refusal)
    return _accepted(
        command, f"disk {label} is being released; unmount it after the event disk-released"
    )


def _accept_disk(command: ServiceCommand, flight: CommandTarget) -> Answer:
    label = str(command.arguments.get("disk", ""))
    refusal = flight.mirror.accept(label)
    if refusal is not None:
        return _rejected(command, refusal)
    return _accepted(command, f"the disk mounted as {label} is synchronized and then used")


def _reject(command: ServiceCommand, flight: CommandTarget) -> Answer:
    return _decide("reject", "rejected; it is to be flown again", command, flight)


def _accept(command: ServiceCommand, flight: CommandTarget) -> Answer:
    return _decide("accept", "accepted; the computed verdict stays recorded", command, flight)


def _withdraw(command: ServiceCommand, flight: CommandTarget) -> Answer:
    return _decide("withdraw", "has its computed verdict again", command, flight)


def _decide(
    kind: DecisionKind, result: str, command: ServiceCommand, flight: CommandTarget
) -> Answer:
    number, reason = command.arguments.get("number"), str(command.arguments.get("reason", ""))
    refusal = flight.journal.decide(kind, number, reason, command.by, command.role)
    if refusal is not None:
        return _rejected(command, refusal)
    return _accepted(command, f"exposure {number} {result}")


def _retake(command: ServiceCommand, flight: CommandTarget) -> Answer:
    given = command.arguments
    line, from_m, to_m = given.get("line"), given.get("from_m"), given.get("to_m")
    if not line or from_m is None or to_m is None:
        return _rejected(command, "retake needs line, from_m and to_m, metres from its start")
    try:
        added = flight.journal.retake(
            str(line),
            float(from_m),
            float(to_m),
            number=given.get("number"),
            reason=str(given.get("reason", "")),
            by=command.by,
            role=command.role,
        )
    except DaemonError as error:
        return _rejected(command, str(error))
    return _accepted(command, f"line {added} is added to the lines to fly")


def _arm_or_reject(command: ServiceCommand, flight: CommandTarget) -> Answer | None:
    """Arm; return the refusal if a prerequisite is missing and not overridden."""
    if flight.line.is_flown:
        return _rejected(command, "the planned number of exposures is flown")
    if not flight.is_ready:
        return _rejected(command, "the service is not ready: devices open and kernels load")
    missing = flight.preflight.missing_prerequisites()
    blocking = [item for item in missing if not item.may_be_overridden]
    if blocking:
        return _rejected(command, f"not armed: {'; '.join(map(str, blocking))}")
    if missing and not command.arguments.get("override"):
        details = "; ".join(map(str, missing))
        return _rejected(command, f"not armed: {details}; override to fly without")
    if missing:
        reason = str(command.arguments.get("reason", ""))
        flight.preflight.override(command.by, missing, reason)
    flight.preflight.arm()
    return None


def _is_positive(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < 1e6


def _accepted(command: ServiceCommand, sentence: str) -> Answer:
    return Answer(command.number, True, sentence)


def _rejected(command: ServiceCommand, sentence: str) -> Answer:
    return Answer(command.number, False, sentence)


_COMMANDS: Mapping[str, Callable[[ServiceCommand, CommandTarget], Answer]] = {
    "arm": _arm,
    "start": _start,
    "stop": _stop,
    "trigger": _trigger,
    "interval": _interval,
    "distance": _distance,
    "land": _land,
    "acknowledge": _acknowledge,
    "new-mission": _new_mission,
    "verify": _after_landing,
    "copy": _after_landing,
    "report": _after_landing,
    "shutdown": _after_landing,
    "exposure": _exposure,
    "reject": _reject,
    "accept": _accept,
    "withdraw": _withdraw,
    "retake": _retake,
    "release-disk": _release_disk,
    "accept-disk": _accept_disk,
}
