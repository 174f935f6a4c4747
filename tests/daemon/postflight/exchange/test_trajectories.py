"""Exported trajectories come back: SBET, CSV and RTKLIB's positions, and what they refuse."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_records import message_of
from daemon.orientation.rtklib_positions import read_positions
from daemon.orientation.trajectory import read_trajectory
from tests.daemon.orientation.test_orientation import sample_at
from tests.daemon.postflight.exchange.flown_block import EPOCH_NS, fly

RUN = CliRunner()
WEEK_NS = 604_800_000_000_000
INSTANTS = [EPOCH_NS + k * 100_000_000 for k in range(100)]


@pytest.fixture(scope="module")
def mission(tmp_path_factory) -> Path:
    path = fly(
        tmp_path_factory.mktemp("trajectory") / "mission", "ultracam-l-mini", seconds=(5.0,),
        lens="f_number = 5.6",
    ).path  # fmt: skip
    (path / "log").mkdir()
    log = FlightLog.create(path / "log")
    for instant in INSTANTS:
        log.write(message_of(sample_at(instant)))
    log.close()
    return path


def export(mission: Path, kind: str, *more: str) -> tuple[dict, Path]:
    done = RUN.invoke(app, ["export", "trajectory", str(mission), "--as", kind, "--json", *more])
    assert done.exit_code == 0, done.output + str(done.exception)
    content = json.loads(done.stdout)
    assert (content["samples"], content["left_out"]) == (100, 0)
    return content, Path(content["folder"]) / content["files"][0]


@pytest.mark.parametrize("kind", ["sbet", "csv"])
def test_positions_and_attitudes_come_back(mission, kind: str) -> None:
    _, path = export(mission, kind)
    found = read_trajectory(path, around_gps_ns=EPOCH_NS)
    assert len(found.instants_ns) == 100
    for i, instant in enumerate(INSTANTS):
        one, truth = found.sample(i), sample_at(instant)
        # Seconds of the week are doubles in an SBET: 0.1 us.
        assert abs(one.gps_ns - instant) <= (200 if kind == "sbet" else 0)
        assert abs(one.latitude_deg - truth.latitude_deg) < 1e-10
        assert abs(one.longitude_deg - truth.longitude_deg) < 1e-10
        assert abs(one.height_m - truth.height_m) < 1e-4
        for name in ("roll_rad", "pitch_rad"):
            assert abs(getattr(one, name) - getattr(truth, name)) < 1e-9
        turn = (one.heading_rad - truth.heading_rad + np.pi) % (2 * np.pi) - np.pi
        assert abs(turn) < 1e-9


@pytest.mark.parametrize("kind", ["csv", "pos"])
def test_the_export_of_an_exported_trajectory_is_byte_identical(mission, tmp_path, kind) -> None:
    _, path = export(mission, kind)
    first = path.read_bytes()
    copied = tmp_path / f"again.{kind}"
    copied.write_bytes(first)
    _, again = export(mission, kind, "--trajectory", str(copied))
    assert again.name != path.name and again.read_bytes() == first


def test_an_sbet_written_again_differs_in_velocities_only(mission, tmp_path) -> None:
    """The reader takes velocities from positions: an SBET has them in a wander frame."""
    _, path = export(mission, "sbet")
    copied = tmp_path / "again.sbet"
    copied.write_bytes(path.read_bytes())
    _, again = export(mission, "sbet", "--trajectory", str(copied))
    first, second = (np.fromfile(one, "<f8").reshape(-1, 17) for one in (path, again))
    same = [0, 1, 2, 3, *range(7, 17)]
    # Angles go through degrees: the last digit of a double.
    assert np.allclose(first[:, same], second[:, same], rtol=4e-16, atol=0.0)
    assert (first[:, [0, 3]] == second[:, [0, 3]]).all()
    assert not np.array_equal(first[:, 4:7], second[:, 4:7])
    assert np.abs(first[1:-1, 4:7] - second[1:-1, 4:7]).max() < 0.1


def test_smrmsg_has_the_accuracies_and_is_written_only_with_those_of_attitude(mission) -> None:
    content, _ = export(mission, "sbet")
    assert not any(name.endswith(".smrmsg") for name in content["files"])
    content, path = export(mission, "sbet", "--attitude-sigma", "5", "6", "8")
    rows = np.fromfile(path.with_suffix(".smrmsg"), "<f8").reshape(-1, 10)
    assert len(rows) == 100
    assert np.allclose(rows[:, 0], [(i % WEEK_NS) * 1e-9 for i in INSTANTS])
    assert np.allclose(rows[:, 1:4], [0.02, 0.02, 0.03])
    assert np.allclose(rows[:, 7:], np.array([5, 6, 8]) * 60e-3)


def test_positions_of_rtklib_come_back_with_their_accuracies(mission) -> None:
    _, path = export(mission, "pos")
    found = read_positions(path)
    assert [one.gps_ns for one in found] == INSTANTS
    for one, instant in zip(found, INSTANTS, strict=True):
        truth = sample_at(instant)
        assert abs(one.latitude_deg - truth.latitude_deg) < 1e-9
        assert (one.horizontal_sigma_m, one.vertical_sigma_m) == (0.02, 0.03)


def test_what_a_trajectory_does_not_state_is_refused(mission) -> None:
    _, path = export(mission, "csv")
    done = RUN.invoke(
        app, ["export", "trajectory", str(mission), "--as", "pos", "--trajectory", str(path)]
    )
    assert done.exit_code != 0
    assert "0 of 100 samples have a height and standard deviations" in str(done.exception)
    done = RUN.invoke(app, ["export", "trajectory", str(mission), "--as", "kml"])
    assert done.exit_code != 0 and "sbet, csv, pos are right" in str(done.exception)
