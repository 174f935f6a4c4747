"""A disk that refuses a record: the exposure stays open and its record is asked for again."""

from __future__ import annotations

import time
from typing import Any

from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.service.messages import WriteFailed
from daemon.onboard.storage.keeping import SEAL_RETRY_NS, Keeping
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
    made = flight()
    given = fly_one(made, 1, 0.0)
    made.stored(1, stored_frames(made, 1, NS))
    made.mark(mark(given))
    made.navigation(nav(1.0))
    return made, 4 * NS


def test_a_record_that_was_refused_is_made_again_the_same() -> None:
    made, now_ns = flown()
    first = made.due_to_seal(now_ns)
    again = made.due_to_seal(now_ns + SEAL_RETRY_NS)
    assert first is not None and first == again and first.mark_source == "event-mark"
    assert len(first.frames) == len(HEADS)
    made.sealed(1, first.state)
    assert made.due_to_seal(now_ns + 2 * SEAL_RETRY_NS) is None
    assert made.ledger.imbalances(has_landed=True) == []


def test_the_service_asks_again_after_a_second_and_closes_nothing() -> None:
    events: list[str] = []

    def tell(event: str, **_: Any) -> None:
        events.append(event)

    def send(_process: str, _message: object) -> None:
        pass

    made, now_ns = flown()
    keeping = Keeping(made, PipelineQueue(1, send, tell), send, tell, lambda _: None)
    due = made.due_to_seal(now_ns)
    assert due is not None
    keeping.seal(due)
    before_ns = time.monotonic_ns()
    assert keeping.is_sealing and not keeping.may_seal(before_ns)
    assert keeping.hear(WriteFailed(1, "the disk is full", may_pass=True))
    assert not keeping.is_sealing and made.open_numbers == (1,)
    assert not keeping.may_seal(before_ns + SEAL_RETRY_NS - 1)
    assert keeping.may_seal(time.monotonic_ns() + SEAL_RETRY_NS)
    assert events == ["not-written"]
    # What cannot become right by waiting is closed, and left to recovery.
    keeping.seal(due)
    assert keeping.hear(WriteFailed(1, "sealed with other content"))
    assert not keeping.is_sealing and made.open_numbers == ()
