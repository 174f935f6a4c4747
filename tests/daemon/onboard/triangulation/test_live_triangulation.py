"""The triangulation of a flight, held against the truth of the emulator, and its bad cases."""

from __future__ import annotations

import json
import math
import queue
import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from daemon.cli import app
from daemon.configuration.model import TriangulationSection
from daemon.mission.layout import Mission
from daemon.onboard.service.messages import TriangulationFinished
from daemon.onboard.service.processes import ServiceConnection
from daemon.onboard.triangulation import triangulation_process
from daemon.onboard.triangulation.flown_lines import FlownLines
from daemon.onboard.triangulation.live_record import live_json, summary_json, write_live
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.exterior_orientation import sealed_exposures
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.triangulation.matching_work import match_mission_block
from daemon.postflight.triangulation.report import mountings_of
from daemon.postflight.triangulation.triangulation import (
    TriangulationSettings,
    block_of,
    project_of,
    weight_by_residuals,
)
from processing.bundle.adjust import adjust
from processing.bundle.block_adjustment import added_parameters
from processing.bundle.camera_orientations import camera_orientations
from processing.bundle.initial_values import completed
from processing.geometry.rotation import vectors_from_rotations
from processing.matching.block_matching import BlockMatching
from processing.pipelines.live_triangulation import MeasuredImage
from tests.daemon.flown_block import (
    FlownBlock,
    ground_points,
    read_record,
    write_image,
    write_navigation,
    write_points,
    write_record,
)
from tests.daemon.onboard.conftest import EACH, LINES

RUN = CliRunner()
DRIFT_DEG_H = 5.0


@pytest.fixture(scope="module")
def triangulated(flown) -> MissionTriangulation:
    return _replayed(flown.mission)


@pytest.fixture
def copied(flown, tmp_path) -> Path:
    shutil.copytree(flown.mission, tmp_path / "mission")
    return tmp_path / "mission"


def _replayed(mission: Path, numbers: range | None = None) -> MissionTriangulation:
    folder = Mission.open(mission)
    done = MissionTriangulation(folder)
    read = sealed_exposures(folder).results
    for number in sorted(read) if numbers is None else numbers:
        done.add(read[number])
    done.land()
    return done


def _names(done: MissionTriangulation) -> set[str]:
    return {one.name for one in done.findings}


def _errors(flown: FlownBlock, done: MissionTriangulation) -> np.ndarray:
    """Errors (n, 6) of projection centres, m, and of rotations about the camera's axes, rad."""
    frame = done.frame
    errors = []
    for one in done.live.orientations:
        k = one.image.number - 1
        truth = frame.from_geodetic(*(np.array(v) for v in flown.place[k]))
        origin = LocalFrame(
            flown.world.flight.plan.latitude_deg, flown.world.flight.plan.longitude_deg
        )
        rotation = (
            frame.local_from_enu(origin.latitude_deg, origin.longitude_deg)
            @ flown.enu_from_camera[k]
        )
        turn = vectors_from_rotations((rotation.T @ one.rotation)[None])[0]
        errors.append(np.concatenate([one.position_m - truth, turn]))
    return np.array(errors)


def test_adjusted_orientations_err_as_their_full_covariance_states(flown, triangulated) -> None:
    errors = _errors(flown, triangulated)
    covariance = triangulated.live.last.cameras.covariance()
    flat = errors.ravel()
    squares = flat @ np.linalg.solve(covariance, flat) / len(flat)
    low, high = stats.chi2.ppf([0.0005, 0.9995], len(flat)) / len(flat)
    assert low < squares < high
    sigma = np.sqrt(np.diag(covariance)).reshape(-1, 6)
    assert (np.abs(errors) < 4.5 * sigma).all()
    # Tie points improve on what was measured.
    assert (sigma[:, 3:5] < 0.6 * math.radians(0.0076)).all()


def test_the_triangulation_after_landing_shares_its_unknowns_with_that_in_flight(
    flown, triangulated
) -> None:
    trajectory = write_navigation(flown)
    block = block_of(Mission.open(flown.mission), trajectory_file=trajectory)
    matching = BlockMatching(cells=(10, 7))
    tied = match_mission_block(block, matching)
    project = weight_by_residuals(project_of(block, tied, TriangulationSettings()), tied.points)
    done = adjust(completed(project.network), project.settings)
    cameras = camera_orientations(done)
    errors, sigma = [], np.sqrt(np.diag(cameras.covariance())).reshape(-1, 6)
    for k, one in enumerate(triangulated.live.orientations):
        there = block.frame.to_geodetic(cameras.station_m[k : k + 1])
        step = one.position_m - triangulated.frame.from_geodetic(*there.T)[0]
        between = triangulated.frame.local_from_enu(
            block.frame.latitude_deg, block.frame.longitude_deg
        )
        turn = vectors_from_rotations(((between @ cameras.rotation[k]).T @ one.rotation)[None])[0]
        errors.append(np.concatenate([step, turn]))
    # Both have the same navigation and mounting, and other tie points of the same images.
    live = np.sqrt(np.einsum("nii->ni", triangulated.live.last.cameras.covariances()))
    assert (np.abs(errors) < 3.0 * np.maximum(sigma, live)).all()
    assert float(np.sqrt(np.mean(np.square(errors / sigma)))) < 1.0
    found = {(q["what"], q["axis"]): q for q in mountings_of(done)}
    drifts = {one.name: one for one in triangulated.drifts}
    for axis in ("x", "y", "z"):
        own, other = found["boresight", axis], drifts[f"boresight about the camera's {axis}"]
        assert own["value"] == pytest.approx(other.value, abs=2.0 * own["sigma"])
        assert own["sigma"] == pytest.approx(other.sigma, rel=0.3)


def test_lines_flown_there_and_back_tie_and_nothing_is_wrong(triangulated) -> None:
    found = summary_json(triangulated)
    assert found["exposures"] == EACH * LINES and found["adjusted"] == EACH * LINES
    (pair,) = found["line_ties"]
    assert pair["found"] > 0.5 * pair["tried"] > 10
    assert found["findings"] == [] and found["reflights"] == []
    assert found["accuracy"]["plan_m"] < 0.1 < found["accuracy"]["height_m"] < 1.0
    assert all(one.source == "block" for one in triangulated.live.orientations)
    # Weights are those of the residuals, and no good position is a blunder.
    assert 0.8 < triangulated.live.last.sigma0 < 1.2
    assert triangulated.live.last.result.excluded.others == 0
    assert max(found["image_sigma_px"]) < 0.05


def test_each_exposure_has_an_orientation_before_the_next_is_taken(flown) -> None:
    mission = Mission.open(flown.mission)
    done = MissionTriangulation(mission)
    read = sealed_exposures(mission).results
    sources = [done.add(read[number]).orientation.source for number in sorted(read)]
    assert sources[0] == "measured" and set(sources[1:EACH]) == {"window"}
    squares = [
        float(e @ np.linalg.solve(o.covariance, e)) / 6
        for e, o in zip(_errors(flown, done), done.live.orientations, strict=True)
    ]
    assert np.mean(squares) < 2.0


def test_the_command_writes_the_record_and_a_page_and_repeats_to_the_byte(
    copied, flown, tmp_path
) -> None:
    tables = write_points(tmp_path, flown, ground_points(flown, 8, 3))
    options = ["--points", str(tables[0]), "--measured", str(tables[1]), "--json"]
    done = RUN.invoke(app, ["triangulate", str(copied), "--live", *options])
    assert done.exit_code == 0, done.output + str(done.exception)
    found = json.loads(done.stdout)
    assert found["control"]["in_plan"] == found["control"]["points"] == 8
    folder = Path(found["folder"])
    record = json.loads((folder / "live.json").read_text())
    assert len(record["orientations"]) == EACH * LINES and not record["is_preliminary"]
    assert len(record["orientations"][0]["covariance"]) == 36
    rows = (folder / "orientations.csv").read_text().splitlines()
    assert len(rows) == EACH * LINES + 3
    page = (folder / "report.html").read_text()
    assert "Expected accuracy without control points" in page and "<script" not in page
    assert "Control and check points" in page and page.count("<tr><td>P00") == 8
    assert len(record["control"]["residuals"]) == 8
    first = {p.name: p.read_bytes() for p in folder.iterdir() if p.name == "orientations.csv"}
    again = RUN.invoke(app, ["triangulate", str(copied), "--live"])
    assert again.exit_code == 0 and "Expected accuracy" in again.output
    assert {name: (folder / name).read_bytes() for name in first} == first


def test_a_single_strip_states_what_it_cannot_determine(flown) -> None:
    done = _replayed(flown.mission, range(1, EACH + 1))
    (finding,) = [f for f in done.findings if f.name == "SINGLE_STRIP"]
    assert "lever arm along the camera's x" in finding.sentence
    assert "cross line" in finding.sentence


def test_exposures_without_navigation_are_named_and_the_others_are_adjusted(copied) -> None:
    for number in (2, 3):
        record = read_record(copied, number)
        del record["navigation"]
        write_record(copied, record)
    done = _replayed(copied)
    (finding,) = [f for f in done.findings if f.name == "NO_GNSS"]
    assert finding.exposures == (2, 3) and "Exposures 2-3 are not in the block" in finding.sentence
    assert len(done.live.images) == EACH * LINES - 2
    assert {"kind": "exposures", "line": None, "from": 2, "to": 3,
            "reason": "no navigation"} in summary_json(done)["reflights"]  # fmt: skip


def test_a_flight_without_any_position_reports_that_there_is_no_block(copied) -> None:
    for number in range(1, EACH * LINES + 1):
        record = read_record(copied, number)
        del record["navigation"]
        write_record(copied, record)
    done = RUN.invoke(app, ["triangulate", str(copied), "--live", "--json"])
    assert done.exit_code == 1
    found = json.loads(done.stdout)
    assert found["findings"][0]["name"] == "NO_GNSS" and found["accuracy"] is None
    assert "There is no block" in found["findings"][0]["sentence"]


def test_an_exposure_of_water_is_measured_only_and_to_be_flown_again(copied) -> None:
    noise = np.random.default_rng(1)
    shape = (1620, 1182)
    for number in (3, 4, 5):
        water = noise.normal(3000.0, 20.0, shape).clip(2, 60000).astype(np.uint16)
        write_image(copied, number, water & 0xFFFE)
    done = _replayed(copied)
    (finding,) = [f for f in done.findings if f.name == "UNTIED_EXPOSURES"]
    assert set(finding.exposures) >= {4, 5} and set(finding.exposures) <= {2, 3, 4, 5}
    sources = {o.image.number: o.source for o in done.live.orientations}
    assert sources[4] == "measured" and sources[7] == "block"
    assert summary_json(done)["reflights"][0]["line"] == "line 1"


def test_swapped_images_are_not_adjusted_as_if_right(copied) -> None:
    a, b = copied / "L2/000002/pan.tif", copied / "L2/000008/pan.tif"
    first, second = a.read_bytes(), b.read_bytes()
    a.write_bytes(second)
    b.write_bytes(first)
    done = _replayed(copied)
    (finding,) = [f for f in done.findings if f.name == "UNTIED_EXPOSURES"]
    assert set(finding.exposures) >= {2, 8}


def test_a_drifting_inertial_unit_is_named(copied) -> None:
    first_ns = int(read_record(copied, 1)["mark_gps_ns"])
    for number in range(1, EACH * LINES + 1):
        record = read_record(copied, number)
        seconds = (int(record["mark_gps_ns"]) - first_ns) * 1e-9
        record["navigation"]["pitch_rad"] += math.radians(DRIFT_DEG_H) * seconds / 3600.0
        write_record(copied, record)
    done = _replayed(copied)
    assert "ATTITUDE_DRIFT" in _names(done)
    drift = max(abs(d.value) for d in done.drifts if "per hour" in d.name)
    assert drift == pytest.approx(1e3 * DRIFT_DEG_H, rel=0.3)


def test_a_boresight_that_changed_is_named_and_estimated(copied) -> None:
    for number in range(1, EACH * LINES + 1):
        record = read_record(copied, number)
        record["navigation"]["roll_rad"] += math.radians(0.05)
        write_record(copied, record)
    done = _replayed(copied)
    assert "BORESIGHT_CHANGED" in _names(done)
    boresight = max(abs(d.value) for d in done.drifts if d.name.startswith("boresight"))
    assert boresight == pytest.approx(50.0, abs=12.0)


def test_an_image_that_cannot_be_read_is_left_out_and_named(copied) -> None:
    image = copied / "L2/000004/pan.tif"
    image.write_bytes(image.read_bytes()[:-100])
    (copied / "L2/000005/pan.tif").unlink()
    done = _replayed(copied)
    numbers = {n for f in done.findings if f.name == "NO_IMAGE" for n in f.exposures}
    assert numbers == {4, 5}
    assert {o.image.number for o in done.live.orientations} == {1, 2, 3, 6, 7, 8, 9, 10}


def test_landing_names_exposures_that_never_came(copied) -> None:
    """Lost, not processed, and processed too late."""
    record = read_record(copied, 5)
    write_record(copied, record | {"frames": [], "state": "lost"})
    for number in (4, 5):
        shutil.rmtree(copied / f"L2/{number:06d}")
    done = _replayed(copied, range(1, 4))
    found = {f.name: f for f in done.findings}
    assert found["EXPOSURES_LOST"].exposures == (5,)
    assert "Exposures 5 are not in the block: lost" in found["EXPOSURES_LOST"].sentence
    assert found["NO_IMAGE"].exposures == (4,)
    assert "it was not processed" in found["NO_IMAGE"].sentence
    assert found["NOT_TRIANGULATED"].exposures == (6, 7, 8, 9, 10)
    advised = [(r["from"], r["to"]) for r in summary_json(done)["reflights"] if "from" in r]
    assert advised == [(4, 4), (5, 5), (6, 10)]


def test_exposures_behind_at_landing_do_not_take_the_time_of_the_adjustment(copied) -> None:
    sent: list[object] = []
    link = cast(ServiceConnection, SimpleNamespace(send=sent.append))
    landing = triangulation_process._Landing()
    work = triangulation_process._Work(
        link, copied, TriangulationSection(enabled=True), queue.Queue(), landing
    )
    for number in (1, 2, 3):
        work._triangulate(work._done, number)
    landing.until_s = time.monotonic() - 1.0
    for number in (3, 4):  # one that is in the block already, and one that is not
        work._triangulate(work._done, number)
    work._finish()
    assert isinstance(sent[-1], TriangulationFinished) and sent[-1].is_written
    record = json.loads((copied / "export/triangulation/live/live.json").read_text())
    assert not record["is_preliminary"] and record["adjusted"] == 3
    assert {s["exposure"] for s in record["skipped"]} == set(range(4, EACH * LINES + 1))
    assert "NOT_TRIANGULATED" in {f["name"] for f in record["findings"]}


def test_without_a_plan_lines_are_those_that_were_flown(copied) -> None:
    """All exposures bear one name; the block is adjusted at the turn, too."""
    for number in range(1, EACH * LINES + 1):
        write_record(copied, read_record(copied, number) | {"line_id": ""})
    done = _replayed(copied)
    assert [i.line for i in done.live.images] == ["line 1"] * EACH + ["line 2"] * EACH
    assert "SINGLE_STRIP" not in _names(done) and done.block_count == LINES


def _measured_image(east_m: float, north_m: float, heading_deg: float, line: str = ""):
    angle = math.radians(heading_deg)
    forward = np.array([math.sin(angle), math.cos(angle), 0.0])
    right = np.array([forward[1], -forward[0], 0.0])
    rotation = np.column_stack([right, forward, [0.0, 0.0, 1.0]])
    return MeasuredImage(
        1, line, 0.0, np.array([east_m, north_m, 1000.0]), rotation, np.ones(3), np.ones(3),
        np.full(3, np.nan),
    )  # fmt: skip


def test_a_gap_or_a_slow_curve_begins_no_line_a_turn_or_a_step_aside_does() -> None:
    lines = FlownLines(("A",))
    flown = [
        (0, 0, 0, ""), (0, 100, 0, ""), (5, 2000, 4, ""), (80, 2200, 20, ""),
        (400, 2000, 180, ""), (400, 1900, 180, ""),
        (800, 0, 180, ""), (800, -100, 180, ""), (805, -100, 270, ""), (0, 0, 0, "A"),
        (0, 0, 180, "A"),
    ]  # fmt: skip
    names = [lines.name(_measured_image(*one), 1000.0) for one in flown]
    assert names == [
        "line 1", "line 1", "line 1", "line 1", "line 2", "line 2", "line 3", "line 3", "line 4",
        "A", "A",
    ]  # fmt: skip


def test_an_exposure_that_comes_twice_counts_once(flown) -> None:
    mission = Mission.open(flown.mission)
    read = sealed_exposures(mission).results
    done = MissionTriangulation(mission)
    for number in (1, 2, 2, 3, 1):
        done.add(read[number])
    assert [i.number for i in done.live.images] == [1, 2, 3]


def test_a_height_model_that_fails_or_lies_is_named(copied, tmp_path) -> None:
    cells = "ncols 10\nnrows 5\nxllcorner 0\nyllcorner 5000000\ncellsize 100000\n"
    heights = " ".join(["900"] * 50)
    (tmp_path / "model.asc").write_text(f"{cells}{heights}\n")
    done = _with_model(copied, "model.asc")
    assert "HEIGHT_MODEL_CONTRADICTED" in _names(done)
    (copied / "model.asc").write_text("no grid")
    assert "HEIGHT_MODEL_FAILED" in _names(_replayed(copied))


def _with_model(mission: Path, name: str) -> MissionTriangulation:
    shutil.copy(mission.parent / name, mission / name)
    text = (mission / "service.toml").read_text()
    text += f'elevation = "{name}"\nelevation_crs = "EPSG:32633"\n'
    (mission / "service.toml").write_text(text)
    return _replayed(mission)


def test_lines_that_were_not_flown_are_named_at_landing(flown, triangulated) -> None:
    done = _replayed(flown.mission, range(1, EACH + 1))
    done._planned_lines = ("line 1", "line 2", "line 3")
    done.land()
    (finding,) = [f for f in done.findings if f.name == "PLAN_CUT_SHORT"]
    assert finding.lines == ("line 2", "line 3")


def test_a_failed_disk_leaves_the_last_record(copied, monkeypatch) -> None:
    done = _replayed(copied, range(1, 4))
    write_live(done)
    before = (done.folder / "live.json").read_bytes()
    monkeypatch.setattr("daemon.onboard.triangulation.live_record.quality_page", lambda _: "\ud800")
    with pytest.raises(UnicodeEncodeError):
        write_live(done)
    assert (done.folder / "live.json").read_bytes() == before


def test_an_added_parameter_is_what_an_unknown_would_be(triangulated) -> None:
    """A shift of all measured positions is nowhere in the images; a rotation is in the others."""
    result = triangulated.live.last.result
    n = len(triangulated.live.images)
    position = np.zeros((n, 3, 1))
    position[:, 2, 0] = 1.0
    done = added_parameters(result, position, np.zeros((n, 3, 1)), np.array([np.inf]))
    assert not np.isfinite(done.sigma[0]) or done.sigma[0] > 1.0
    moved = replace(
        result.equations,
        misclosure=result.equations.misclosure.copy(),
    )
    own = (moved.group == 4) & (moved.axis == 0)
    plant = np.zeros((n, 3, 1))
    plant[:, 0, 0] = np.linspace(-1.0, 1.0, n)
    moved.misclosure[own] += 0.5 * plant[moved.source[own], 0, 0] / moved.sigma[own]
    before = added_parameters(result, plant, np.zeros((n, 3, 1)), np.array([np.inf]))
    # What the adjustment would absorb is taken off by the same projection.
    into = np.asarray(moved.reduced.T @ (moved.misclosure - result.equations.misclosure))
    residual = moved.misclosure - np.asarray(moved.reduced @ (result.cofactor @ into))
    after = added_parameters(
        replace(result, equations=replace(moved, misclosure=residual)),
        plant, np.zeros((n, 3, 1)), np.array([np.inf]),
    )  # fmt: skip
    assert after.value[0] - before.value[0] == pytest.approx(0.5, rel=1e-6)


def test_the_record_holds_what_the_format_names(triangulated) -> None:
    record = live_json(triangulated)
    assert record["format"] == 1 and record["simulated"]
    one = record["orientations"][0]
    assert set(one) == {
        "exposure", "line", "source", "tie_points", "latitude_deg", "longitude_deg", "height_m",
        "omega_phi_kappa_deg", "sigma_m", "sigma_mdeg", "covariance",
    }  # fmt: skip
    covariance = np.array(one["covariance"]).reshape(6, 6)
    assert np.allclose(covariance, covariance.T)
    assert np.sqrt(np.diag(covariance))[:3] == pytest.approx(one["sigma_m"])
