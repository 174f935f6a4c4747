"""What is due at an instant, and what the flight log records of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from daemon.onboard.flight.decisions import Tick, tick

NOTHING = Tick((), (), None, None, asked_to_seal=True, resolved=0)


def due(to_seal: object = None) -> Any:
    """A flight with a provisional record, and perhaps one to seal."""
    return SimpleNamespace(
        due_to_store=lambda _: [],
        due_to_give_up=lambda _: [],
        due_to_seal=lambda _: to_seal,
        due_provisionally=lambda: "provisional",
        resolved_marks=[],
    )


@pytest.mark.parametrize(
    ("may_seal", "allow_provisional", "to_seal", "provisional"),
    [
        (True, True, None, "provisional"),
        (True, False, None, None),
        (False, True, None, None),
        (False, False, None, None),
        (True, True, "sealed", None),
    ],
)
def test_a_record_is_provisional_only_while_none_is_sealed(
    may_seal: bool, allow_provisional: bool, to_seal: object, provisional: object
) -> None:
    found = tick(due(to_seal), 7, may_seal=may_seal, allow_provisional=allow_provisional)
    assert (found.to_seal, found.provisional) == (to_seal, provisional)
    assert found.asked_to_seal is may_seal


def test_a_tick_is_logged_only_if_something_was_due() -> None:
    assert NOTHING.detail is None
    given_up = Tick((), ((3, "no head sent a frame"),), None, None, asked_to_seal=True, resolved=0)
    assert given_up.detail == {
        "store": [],
        "given_up": [3],
        "seal": None,
        "foreseen": None,
        "resolved": 0,
        "asked_to_seal": True,
    }
