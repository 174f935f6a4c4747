"""A disk that refuses a record: the exposure stays open and its record is asked for again."""

from __future__ import annotations

import copy
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from daemon.configuration import from_mapping
from daemon.service.messages import WriteFailed
from daemon.service.pipeline_queue import PipelineQueue
from daemon.service.service import SEAL_RETRY_NS, Service
from tests.daemon.flight.test_flight import (
    HEADS,
    NS,
    Flight,
    flight,
    fly_one,
    mark,
    nav,
    stored_frames,
)
from tests.daemon.test_configuration import GOOD


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


def test_the_service_asks_again_after_a_second_and_closes_nothing(tmp_path: Path) -> None:
    configuration, rig = from_mapping(copy.deepcopy(GOOD), tmp_path / "service.toml")
    events: list[dict[str, Any]] = []
    service = Service(configuration, rig, tmp_path / "service.toml", lambda e: events.append({**e}))
    made, now_ns = flown()
    service.flight = made
    service.mission = SimpleNamespace(path=tmp_path)
    service.pipeline = PipelineQueue(1, lambda _name, _message: None, service._event)
    service.sealing = made.due_to_seal(now_ns)
    before_ns = time.monotonic_ns()
    service._on_write_failed(WriteFailed(1, "the disk is full", may_pass=True))
    assert service.sealing is None and made.open_numbers == (1,)
    assert service.seal_again_ns >= before_ns + SEAL_RETRY_NS
    assert [event["event"] for event in events] == ["not-written"]
    # What cannot become right by waiting is closed, and left to recovery.
    service.sealing = made.due_to_seal(now_ns)
    service._on_write_failed(WriteFailed(1, "sealed with other content"))
    assert service.sealing is None and made.open_numbers == ()
