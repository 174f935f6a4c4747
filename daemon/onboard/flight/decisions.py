"""Decisions of the service and their instants, as messages of the flight log.

The instant determines which exposures are stored or sealed. It is recorded because a loaded machine
evaluates later. `daemon.postflight.replay` repeats the decisions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, cast

from daemon.mission.canonical_json import RecordError, parse_record
from daemon.mission.exposure import Exposure
from daemon.mission.log.log_records import Message, lenient_json_bytes
from daemon.onboard.flight.flight import Flight, PendingStore

TOPIC = "decision"
Kind = Literal[
    "begin", "order", "not-fired", "tick", "stored", "not-stored", "sealed", "not-sealed", "process"
]


@dataclass(frozen=True)
class Decision:
    """One decision at `mono_ns`; `number` is the exposure it is about, 0 for none."""

    kind: Kind
    mono_ns: int
    number: int = 0
    detail: Mapping[str, Any] = field(default_factory=dict)

    def message(self) -> Message:
        """The decision as a message of the flight log."""
        content = {"kind": self.kind, "number": self.number, **self.detail}
        return Message(TOPIC, self.mono_ns, lenient_json_bytes(content))


def decision_of(message: Message) -> Decision | None:
    """The decision in a message of the flight log; None for other topics and damaged content."""
    if message.topic != TOPIC:
        return None
    try:
        content = dict(parse_record(message.payload, TOPIC))
    except RecordError:
        return None
    kind, number = content.pop("kind", None), content.pop("number", 0)
    if not isinstance(kind, str) or not isinstance(number, int):
        return None
    # A kind added by a later version is kept unchanged.
    return Decision(cast(Kind, kind), message.mono_ns, number, content)


@dataclass(frozen=True)
class Tick:
    """Exposures due at an instant: to store, given up (number, cause), and to seal.

    `provisional` is the record of an exposure that only awaits a second mark before it is sealed.
    """

    to_store: tuple[PendingStore, ...]
    given_up: tuple[tuple[int, str], ...]
    to_seal: Exposure | None
    provisional: Exposure | None
    asked_to_seal: bool
    resolved: int

    @property
    def detail(self) -> dict[str, Any] | None:
        """Content for the flight log; None if nothing was due."""
        content = {
            "store": [due.capture.number for due in self.to_store],
            "given_up": [number for number, _ in self.given_up],
            "seal": None if self.to_seal is None else self.to_seal.number,
            "foreseen": None if self.provisional is None else self.provisional.number,
            "resolved": self.resolved,
        }
        return {**content, "asked_to_seal": self.asked_to_seal} if any(content.values()) else None


def tick(flight: Flight, mono_ns: int, *, may_seal: bool, allow_provisional: bool = True) -> Tick:
    """Everything that is due now; `may_seal`: the writer has no record to seal."""
    to_store = tuple(flight.due_to_store(mono_ns))
    given_up = tuple(flight.due_to_give_up(mono_ns))
    to_seal = flight.due_to_seal(mono_ns) if may_seal else None
    provisional = (
        flight.due_provisionally() if may_seal and allow_provisional and to_seal is None else None
    )
    return Tick(to_store, given_up, to_seal, provisional, may_seal, len(flight.resolved_marks))
