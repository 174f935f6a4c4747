"""Record of an override of missing prerequisites: in the flight log, as an event, and as a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from daemon.onboard.flight.arming import (
    FILE,
    MissingPrerequisite,
    override_message,
    overrides_content,
)
from daemon.onboard.service.messages import AppendToLog, EmitEvent


class OverrideRecord:
    """Records who overrides which missing prerequisites, and why.

    Args:
        mission: returns the folder of the mission on the leading disk.
        send: sends a message to a process, by its name.
        save: puts a small file below the root of every disk in use.
        emit: emits an event.
    """

    def __init__(
        self,
        mission: Callable[[], Path],
        send: Callable[[str, object], None],
        save: Callable[[str, bytes], None],
        emit: EmitEvent,
    ) -> None:
        self._mission = mission
        self._send = send
        self._save = save
        self._emit = emit

    def record(self, by: str, missing: Sequence[MissingPrerequisite], reason: str) -> None:
        """Record an override."""
        self._send("writer", AppendToLog(override_message(by, missing, reason)))
        message = "; ".join(map(str, missing)) + (f". Reason: {reason}" if reason else "")
        self._emit("override", by=by, sentence=f"{by} overrides: {message}")
        mission = self._mission()
        try:
            note = overrides_content(mission, by, missing, reason=reason)
            self._save(f"{mission.name}/{FILE}", note)
        except OSError as error:
            # The log has it too.
            self._emit("disk", fault=True, sentence=f"the override is not noted: {error}")
