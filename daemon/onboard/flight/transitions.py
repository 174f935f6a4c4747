"""What may become of an exposure: its states, and the only steps between them.

Pure and complete: every step not listed is refused. The counting is in
`daemon.onboard.flight.ledger`.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

from daemon.errors import DaemonError


class LedgerError(DaemonError):
    """A step that an exposure cannot take, or a count that cannot be."""


class State(enum.Enum):
    """How an exposure stands. OPEN: triggered, not judged yet; the others say how it ended."""

    OPEN = "open"
    COMPLETE = "complete"
    DEGRADED = "degraded"
    LOST = "lost"


class Storage(enum.Enum):
    """How safe it is. STORED: pixels durable. SEALED: the record is final and durable."""

    VOLATILE = "volatile"
    STORED = "stored"
    SEALED = "sealed"


class Step(enum.Enum):
    """What happens to an exposure."""

    SETTLE_COMPLETE = "settled complete"
    SETTLE_DEGRADED = "settled degraded"
    SETTLE_LOST = "settled lost"
    STORE = "stored"
    SEAL = "sealed"


@dataclass(frozen=True)
class Standing:
    """State and storage of one exposure."""

    state: State = State.OPEN
    storage: Storage = Storage.VOLATILE


def _table() -> dict[tuple[Standing, Step], Standing]:
    open_, complete, degraded, lost = State.OPEN, State.COMPLETE, State.DEGRADED, State.LOST
    volatile, stored, sealed = Storage.VOLATILE, Storage.STORED, Storage.SEALED
    table: dict[tuple[Standing, Step], Standing] = {}

    def allow(
        state: State, storage: Storage, step: Step, new_state: State, new_storage: Storage
    ) -> None:
        table[Standing(state, storage), step] = Standing(new_state, new_storage)

    # Judged once; later it may only turn out worse, until it is sealed.
    for storage in (volatile, stored):
        allow(open_, storage, Step.SETTLE_COMPLETE, complete, storage)
        for state in (open_, complete, degraded):
            allow(state, storage, Step.SETTLE_DEGRADED, degraded, storage)
    # What is stored cannot be lost any more.
    for state in (open_, complete, degraded):
        allow(state, volatile, Step.SETTLE_LOST, lost, volatile)
        allow(state, volatile, Step.STORE, state, stored)
    for state in (complete, degraded):
        allow(state, stored, Step.SEAL, state, sealed)
    allow(lost, volatile, Step.SEAL, lost, sealed)
    return table


TRANSITIONS = _table()


def after(standing: Standing, step: Step) -> Standing:
    """How an exposure stands after a step.

    Raises:
        LedgerError: the step is not allowed from there.
    """
    following = TRANSITIONS.get((standing, step))
    if following is None:
        raise LedgerError(
            f"an exposure that is {standing.state.value} and {standing.storage.value} "
            f"cannot be {step.value}"
        )
    return following
