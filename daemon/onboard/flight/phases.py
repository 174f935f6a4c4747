"""Where a service and its mission stand: idle, ready, armed, flying, landed or in fault.

Pure: facts in, one step at a time out; no phase is skipped. What arming needs is in
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
    """Nothing opens any more; something that a flight needs is missing, or nobody has armed."""
    ARMED = "armed"
    """Somebody armed, and all that a flight needs is there or accepted as missing."""
    FLYING = "flying"
    """The line runs."""
    LANDED = "landed"
    """The planned exposures are made, or somebody ended the flight."""
    FAULT = "fault"
    """The service ends, and is started again into the same mission."""


@dataclass(frozen=True)
class PhaseInputs:
    """What the phase depends on."""

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
"""What may follow. A fault is left by starting anew alone; what is lost in the air disarms nobody:
the line goes on without it until it is stopped."""


class PhaseMachine:
    """The phase, and the way there."""

    def __init__(self) -> None:
        self.phase = Phase.IDLE

    def advance(self, facts: PhaseInputs) -> list[Phase]:
        """Go where the facts lead; the phases entered on the way, in their order."""
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
