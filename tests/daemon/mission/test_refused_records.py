"""A disk that refuses a record: the exposure stays open and its record is asked for again."""

from __future__ import annotations

import time
from typing import Any

from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.service.messages import WriteFailed
from daemon.onboard.storage.storage_coordinator import SEAL_RETRY_NS, StorageCoordinator
from tests.daemon.onboard.flight.test_flight import (
    HEADS,
    NS,
    Flight,
    flight,
    fly_one,
    mark,
    nav,
    stored_frames,
)


def flown() -> tuple[Flight, int]:
    """A flight with one stored exposure whose record is due, and that instant."""
    new_flight = flight()
    given = fly_one(new_flight, 1, 0.0)
    new_flight.stored(1, stored_frames(new_flight, 1, NS))
    new_flight.mark(mark(given))
    new_flight.navigation(nav(1.0))
    return new_flight, 4 * NS


def test_a_refused_record_is_rebuilt_identically() -> None:
    new_flight, now_ns = flown()
    first = new_flight.due_to_seal(now_ns)
    again = new_flight.due_to_seal(now_ns + SEAL_RETRY_NS)
    assert first is not None and first == again and first.mark_source == "event-mark"
    assert len(first.frames) == len(HEADS)
    new_flight.sealed(1, first.state)
    assert new_flight.due_to_seal(now_ns + 2 * SEAL_RETRY_NS) is None
    assert new_flight.ledger.imbalances(has_landed=True) == []


def test_the_service_asks_again_after_a_second_and_closes_nothing() -> None:
    events: list[str] = []

    def emit(event: str, **_: Any) -> None:
        events.append(event)

    def send(_process: str, _message: object) -> None:
        pass

    new_flight, now_ns = flown()
    coordinator = StorageCoordinator(
        new_flight, PipelineQueue(1, send, emit), send, emit, lambda _: None
    )
    due = new_flight.due_to_seal(now_ns)
    assert due is not None
    coordinator.seal(due)
    before_ns = time.monotonic_ns()
    assert coordinator.is_sealing and not coordinator.may_seal(before_ns)
    assert coordinator.dispatch(WriteFailed(1, "the disk is full", is_transient=True))
    assert not coordinator.is_sealing and new_flight.open_numbers == (1,)
    assert not coordinator.may_seal(before_ns + SEAL_RETRY_NS - 1)
    assert coordinator.may_seal(time.monotonic_ns() + SEAL_RETRY_NS)
    assert events == ["not-written"]
    # What cannot become right by waiting is closed, and left to recovery.
    coordinator.seal(due)
    assert coordinator.dispatch(WriteFailed(1, "sealed with other content"))
    assert not coordinator.is_sealing and new_flight.open_numbers == ()
