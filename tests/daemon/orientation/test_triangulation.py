"""`syntopic triangulate`: two lines, flown both ways, matched and held against check points."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
import tifffile
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission, MissionError
from daemon.mission.store.level0 import tiff_parts
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.adjustment.project import read_project
from daemon.postflight.triangulation.measured_points import read_measured_points
from daemon.postflight.triangulation.point_transfer import transferred
from daemon.postflight.triangulation.triangulation import block_of
from processing.matching.block_matching import BlockMatching
from processing.rig import shipped_rigs
from sim_hw.processes.exposures import EPOCH_GPS_NS, FIRST_AFTER_S
from sim_hw.world import true_camera
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.post_processed_trajectory import marks_of_lines, write_trajectory
from sim_hw.world.rendering import render_ideal
from sim_hw.world.scene import open_scene
from sim_hw.world.surveyed_points import write_surveyed
from sim_hw.world.world import World, WorldSettings

RUN = CliRunner()
EACH, LINES = 4, 2
DRIFT_DEG_H = 3.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> tuple[Path, World, SimulatedFlight, list[int]]:
    """Eight ideal images with shot noise over true terrain, a trajectory, surveyed points."""
    folder = tmp_path_factory.mktemp("block")
    text = shipped_rigs()["ultracam-l-mini"].read_text()
    file = folder / "rig.toml"
    file.write_text(text.replace("width_px = 2364", "width_px = 1182"))
    world = World(
        WorldSettings(
            rig_file=str(file), seed=5, epoch_gps_ns=EPOCH_GPS_NS, exposures=EACH, height_m=1500.0
        )
    )
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    marks = marks_of_lines(world, flight, first, EACH, LINES)
    write_trajectory(folder / "trajectory.csv", flight, marks, seed=5)
    write_surveyed(
        folder / "surveyed", world, flight, marks, seed=5, control=6, checks=12, measured_px=0.05
    )
    scene = open_scene(world.scene_settings, folder / "scenes")
    mission, noise = folder / "mission", np.random.default_rng(5)
    for number, mark in enumerate(marks, 1):
        light = render_ideal(world, scene, flight, mark)
        pixels = np.clip(light / light.mean() * 8000.0, 2, 60000)
        pixels = (pixels + noise.normal(0.0, 40.0, pixels.shape)).clip(2, 65534).astype(np.uint16)
        (mission / f"L2/{number:06d}").mkdir(parents=True)
        (mission / f"L0/{number:06d}").mkdir(parents=True)
        parts = tiff_parts([np.ascontiguousarray(pixels & 0xFFFE)], {"bands": ["pan"]})
        (mission / f"L2/{number:06d}/pan.tif").write_bytes(b"".join(bytes(p) for p in parts))
        record = {
            "number": number,
            "simulated": True,
            "mark_gps_ns": str(mark),
            "mark_source": "event-mark",
            "line_id": f"line {(number - 1) // EACH + 1}",
            "frames": [{"sensor": s.name, "mid_exposure_gps_ns": str(mark)} for s in _pan(world)],
        }
        (mission / f"L0/{number:06d}/exposure.json").write_text(json.dumps(record))
    (mission / "rig.toml").write_text(file.read_text())
    plan = f"[plan]\nground_height_m = {world.plan.ground_height_m}\n"
    (mission / "service.toml").write_text(plan)
    return folder, world, flight, marks


def _pan(world: World):
    return [s for cone in world.rig.pan_cones for s in cone.sensors]


def _settings(folder: Path, out: str, *more: str) -> list[str]:
    return [
        "triangulate", str(folder / "mission"), "--trajectory", str(folder / "trajectory.csv"),
        "--out", str(folder / out), "--json", *more,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def report(flown) -> dict:
    folder = flown[0]
    points = ["--points", str(folder / "surveyed/points.csv")]
    measured = ["--measured", str(folder / "surveyed/measured.csv")]
    done = RUN.invoke(app, _settings(folder, "none", *points, *measured))
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_lines_flown_there_and_back_are_tied_to_each_other(report) -> None:
    t = report["triangulation"]
    assert (t["exposures"], t["lines"]) == (EACH * LINES, LINES)
    assert t["matches_across"] > 100 and t["matches_along"] > 500
    assert t["rays"]["3"] > 50


def test_check_points_err_as_predicted_and_matching_by_hundredths_of_a_pixel(report) -> None:
    t = report["triangulation"]
    assert max(t["image_rms_px"]) < 0.05
    assert t["checks"]["count"] == 12 and t["control"]["count"] == 6
    assert max(t["checks"]["rms_px"][:2]) < 0.3
    for rms, predicted in zip(t["checks"]["rms_m"], t["checks"]["predicted_m"], strict=True):
        assert rms < 2.0 * predicted
    assert t["systematic_most_um"] < 1.0


def test_a_point_measured_in_one_image_is_found_in_the_others(flown) -> None:
    folder = flown[0]
    block = block_of(Mission.open(folder / "mission"), trajectory_file=folder / "trajectory.csv")
    tables = (folder / "surveyed/points.csv", folder / "surveyed/measured.csv")
    every = read_measured_points(block.names, block.frame, *tables)
    _, first = np.unique(every.point, return_index=True)
    alone = replace(
        every, image=every.image[first], point=every.point[first], px=every.px[first],
        sigma_px=every.sigma_px[first],
    )  # fmt: skip
    found = transferred(block, alone, BlockMatching())
    at = {(i, p): px for i, p, px in zip(every.image, every.point, every.px, strict=True)}
    new = slice(len(first), None)
    pairs = list(zip(found.image[new], found.point[new], found.px[new], strict=True))
    # Each was measured by hand with 0.05 px, in all images that show it well inside.
    errors = np.array([px - at[i, p] for i, p, px in pairs if (i, p) in at])
    assert len(errors) > 0.6 * (len(every.point) - len(first))
    assert np.sqrt(np.mean(errors**2)) < 0.15 and np.abs(errors).max() < 0.6
    assert len(set(zip(found.image, found.point, strict=True))) == len(found.image)
    has_more = np.isin(np.arange(len(every.names)), found.point[new])
    expected_m = np.hypot(0.02, 0.05 * block.gsd_m)
    assert found.sigma_m[has_more, :2] == pytest.approx(expected_m, rel=0.05)
    assert found.sigma_m[:, 2] == pytest.approx(every.sigma_m[:, 2])


def test_nothing_is_wrong_with_a_good_block_and_its_drifts_are_small(report) -> None:
    t = report["triangulation"]
    assert t["findings"] == []
    drifts = {one["name"]: one for one in t["drifts"]}
    assert abs(drifts["time offset"]["value"]) < 4.0 * drifts["time offset"]["sigma"]
    assert "time offset per hour" in drifts
    # One flying height, and no probe: neither is estimated.
    assert not {n for n in drifts if n.startswith("principal") or n.endswith("per K")}


def test_a_strip_alone_a_failed_height_model_and_a_cut_flight_are_named(
    flown, tmp_path: Path
) -> None:
    mission = tmp_path / "mission"
    shutil.copytree(flown[0] / "mission", mission)
    for number in range(EACH + 1, 2 * EACH + 1):
        shutil.rmtree(mission / f"L0/{number:06d}")
    (mission / f"L2/{EACH:06d}/pan.tif").unlink()
    record = mission / f"L0/{EACH - 1:06d}/exposure.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"mark_gps_ns": None}))
    (mission / "model.asc").write_text("no grid")
    text = (mission / "service.toml").read_text()
    (mission / "service.toml").write_text(
        text + 'elevation = "model.asc"\nelevation_crs = "EPSG:32633"\n'
    )
    done = RUN.invoke(
        app,
        ["triangulate", str(mission), "--trajectory", str(flown[0] / "trajectory.csv"), "--json"],
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    found = {one["name"]: one for one in json.loads(done.stdout)["triangulation"]["findings"]}
    assert found["NO_IMAGE"]["exposures"] == [EACH] and found["NO_GNSS"]["exposures"] == [EACH - 1]
    assert "not processed" in found["NO_IMAGE"]["sentence"]
    assert "lever arm along the camera's x" in found["SINGLE_STRIP"]["sentence"]
    assert "model.asc" in found["HEIGHT_MODEL_FAILED"]["sentence"]


def test_a_drifting_inertial_unit_and_water_are_named_after_landing(flown, tmp_path: Path) -> None:
    mission = tmp_path / "mission"
    shutil.copytree(flown[0] / "mission", mission)
    trajectory = tmp_path / "trajectory.csv"
    lines = (flown[0] / "trajectory.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    first = int(rows[0][0])
    for row in rows:
        row[6] = repr(float(row[6]) + DRIFT_DEG_H * (int(row[0]) - first) * 1e-9 / 3600.0)
    trajectory.write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n")
    path = mission / "L2/000002/pan.tif"
    sea = np.random.default_rng(1).normal(3000.0, 20.0, tifffile.imread(path).shape)
    parts = tiff_parts([sea.astype(np.uint16) & 0xFFFE], {"bands": ["pan"]})
    path.write_bytes(b"".join(bytes(p) for p in parts))
    done = RUN.invoke(app, ["triangulate", str(mission), "--trajectory", str(trajectory), "--json"])
    assert done.exit_code == 0, done.output + str(done.exception)
    t = json.loads(done.stdout)["triangulation"]
    found = {one["name"]: one for one in t["findings"]}
    assert found["UNTIED_EXPOSURES"]["exposures"] == [2]
    assert "ATTITUDE_DRIFT" in found
    drifts = {one["name"]: one for one in t["drifts"]}
    heading = abs(drifts["attitude about the camera's z per hour"]["value"])
    assert heading == pytest.approx(1e3 * DRIFT_DEG_H, rel=0.2)


def test_adjusted_orientations_are_those_of_the_true_camera(flown, report) -> None:
    folder, world, flight, marks = flown
    rows = [
        line.split(",")
        for line in (folder / "none/exterior.csv").read_text().splitlines()
        if line.startswith("0")
    ]
    assert len(rows) == len(marks)
    frame = LocalFrame(world.flight.plan.latitude_deg, world.flight.plan.longitude_deg)
    for row, mark in zip(rows, marks, strict=True):
        pose = flight.pose(mark)
        truth = flight.geodetic(true_camera.image_centre_m(world.rig, pose))
        found = frame.from_geodetic(float(row[7]), float(row[8]), np.array(float(row[3])))
        expected = frame.from_geodetic(*(np.array(v) for v in truth))
        sigma = np.array([float(v) for v in row[9:12]])
        assert (np.abs(found - expected) < 5.0 * sigma + 0.02).all(), row[0]


def test_the_result_is_a_project_that_adjusts_again(flown, report) -> None:
    folder = flown[0]
    again = read_project(folder / "none/project.toml")
    assert len(again.network.images.names) == EACH * LINES
    page = (folder / "none/report.html").read_text()
    assert "RMSE" in page and "Mean image residuals" in page and "checks, RMS" in page
    twice = RUN.invoke(app, _settings(folder, "none"))
    assert twice.exit_code != 0


def test_control_without_its_places_in_the_images_is_refused_with_the_cure(flown) -> None:
    folder = flown[0]
    done = RUN.invoke(
        app, _settings(folder, "half", "--points", str(folder / "surveyed/points.csv"))
    )
    assert done.exit_code != 0 and "--measured go together" in str(done.exception)


def test_a_local_frame_is_true_to_length_and_comes_back() -> None:
    frame = LocalFrame(47.0, 15.0)
    places = np.array([[0.0, 0.0, 400.0], [3000.0, -2000.0, 500.0]])
    back = frame.to_geodetic(places)
    assert frame.from_geodetic(*back.T) == pytest.approx(places, abs=1e-6)
    _, _, length = pyproj.Geod(ellps="WGS84").inv(back[0, 1], back[0, 0], back[1, 1], back[1, 0])
    # On the ellipsoid, 500 m below: shorter by 500 / 6378000 of 3606 m.
    assert length == pytest.approx(np.hypot(3000, 2000) * (1 - 500 / 6.378e6), abs=0.01)


def test_a_triangulated_block_yields_the_boresight(flown, report, tmp_path: Path) -> None:
    folder = flown[0]
    arguments = [
        "calibrate", "boresight", str(folder / "none"), "--mission", str(folder / "mission"),
        "--trajectory", str(folder / "trajectory.csv"), "--out", str(tmp_path / "b"), "--json",
        "--hold", "lever", "--position-sigma", "0.05", "0.05", "0.05",
        "--attitude-sigma", "5", "5", "5",
    ]  # fmt: skip
    done = RUN.invoke(app, arguments)
    assert done.exit_code == 0, done.output + str(done.exception)
    found = {(q["where"], q["what"]): q for q in json.loads(done.stdout)["quantities"]}
    # The emulated unit is aligned with the camera, its clock is right, both heights agree.
    for key in (("boresight", "roll"), ("boresight", "pitch"), ("boresight", "heading")):
        assert abs(found[key]["value"]) < 4.5 * found[key]["sigma"] < 0.2, key
    assert abs(found["time", "offset"]["value"]) < 4.5 * found["time", "offset"]["sigma"]
    assert found["lever arm", "down"]["sigma"] is None
    up = found["position shift", "up"]
    assert abs(up["value"]) < 4.5 * up["sigma"]


@pytest.mark.trust
def test_images_and_records_that_cannot_be_read_are_left_out_and_listed(flown, tmp_path) -> None:
    mission = tmp_path / "mission"
    shutil.copytree(flown[0] / "mission", mission)
    for number in (7, 8):
        shutil.rmtree(mission / f"L0/{number:06d}")
    image = mission / "L2/000003/pan.tif"
    image.write_bytes(image.read_bytes()[:-2])
    image = mission / "L2/000004/pan.tif"
    image.unlink()
    image.mkdir()
    (mission / "L0/000006/exposure.json").write_text('{"number": "6"}')
    where = ["--trajectory", str(flown[0] / "trajectory.csv"), "--json"]
    done = RUN.invoke(app, ["triangulate", str(mission), *where])
    assert done.exit_code == 1, done.output
    report = json.loads(done.stdout)
    assert report["triangulation"]["exposures"] == 3
    causes = {failure["exposure"]: failure["cause"] for failure in report["failures"]}
    assert set(causes) == {3, 4, 6}
    assert "pixels" in causes[3] and "Is a directory" in causes[4] and "number" in causes[6]
    assert "3 exposures failed" in done.stderr
    exterior = (Path(report["folder"]) / "exterior.csv").read_text()
    assert "000005" in exterior and "000003" not in exterior


@pytest.mark.trust
def test_a_block_is_not_begun_while_another_process_writes_into_the_mission(flown) -> None:
    mission = Mission.open(flown[0] / "mission")
    command = ["triangulate", str(mission.path), "--trajectory", str(flown[0] / "trajectory.csv")]
    with mission.held(), pytest.raises(MissionError, match="is held by another process"):
        RUN.invoke(app, command, catch_exceptions=False)
