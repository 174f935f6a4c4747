"""`syntopic calibrate boresight`: from a project, or a mission's trajectory, to a dated mount."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.boresight import write_flight
from daemon.cli import app
from daemon.configuration.model import MountSection
from daemon.orientation.geodesy import utm_of
from daemon.orientation.georeference import Georeference
from daemon.postflight.calibration.boresight_calibration import (
    BoresightError,
    inertial_of_mission,
    inertial_table,
)
from daemon.postflight.calibration.rig_writer import rig_toml
from processing.rig import find_rig, load_rig
from sim_hw.blocks.calibration_flight import simulate_calibration_flight
from tests.daemon.orientation.test_orientation import (
    EPOCH_NS,
    FLIGHT,
    MID_NS,
    PLAN,
    master_of,
    mission_at,
    sample_at,
)

RUN = CliRunner()


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("flight") / "project"
    write_flight(simulate_calibration_flight(1), folder)
    return folder


def test_a_flight_becomes_a_dated_mount_that_is_compared_and_never_overwritten(
    project, tmp_path
) -> None:
    truth = simulate_calibration_flight(1)
    out = tmp_path / "first"
    done = RUN.invoke(app, ["calibrate", "boresight", str(project), "--out", str(out), "--json"])
    assert done.exit_code == 0, done.output
    output = json.loads(done.stdout)
    mount = MountSection.model_validate(tomllib.loads((out / "mount.toml").read_text())["mount"])
    assert np.abs(np.array(mount.antenna_m[:2]) - truth.antenna_m[:2]).max() < 0.08
    assert mount.time_offset_ms == pytest.approx(truth.time_offset_s * 1e3, abs=1.0)
    assert np.abs(np.radians(mount.boresight_deg) - truth.boresight_rad).max() < 1e-4
    assert any("lever arm down and position shift up" in w for w in output["warnings"])
    assert "lever arm down and position shift up" in (out / "report.html").read_text()
    assert output["serials"] == {} and any("give --rig" in w for w in output["warnings"])
    again = RUN.invoke(app, ["calibrate", "boresight", str(project), "--out", str(out)])
    assert again.exit_code != 0
    fitted = rig_toml(replace(find_rig("ultracam-x-mini"), probe_serials={"0": "PT-1"}))
    (tmp_path / "rig.toml").write_bytes(fitted)
    second = ["--out", str(tmp_path / "second"), "--previous", str(out), "--json"]
    second += ["--rig", str(tmp_path / "rig.toml")]
    compared = RUN.invoke(app, ["calibrate", "boresight", str(project), *second])
    changes = json.loads(compared.stdout)["changes"]
    serials = json.loads(compared.stdout)["serials"]
    assert serials == load_rig(tmp_path / "rig.toml").serials and serials["probe 0"] == "PT-1"
    assert "PT-1" in (tmp_path / "second" / "report.html").read_text()
    assert {c["what"] for c in changes} >= {"roll", "pitch", "heading", "offset"}
    assert not any(c["significant"] for c in changes)


def test_exposures_with_other_names_are_an_error_that_states_so(project) -> None:
    ones = np.ones(3)
    with pytest.raises(BoresightError, match="must use the same names"):
        inertial_table(project / "inertial.csv", ("left", "right"), ones, ones)


def test_the_trajectory_of_a_mission_is_taken_at_its_marks(tmp_path: Path) -> None:
    fine = [sample_at(EPOCH_NS + 4_900_000_000 + i * 10_000_000) for i in range(40)]
    mission = mission_at(tmp_path / "m", samples=fine)
    crs = utm_of(PLAN.latitude_deg, PLAN.longitude_deg)
    ones = np.ones(3)
    which, found = inertial_of_mission(mission, ("000001", "other"), crs, None, ones, ones)
    assert which == (0,)
    pose = FLIGHT.pose(MID_NS)
    latitude, longitude, height = FLIGHT.geodetic(pose.position_enu_m)
    place = Georeference(crs).place(latitude, longitude, height)
    assert found.position_m[0] == pytest.approx(
        [place.east_m, place.north_m, place.height_m], abs=1e-3
    )
    speed = np.linalg.norm(found.velocity_mps[0])
    assert speed == pytest.approx(np.linalg.norm(FLIGHT.velocity_ned_mps(pose)), rel=1e-4)
    before, after = (FLIGHT.pose(MID_NS + k * 10_000_000) for k in (-1, 1))
    rotation = before.enu_from_body.T @ after.enu_from_body / 0.02
    expected = [
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    ]
    assert found.rate_rad_per_s[0] == pytest.approx(np.array(expected) / 2.0, abs=2e-4)


def test_a_time_offset_moves_orientations_along_the_flight(tmp_path: Path) -> None:
    fine = [sample_at(EPOCH_NS + 4_900_000_000 + i * 10_000_000) for i in range(40)]
    mission = mission_at(tmp_path / "m", samples=fine)
    at = master_of(mission, MountSection())
    late = master_of(mission, MountSection(time_offset_ms=10.0))
    moved = float(np.linalg.norm(late.centre_m - at.centre_m))
    assert moved == pytest.approx(PLAN.ground_speed_mps * 0.010, rel=0.05)


def test_another_mount_orients_in_addition_to_the_one_flown(tmp_path: Path) -> None:
    mission = mission_at(tmp_path / "m")
    mount = tmp_path / "mount.toml"
    mount.write_text("[mount]\nboresight_deg = [0.0, 0.1, 0.0]\n")
    folders = []
    for more in ([], ["--mount", str(mount)]):
        done = RUN.invoke(app, ["orient", str(mission.path), *more, "--json"])
        assert done.exit_code == 0, done.output + str(done.exception)
        output = json.loads(done.stdout)
        folders.append(output["folder"])
    assert folders[0] != folders[1] and output["change_deg"] == pytest.approx(0.1, abs=1e-4)
    (tmp_path / "none.toml").write_text("[plan]\n")
    wrong = RUN.invoke(
        app, ["orient", str(mission.path), "--mount", str(tmp_path / "none.toml"), "--json"]
    )
    assert wrong.exit_code != 0 and "no [mount] in it" in str(wrong.exception)
