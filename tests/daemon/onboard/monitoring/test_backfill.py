"""After a restart clients receive the complete flight from the mission folder."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daemon.mission.exposure import Exposure, exposure_bytes
from daemon.mission.layout import Mission
from daemon.onboard.monitoring.backfill import BATCH_SIZE, backfill_exposures
from daemon.onboard.monitoring.flight_state import FlightState
from tests.daemon.onboard.monitoring import flight_events

MANY = BATCH_SIZE + 3
LOST, UNPROCESSED, DAMAGED, SENT_LIVE = 4, 5, 6, 7


@pytest.fixture
def mission(tmp_path: Path) -> Mission:
    mission = Mission.create(
        tmp_path, "small", rig_toml=b"", service_toml=b"", started_utc=datetime.now(UTC)
    )
    for number in range(1, MANY + 1):
        mission.level0(number).mkdir(parents=True)
        exposure = Exposure(number=number, line_id="A7")
        exposure = replace(exposure, state="lost") if number == LOST else exposure
        record = b"{" if number == DAMAGED else exposure_bytes(exposure)
        (mission.level0(number) / "exposure.json").write_bytes(record)
        if number not in (LOST, UNPROCESSED):
            mission.level2(number).mkdir(parents=True)
            report = {"verdict": "refly", "findings": [], "figures": {"sigma0_px": 0.02}}
            (mission.level2(number) / "quality.json").write_text(json.dumps(report))
    return mission


def test_earlier_exposures_are_reported_and_received_events_take_precedence(
    mission: Mission,
) -> None:
    state, on_batch = FlightState("syntopic test"), []
    state.apply(flight_events.mission(str(mission.path)))
    for event in flight_events.exposure(SENT_LIVE, "good"):
        state.apply(event)
    asyncio.run(
        backfill_exposures(state, mission.path, lambda: on_batch.append(len(state.exposures())))
    )
    reported = {one["number"]: one for one in state.exposures()}
    assert set(reported) == set(range(1, MANY + 1)) - {DAMAGED}
    assert (reported[LOST]["step"], reported[UNPROCESSED]["step"]) == ("lost", "sealed")
    assert (reported[1]["step"], reported[1]["verdict"], reported[1]["line"]) == (
        "processed",
        "refly",
        "A7",
    )
    assert reported[SENT_LIVE]["verdict"] == "good"
    assert state.brief()["verdicts"] == {"good": 1, "usable": 0, "refly": MANY - 4}
    assert state.brief()["last_number"] == MANY
    assert [one["sigma0_px"] for one in state.changed("history", 0)] == [0.01, *[0.02] * (MANY - 4)]
    # What the state may forget is gathered before it does; once more after the manual verdicts.
    assert len(on_batch) == 3


def test_a_folder_that_is_no_mission_costs_only_what_was_before(tmp_path: Path) -> None:
    state = FlightState("syntopic test")
    asyncio.run(backfill_exposures(state, tmp_path / "nowhere", lambda: None))
    assert state.exposures() == []
