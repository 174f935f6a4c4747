"""What watchers see follows the events, and a fault stays until a person has seen it."""

from __future__ import annotations

import json

from daemon.onboard.monitoring.state import EVENTS_KEPT, EXPOSURES_KEPT, FlightState
from tests.daemon.onboard.monitoring import flown


def state_of(*events: dict[str, object]) -> FlightState:
    state = FlightState("syntopic test")
    for event in events:
        state.apply(event)
    return state


def test_an_exposure_goes_from_trigger_to_verdict() -> None:
    steps = []
    state = state_of(flown.mission())
    for event in flown.exposure(7):
        state.apply(event)
        told = state.exposure(7)
        assert told is not None
        steps.append(told["step"])
    assert steps == ["triggered", "stored", "sealed", "processed"]
    assert told["verdict"] == "good"
    assert told["figures"] == {"sigma0_px": 0.01, "tie_points_pp": 900, "dc_k": 11.8}
    assert state.brief()["verdicts"] == {"good": 1, "usable": 0, "refly": 0}
    json.dumps(state.snapshot())


def test_a_fault_that_passed_stays_until_it_is_acknowledged() -> None:
    state = state_of(flown.mission(), flown.lost("SU02"), flown.lost("SU02"))
    (fault,) = state.faults()
    assert (fault["stands"], fault["count"], fault["acknowledged"]) == (True, 2, False)
    state.apply(flown.recovered("SU02"))
    (fault,) = state.faults()
    assert fault["stands"] is False
    assert state.acknowledge(fault["id"])
    assert state.faults() == []


def test_a_fault_that_stands_stays_even_when_it_is_acknowledged() -> None:
    state = state_of(flown.lost("SU02"))
    assert state.acknowledge("device SU02")
    (fault,) = state.faults()
    assert fault["acknowledged"] is True
    state.apply(flown.recovered("SU02"))
    assert state.faults() == []
    assert not state.acknowledge("device SU02")


def test_a_watcher_that_asks_for_what_changed_misses_nothing() -> None:
    state = state_of(flown.mission())
    seen: dict[int, dict[str, object]] = {}
    cursor = 0
    for number in range(1, 30):
        for event in flown.exposure(number, "usable" if number % 3 else "refly"):
            state.apply(event)
        if number % 4 == 0:
            for one in state.changed("exposures", cursor):
                seen[one["number"]] = dict(one)
                cursor = one["sequence"]
    for one in state.changed("exposures", cursor):
        seen[one["number"]] = dict(one)
    assert seen == {one["number"]: one for one in state.exposures()}


def test_it_never_grows_beyond_its_bounds() -> None:
    state = state_of(flown.mission())
    for number in range(1, EXPOSURES_KEPT + 500):
        for event in flown.exposure(number):
            state.apply(event)
    assert len(state.changed("exposures", 0)) == EXPOSURES_KEPT
    assert len(state.changed("events", 0)) == EVENTS_KEPT
    assert state.exposure(1) is None
    # What is no longer kept still counts: a counter that falls is a restart to who scrapes it.
    assert state.brief()["verdicts"]["good"] == EXPOSURES_KEPT + 499


def test_events_nobody_knows_are_listed_and_harm_nothing() -> None:
    state = state_of({"event": "new-thing", "what": [1, {"deep": None}]}, {})
    assert [event.get("event") for event in state.changed("events", 0)] == ["new-thing", None]


def test_the_status_puts_right_what_was_dropped() -> None:
    state = state_of(flown.mission())
    state.apply({"event": "disk", "fault": True, "sentence": "room for 0 exposures"})
    assert state.faults()[0]["stands"]
    state.apply(flown.status("armed", triggers=5))
    assert state.phase == "armed"
    assert state.brief()["status"]["ledger"]["triggers"]["triggers"] == 5
    assert not state.faults()[0]["stands"]
