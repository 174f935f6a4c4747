"""A flown five-head mission: processed to perspectives, oriented head by head, against truth."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyproj
import pytest
import tifffile
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.process import as_flown
from daemon.configuration.model import PlanSection, ProcessingSection
from daemon.mission.exposure import NavigationRecord, exposure_bytes
from daemon.mission.layout import Mission
from daemon.mission.store import store
from daemon.mission.store.level0 import read_description
from daemon.onboard.capture.frame_ring import FrameRing
from daemon.onboard.pipeline import worker
from daemon.onboard.service.messages import (
    BeginProcessing,
    FramesRead,
    Process,
    Processed,
    Stop,
    VerdictReady,
    WorkerBuilt,
    WorkerReady,
    WorkerSettings,
)
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.replay.flight_replay import ReplayResult
from daemon.postflight.triangulation.matching_work import match_mission_block
from daemon.postflight.triangulation.triangulation import (
    TriangulationError,
    TriangulationSettings,
    block_of,
    project_of,
    weight_by_residuals,
)
from processing.bundle.adjust import adjust
from processing.bundle.camera_orientations import camera_orientations
from processing.bundle.initial_values import completed
from processing.geometry.rotation import vectors_from_rotations
from processing.matching.block_matching import BlockMatching
from processing.rig import load_rig, shipped_rigs
from sim_hw.processes.exposures import EPOCH_GPS_NS, FIRST_AFTER_S, write_exposures
from sim_hw.world import true_camera
from sim_hw.world.world import World, WorldSettings
from tests.daemon.orientation.oblique_ground import CRS, hill, seen_pixels

RUN = CliRunner()
EXPOSURES, LINES = 2, 2


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> tuple[World, Path]:
    """Four exposures on two lines by a still smaller sibling of the rig, with distorting lenses."""
    folder = tmp_path_factory.mktemp("oblique")
    text = shipped_rigs()["midas-mini"].read_text()
    text = text.replace("width_px = 1248", "width_px = 416")
    text = text.replace("height_px = 832", "height_px = 278")
    text = re.sub(
        r"^f_number = .*$", "f_number = 4.0\nk1 = -5e-4\nk2 = 1e-5", text, flags=re.MULTILINE
    )
    (folder / "rig.toml").write_text(text)
    world = World(
        WorldSettings(
            rig_file=str(folder / "rig.toml"),
            seed=3,
            epoch_gps_ns=EPOCH_GPS_NS,
            exposures=EXPOSURES,
        )
    )
    write_exposures(world, folder, count=EXPOSURES, scenes=folder / "scenes", lines=LINES)
    done = RUN.invoke(app, ["process", str(folder / "mission"), "--json"])
    assert done.exit_code == 0, done.output
    output = json.loads(done.stdout)["exposures"]
    assert [e["heads"] for e in output] == [["nadir", "5", "7", "8", "19"]] * 4
    # The calibration of the paper is of 2008; the emulated rig's is not.
    assert not any("CALIBRATION_EXPIRED" in e["flags"] for e in output)
    return world, folder


def test_every_head_becomes_an_image_of_its_own(flown) -> None:
    _, folder = flown
    for name in ("nadir", "5", "7", "8", "19"):
        path = folder / "mission/L2/000001" / f"{name}.tif"
        planes, about = tifffile.imread(path), read_description(path)
        assert planes.shape == (3, 278, 416) and about["bands"] == ["red", "green", "blue"]
        seen = (planes > 0).all(axis=0)
        assert seen.mean() > 0.9 and planes[:, seen].std() > 100.0
        assert about["geometry"].startswith("strict perspective")


class _Link:
    """The worker's end of a link: one exposure from memory, then the end."""

    def __init__(self, *orders: object) -> None:
        self.orders, self.received = [*orders, Stop()], []

    def receive(self, *, timeout_s: float) -> object:
        return self.orders.pop(0)

    def send(self, message: object) -> None:
        self.received.append(message)


def test_the_onboard_worker_makes_every_head_and_its_orientation_as_exposures_come(
    flown, tmp_path: Path
) -> None:
    world, folder = flown
    mission = Mission.open(shutil.copytree(folder / "mission", tmp_path / "flown"))
    shutil.rmtree(mission.level2_root)
    rig = load_rig(mission.rig_path)
    frames, exposure = store.load_level0(mission.level0(2), rig)
    rings = tuple(FrameRing.create(name, 2, frame.nbytes) for name, frame in frames.items())
    for ring in rings:
        ring.frame(1, *frames[ring.head].shape)[:] = frames[ring.head]
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    pose = flight.pose(exposure.mark_gps_ns)
    latitude, longitude, height = flight.geodetic(pose.position_enu_m)
    east, north, up = pose.velocity_enu_mps
    navigation = NavigationRecord(
        receiver="gnss",
        gps_ns=exposure.mark_gps_ns,
        method="interpolated",
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        horizontal_sigma_m=0.02,
        vertical_sigma_m=0.03,
        velocity_ned_mps=(north, east, -up),
        speed_sigma_mps=0.01,
        roll_rad=pose.roll_rad,
        pitch_rad=pose.pitch_rad,
        heading_rad=pose.heading_rad,
    )
    exposure = replace(exposure, navigation=navigation)
    plan = PlanSection(ground_height_m=395.0)
    settings = WorkerSettings(
        str(mission.rig_path), as_flown(mission, None)[1], None, plan, ProcessingSection()
    )
    link = _Link(BeginProcessing(mission.path), Process(exposure, dict.fromkeys(frames, 1)))
    worker.main(link, settings, rings)
    received = [type(message) for message in link.received]
    assert received == [WorkerBuilt, WorkerReady, FramesRead, VerdictReady, Processed]
    flown_folder, again = mission.level2(2), folder / "mission/L2/000002"
    for name in ("nadir.tif", "5.tif", "7.tif", "8.tif", "19.tif", "quicklook.jpg"):
        assert (flown_folder / name).read_bytes() == (again / name).read_bytes()
    report = json.loads((flown_folder / "quality.json").read_text())
    assert report["heads"] == ["nadir", "5", "7", "8", "19"]
    assert report["verdict"] in ("good", "usable") and report["figures"]["tilt_deg"] < 3.0
    # An exposure time of the plan leaves a third of a pixel or so under the nadir head.
    assert 0.05 < report["figures"]["smear_along_px"] < 1.0
    output = json.loads((flown_folder / "orientation.json").read_text())
    assert [head["cone"] for head in output["heads"]] == report["heads"]
    for head in output["heads"]:
        cone = rig.cone(head["cone"])
        there = flight.geodetic(true_camera.projection_centre_m(cone, pose))
        place = (head["latitude_deg"], head["longitude_deg"], head["height_m"])
        assert np.abs(np.subtract(there, place) * [111_000, 111_000, 1]).max() < 0.002
        truth = (
            pose.enu_from_body @ true_camera.BODY_FROM_CAMERA @ world.camera.master_from_cone(cone)
        )
        rotation = true_camera.rotation_opk(np.radians(head["omega_phi_kappa_deg"])).T @ truth
        # The emulated mounting is off by 20 urad about each axis.
        assert np.abs(rotation - np.eye(3)).max() < 2e-4, cone.name
        ground = np.array(head["footprint"]) - [longitude, latitude]
        assert (ground[:, 1].min() > 0.02) == (cone.name == "5"), "the head that looks ahead"


def test_a_flight_over_a_height_model_is_replayed_with_the_model_from_elsewhere(
    flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world, folder = flown
    mission = Mission.open(shutil.copytree(folder / "mission", tmp_path / "flown"))
    text = mission.service_path.read_text().replace(
        "[plan]", f'[plan]\nelevation = "terrain.asc"\nelevation_crs = "{CRS}"'
    )
    rest = 'root = "."\nrig = "rig.toml"\n\n[trigger]\ndriver = "t"\n\n[[head]]\nsensor = "nadir"\n'
    mission.service_path.write_text(text + rest + 'driver = "h"\n')
    # What the log would give again: one sealed exposure with its position.
    _, exposure = store.load_level0(mission.level0(2), load_rig(mission.rig_path))
    here = world.flight.geodetic(np.zeros(3))
    navigation = NavigationRecord(
        receiver="gnss",
        gps_ns=exposure.mark_gps_ns,
        method="interpolated",
        latitude_deg=here[0],
        longitude_deg=here[1],
        height_m=here[2] + 1000.0,
        horizontal_sigma_m=0.02,
        vertical_sigma_m=0.03,
        velocity_ned_mps=(60.0, 0.0, 0.0),
        speed_sigma_mps=0.01,
        roll_rad=0.0,
        pitch_rad=0.0,
        heading_rad=0.0,
    )
    exposure = replace(exposure, navigation=navigation)
    (mission.level0(2) / "exposure.json").write_bytes(exposure_bytes(exposure))
    (mission.path / "log").mkdir()
    (mission.path / "log" / "1.mcap").touch()
    again = {"records": [exposure], "is_complete": True}
    monkeypatch.setattr(
        "daemon.postflight.replay.flight_replay.replay_log", lambda *_: ReplayResult(**again)
    )
    models = [hill(tmp_path / f"{top}.asc", here, top) for top in (150.0, 300.0)]
    shutil.rmtree(mission.level2_root)
    flown_with = ["process", str(mission.path), "--only", "2", "--elevation", str(models[0])]
    assert RUN.invoke(app, flown_with).exit_code == 0
    arguments = ["replay", str(mission.path), "--parallel", "1", "--json"]
    without = RUN.invoke(app, arguments)
    assert without.exit_code != 0 and "give --elevation FILE" in str(without.exception)
    output = [
        json.loads(RUN.invoke(app, [*arguments, "--elevation", str(model)]).stdout)
        for model in models
    ]
    assert output[0]["agrees"], output[0]["sentences"]
    assert output[1]["sentences"] == ["L2/000002/quality.json: differs with 1 in work"]


def test_obliques_of_the_same_direction_are_tied_where_both_see_the_same_ground(flown) -> None:
    world, folder = flown
    mission = Mission.open(folder / "mission")
    trajectory = folder / "trajectory.csv"
    block = block_of(mission, crs=CRS, trajectory_file=trajectory, heads=("5", "8"))
    tied = match_mission_block(block, BlockMatching(cells=(14, 10)))
    assert len(block.names) == EXPOSURES * LINES * 2 and tied.points > 100
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    places, rotations = [], []
    for eo in block.oriented:
        pose, cone = flight.pose(eo.gps_ns), world.rig.cone(eo.cone)
        places.append(true_camera.projection_centre_m(cone, pose))
        own = world.camera.master_from_cone(cone)
        rotations.append(pose.enu_from_body @ true_camera.BODY_FROM_CAMERA @ own)
    ground: dict[int, np.ndarray] = {}
    errors = []
    middle = np.array([block.image.width_px - 1, block.image.height_px - 1]) / 2
    for k, point, px in zip(tied.image, tied.point, tied.px, strict=True):
        if point not in ground:
            x, y = (px - middle) * block.image.pitch_mm
            ray = rotations[k] @ np.array([x, -y, -block.image.f_mm])
            ground[point] = world.terrain.intersect(places[k], ray[None])[0]
            continue
        seen = rotations[k].T @ (ground[point] - places[k])
        at = -block.image.f_mm / seen[2] / block.image.pitch_mm * seen[:2]
        errors.append(px - middle - at * [1, -1])
    size = np.array(errors)
    assert float(np.sqrt(np.mean(size**2))) < 0.08
    assert float(np.abs(size).max()) < 0.5
    project = project_of(block, tied, TriangulationSettings())
    network = project.network
    assert len(network.stations.names) == EXPOSURES * LINES
    assert [head.name for head in network.heads] == [camera.name for camera in network.cameras]
    done = adjust(completed(weight_by_residuals(project, tied.points).network), project.settings)
    adjusted = camera_orientations(done)
    between = [
        a.T @ b for a, b in zip(adjusted.rotation[::2], adjusted.rotation[1::2], strict=True)
    ]
    true = rotations[0].T @ rotations[1]
    assert block.oriented[0].cone == "5" and block.oriented[1].cone == "8"
    assert np.abs(np.array(between) - between[0]).max() < 1e-9, "one rigid body"
    sigma = np.sqrt(done.cofactor.diagonal()[done.layout.head_rotation].max()) * done.sigma0
    off = vectors_from_rotations((true.T @ between[0])[None])[0]
    assert np.abs(off).max() < 4.5 * np.sqrt(2.0) * sigma < 1e-3
    with pytest.raises(TriangulationError, match="same pixels and principal distance"):
        block_of(mission, crs=CRS, trajectory_file=trajectory, heads=("5", "nadir"))
    with pytest.raises(TriangulationError, match="--head"):
        block_of(mission, crs=CRS, trajectory_file=trajectory)


def _oriented(folder: Path) -> dict[str, dict]:
    arguments = ["orient", str(folder / "mission"), "--trajectory", str(folder / "trajectory.csv")]
    done = RUN.invoke(app, [*arguments, "--crs", CRS, "--json"])
    assert done.exit_code == 0, done.output
    return {eo["image"]: eo for eo in json.loads(done.stdout)["oriented"]}


def test_every_head_is_oriented_as_in_the_truth(flown) -> None:
    world, folder = flown
    output = _oriented(folder)
    assert len(output) == EXPOSURES * LINES * 5
    rig = load_rig(Mission.open(folder / "mission").rig_path)
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    to_grid = pyproj.Transformer.from_crs("EPSG:4979", CRS, always_xy=True)
    for name, eo in output.items():
        cone = rig.cone(name.split("_")[1])
        pose = flight.pose(int(eo["gps_ns"]))
        latitude, longitude, height = flight.geodetic(true_camera.projection_centre_m(cone, pose))
        east, north, up = to_grid.transform(longitude, latitude, height)
        off = np.array([east - eo["east_m"], north - eo["north_m"], up - eo["height_m"]])
        assert np.abs(off).max() < 0.3, "five standard deviations of the trajectory"
        # Where the middle of the head's image meets the ground.
        truth = (
            pose.enu_from_body @ true_camera.BODY_FROM_CAMERA @ world.camera.master_from_cone(cone)
        )
        omega, phi, kappa = np.radians(eo["omega_phi_kappa_deg"])
        found = true_camera.rotation_opk((omega, phi, kappa))
        axis = found[:, 2] @ truth[:, 2]
        # The grid turns by its convergence; the angle off the vertical stays but for the curvature.
        assert np.degrees(np.arccos(min(1.0, axis))) < 1.0
        assert abs(np.degrees(np.arccos(found[2, 2]) - np.arccos(truth[2, 2]))) < 0.05


def test_the_second_line_is_flown_back_next_to_the_first(flown) -> None:
    world, folder = flown
    records = [
        json.loads((folder / f"mission/L0/{k:06d}/exposure.json").read_text()) for k in (1, 2, 3, 4)
    ]
    assert [r["line_id"] for r in records] == ["line 1", "line 1", "line 2", "line 2"]
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    places = [flight.pose(int(r["mark_gps_ns"])).position_enu_m for r in records]
    distance_m = np.linalg.norm((places[3] - places[0])[:2])
    assert distance_m == pytest.approx(world.flight.plan.line_spacing_m, rel=0.1)
    headings = [flight.pose(int(r["mark_gps_ns"])).heading_rad for r in records]
    assert abs(abs(headings[2] - headings[0]) - np.pi) < 0.1


def _exported(folder: Path, kind: str) -> Path:
    arguments = ["export", "pictures", str(folder / "mission"), "--as", kind, "--only", "2"]
    done = RUN.invoke(
        app, [*arguments, "--trajectory", str(folder / "trajectory.csv"), "--crs", CRS, "--json"]
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    output = json.loads(done.stdout)
    assert len(output["files"]) == 5
    return Path(output["folder"])


def test_exiftool_reads_time_place_and_attitude_of_a_picture(flown) -> None:
    _, folder = flown
    pictures = _exported(folder, "jpeg")
    if shutil.which("exiftool") is None:
        pytest.skip("exiftool is not here; apt-get install libimage-exiftool-perl")
    output = json.loads(
        subprocess.run(
            ["exiftool", "-json", "-n", str(pictures / "000002_7.jpg")],
            capture_output=True, check=True, timeout=60,
        ).stdout
    )[0]  # fmt: skip
    eo = _oriented(folder)["000002_7"]
    assert "Warning" not in output
    to_wgs = pyproj.Transformer.from_crs(CRS, "EPSG:4979", always_xy=True)
    longitude, latitude, height = to_wgs.transform(eo["east_m"], eo["north_m"], eo["height_m"])
    assert output["GPSLatitude"] == pytest.approx(latitude, abs=1e-8)
    assert output["GPSLongitude"] == pytest.approx(longitude, abs=1e-8)
    assert output["GPSAltitude"] == pytest.approx(height, abs=1e-3)
    assert output["FocalLength"] == 51.0
    assert 10.0 / output["FocalPlaneXResolution"] == pytest.approx(7.2e-3)
    assert [output["Omega"], output["Phi"], output["Kappa"]] == pytest.approx(
        eo["omega_phi_kappa_deg"], abs=1e-6
    )
    # The head looks right, 44.2 deg off the vertical: that is roll, seen from its own camera.
    assert abs(abs(output["Roll"]) - 44.2) < 3.0 or abs(abs(output["Pitch"]) - 44.2) < 3.0
    instant = datetime(1980, 1, 6, tzinfo=UTC) + timedelta(
        microseconds=int(eo["gps_ns"]) // 1000, seconds=-18
    )
    assert output["DateTimeOriginal"] == instant.strftime("%Y:%m:%d %H:%M:%S")
    assert output["Model"].startswith("Track'Air MIDAS") and output["ImageUniqueID"] == "000002_7"
    assert "SIMULATED" in output["ImageDescription"]


def test_a_cog_has_tiles_overviews_tags_and_the_place_of_its_footprint(flown) -> None:
    rasterio = pytest.importorskip("rasterio", reason="pip install 'syntopic[geotiff]'")
    _, folder = flown
    eo = _oriented(folder)["000002_5"]
    with rasterio.open(_exported(folder, "cog") / "000002_5.tif") as raster:
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert (raster.width, raster.height, raster.count) == (416, 278, 3)
        assert raster.descriptions == ("red", "green", "blue")
        points, crs = raster.gcps
        assert crs.to_epsg() == int(CRS.split(":")[1]) and len(points) == 25
        middle = next(p for p in points if (p.col, p.row) == (208.0, 139.0))
        # Forward head, 44.96 deg off the vertical: as far ahead as it is high.
        height = eo["height_m"] - 395.0
        reach = np.hypot(middle.x - eo["east_m"], middle.y - eo["north_m"])
        assert reach == pytest.approx(height * np.tan(np.radians(44.96)), rel=0.15)
        assert abs(middle.z - 395.0) < 1.0
        assert raster.tags()["PRINCIPAL_DISTANCE_MM"] == "51.000000"
        pixels = raster.read(1)
    plain = tifffile.imread(folder / "mission/L2/000002/5.tif")[0]
    assert (pixels == (plain & 0xFFFE)).all(), "lossless"


def test_every_head_is_certified_with_axes_and_signs(flown) -> None:
    _, folder = flown
    done = RUN.invoke(app, ["export", "certificate", str(folder / "mission"), "--json"])
    assert done.exit_code == 0, done.output
    output = json.loads(done.stdout)
    assert [c["name"] for c in output["cameras"]] == ["nadir", "5", "7", "8", "19"]
    assert output["cameras"][1]["principal_distance_mm"] == 51.0
    assert output["cameras"][1]["pixel_size_um"] == 7.2
    assert output["simulated"] and "the camera looks along -z" in output["axes"]
    page = (folder / "mission/export/certificate.html").read_text()
    assert "SIMULATED" in page and "Axes and signs" in page


def test_footprints_follow_a_height_model(flown, tmp_path: Path) -> None:
    _, folder = flown
    eo = _oriented(folder)["000001_5"]
    # A slope that rises by a tenth to the north, through 395 m below the camera.
    cell, rows = 50.0, 400
    x0, y0 = eo["east_m"] - 10_000.0, eo["north_m"] - 10_000.0
    north = y0 + (rows - 0.5 - np.arange(rows)) * cell
    heights = np.repeat((395.0 + 0.1 * (north - eo["north_m"]))[:, None], rows, axis=1)
    dem = tmp_path / "slope.asc"
    head = f"ncols {rows}\nnrows {rows}\nxllcorner {x0}\nyllcorner {y0}\ncellsize {cell}\n"
    dem.write_text(head + "\n".join(" ".join(f"{v:.3f}" for v in row) for row in heights))
    arguments = ["orient", str(folder / "mission"), "--trajectory", str(folder / "trajectory.csv")]
    done = RUN.invoke(app, [*arguments, "--crs", CRS, "--dem", str(dem), "--json"])
    assert done.exit_code == 0, done.output + str(done.exception)
    written = Path(json.loads(done.stdout)["folder"]) / "footprints.geojson"
    features = {f["properties"]["image"]: f for f in json.loads(written.read_text())["features"]}
    assert len(features) == EXPOSURES * LINES * 5
    ring = np.array(features["000001_5"]["geometry"]["coordinates"][0])
    assert len(ring) == 33 and (ring[0] == ring[-1]).all()
    to_grid = pyproj.Transformer.from_crs("EPSG:4326", CRS, always_xy=True)
    _, n = to_grid.transform(ring[:, 0], ring[:, 1])
    # The upper middle of the forward head's image, 46 deg off the vertical, meets the slope.
    omega, phi, kappa = np.radians(eo["omega_phi_kappa_deg"])
    ray = true_camera.rotation_opk((omega, phi, kappa)) @ np.array([0.0, 278 * 7.2e-3 / 2, -51.0])
    fall = eo["height_m"] - 395.0
    reach = fall / (-ray[2] + 0.1 * ray[1])
    assert n.max() == pytest.approx(eo["north_m"] + reach * ray[1], abs=8.0)
    wrong = RUN.invoke(app, [*arguments, "--crs", CRS, "--dem", str(folder / "trajectory.csv")])
    assert wrong.exit_code != 0


def test_intersected_points_err_as_their_sigmas_say(flown, tmp_path: Path) -> None:
    world, folder = flown
    rig = load_rig(Mission.open(folder / "mission").rig_path)
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    random = np.random.default_rng(8)
    poses = {eo["image"]: flight.pose(int(eo["gps_ns"])) for eo in _oriented(folder).values()}
    truth, lines = {}, ["image,point,column_px,row_px,sigma_px"]
    for name, pose in poses.items():
        # Rays of the first exposure of each line, followed to the true terrain.
        if not name.startswith(("000001", "000003")):
            continue
        cone = rig.cone(name.split("_")[1])
        for k in range(6):
            xy = random.uniform(-0.4, 0.4, 2) * [416 * 7.2e-3, 278 * 7.2e-3]
            rotation = (
                pose.enu_from_body
                @ true_camera.BODY_FROM_CAMERA
                @ world.camera.master_from_cone(cone)
            )
            ray = rotation @ np.array([*xy, -cone.lens.f_mm])
            ground = world.terrain.intersect(true_camera.projection_centre_m(cone, pose), ray)
            seen = [
                row
                for row in (seen_pixels(world, rig, n, p, ground) for n, p in poses.items())
                if row
            ]
            if len({row[0][:6] for row in seen}) < 2:
                continue
            point = f"{name}-{k}"
            truth[point] = ground
            for image, column, row in seen:
                noise = random.normal(0.0, 0.3, 2)
                lines.append(f"{image},{point},{column + noise[0]:.4f},{row + noise[1]:.4f},0.3")
    lines.append("000001_5,alone,100,100,0.3")
    (tmp_path / "measured.csv").write_text("\n".join(lines) + "\n")
    arguments = ["intersect", str(folder / "mission"), str(tmp_path / "measured.csv"), "--json"]
    sigmas = ["--attitude-sigma", "5", "5", "5", "--position-sigma", "0.05", "0.05", "0.05"]
    done = RUN.invoke(app, [*arguments, *sigmas, "--trajectory", str(folder / "trajectory.csv")])
    assert done.exit_code == 0, done.output + str(done.exception)
    output = json.loads(done.stdout)
    assert output["left_out"] == ["alone"] and len(output["points"]) == len(truth) >= 8
    frame = LocalFrame(flight.plan.latitude_deg, flight.plan.longitude_deg)
    ratios = []
    for p in output["points"]:
        place = [np.array(p[k]) for k in ("latitude_deg", "longitude_deg", "height_m")]
        latitude, longitude, height = flight.geodetic(truth[p["name"]])
        expected = frame.from_geodetic(np.array(latitude), np.array(longitude), np.array(height))
        ratios.append((frame.from_geodetic(*place) - expected) / np.array(p["sigma_m"]))
        assert (np.array(p["of_image_m"]) < np.array(p["sigma_m"])).all()
    assert np.abs(ratios).max() < 4.5
    assert 0.2 < np.mean(np.square(ratios)) < 3.0
