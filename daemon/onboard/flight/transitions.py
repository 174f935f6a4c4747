"""States of an exposure and the allowed transitions between them.

Pure; every transition not listed is refused. The counting is in
`daemon.onboard.flight.ledger`.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

from daemon import DaemonError


class LedgerError(DaemonError):
    """A transition that is not allowed, or an inconsistent count."""


class ExposureState(enum.Enum):
    """State of an exposure. OPEN: triggered, not finalized. The others are final states."""

    OPEN = "open"
    COMPLETE = "complete"
    DEGRADED = "degraded"
    LOST = "lost"


class StorageState(enum.Enum):
    """Durability of an exposure. STORED: pixels durable. SEALED: record final and durable."""

    VOLATILE = "volatile"
    STORED = "stored"
    SEALED = "sealed"


class Transition(enum.Enum):
    """Transitions of an exposure."""

    SET_COMPLETE = "set to complete"
    SET_DEGRADED = "set to degraded"
    SET_LOST = "set to lost"
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

    # A final state may only get worse until the exposure is sealed.
    for storage in (volatile, stored):
        allow(open_, storage, Transition.SET_COMPLETE, complete, storage)
        for state in (open_, complete, degraded):
            allow(state, storage, Transition.SET_DEGRADED, degraded, storage)
    # A stored exposure cannot be lost.
    for state in (open_, complete, degraded):
        allow(state, volatile, Transition.SET_LOST, lost, volatile)
        allow(state, volatile, Transition.STORE, state, stored)
    for state in (complete, degraded):
        allow(state, stored, Transition.SEAL, state, sealed)
    allow(lost, volatile, Transition.SEAL, lost, sealed)
    return table


TRANSITIONS = _table()


def next_status(status: ExposureStatus, step: Transition) -> ExposureStatus:
    """State and storage of an exposure after a transition.

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
