"""A flown five-head mission: processed to perspectives, oriented head by head, against truth."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from daemon.cli import app
from daemon.level0 import read_description
from daemon.mission import Mission
from processing.rig import load_rig, shipped_rigs
from sim_hw import camera
from sim_hw.exposures import EPOCH_GPS_NS, FIRST_AFTER_S, write_exposures
from sim_hw.world import World, WorldSettings

pyproj = pytest.importorskip("pyproj", reason="pip install 'syntopic[geodesy]'")
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
    return world, folder


def test_every_head_becomes_an_image_of_its_own(flown) -> None:
    _, folder = flown
    done = RUN.invoke(app, ["process", str(folder / "mission"), "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)["exposures"]
    assert [e["heads"] for e in told] == [["nadir", "5", "7", "8", "19"]] * 4
    for name in ("nadir", "5", "7", "8", "19"):
        path = folder / "mission/L2/000001" / f"{name}.tif"
        planes, about = tifffile.imread(path), read_description(path)
        assert planes.shape == (3, 278, 416) and about["bands"] == ["red", "green", "blue"]
        seen = (planes > 0).all(axis=0)
        assert seen.mean() > 0.9 and planes[:, seen].std() > 100.0
        assert about["geometry"].startswith("strict perspective")


def test_every_head_is_oriented_where_it_truly_looked(flown) -> None:
    world, folder = flown
    asked = ["orient", str(folder / "mission"), "--trajectory", str(folder / "trajectory.csv")]
    done = RUN.invoke(app, [*asked, "--json"])
    assert done.exit_code == 0, done.output
    told = {eo["image"]: eo for eo in json.loads(done.stdout)["oriented"]}
    assert len(told) == EXPOSURES * LINES * 5
    rig = load_rig(Mission.open(folder / "mission").rig_path)
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    crs = json.loads(done.stdout)["crs"].split(" ")[0]
    to_grid = pyproj.Transformer.from_crs("EPSG:4979", crs, always_xy=True)
    for name, eo in told.items():
        cone = rig.cone(name.split("_")[1])
        pose = flight.pose(int(eo["gps_ns"]))
        latitude, longitude, height = flight.geodetic(camera.projection_centre_m(cone, pose))
        east, north, up = to_grid.transform(longitude, latitude, height)
        off = np.array([east - eo["east_m"], north - eo["north_m"], up - eo["height_m"]])
        assert np.abs(off).max() < 0.3, "five standard deviations of the trajectory"
        # Where the middle of the head's image meets the ground.
        truth = pose.enu_from_body @ camera.BODY_FROM_CAMERA @ world.camera.master_from_cone(cone)
        omega, phi, kappa = np.radians(eo["omega_phi_kappa_deg"])
        found = camera.rotation_opk((omega, phi, kappa))
        axis = found[:, 2] @ truth[:, 2]
        # The grid turns by its convergence; the angle off the vertical stays but for the curvature.
        assert np.degrees(np.arccos(min(1.0, axis))) < 1.0
        assert abs(np.degrees(np.arccos(found[2, 2]) - np.arccos(truth[2, 2]))) < 0.05


def test_the_second_line_is_flown_back_beside_the_first(flown) -> None:
    world, folder = flown
    records = [
        json.loads((folder / f"mission/L0/{k:06d}/exposure.json").read_text()) for k in (1, 2, 3, 4)
    ]
    assert [r["line_id"] for r in records] == ["line 1", "line 1", "line 2", "line 2"]
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    places = [flight.pose(int(r["mark_gps_ns"])).position_enu_m for r in records]
    apart = np.linalg.norm((places[3] - places[0])[:2])
    assert apart == pytest.approx(world.flight.plan.line_spacing_m, rel=0.1)
    headings = [flight.pose(int(r["mark_gps_ns"])).heading_rad for r in records]
    assert abs(abs(headings[2] - headings[0]) - np.pi) < 0.1
