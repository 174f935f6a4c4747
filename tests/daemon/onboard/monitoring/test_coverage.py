"""What was flown past and is not well seen is a hole; what is still ahead is not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fastapi import Depends, FastAPI
from fastapi.testclient import TestClient

from daemon.onboard.monitoring.coverage import Coverage, advice_json
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.monitoring_process import _MissionGeometry
from daemon.onboard.monitoring.plan_routes import add_plan
from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events


@pytest.fixture
def state(tmp_path: Path) -> FlightState:
    """A mission over two lines of 1.1 km; an image sees 159 m of one, and one is due every 64 m."""
    features = [
        {
            "type": "Feature",
            "properties": {"id": name, "strip": "S"},
            "geometry": {"type": "LineString", "coordinates": [[east, 47.07], [east, 47.08]]},
        }
        for name, east in (("A", 15.43), ("B", 15.44))
    ]
    (tmp_path / "L0").mkdir()
    (tmp_path / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    (tmp_path / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    plan = {"type": "FeatureCollection", "features": features}
    (tmp_path / "plan.geojson").write_text(json.dumps(plan))
    ground = _MissionGeometry()
    state = FlightState("syntopic", ground.footprint_corners)
    ground.state = state
    state.apply(flight_events.mission(str(tmp_path)))
    return state


def fly(state: FlightState, first: int, places_m: list[int], *, line: str = "A") -> None:
    for number, north_m in enumerate(places_m, start=first):
        for event in flight_events.exposure(number, "good", line=line, north_m=north_m):
            state.apply(event)


def kinds(coverage: Coverage) -> list[tuple[str, str, int, int]]:
    advice_task = coverage.advice_task()
    assert advice_task is not None
    reported = advice_json(advice_task(), coverage)
    return [
        (one["line"], one["kind"], round(one["from_m"]), round(one["to_m"]))
        for one in reported["segments"]
    ]


def test_before_anything_is_flown_all_is_to_be_flown(state: FlightState) -> None:
    assert [kind for _, kind, _, _ in kinds(Coverage(state))] == ["to fly", "to fly"]


def test_a_gap_behind_is_a_hole_and_the_rest_of_the_line_is_not(state: FlightState) -> None:
    fly(state, 1, [64 * k for k in range(6)])
    fly(state, 7, [64 * k for k in range(11, 15)])
    found = kinds(Coverage(state))
    assert [(line, kind) for line, kind, _, _ in found] == [
        ("A", "hole"),
        ("A", "to fly"),
        ("B", "to fly"),
    ]
    _, _, from_m, to_m = found[0]
    assert 256 <= from_m <= 383
    assert 574 <= to_m <= 702


def test_a_line_flown_back_is_passed_from_its_end(state: FlightState) -> None:
    fly(state, 1, [64 * k for k in range(18, 12, -1)])
    fly(state, 7, [64 * k for k in range(8, 4, -1)])
    found = [(kind, from_m) for line, kind, from_m, _ in kinds(Coverage(state)) if line == "A"]
    assert [kind for kind, _ in found] == ["to fly", "hole"]
    assert found[0][1] == 0


def test_a_line_that_was_left_has_no_rest_but_holes(state: FlightState) -> None:
    coverage = Coverage(state)
    fly(state, 1, [64 * k for k in range(10)])
    coverage.update()
    fly(state, 20, [0], line="B")
    assert ("A", "hole") in [(line, kind) for line, kind, _, _ in kinds(coverage)]


def test_an_image_that_is_refly_leaves_a_hole_unless_only_its_overlap_is(
    state: FlightState,
) -> None:
    fly(state, 1, [64 * k for k in range(19)])
    assert [one[0] for one in kinds(Coverage(state))] == ["B"]
    for flag, lines in (("OVERLAP", ["B"]), ("BLUR", ["A", "B"])):
        reported = flight_events.exposure(8, "refly", line="A", north_m=64 * 7)
        reported[-1]["report"]["findings"][0]["flag"] = flag
        for event in reported:
            state.apply(event)
        assert [one[0] for one in kinds(Coverage(state))] == lines


def test_without_a_plan_nothing_is_computed(tmp_path: Path) -> None:
    state = FlightState("syntopic")
    coverage = Coverage(state)
    assert coverage.advice_task() is None
    state.apply(flight_events.mission(str(tmp_path / "gone")))
    assert coverage.plan_json() is None


def test_unchanged_advice_is_not_sent_again(state: FlightState) -> None:
    app = FastAPI()
    add_plan(app, state, Coverage(state), Depends(lambda: None))
    with TestClient(app) as client:
        first = client.get("/api/v1/advice")
        assert [one["kind"] for one in first.json()["segments"]] == ["to fly", "to fly"]
        known = {"If-None-Match": f'W/"other", {first.headers["ETag"]}'}
        again = client.get("/api/v1/advice", headers=known)
        assert (again.status_code, again.content) == (304, b"")
        fly(state, 1, [0, 64, 128, 192, 256])
        changed = client.get("/api/v1/advice", headers=known)
        assert changed.status_code == 200 and changed.headers["ETag"] != first.headers["ETag"]
        assert changed.json()["covered_m"] > 0.0
