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


class ExposureState(enum.Enum):
    """How an exposure stands. OPEN: triggered, not judged yet; the others say how it ended."""

    OPEN = "open"
    COMPLETE = "complete"
    DEGRADED = "degraded"
    LOST = "lost"


class StorageState(enum.Enum):
    """How safe it is. STORED: pixels durable. SEALED: the record is final and durable."""

    VOLATILE = "volatile"
    STORED = "stored"
    SEALED = "sealed"


class Transition(enum.Enum):
    """What happens to an exposure."""

    SET_COMPLETE = "settled complete"
    SET_DEGRADED = "settled degraded"
    SET_LOST = "settled lost"
    STORE = "stored"
    SEAL = "sealed"


@dataclass(frozen=True)
class ExposureStatus:
    """State and storage of one exposure."""

    state: ExposureState = ExposureState.OPEN
    storage: StorageState = StorageState.VOLATILE


def _table() -> dict[tuple[ExposureStatus, Transition], ExposureStatus]:
    open_, complete, degraded, lost = (
        ExposureState.OPEN,
        ExposureState.COMPLETE,
        ExposureState.DEGRADED,
        ExposureState.LOST,
    )
    volatile, stored, sealed = StorageState.VOLATILE, StorageState.STORED, StorageState.SEALED
    table: dict[tuple[ExposureStatus, Transition], ExposureStatus] = {}

    def allow(
        state: ExposureState,
        storage: StorageState,
        step: Transition,
        new_state: ExposureState,
        new_storage: StorageState,
    ) -> None:
        table[ExposureStatus(state, storage), step] = ExposureStatus(new_state, new_storage)

    # Judged once; later it may only turn out worse, until it is sealed.
    for storage in (volatile, stored):
        allow(open_, storage, Transition.SET_COMPLETE, complete, storage)
        for state in (open_, complete, degraded):
            allow(state, storage, Transition.SET_DEGRADED, degraded, storage)
    # What is stored cannot be lost any more.
    for state in (open_, complete, degraded):
        allow(state, volatile, Transition.SET_LOST, lost, volatile)
        allow(state, volatile, Transition.STORE, state, stored)
    for state in (complete, degraded):
        allow(state, stored, Transition.SEAL, state, sealed)
    allow(lost, volatile, Transition.SEAL, lost, sealed)
    return table


TRANSITIONS = _table()


def next_status(status: ExposureStatus, step: Transition) -> ExposureStatus:
    """How an exposure stands after a step.

    Raises:
        LedgerError: the step is not allowed from there.
    """
    following = TRANSITIONS.get((status, step))
    if following is None:
        raise LedgerError(
            f"an exposure that is {status.state.value} and {status.storage.value} "
            f"cannot be {step.value}"
        )
    return following
