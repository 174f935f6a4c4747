"""What is due at an instant is recorded in the flight log, and nothing else is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from daemon.onboard.flight.decisions import Actions, decision_of
from daemon.onboard.timing.gps_clock import ClockEvent


def test_an_instant_is_logged_only_if_something_was_due() -> None:
    assert Actions(7, next_ns=9).decision is None
    clock_events = (ClockEvent("pps-holdover", True, "no edge"),)
    assert Actions(7, clock_events=clock_events).decision is None


def test_what_was_due_is_read_back_from_the_log() -> None:
    one: Any = SimpleNamespace(number=5, capture=SimpleNamespace(number=5))
    due = Actions(7, (one,), ((3, "no head sent a frame"),), cast(Any, ("mark",)), one, one)
    decision = due.decision
    assert decision is not None and decision_of(decision.message()) == decision
    assert (decision.kind, decision.mono_ns) == ("advance", 7)
    assert decision.detail == {
        "store": [5],
        "lost": [3],
        "spurious": 1,
        "seal": 5,
        "provisional": 5,
    }
