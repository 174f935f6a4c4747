"""Files for BINGO, PATB, BLUH, ImageStation and Inpho: each read by its own order and unit."""

from __future__ import annotations

import json

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from daemon.cli import app
from tests.daemon.postflight.exchange.flown_block import FLIGHT, FlownBlock, fly, targets
from tests.daemon.postflight.exchange.test_colmap import SECONDS, export

RUN = CliRunner()
CRS = ("--crs", "EPSG:32633")
to_grid = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> FlownBlock:
    return fly(tmp_path_factory.mktemp("oblique") / "mission", "midas-mini", seconds=SECONDS)


def in_grid(world: np.ndarray) -> np.ndarray:
    places = [FLIGHT.geodetic(point) for point in np.atleast_2d(world)]
    return np.array([to_grid.transform(lon, lat, height) for lat, lon, height in places])


def assert_sees_its_target(flown, head: str, place: np.ndarray, turn: np.ndarray) -> None:
    """That the middle of head's image of exposure 2 is where the emulator sees it."""
    world, centre = targets(flown, head, flown.marks[2], np.array([[623.5, 415.5]]), raw=False)
    assert np.abs(place - in_grid(centre)[0]).max() < 0.001
    ray = (in_grid(world)[0] - place) @ turn
    # A hundredth of a degree: the grid's scale and the curvature over 1500 m.
    assert np.hypot(*(ray[:2] / ray[2])) < 2e-4


def rotation_of(words: list[str], order: str, gon: bool) -> np.ndarray:
    angles = np.array(words, float) * (0.9 if gon else 1.0)
    return Rotation.from_euler(order, angles, degrees=True).as_matrix()


@pytest.mark.parametrize(
    ("program", "more", "order", "gon"),
    [
        ("bingo", (), "YXZ", True),
        ("imagestation", (), "XYZ", False),
        ("bluh", (), "YXZ", True),
        ("bingo", ("--angles", "omega-phi-kappa", "--unit", "deg"), "XYZ", False),
        ("imagestation", ("--unit", "gon"), "XYZ", True),
    ],
)
@pytest.mark.parametrize("head", ["nadir", "5", "7"])
def test_angles_in_the_stated_order_and_unit_are_right(
    flown, program, more, order, gon, head
) -> None:
    _, folder = export(flown, *CRS, *more, to=program)
    rows = [line.split() for line in (folder / f"orientation.{program}").read_text().splitlines()]
    photos = dict(line.split()[:2] for line in (folder / "photos.txt").read_text().splitlines())
    key = f"000002_{head}"
    if program == "bluh":
        key = next(number for number, name in photos.items() if name == f"{key}.jpg")
    row = next(row for row in rows if row[0] == key)
    turn = rotation_of(row[4:7], order, gon)
    assert_sees_its_target(flown, head, np.array(row[1:4], float), turn)
    stated = (folder / "angles.txt").read_text()
    assert ("unit: gon" if gon else "unit: deg") in stated
    assert ("Ry(phi) Rx(omega)" if order == "YXZ" else "Rx(omega) Ry(phi)") in stated
    # The other order is seen to be wrong for a tilted head.
    if head == "7":
        with pytest.raises(AssertionError):
            swapped = rotation_of(row[4:7], "XYZ" if order == "YXZ" else "YXZ", gon)
            assert_sees_its_target(flown, head, np.array(row[1:4], float), swapped)


def test_heading_roll_pitch_are_those_of_the_flight(flown) -> None:
    _, folder = export(flown, *CRS, "--angles", "heading-roll-pitch", "--unit", "deg", to="bingo")
    lines = (folder / "orientation.bingo").read_text().splitlines()
    row = next(line.split() for line in lines if line.startswith("000002_nadir"))
    roll, pitch, heading = np.degrees(FLIGHT.attitude_rad(FLIGHT.pose(flown.marks[2])))
    assert np.abs(np.array(row[4:], float) - [heading % 360, roll, pitch]).max() < 1e-5


def test_patb_has_three_records_a_photo_and_the_matrix_by_rows(flown) -> None:
    _, folder = export(flown, *CRS, to="patb")
    lines = (folder / "orientation.ori").read_text().splitlines()
    photos = [line.split()[:2] for line in (folder / "photos.txt").read_text().splitlines()]
    assert len(lines) == 3 * len(photos) == 60
    for head in ("nadir", "5"):
        k = next(k for k, (_, name) in enumerate(photos) if name == f"000002_{head}.jpg")
        first = lines[3 * k]
        assert int(first[:16]) == k + 1 and first[16:32].strip() == ""
        place = np.array([first[32:48], first[48:64], first[64:80]], float)
        turn = np.array((lines[3 * k + 1] + lines[3 * k + 2]).split(), float).reshape(3, 3)
        assert_sees_its_target(flown, head, place, turn)


def test_an_inpho_project_maps_pixels_by_its_own_camera_block(flown) -> None:
    _, folder = export(flown, *CRS, to="inpho")
    (path,) = folder.glob("*.prj")
    photos, cameras, section = {}, {}, {}
    for line in path.read_text().splitlines():
        key, _, value = line.strip().partition(" : ")
        if line in ("$PHOTO", "$CAMERA"):
            section = {"rows": []}
        elif line == "$END" and "$PHOTO_NUM" in section:
            photos[section["$PHOTO_NUM"]] = section
        elif line == "$END" and "$TYPE" in section:
            cameras[section["$TYPE"]] = section
        elif key.startswith("$"):
            section[key.removesuffix(" :")] = value
        else:
            section.setdefault("rows", []).append([float(v) for v in key.split()])
    for head in ("nadir", "19"):
        photo, camera = photos[f"000002_{head}"], cameras[head]
        focal, *place = photo["rows"][0]
        turn = np.array(photo["rows"][1:4])
        assert focal == float(camera["$FOCAL_LENGTH"]) and photo["$CAMERA_ID"] == head
        assert camera["$PIXEL_REFERENCE"] == "CenterTopLeft"
        (a, b, c), (d, e, f) = camera["rows"]
        pixels = np.array([[100.0, 700.0], [1100.0, 90.0]])
        world, _ = targets(flown, head, flown.marks[2], pixels, raw=False)
        x, y, z = ((in_grid(world) - place) @ turn).T
        x, y = -focal * x / z, -focal * y / z
        seen = np.stack([a * x + b * y + c, d * x + e * y + f], axis=1)
        # Scale of the grid: some 1e-4 of 550 px.
        assert np.abs(seen - pixels).max() < 0.7


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--to", "bingo", "--images", "raw"], "choose --images perspective"),
        (["--to", "patb", "--unit", "gon"], "reads rotation matrices"),
        (["--to", "colmap", "--angles", "omega-phi-kappa"], "has angles of its own"),
        (["--to", "bingo", "--unit", "rad"], "deg, gon are right"),
        (["--to", "match-at"], "inpho are right"),
    ],
)
def test_what_does_not_fit_is_refused(flown, options, sentence) -> None:
    done = RUN.invoke(
        app, ["export", "block", str(flown.path), "--trajectory", str(flown.trajectory), *options]
    )
    assert done.exit_code != 0
    assert sentence in " ".join(f"{done.exception} {done.output}".split())


def test_the_files_state_the_coordinate_system(flown) -> None:
    about, folder = export(flown, *CRS, to="bingo")
    assert about["crs"] == "EPSG:32633" and about["rig"] is None
    assert "EPSG:32633" in (folder / "angles.txt").read_text()
    assert json.loads((folder / "about.json").read_text())["images"] == 20
