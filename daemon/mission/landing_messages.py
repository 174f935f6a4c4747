"""Messages of the process that verifies, copies or reports a closed mission."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LandingProgress:
    """Progress of an action, bytes read so far and in total."""

    action: str
    done: int
    total: int


@dataclass(frozen=True)
class LandingResult:
    """An action has ended; the sentence states its result, or why it failed."""

    action: str
    is_done: bool
    sentence: str
