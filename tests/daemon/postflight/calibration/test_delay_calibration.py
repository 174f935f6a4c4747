"""`syntopic calibrate boresight` with delays of heads: project, command, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.time_from_pixels import network_of, write_flight
from daemon.cli import app
from daemon.postflight.adjustment.csv_tables import ProjectError
from daemon.postflight.adjustment.project import CheckPoints, read_project
from daemon.postflight.adjustment.project_writer import write_project
from sim_hw.blocks.figure_of_eight import FigureFlight, nine_heads, simulate_figure_flight

RUN = CliRunner()
OPTIONS = ("--position-correlation", "30", "--attitude-correlation", "20")


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> tuple[Path, FigureFlight]:
    folder = tmp_path_factory.mktemp("figure") / "project"
    heads = nine_heads(np.random.default_rng(1))
    flight = simulate_figure_flight(1, heads=heads, interval_s=8.0, ground_points=500)
    write_flight(flight, folder)
    return folder, flight


def test_the_command_states_the_delay_of_every_head(flown, tmp_path) -> None:
    project, flight = flown
    out = tmp_path / "out"
    done = RUN.invoke(
        app, ["calibrate", "boresight", str(project), *OPTIONS, "--out", str(out), "--json"]
    )
    assert done.exit_code == 0, done.output
    stated = {(q["where"], q["what"]): q for q in json.loads(done.stdout)["quantities"]}
    for head in flight.heads:
        total = stated[f"head {head.name}", "delay after the mark"]
        truth = (flight.common_delay_s + head.delay_s) * 1e3
        assert total["unit"] == "ms"
        assert abs(total["value"] - truth) < 4.0 * total["sigma"] < 2.0
    own = stated["head oblique 3", "delay after the rig's instant"]
    assert own["sigma"] < 0.1
    assert "head oblique 3: delay after the mark" in (out / "mount.toml").read_text()


def test_an_exposure_without_inertial_values_is_named(flown, tmp_path) -> None:
    project, _ = flown
    short = tmp_path / "short"
    short.mkdir()
    for file in project.iterdir():
        content = file.read_text()
        if file.name == "inertial.csv":
            content = "\n".join(line for line in content.splitlines() if "000003" not in line)
        (short / file.name).write_text(content)
    done = RUN.invoke(app, ["calibrate", "boresight", str(short), *OPTIONS])
    assert done.exit_code != 0
    assert "000003" in f"{done.output} {done.exception}"


def test_a_project_keeps_delays_and_motion(flown, tmp_path) -> None:
    project, flight = flown
    given = read_project(project / "project.toml")
    network = network_of(flight, readout=True)
    write_project(
        tmp_path / "p", given.file, network, CheckPoints((), np.zeros((0, 3)), np.zeros((0, 3)))
    )
    again = read_project(tmp_path / "p" / "project.toml").network
    assert network.motion is not None and again.motion is not None
    assert again.motion.velocity_mps == pytest.approx(network.motion.velocity_mps)
    assert again.motion.rate_rad_per_s == pytest.approx(network.motion.rate_rad_per_s)
    assert again.motion.acceleration_mps2 == pytest.approx(network.motion.acceleration_mps2)
    change = network.motion.rate_change_rad_per_s2
    assert again.motion.rate_change_rad_per_s2 == pytest.approx(change)
    assert [h.timing for h in again.heads] == [h.timing for h in given.network.heads]


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ("000002,1,2,3,4,5,6\n", "exposures have no motion, first 000001"),
        ("000001,1,2,x,4,5,6\n", "vz_mps is 'x'; a number is right"),
        ("000001,1,2,,4,5,6\n", "need a number each"),
        ("999999,1,2,3,4,5,6\n", "exposure '999999' is not there"),
    ],
)
def test_a_wrong_motion_is_refused_with_file_and_line(
    flown, tmp_path, wrong: str, sentence: str
) -> None:
    project, _ = flown
    for file in project.iterdir():
        content = file.read_text()
        if file.name == "project.toml":
            content = content.replace("[files]", '[files]\nmotion = "motion.csv"')
        (tmp_path / file.name).write_text(content)
    head = "exposure,vx_mps,vy_mps,vz_mps,rate_x_deg_s,rate_y_deg_s,rate_z_deg_s\n"
    (tmp_path / "motion.csv").write_text(head + wrong)
    with pytest.raises(ProjectError) as error:
        read_project(tmp_path / "project.toml")
    assert sentence in str(error.value) and "motion.csv" in str(error.value)


def _with_inertial(project: Path, folder: Path, change) -> Path:
    """A copy of the project whose inertial values, (exposures, columns), are changed."""
    folder.mkdir()
    for file in project.iterdir():
        (folder / file.name).write_text(file.read_text())
    lines = (project / "inertial.csv").read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if line.startswith("exposure"))
    columns = lines[head].split(",")[1:]
    names = [line.split(",")[0] for line in lines[head + 1 :]]
    table = np.array([[float(v) for v in line.split(",")[1:]] for line in lines[head + 1 :]])
    changed = change(table, columns)
    rows = [",".join([n, *map(repr, row.tolist())]) for n, row in zip(names, changed, strict=True)]
    (folder / "inertial.csv").write_text("\n".join([*lines[: head + 1], *rows]) + "\n")
    return folder


def _scaled(part: str, factor: float):
    def change(table: np.ndarray, columns: list[str]) -> np.ndarray:
        own = [part in column and "change" not in column for column in columns]
        return np.where(own, table * factor, table)

    return change


def _stale(table: np.ndarray, columns: list[str]) -> np.ndarray:
    own = [column.startswith(("v", "rate")) for column in columns]
    return np.where(own, np.roll(table, 1, axis=0), table)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_scaled("rate", np.pi / 180.0), "rates do not fit the attitudes"),
        (_scaled("rate", -1.0), "rates do not fit the attitudes"),
        (_scaled("_mps", 3.6), "velocities do not fit the positions"),
        (_scaled("_mps", -1.0), "velocities do not fit the positions"),
        (_stale, "velocities do not fit the positions"),
        (lambda table, columns: table[:, [1, 0, *range(2, len(columns))]], "velocities"),
    ],
    ids=["rad", "negated rates", "km/h", "negated velocities", "stale", "north before east"],
)
def test_motion_that_contradicts_the_trajectory_is_refused(
    flown, tmp_path, change, sentence: str
) -> None:
    project, _ = flown
    wrong = _with_inertial(project, tmp_path / "wrong", change)
    done = RUN.invoke(app, ["calibrate", "boresight", str(wrong), *OPTIONS])
    assert done.exit_code != 0 and sentence in f"{done.output} {done.exception}"


def test_inertial_values_of_other_exposures_are_warned_of(flown, tmp_path) -> None:
    project, _ = flown

    def swapped(table: np.ndarray, _: list[str]) -> np.ndarray:
        return table[[1, 0, *range(2, len(table))]]

    wrong = _with_inertial(project, tmp_path / "wrong", swapped)
    out = ["--out", str(tmp_path / "out"), "--json"]
    done = RUN.invoke(app, ["calibrate", "boresight", str(wrong), *OPTIONS, *out])
    assert done.exit_code == 0, done.output
    warnings = json.loads(done.stdout)["warnings"]
    assert any("residuals of the comparison are larger than stated" in w for w in warnings)
