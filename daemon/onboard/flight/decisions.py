"""What a flight decides at an instant, and the messages of the flight log that repeat it.

The instant determines which exposures are stored or sealed. It is recorded because a loaded machine
evaluates later. `daemon.postflight.replay` repeats the decisions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, cast

from daemon.mission.canonical_json import RecordError, parse_record
from daemon.mission.exposure import CaptureRecord, Exposure
from daemon.mission.log.log_records import Message, lenient_json_bytes
from daemon.onboard.timing.gps_clock import ClockEvent
from drivers.contract import EventMark

TOPIC = "decision"
Kind = Literal[
    "begin", "order", "not-fired", "advance", "stored", "not-stored", "sealed", "not-sealed",
    "seal-refused", "timeouts-expired", "process",
]  # fmt: skip


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
class PendingStore:
    """An exposure to be stored: its frames have arrived or timed out."""

    capture: CaptureRecord
    slots: Mapping[str, int]


@dataclass(frozen=True)
class Actions:
    """What is due at `mono_ns`, in the order in which it is done. Each is returned once.

    Attributes:
        mono_ns: the instant.
        store: exposures whose frames go to disk.
        lost: number and cause of exposures of which no frame arrived in time.
        spurious: marks that belong to no exposure.
        seal: the record that goes to disk. The next one is returned after this one is sealed.
        provisional: a record that only awaits a second mark before it is sealed.
        clock_events: events of the clocks.
        next_ns: the next instant at which something is due without a new record; None for none.
    """

    mono_ns: int
    store: tuple[PendingStore, ...] = ()
    lost: tuple[tuple[int, str], ...] = ()
    spurious: tuple[EventMark, ...] = ()
    seal: Exposure | None = None
    provisional: Exposure | None = None
    clock_events: tuple[ClockEvent, ...] = ()
    next_ns: int | None = None

    @property
    def decision(self) -> Decision | None:
        """The decision for the flight log; None if no exposure and no mark is concerned."""
        detail = {
            "store": [due.capture.number for due in self.store],
            "lost": [number for number, _ in self.lost],
            "spurious": len(self.spurious),
            "seal": None if self.seal is None else self.seal.number,
            "provisional": None if self.provisional is None else self.provisional.number,
        }
        return Decision("advance", self.mono_ns, detail=detail) if any(detail.values()) else None
