"""What watchers see follows the events, and a fault stays until a person has seen it."""

from __future__ import annotations

import json
import math

import pytest

from daemon.onboard.monitoring.flight_state import EVENTS_MAX, EXPOSURES_MAX, FlightState
from tests.daemon.onboard.monitoring import flight_events


def state_of(*events: dict[str, object]) -> FlightState:
    state = FlightState("syntopic test")
    for event in events:
        state.apply(event)
    return state


def test_an_exposure_proceeds_from_trigger_to_verdict() -> None:
    steps = []
    state = state_of(flight_events.mission())
    for event in flight_events.exposure(7):
        state.apply(event)
        reported = state.exposure(7)
        assert reported is not None
        steps.append(reported["step"])
    assert steps == ["triggered", "stored", "sealed", "processed"]
    assert reported["verdict"] == "good"
    assert reported["verdict_mono_ns"] == "1"
    assert reported["figures"] == {"sigma0_px": 0.01, "tie_points_pp": 900, "dc_k": 11.8}
    assert state.brief()["verdicts"] == {"good": 1, "usable": 0, "refly": 0}
    json.dumps(state.snapshot())


def test_a_fault_that_passed_stays_until_it_is_acknowledged() -> None:
    state = state_of(
        flight_events.mission(), flight_events.lost("SU02"), flight_events.lost("SU02")
    )
    (fault,) = state.faults()
    assert (fault["stands"], fault["count"], fault["acknowledged"]) == (True, 2, False)
    state.apply(flight_events.recovered("SU02"))
    (fault,) = state.faults()
    assert fault["stands"] is False
    assert state.acknowledge(fault["id"])
    assert state.faults() == []


def test_an_active_fault_remains_after_it_is_acknowledged() -> None:
    state = state_of(flight_events.lost("SU02"))
    assert state.acknowledge("device SU02")
    (fault,) = state.faults()
    assert fault["acknowledged"] is True
    state.apply(flight_events.recovered("SU02"))
    assert state.faults() == []
    assert not state.acknowledge("device SU02")


def test_a_client_that_requests_changes_misses_nothing() -> None:
    state = state_of(flight_events.mission())
    seen: dict[int, dict[str, object]] = {}
    cursor = 0
    for number in range(1, 30):
        for event in flight_events.exposure(number, "usable" if number % 3 else "refly"):
            state.apply(event)
        if number % 4 == 0:
            for one in state.changed("exposures", cursor):
                seen[one["number"]] = dict(one)
                cursor = one["sequence"]
    for one in state.changed("exposures", cursor):
        seen[one["number"]] = dict(one)
    assert seen == {one["number"]: one for one in state.exposures()}


def test_it_never_grows_beyond_its_bounds() -> None:
    state = state_of(flight_events.mission())
    for number in range(1, EXPOSURES_MAX + 500):
        for event in flight_events.exposure(number):
            state.apply(event)
    assert len(state.changed("exposures", 0)) == EXPOSURES_MAX
    assert len(state.changed("events", 0)) == EVENTS_MAX
    assert state.exposure(1) is None
    # What is no longer kept still counts: a counter that falls is a restart to who scrapes it.
    assert state.brief()["verdicts"]["good"] == EXPOSURES_MAX + 499


def test_unknown_events_are_listed_and_have_no_effect() -> None:
    state = state_of({"event": "new-thing", "what": [1, {"deep": None}]}, {})
    assert [event.get("event") for event in state.changed("events", 0)] == ["new-thing", None]


def test_the_status_puts_right_what_was_dropped() -> None:
    state = state_of(flight_events.mission())
    state.apply({"event": "disk", "fault": True, "sentence": "room for 0 exposures"})
    assert state.faults()[0]["stands"]
    state.apply(flight_events.status("armed", triggers=5))
    assert state.phase == "armed"
    assert state.brief()["status"]["ledger"]["triggers"]["triggers"] == 5
    assert not state.faults()[0]["stands"]


def test_counters_are_listed_with_their_devices_and_are_no_part_of_telemetry() -> None:
    state = state_of(flight_events.mission(), flight_events.lost("SU02"))
    cursor = state.sequence
    state.apply({"event": "counters", "devices": {"SU02": {"frames": 7}, "SU03": {"frames": 8}}})
    (device,) = state.devices()
    assert device["name"] == "SU02" and device["counters"] == {"frames": 7}
    assert state.changed("devices", cursor) == state.changed("events", cursor) == []
    assert "counters" not in state.snapshot()["devices"][0]
    state.apply({"event": "counters", "devices": {"SU02": {"frames": 9}}})
    assert state.devices()[0]["counters"] == {"frames": 9}


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg"),
    [(math.nan, 15.0), (47.0, math.inf), (90.5, 15.0), (47.0, 1e9), (None, 15.0)],
)
def test_what_is_no_place_on_earth_is_no_position_and_no_footprint(
    latitude_deg: float | None, longitude_deg: float
) -> None:
    place = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
    corner = [47.0, 15.0]
    state = FlightState("syntopic test", lambda _: [corner, corner, corner, list(place.values())])
    status = flight_events.status(triggers=1)
    state.apply(status | {"position": status["position"] | place})
    assert state.brief()["status"]["position"] is None
    assert state.brief()["phase"] == "flying"
    assert state.changed("track", 0) == []
    for event in flight_events.exposure(1):
        state.apply(event)
    reported = state.exposure(1)
    assert reported is not None
    assert (reported["footprint"], reported["verdict"]) == (None, "good")
    json.dumps(state.snapshot(), allow_nan=False)


def test_the_poles_and_the_antimeridian_are_places() -> None:
    state = FlightState(
        "syntopic test", lambda _: [[90.0, 180.0], [-90.0, 190.0], [0, -180], [0, 0]]
    )
    for event in flight_events.exposure(1):
        state.apply(event)
    reported = state.exposure(1)
    assert reported is not None and len(reported["footprint"]) == 4


def test_another_mission_has_nothing_of_the_one_before_and_the_same_one_keeps_all() -> None:
    state = state_of(flight_events.mission(), *flight_events.exposure(1, "refly"))
    state.apply(flight_events.status(triggers=1))
    state.apply(flight_events.lost("SU02"))
    state.apply(flight_events.mission() | {"resumed": True})
    assert [one["number"] for one in state.exposures()] == [1]
    state.apply(flight_events.mission() | {"id": "20261122T080000Z-small"})
    assert state.exposures() == [] and state.changed("history", 0) == []
    assert state.changed("track", 0) == [] and state.brief()["status"] == {}
    assert state.brief()["verdicts"] == {"good": 0, "usable": 0, "refly": 0}
    assert [one["device"] for one in state.faults()] == ["SU02"]
