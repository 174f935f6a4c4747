"""Phases of a flight: idle, ready, armed, flying, landed and fault.

A pure state machine without skipped phases. The prerequisites of arming are in
`daemon.onboard.flight.arming`.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final


class Phase(enum.StrEnum):
    IDLE = "idle"
    """Devices open and kernels load."""
    READY = "ready"
    """Opening has ended; a prerequisite is missing, or the service is not armed."""
    ARMED = "armed"
    """Armed: every prerequisite is met or overridden."""
    FLYING = "flying"
    """The line runs."""
    LANDED = "landed"
    """The planned exposures are made, or the flight was ended by command."""
    FAULT = "fault"
    """The service ends; its restart resumes the same mission."""


@dataclass(frozen=True)
class PhaseInputs:
    """Inputs of the state machine."""

    is_prepared: bool = False
    is_armed: bool = False
    is_running: bool = False
    has_landed: bool = False
    has_failed: bool = False


ALLOWED_NEXT: Final[Mapping[Phase, tuple[Phase, ...]]] = {
    Phase.IDLE: (Phase.READY, Phase.LANDED, Phase.FAULT),
    Phase.READY: (Phase.ARMED, Phase.LANDED, Phase.FAULT),
    Phase.ARMED: (Phase.FLYING, Phase.READY, Phase.LANDED, Phase.FAULT),
    Phase.FLYING: (Phase.ARMED, Phase.LANDED, Phase.FAULT),
    Phase.LANDED: (Phase.FAULT,),
    Phase.FAULT: (),
}
"""Allowed successors of each phase. Only a restart leaves FAULT. A device lost in flight does not
disarm: the line continues without it until it is stopped."""


class PhaseMachine:
    """The present phase and its transitions."""

    def __init__(self) -> None:
        self.phase = Phase.IDLE

    def advance(self, facts: PhaseInputs) -> list[Phase]:
        """Advance as far as the inputs allow; return the phases entered, in order."""
        entered: list[Phase] = []
        while (phase := _next(self.phase, facts)) is not None:
            assert phase in ALLOWED_NEXT[self.phase]
            self.phase = phase
            entered.append(phase)
        return entered


def _next(phase: Phase, facts: PhaseInputs) -> Phase | None:
    if phase is Phase.FAULT:
        return None
    if facts.has_failed:
        return Phase.FAULT
    if phase is Phase.LANDED:
        return None
    if facts.has_landed:
        return Phase.LANDED
    if phase is Phase.IDLE:
        return Phase.READY if facts.is_prepared else None
    if phase is Phase.READY:
        return Phase.ARMED if facts.is_armed else None
    if phase is Phase.FLYING:
        return None if facts.is_running else Phase.ARMED
    if facts.is_running:
        return Phase.FLYING
    return None if facts.is_armed else Phase.READY
