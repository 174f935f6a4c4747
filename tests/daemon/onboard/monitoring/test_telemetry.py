"""Under any budget a client receives the state of the service, the essential parts first."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import msgpack
import pytest

from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.telemetry import PAST_BYTES, Subscription, packed
from tests.daemon.onboard.monitoring import flight_events


def fly(state: FlightState, numbers: range) -> None:
    for number in numbers:
        for event in flight_events.exposure(number):
            state.apply(event)
        state.apply(flight_events.status(triggers=number))


@pytest.mark.parametrize("bytes_per_s", [1000, 4000, 1e9])
def test_every_client_converges_within_its_budget(bytes_per_s: float) -> None:
    state = FlightState("syntopic test")
    state.apply(flight_events.mission())
    subscription = Subscription(bytes_per_s)
    seen: dict[int, object] = {}
    nbytes, now_s, brief = 0, 0.0, None
    for step in range(2000):
        now_s = step * 0.2
        if step < 200 and step % 10 == 0:
            fly(state, range(step // 10 + 1, step // 10 + 2))
        record = subscription.record(state, now_s)
        if record is None:
            continue
        nbytes += len(packed(record))
        assert nbytes <= bytes_per_s * (now_s + 3.0) + 1500
        brief = record
        for one in record.get("exposures", []):
            seen[one["number"]] = dict(one)
    assert seen == {one["number"]: one for one in state.exposures()}
    assert brief is not None
    assert brief["status"]["ledger"] == state.brief()["status"]["ledger"]


@pytest.mark.parametrize("bytes_per_s", [4000, 1e9])
def test_a_client_of_the_newest_receives_the_past_backwards_in_small_records(
    bytes_per_s: float,
) -> None:
    state = FlightState("syntopic test", lambda _: [[47.0, 15.0]] * 4)
    state.apply(flight_events.mission())
    state.apply({"event": "bound", "device": "SU02", "kind": "head", "found": {}})
    fly(state, range(1, 601))
    subscription = Subscription(bytes_per_s, ("exposures", "devices", "track"), newest=100)
    seen: dict[int, object] = {}
    order: list[int] = []
    track = []
    for step in range(2000):
        if step < 40 and step % 10 == 5:  # the flight goes on meanwhile
            fly(state, range(601 + step // 10, 602 + step // 10))
        record = subscription.record(state, step * 0.2)
        if record is None:
            continue
        assert len(packed(record)) < PAST_BYTES + 3000
        assert "events" not in record
        if not order and record.get("exposures"):
            assert record["devices"][0]["name"] == "SU02"
        for one in record.get("exposures", []):
            seen[one["number"]] = dict(one)
            order.append(one["number"])
        track += [one["sequence"] for one in record.get("track", [])]
    assert seen == {one["number"]: one for one in state.exposures() if one["number"] > 500}
    assert [number for number in order if number <= 600] == list(range(600, 500, -1))
    assert len(track) == len(set(track)) == 604
    older = [one["number"] for one in state.older_footprints(newest=104)]
    assert older == list(range(1, 501))


def test_a_curve_of_the_past_is_thinned_evenly_to_its_end() -> None:
    state = FlightState("syntopic test")
    for number in range(1, 2501):
        state.apply(flight_events.status(triggers=number))
    subscription = Subscription(parts=("track",), newest=5)
    found = []
    for step in range(50):
        record = subscription.record(state, float(step))
        found += [] if record is None else record.get("track", [])
    places = [one["at"][0] for one in reversed(found)]
    assert len(places) == pytest.approx(2500 / 3, abs=1)
    assert places[-1] == 47.07 + 2500 * 1e-3
    assert {round(1e3 * (b - a)) for a, b in pairwise(places)} == {3}


def test_a_fault_overtakes_everything_else() -> None:
    state = FlightState("syntopic test")
    state.apply(flight_events.mission())
    fly(state, range(1, 500))
    subscription = Subscription(2000)
    assert subscription.record(state, 0.0) is not None
    state.apply(flight_events.lost("SU02"))
    now_s = 0.0
    while True:
        now_s += 0.2
        record = subscription.record(state, now_s)
        if record is not None and record["faults"]:
            break
    assert now_s <= 2.0


def test_a_record_is_msgpack_that_any_reader_reads() -> None:
    state = FlightState("syntopic test")
    state.apply(flight_events.mission())
    fly(state, range(1, 3))
    record = Subscription().record(state, 0.0)
    assert msgpack.unpackb(packed(record)) == record
    assert record["version"] == 1


def test_an_unchanged_state_is_repeated_at_the_interval_only() -> None:
    state = FlightState("syntopic test")
    state.apply(flight_events.mission())
    subscription = Subscription()
    times = [
        step * 0.1 for step in range(100) if subscription.record(state, step * 0.1) is not None
    ]
    assert len(times) == pytest.approx(10, abs=1)


def test_the_schema_names_every_reported_key() -> None:
    state = FlightState("syntopic test")
    settings = {"by": "operator", "control": "manual", "lock": "line", "locked_on": None}
    lost = {"event": "lost", "mono_ns": "1", "number": 2, "cause": "no frames"}
    bound = {"event": "bound", "device": "SU02", "kind": "head", "found": {}}
    for event in (
        *(
            flight_events.mission(),
            bound,
            flight_events.lost("SU02"),
            *flight_events.exposure(1),
            lost,
            flight_events.status(),
        ),
        {"event": "exposure-settings", "settings": {}, **settings},
    ):
        state.apply(event)
    snapshot = state.snapshot()
    del snapshot["events"]  # each kind has its own keys, docs/reference/flight/events.md
    subscription = set(snapshot)
    for part in snapshot.values():
        for item in part if isinstance(part, list) else [part]:
            subscription |= set(item) if isinstance(item, dict) else set()
    schema = (Path(__file__).parents[4] / "docs/reference/flight/telemetry.md").read_text()
    assert {key for key in subscription if f"`{key}`" not in schema} == set()
