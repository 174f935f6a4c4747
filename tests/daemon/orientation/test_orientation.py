"""Orientations of a flight agree with where the emulated camera truly stood and looked.

Truth is the emulator's own flight and ellipsoid; the map projection is PROJ's, asked directly.
"""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest

from daemon.configuration.model import MountSection
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_records import message_of
from daemon.orientation.exterior_orientation import (
    ExteriorOrientation,
    mount_of,
    orient,
    sealed_exposures,
)
from daemon.orientation.geodesy import utm_of
from daemon.orientation.georeference import Georeference, GeoreferenceError
from daemon.orientation.orientation_inputs import OrientationError
from daemon.orientation.trajectory import TrajectoryError, flown_trajectory, read_trajectory
from daemon.postflight.export.orientation_set import export_orientation
from drivers.contract import NavSample
from processing.geometry.rotation import rotation_matrix as r
from processing.rig import load_rig, shipped_rigs
from sim_hw.world.flight import enu_from_body
from sim_hw.world.true_camera import BODY_FROM_CAMERA, projection_centre_m
from tests.daemon.postflight.exchange.flown_block import EPOCH_NS, FLIGHT, PLAN

STEP_NS = 100_000_000
MID_NS = EPOCH_NS + 5_034_567_890
ANTENNA_M = (0.4, -0.2, -1.3)
BORESIGHT_DEG = (0.21, -0.13, 0.35)


def sample_at(gps_ns: int) -> NavSample:
    pose = FLIGHT.pose(gps_ns)
    latitude, longitude, height = FLIGHT.geodetic(pose.position_enu_m)
    roll, pitch, heading = FLIGHT.attitude_rad(pose)
    return NavSample(
        receiver="gnss",
        gps_ns=gps_ns,
        mono_ns=gps_ns - EPOCH_NS,
        fix="3d",
        satellites=12,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        horizontal_sigma_m=0.02,
        vertical_sigma_m=0.03,
        velocity_ned_mps=FLIGHT.velocity_ned_mps(pose),
        speed_sigma_mps=0.02,
        roll_rad=roll,
        pitch_rad=pitch,
        heading_rad=heading,
        leap_seconds=18,
        time_valid=True,
    )


SAMPLES = [sample_at(EPOCH_NS + i * STEP_NS) for i in range(100)]


def mission_at(path: Path, *, mount: str = "", samples: list[NavSample] = SAMPLES) -> Mission:
    for folder in ("L0/000001", "log", "export"):
        (path / folder).mkdir(parents=True)
    (path / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    (path / "service.toml").write_text(f"[plan]\nground_height_m = 395.0\n{mount}")
    record = {
        "number": 1,
        "mark_gps_ns": str(MID_NS),
        "mark_sigma_ns": 25,
        "mark_source": "event-mark",
        "simulated": True,
        "frames": [{"sensor": "SU10", "mid_exposure_gps_ns": str(MID_NS + 7_000_000)}],
    }
    (path / "L0/000001/exposure.json").write_text(json.dumps(record))
    mission = Mission(path, path.name)
    log = FlightLog.create(mission.log_dir)
    for sample in samples:
        log.write(message_of(sample))
    log.close()
    return mission


def master_of(mission: Mission, mount: MountSection | None = None) -> ExteriorOrientation:
    exposure = sealed_exposures(mission).results[1]
    rig = load_rig(mission.rig_path)
    crs = Georeference(utm_of(PLAN.latitude_deg, PLAN.longitude_deg))
    found = orient(exposure, rig, mount or mount_of(mission)[0], flown_trajectory(mission), crs)
    master = next(found)
    assert isinstance(master, ExteriorOrientation)
    return master


def test_ground_points_fall_where_the_true_camera_sees_them(tmp_path: Path) -> None:
    fine = [sample_at(EPOCH_NS + 4_900_000_000 + i * 10_000_000) for i in range(30)]
    eo = master_of(mission_at(tmp_path, samples=fine))
    pose = FLIGHT.pose(MID_NS)
    rig = load_rig(shipped_rigs()["ultracam-x-mini"])
    centre = projection_centre_m(rig.cone(rig.master_cone), pose)
    to_grid = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)
    for offset in ([0, 0], [400, 300], [-350, 420], [300, -400]):
        ground = np.array([centre[0] + offset[0], centre[1] + offset[1], 0.0])
        true_ray = (ground - centre) @ (pose.enu_from_body @ BODY_FROM_CAMERA)
        latitude, longitude, height = FLIGHT.geodetic(ground)
        point = np.array(to_grid.transform(longitude, latitude, height))
        ray = eo.rotation.T @ (point - eo.centre_m)
        seen = true_ray[:2] / -true_ray[2]
        # The grid's scale is 1 within 1e-4 here, which is felt away from the nadir.
        assert ray[:2] / -ray[2] == pytest.approx(seen, rel=1e-4, abs=2e-6)


def test_each_cone_has_the_pose_of_its_own_mid_exposure(tmp_path: Path) -> None:
    done = export_orientation(mission_at(tmp_path))
    by_cone = {eo.cone: eo for eo in done.oriented}
    assert by_cone["1"].gps_ns == MID_NS + 7_000_000
    assert by_cone["0"].gps_ns == MID_NS
    moved = by_cone["1"].centre_m - by_cone["0"].centre_m
    rig_offset_m = 0.08  # cones 0 and 1 are 8 cm apart along the body
    assert float(np.linalg.norm(moved)) == pytest.approx(60.0 * 0.007 + rig_offset_m, abs=0.03)


def test_lever_arm_and_boresight_are_applied(tmp_path: Path) -> None:
    """Samples of an antenna and a tilted inertial unit give the orientation of plain ones."""
    plain = master_of(mission_at(tmp_path / "plain"))
    boresight = enu_to_ned(enu_from_body(*np.radians(BORESIGHT_DEG)))
    seen = []
    for sample in SAMPLES:
        pose = FLIGHT.pose(sample.gps_ns)
        antenna = pose.position_enu_m + pose.enu_from_body @ np.array(ANTENNA_M)
        level_from_imu = enu_to_ned(enu_from_body(*FLIGHT.attitude_rad(pose))) @ boresight.T
        latitude, longitude, height = FLIGHT.geodetic(antenna)
        roll, pitch, heading = angles_of(level_from_imu)
        seen.append(
            replace(
                sample,
                latitude_deg=latitude,
                longitude_deg=longitude,
                height_m=height,
                roll_rad=roll,
                pitch_rad=pitch,
                heading_rad=heading,
            )
        )
    mount = f"[mount]\nantenna_m = {list(ANTENNA_M)}\nboresight_deg = {list(BORESIGHT_DEG)}\n"
    found = master_of(mission_at(tmp_path / "mounted", mount=mount, samples=seen))
    # Velocity at the antenna omits the rates of the body, so the position between two samples is
    # a few millimetres off.
    assert found.centre_m == pytest.approx(plain.centre_m, abs=0.01)
    assert found.rotation == pytest.approx(plain.rotation, abs=1e-7)


def enu_to_ned(matrix: np.ndarray) -> np.ndarray:
    return np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]) @ matrix


def angles_of(level_from_imu: np.ndarray) -> tuple[float, float, float]:
    return (
        math.atan2(level_from_imu[2, 1], level_from_imu[2, 2]),
        -math.asin(level_from_imu[2, 0]),
        math.atan2(level_from_imu[1, 0], level_from_imu[0, 0]) % (2 * math.pi),
    )


def test_true_north_in_the_grid_is_what_proj_calls_convergence() -> None:
    georeference = Georeference("EPSG:32633")
    factors = pyproj.Proj("EPSG:32633").get_factors(17.37, 47.07)
    place = georeference.place(47.07, 17.37, 400.0)
    assert math.degrees(place.azimuth_of_north_rad) == pytest.approx(
        -factors.meridian_convergence, abs=1e-6
    )
    assert place.scale == pytest.approx(factors.meridional_scale, abs=1e-8)
    assert place.height_m == 400.0


def test_the_files_say_the_same_in_their_own_words(tmp_path: Path) -> None:
    done = export_orientation(mission_at(tmp_path))
    assert done.crs.startswith("EPSG:32"), "the system that was chosen is named"
    lines = (done.folder / "orientation.csv").read_text().splitlines()
    assert "# SIMULATED: emulated hardware, no survey" in lines
    assert any(
        re.match(r"# coordinate system: EPSG:32633 \(WGS 84 / UTM zone 33N\)", x) for x in lines
    )
    rows = list(csv.DictReader(x for x in lines if not x.startswith("#")))
    assert [row["image"] for row in rows][:2] == ["000001", "000001_1"]
    patb = (done.folder / "orientation.ori").read_text().splitlines()
    assert len(patb) == 3 * len(rows)
    assert int(patb[0][:16]) == 100
    assert float(patb[0][32:48]) == pytest.approx(float(rows[0]["east_m"]), abs=1e-3)
    values = [float(line[i : i + 16]) for line in patb[1:3] for i in range(0, len(line), 16)]
    matrix = np.array(values).reshape(3, 3)
    assert matrix == pytest.approx(done.oriented[0].rotation, abs=1e-11)
    bingo = (done.folder / "orientation.bingo").read_text().split()
    phi, omega, kappa = (float(x) * math.pi / 200 for x in bingo[4:7])
    assert r(0, phi, 0) @ r(omega, 0, 0) @ r(0, 0, kappa) == pytest.approx(matrix, abs=1e-7)
    certificate = json.loads((done.folder / "camera.json").read_text())
    assert certificate["principal_point_mm"] == [0.0, 0.0]
    assert certificate["width_px"] * certificate["pixel_size_um"] == pytest.approx(
        certificate["format_mm"][0] * 1000
    )


def test_footprints_lie_on_the_ground_below(tmp_path: Path) -> None:
    done = export_orientation(mission_at(tmp_path))
    features = json.loads((done.folder / "footprints.geojson").read_text())["features"]
    ring = np.array(features[0]["geometry"]["coordinates"][0])
    assert (ring[0] == ring[-1]).all()
    geod = pyproj.Geod(ellps="WGS84")
    area, _ = geod.polygon_area_perimeter(ring[:, 0], ring[:, 1])
    rig_image = json.loads((done.folder / "camera.json").read_text())
    width_mm, height_mm = rig_image["format_mm"]
    height = done.oriented[0].height_m - 395.0
    flat = width_mm * height_mm * (height / rig_image["principal_distance_mm"]) ** 2
    assert area == pytest.approx(flat, rel=0.02)  # positive: counter-clockwise; tilted by 2 deg
    assert features[0]["properties"]["utc"].startswith("2026-11-21T")


def test_a_grid_that_is_not_installed_is_named() -> None:
    with pytest.raises(GeoreferenceError, match=r"de_bkg_gcg2016\.tif.*pyproj sync --file"):
        Georeference("EPSG:25833+7837")


@pytest.mark.parametrize(
    ("crs", "sentence"),
    [
        ("EPSG:4326", "not projected"),
        ("EPSG:999999", "no coordinate system"),
        ("EPSG:2264", "not m"),
    ],
)
def test_a_system_that_cannot_serve_is_refused(crs: str, sentence: str) -> None:
    with pytest.raises(GeoreferenceError, match=sentence):
        Georeference(crs)


def sbet(samples: list[NavSample], wander_rad: float = 0.0) -> bytes:
    rows = np.zeros((len(samples), 17))
    for row, s in zip(rows, samples, strict=True):
        assert s.heading_rad is not None
        row[0] = (s.gps_ns % 604_800_000_000_000) * 1e-9
        row[1:4] = math.radians(s.latitude_deg), math.radians(s.longitude_deg), s.height_m
        row[7:11] = s.roll_rad, s.pitch_rad, s.heading_rad + wander_rad, wander_rad
    return rows.astype("<f8").tobytes()


def test_a_post_processed_trajectory_is_stored_next_to_the_one_flown(tmp_path: Path) -> None:
    mission = mission_at(tmp_path / "mission")
    fine = [sample_at(EPOCH_NS + i * 5_000_000) for i in range(2000)]
    (tmp_path / "best.out").write_bytes(sbet(fine, wander_rad=0.7))
    in_flight = export_orientation(mission)
    again = export_orientation(mission, trajectory_file=tmp_path / "best.out")
    assert again.folder != in_flight.folder
    assert in_flight.folder.exists()
    assert again.change_m == pytest.approx(0.0, abs=2e-3)
    assert again.change_deg == pytest.approx(0.0, abs=2e-3)
    assert again.oriented[0].centre_m == pytest.approx(in_flight.oriented[0].centre_m, abs=2e-3)


def test_a_csv_trajectory_equals_the_sbet(tmp_path: Path) -> None:
    fine = [sample_at(EPOCH_NS + i * 5_000_000) for i in range(2000)]
    (tmp_path / "t.out").write_bytes(sbet(fine))
    lines = ["gps_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"]
    for s in fine:
        angles = np.degrees([s.roll_rad, s.pitch_rad, s.heading_rad])
        place = (s.latitude_deg, s.longitude_deg, s.height_m)
        lines.append(",".join([str(s.gps_ns), *(repr(float(v)) for v in (*place, *angles))]))
    (tmp_path / "t.csv").write_text("\n".join(lines))
    a = read_trajectory(tmp_path / "t.out", around_gps_ns=MID_NS).at(MID_NS)
    b = read_trajectory(tmp_path / "t.csv", around_gps_ns=MID_NS).at(MID_NS)
    assert a is not None
    assert b is not None
    assert (a.latitude_deg, a.longitude_deg) == pytest.approx(
        (b.latitude_deg, b.longitude_deg), abs=1e-9
    )
    assert a.heading_rad == pytest.approx(b.heading_rad, abs=1e-7)


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("a.out", b"x" * 100, "no whole number of SBET records"),
        ("a.out", b"\xff" * 136 * 3, "no SBET"),
        ("a.csv", b"time,lat\n1,2\n", "has no latitude_deg"),
        ("a.csv", b"\xff\xfe\x00", "UTF-8"),
    ],
)
def test_a_file_that_is_no_trajectory_is_refused_in_a_sentence(
    tmp_path: Path, name: str, data: bytes, sentence: str
) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(TrajectoryError, match=sentence):
        read_trajectory(tmp_path / name, around_gps_ns=MID_NS)


def test_without_attitude_nothing_is_oriented_and_the_cure_is_named(tmp_path: Path) -> None:
    blind = [replace(s, roll_rad=None, pitch_rad=None, heading_rad=None) for s in SAMPLES]
    with pytest.raises(OrientationError, match=r"no attitude.*--trajectory"):
        export_orientation(mission_at(tmp_path, samples=blind))
