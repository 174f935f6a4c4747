"""After landing, a mission reports since when a sensor has been displaced."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.postflight.displacements import DISPLACEMENTS_FILE, without_steps, write_displacements
from daemon.postflight.mission_report import write_report
from processing.mosaic.stitch_record import stitch_record_json
from processing.rig import shipped_rigs
from tests.processing.mosaic.test_flight_validity import Moves, records_of


def landed(root: Path, moves: Moves, *, count: int = 40) -> Path:
    mission = Mission.create(
        root,
        "ultracam-x-mini",
        rig_toml=shipped_rigs()["ultracam-x-mini"].read_bytes(),
        service_toml=b"",
        started_utc=datetime(2026, 11, 21, 10, 15, tzinfo=UTC),
    )
    mission.close()
    for number, record in records_of(moves, seed=8, count=count).items():
        folder = mission.level2(number)
        folder.mkdir(parents=True)
        (folder / "mosaic.json").write_text(json.dumps(stitch_record_json(record)))
    return mission.path


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return landed(tmp_path_factory.mktemp("moved"), {"SU02": (21, (0.08, -0.06))})


def test_the_mission_states_which_sensor_since_when_and_how_far(moved: Path) -> None:
    output = write_displacements(moved)
    (step,) = output["steps"]
    assert step["sensor"] == "SU02" and abs(step["since"] - 21) <= 1
    assert step["length_px"] == pytest.approx(0.1, abs=4 * step["sigma_px"])
    assert output["sentences"][0].startswith("SU02 has been displaced by 0.")
    stored = json.loads((moved / "export" / "displacements.json").read_text())
    assert stored["sentences"] == output["sentences"] and stored["exposures"]["0"] == 40


def test_the_command_prints_it_and_reports_by_its_exit_code(moved: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["calibrate", "validity", str(moved)])
    assert result.exit_code == 1 and "SU02 has been displaced" in result.stdout
    healthy = landed(tmp_path, {})
    result = CliRunner().invoke(app, ["calibrate", "validity", str(healthy)])
    assert result.exit_code == 0 and "No sensor is seen to move." in result.stdout
    assert f"Written: {healthy / DISPLACEMENTS_FILE}" in result.stdout


def test_a_flight_that_shows_nothing_is_not_called_healthy() -> None:
    assert without_steps({"0": 12, "1": 6}) == "No sensor is seen to move."
    assert without_steps({"0": 12, "1": 5}).endswith("not evaluated: cone 1 (too few exposures).")
    assert without_steps({"0": 0, "1": 5}).startswith("Not evaluated:")
    assert without_steps({}).startswith("Not evaluated: it takes three sensors")


def test_a_mission_without_products_is_not_called_healthy(tmp_path: Path) -> None:
    mission = landed(tmp_path, {}, count=0)
    result = CliRunner().invoke(app, ["calibrate", "validity", str(mission)])
    assert "none; has the mission been processed?" in result.stdout
    assert "No sensor is seen to move" not in result.stdout
    assert "Whether a sensor of the camera was displaced is not known" in (
        write_report(mission).path.read_text()
    )


def test_a_damaged_record_is_named_and_the_others_count(tmp_path: Path) -> None:
    mission = landed(tmp_path, {})
    (mission / "L2" / "000007" / "mosaic.json").write_text("{")
    output = write_displacements(mission)
    assert output["exposures"]["0"] == 39 and output["steps"] == []
    (sentence,) = output["unreadable"]
    assert sentence.startswith("000007:")


def test_the_report_states_it_too(moved: Path) -> None:
    html = write_report(moved).path.read_text()
    assert "The flight as a whole:" in html and "SU02 has been displaced by 0." in html
