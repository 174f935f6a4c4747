"""What is left of a flight."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from daemon.onboard.monitoring.coverage import Coverage
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.remaining import remaining_json
from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events

NOON_UNIX_S = datetime(2026, 6, 21, 12, tzinfo=UTC).timestamp()
NOON_GPS_NS = 1_466_078_418_000_000_000
LENGTH_M = 1113.2


def square(navigation: Mapping[str, Any]) -> list[list[float]]:
    """Corners around the place of an exposure."""
    north, east = navigation["latitude_deg"], navigation["longitude_deg"]
    offsets = ((-5e-4, -5e-4), (5e-4, -5e-4), (5e-4, 5e-4), (-5e-4, 5e-4))
    return [[north + y, east + x] for y, x in offsets]


@pytest.fixture
def planned(tmp_path: Path) -> FlightState:
    """A mission with two lines of LENGTH_M to the north, and a limit of the sun."""
    lines = [
        {
            "type": "Feature",
            "properties": {"id": line},
            "geometry": {"type": "LineString", "coordinates": [[east, 47.07], [east, 47.08]]},
        }
        for line, east in (("A1", 15.43), ("A2", 15.44))
    ]
    (tmp_path / "L0").mkdir()
    (tmp_path / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    plan = {"type": "FeatureCollection", "features": lines, "specification": {"sun_deg": 30.0}}
    (tmp_path / "plan.geojson").write_text(json.dumps(plan))
    (tmp_path / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    state = FlightState("syntopic test", square)
    state.apply(flight_events.mission(str(tmp_path)))
    return state


def test_lines_are_left_until_they_are_flown(planned: FlightState) -> None:
    coverage = Coverage(planned)
    lines = remaining_json(planned, coverage, NOON_UNIX_S)["lines"]
    assert (lines["planned"], lines["left"], lines["current"]) == (2, 2, "")
    assert lines["left_m"] == pytest.approx(2 * LENGTH_M, rel=0.01)
    for number, north_m in enumerate((0.0, 100.0, 200.0), start=1):
        for event in flight_events.exposure(number, "good", line="A1", north_m=north_m):
            planned.apply(event)
    lines = remaining_json(planned, coverage, NOON_UNIX_S)["lines"]
    assert (lines["left"], lines["current"]) == (2, "A1")
    assert lines["left_m"] == pytest.approx(2 * LENGTH_M - 230.0, abs=30.0)
    for event in flight_events.exposure(4, "good", line="A2"):
        planned.apply(event)
    lines = remaining_json(planned, coverage, NOON_UNIX_S)["lines"]
    # The line that was broken off is left, too.
    assert (lines["left"], lines["current"]) == (2, "A2")
    assert lines["left_m"] == pytest.approx(2 * LENGTH_M - 260.0, abs=50.0)


def test_a_line_flown_to_its_end_is_not_left_when_the_next_one_begins(planned: FlightState) -> None:
    coverage = Coverage(planned)
    for number, north_m in enumerate(range(0, 1113, 60), start=1):
        for event in flight_events.exposure(number, "good", line="A1", north_m=north_m):
            planned.apply(event)
    for event in flight_events.exposure(30, "good", line="A2"):
        planned.apply(event)
    assert remaining_json(planned, coverage, NOON_UNIX_S)["lines"]["left"] == 1


def test_light_is_that_of_the_plan_and_of_the_receiver_s_time(planned: FlightState) -> None:
    coverage = Coverage(planned)
    light = remaining_json(planned, coverage, NOON_UNIX_S)["light"]
    assert (light["limit_deg"], light["is_light"], light["from_unix_s"]) == (30.0, True, None)
    assert NOON_UNIX_S + 3 * 3600 < light["until_unix_s"] < NOON_UNIX_S + 4.5 * 3600
    planned.apply(flight_events.status() | {"gps_ns": str(NOON_GPS_NS)})
    assert remaining_json(planned, coverage)["light"]["now_unix_s"] == NOON_UNIX_S


def test_without_plan_and_position_nothing_is_claimed() -> None:
    state = FlightState("syntopic test")
    assert remaining_json(state, Coverage(state), NOON_UNIX_S) == {"lines": None, "light": None}
