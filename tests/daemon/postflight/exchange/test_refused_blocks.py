"""Files of other programs with numbers, names or conventions that no block has: one sentence each.

Every case is one change of a file that is imported without it.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.exchange.block import BlockError
from daemon.postflight.exchange.block_project import import_block
from tests.daemon.postflight.exchange.test_import_block import (
    SIZE,
    F,
    bal,
    block_scene,
    bundler,
    colmap,
    opensfm,
)
from tests.daemon.postflight.exchange.test_import_photogrammetry import bingo

RUN = CliRunner()
CAMERA = f"1 PINHOLE {SIZE[0]} {SIZE[1]} {F} {F} 800 600"


@pytest.fixture(scope="module")
def scene():
    return block_scene(0.0, 0.0)


def refused(path: Path, program: str, tmp_path: Path, sentence: str, **settings) -> None:
    with pytest.raises(BlockError, match=sentence) as caught:
        import_block(path, program, tmp_path / "refused", **settings)
    assert "pydantic" not in str(caught.value) and "\n" not in str(caught.value)
    assert path.name in str(caught.value)
    assert not (tmp_path / "refused").exists()


def edit(path: Path, change) -> None:
    text = path.read_text()
    changed = change(text)
    assert changed != text
    path.write_text(changed)


def line(number: int, change):
    """The change of one line, counted from 1 after the comments."""

    def of(text: str) -> str:
        lines = text.split("\n")
        first = sum(1 for one in lines if one.startswith("#"))
        words = lines[first + number - 1].split()
        lines[first + number - 1] = " ".join(change(words))
        return "\n".join(lines)

    return of


def replaced(index: int, value: str):
    return lambda words: [*words[:index], value, *words[index + 1 :]]


@pytest.mark.parametrize(
    ("camera", "sentence"),
    [
        ("1 PINHOLE 1600 1200 0 0 800 600", "camera camera1: its principal distance is 0 px"),
        ("1 PINHOLE 1600 1200 -900 -900 800 600", "camera1: its principal distance is -900 px"),
        ("1 PINHOLE 1600 1200 900 inf 800 600", "camera1: its principal distance is inf px"),
        ("1 PINHOLE 1600 1200 nan 900 800 600", "camera1: its principal distance is nan px"),
        ("1 PINHOLE 1600 1200 900 900 nan 600", "camera1: its principal point is nan, 599.5"),
        ("1 PINHOLE 0 0 900 900 800 600", "camera camera1: its size is 0 x 0 px"),
        ("1 PINHOLE 1600 1e30 900 900 800 600", "camera|cameras.txt"),
        ("1 PINHOLE 2000000 1200 900 900 800 600", "no image is larger than 1000000 px"),
        ("1 PINHOLE 1600 1200 1e9 1e9 800 600", "1e.09 px, 6.25e.05 of the longer side"),
        ("1 PINHOLE 1600 1200 9 9 800 600", "9 px, 0.00562 of the longer side"),
        ("1 OPENCV 1600 1200 900 900 800 600 nan 0 0 0", "camera1: its k1 are not finite"),
        (f"{CAMERA}\n{CAMERA}", "cameras.txt, line 2: camera 1 is there twice"),
    ],
)
def test_cameras_of_colmap_that_cannot_be(scene, tmp_path, camera, sentence) -> None:
    path = colmap(scene, tmp_path / "in", 0.0, 0.0)
    (path / "cameras.txt").write_text(CAMERA + "\n")
    import_block(path, "colmap", tmp_path / "good")
    (path / "cameras.txt").write_text(camera + "\n")
    refused(path, "colmap", tmp_path, sentence)


def longer(words: list[str]) -> list[str]:
    return [words[0], *(repr(2.0 * float(w)) for w in words[1:5]), *words[5:]]


@pytest.mark.parametrize(
    ("file", "change", "sentence"),
    [
        ("images.txt", line(3, replaced(0, "1")), r"images.txt, line 5: image 1 is there twice"),
        ("images.txt", line(3, replaced(9, "0.jpg")), "image 0.jpg is there more than once"),
        ("images.txt", line(1, lambda words: words[:9]), "line 3: image 1 has no name"),
        ("images.txt", line(1, longer), "line 3: a quaternion of length 2; a rotation has length"),
        ("images.txt", line(1, replaced(5, "nan")), "line 3: .* where 7 finite numbers are needed"),
        ("images.txt", line(2, replaced(0, "nan")), "line 4: .* where 2 finite numbers are needed"),
        ("points3D.txt", line(1, replaced(1, "nan")), "line 2: .* 3 finite numbers are needed"),
        ("points3D.txt", line(2, replaced(0, "1")), "points3D.txt, line 3: point 1 is there twice"),
    ],
)
def test_lines_of_colmap_that_cannot_be(scene, tmp_path, file, change, sentence) -> None:
    path = colmap(scene, tmp_path / "in", 0.0, 0.0)
    edit(path / file, change)
    refused(path, "colmap", tmp_path, sentence)


def test_names_that_are_the_same_in_the_project_are_refused(scene, tmp_path) -> None:
    path = colmap(scene, tmp_path / "in", 0.0, 0.0)
    edit(path / "images.txt", line(1, replaced(9, "a b.jpg")))
    import_block(path, "colmap", tmp_path / "one")
    edit(path / "images.txt", line(3, replaced(9, "a_b.jpg")))
    refused(path, "colmap", tmp_path, "image a_b.jpg is there more than once")


def test_a_binary_model_of_random_bytes_is_refused(tmp_path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for name in ("cameras.bin", "images.bin"):
        (folder / name).write_bytes(b"\1" * 50)
    refused(folder, "colmap", tmp_path, "cameras.bin: ends before its last record, or is of anot")


@pytest.mark.parametrize(
    ("program", "write"), [("colmap", colmap), ("bundler", bundler), ("bal", bal)]
)
def test_a_scale_that_no_file_states_is_stated_by_the_user(tmp_path, program, write) -> None:
    path = write(block_scene(-0.05, 0.01), tmp_path / "in")
    refused(
        path, program, tmp_path, "not known to be in metres .*--metric",
        position_sigma_m=(0.02, 0.02, 0.02),
    )  # fmt: skip
    options = ["--position-sigma", "0.02", "0.02", "0.02"]
    begin = ["import", "block", str(path), "--from", program, "--out", str(tmp_path / "p")]
    assert RUN.invoke(app, [*begin, *options]).exit_code != 0
    done = RUN.invoke(app, [*begin, *options, "--metric"])
    assert done.exit_code == 0, done.output + str(done.exception)


def test_opensfm_without_a_place_has_no_scale(scene, tmp_path) -> None:
    path = opensfm(scene, tmp_path / "in")
    refused(
        path, "opensfm", tmp_path, "no reference_lla.*--metric", position_sigma_m=(0.1, 0.1, 0.1)
    )
    place = {"latitude": 47.0, "longitude": 15.0, "altitude": 0.0}
    reconstruction(path, lambda content: content.update(reference_lla=place))
    done = import_block(path, "opensfm", tmp_path / "p", position_sigma_m=(0.1, 0.1, 0.1))
    assert done.block.is_metric and done.block.frame is not None


@pytest.mark.parametrize(
    ("number", "change", "sentence"),
    [
        (2, lambda w: ["0" if float(w[0]) else "1", *w[1:]], "which has no f|counts announce"),
        (3, lambda w: [repr(1.3 * float(v)) for v in w], "image 0: its matrix is no rotation"),
        (3, lambda w: [repr(-float(v)) for v in w], "image 0: its matrix is no rotation"),
        (5, lambda w: [w[0], w[1], repr(float(w[2]) + 0.01)], "image 0: its matrix is no rotation"),
    ],
)
def test_images_of_bundler_that_cannot_be(scene, tmp_path, number, change, sentence) -> None:
    path = bundler(scene, tmp_path / "in")
    edit(path, line(number, change))
    refused(path, "bundler", tmp_path, sentence)


@pytest.mark.parametrize(
    ("program", "write"), [("bundler", bundler), ("bal", bal)], ids=["bundler", "bal"]
)
@pytest.mark.parametrize(
    ("behind", "sentence"),
    [("\n1 2 3 4\n", "1 is behind the last number"), ("\nx\n", "'x' where a number is needed")],
)
def test_numbers_behind_the_last_one(scene, tmp_path, program, write, behind, sentence) -> None:
    path = write(scene, tmp_path / "in")
    edit(path, lambda text: text + behind)
    refused(path, program, tmp_path, sentence)


def test_indices_are_whole_numbers(scene, tmp_path) -> None:
    path = bal(scene, tmp_path / "bal")
    edit(path, lambda text: text.replace("\n0 ", "\n0.5 ", 1))
    refused(path, "bal", tmp_path, "observation of image 0.5; whole numbers from 0 to 8")
    path = bundler(scene, tmp_path / "bundler")
    rows = path.read_text().split("\n")
    at = 2 + 9 * 5 + 2
    words = rows[at].split()
    assert rows[at - 1] == "128 128 128" and len(words) == 1 + 4 * int(words[0])
    rows[at] = " ".join([words[0], "1.5", *words[2:]])
    path.write_text("\n".join(rows))
    refused(path, "bundler", tmp_path, "point 0: image 1.5; whole numbers from 0 to 8")


def test_a_measurement_far_from_every_image(scene, tmp_path) -> None:
    path = bal(scene, tmp_path / "in")
    edit(path, line(2, replaced(2, "1e308")))
    refused(path, "bal", tmp_path, r"a measurement is 1e\+308 px from the middle of its image")


@pytest.mark.parametrize(("value", "sentence"), [("0.0", "is 0 px"), ("-900.0", "is -900 px")])
def test_a_principal_distance_of_bal_is_positive(scene, tmp_path, value, sentence) -> None:
    path = bal(scene, tmp_path / "in")
    edit(path, lambda text: text.replace(f"\n{F}\n", f"\n{value}\n"))
    refused(path, "bal", tmp_path, f"camera camera1: its principal distance {sentence}")


def test_a_bundle_of_its_first_line_alone(tmp_path) -> None:
    path = tmp_path / "bundle.out"
    path.write_text("# Bundle file v0.3")
    refused(path, "bundler", tmp_path, "ends before its last number")


def reconstruction(path: Path, change) -> None:
    file = path / "reconstruction.json"
    (content,) = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps([content]))


PLACE = {"latitude": 47.0, "longitude": 15.0}


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("shots", [], "shots is a list"),
        ("shots", {}, "has no shots"),
        ("cameras", [], "cameras is a list"),
        ("rig_instances", [1], "rig_instances is a list"),
        ("rig_instances", {"a": 1}, "rig instance a is 1"),
        ("points", [1], "points is a list"),
        ("reference_lla", [1, 2, 3], "reference_lla is a list"),
        ("reference_lla", {**PLACE, "latitude": float("nan")}, "latitude is nan"),
        ("reference_lla", {**PLACE, "latitude": 470.0}, "latitude 470 and longitude 15"),
        ("reference_lla", {**PLACE, "longitude": "15"}, "longitude is '15'"),
        ("reference_lla", {"latitude": 47.0}, "has no 'longitude'"),
    ],
)
def test_a_reconstruction_of_other_types(scene, tmp_path, key, value, sentence) -> None:
    path = opensfm(scene, tmp_path / "in")
    reconstruction(path, lambda content: content.update({key: value}))
    refused(path, "opensfm", tmp_path, sentence)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"focal": 0}, "camera camera1: its principal distance is 0 px"),
        ({"focal": float("nan")}, "focal is nan"),
        ({"focal": "0.9"}, "focal is '0.9'"),
        ({"width": 0, "height": 0}, "camera camera1: its size is 0 x 0 px"),
        ({"width": 1600.5}, "1600.5 x 1200 px; whole numbers"),
        ({"k4": 0.5}, "camera camera1 of type perspective has k4"),
        ({"projection_type": "brown", "focal_x": 0.9, "focal_y": 0.9, "k6": 0.1}, "has focal, k6"),
    ],
)
def test_a_camera_of_opensfm_that_cannot_be(scene, tmp_path, changes, sentence) -> None:
    path = opensfm(scene, tmp_path / "in")
    reconstruction(path, lambda content: content["cameras"]["camera1"].update({"k3": 0.0}))
    import_block(path, "opensfm", tmp_path / "good")
    reconstruction(path, lambda content: content["cameras"]["camera1"].update(changes))
    refused(path, "opensfm", tmp_path, sentence)


METASHAPE = (
    '<document version="2.0.0"><chunk label="c"><sensors><sensor id="0" label="s" type="frame">'
    '<resolution width="1000" height="800"/><calibration type="frame" class="adjusted">'
    '<resolution width="1000" height="800"/><f>900</f><cx>0</cx><cy>0</cy></calibration></sensor>'
    '</sensors><components><component id="0"><transform><rotation>1 0 0 0 1 0 0 0 1</rotation>'
    "<translation>4200000 1100000 4650000</translation><scale>1</scale></transform></component>"
    '</components><cameras><camera id="0" sensor_id="0" component_id="0" label="a"><transform>1 0 0'
    ' 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera><camera id="1" sensor_id="0" component_id="0" '
    'label="b" enabled="true"><transform>1 0 0 10 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>'
    "</cameras></chunk></document>"
)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("<f>900", "<f>nan", "camera s: its principal distance is nan px"),
        ("<f>900", "<f>0", "camera s: its principal distance is 0 px"),
        ("<f>900", "<f>-900", "camera s: its principal distance is -900 px"),
        ("<f>900", "<f>inf", "camera s: its principal distance is inf px"),
        ('label="b"', 'label="a"', "image a is there more than once"),
        ('camera id="1"', 'camera id="0"', r"camera 0 \(b\) is there twice"),
        ("<scale>1<", "<scale>nan<", "finite"),
        (
            " 0 0 0 1</transform></camera></",
            " 7 0 0 1</transform></camera></",
            "last row .* 7 0 0 1;",
        ),
    ],
)
def test_cameras_of_metashape_that_cannot_be(tmp_path, old, new, sentence) -> None:
    path = tmp_path / "m.xml"
    assert METASHAPE.count(old) == 1
    path.write_text(METASHAPE)
    assert len(import_block(path, "metashape", tmp_path / "good").block.images) == 2
    path.write_text(METASHAPE.replace(old, new))
    refused(path, "metashape", tmp_path, sentence)


def test_a_disabled_camera_of_metashape_is_left_out_by_name(tmp_path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(METASHAPE.replace('enabled="true"', 'enabled="false"'))
    block = import_block(path, "metashape", tmp_path / "p").block
    assert [image.name for image in block.images] == ["a"]
    assert "disabled and left out: b" in block.notes


def test_the_unit_of_angles_is_seen_where_rays_meet_within_the_limit(tmp_path) -> None:
    """Near-vertical images with small kappa: degrees for gon leave some pixels only."""
    scene = block_scene(0.0, 0.0)
    points, centres, turns, _ = scene
    small = [np.diag([1.0, -1.0, -1.0]) @ _about_z(4.0 * (k - 4)) for k in range(len(turns))]
    seen = []
    for k, (centre, turn) in enumerate(zip(centres, small, strict=True)):
        x, y, z = ((points - centre) @ turn).T
        u, v = F * x / z, F * y / z
        inside = np.flatnonzero((np.abs(u) < 795) & (np.abs(v) < 595)).tolist()
        seen += [(k, p, float(u[p]), float(v[p])) for p in inside]
    folder = bingo((points, centres, small, seen), tmp_path / "in")
    import_block(folder, "bingo", tmp_path / "good")
    edit(folder / "angles.txt", lambda text: text.replace("unit: gon", "unit: deg"))
    refused(
        folder, "bingo", tmp_path, r"as read .* with phi-omega-kappa in gon .* by 0\.\d+ px; state"
    )


def _about_z(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


INPHO = (
    "$PROJECT 5.0.0\n  $PROJECT_NAME : x\n  $LINEAR_UNITS_OF_OBJECT : m\n"
    "  $LINEAR_UNITS_OF_IMAGE : mm\n  $ANGULAR_UNITS : deg\n$END\n"
    + "".join(
        f"$PHOTO\n  $PHOTO_NUM : p{k}\n  $PHOTO_FILE : p{k}.tif\n  $CAMERA_ID : cam\n"
        f"  $ORI_STAT : Initial\n  $EXT_ORI : 10:00:00 1/1/2024\n   100.0 {20 * k} 0 900\n"
        "   1 0 0\n   0 1 0\n   0 0 1\n$END\n"
        for k in range(2)
    )
    + "$CAMERA\n  $TYPE : cam\n  $CCD_INTERIOR_ORIENTATION :\n    100.0 0.0 500.0\n"
    "    0.0 -100.0 400.0\n  $CCD_COLUMNS : 1001\n  $CCD_ROWS : 801\n"
    "  $PIXEL_REFERENCE : CenterTopLeft\n  $FOCAL_LENGTH : 100.0\n"
    "  $PRINCIPAL_POINT_PPA : 0.0 0.0\n  $CAMERA_MOUNT_ROTATION : 0.0\n$END\n"
)


CAMERA_AT = INPHO.index("$CAMERA\n")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("OBJECT : m", "OBJECT : ft", "line 1: .LINEAR_UNITS_OF_OBJECT is ft; m is read"),
        ("IMAGE : mm", "IMAGE : um", "LINEAR_UNITS_OF_IMAGE is um; mm is read"),
        ("UNITS : deg", "UNITS : gon", "ANGULAR_UNITS is gon; deg is read"),
        ("  $LINEAR_UNITS_OF_OBJECT : m\n", "", "LINEAR_UNITS_OF_OBJECT is not stated"),
        ("ROTATION : 0.0", "ROTATION : 180", "camera cam: .CAMERA_MOUNT_ROTATION is 180; 0 is"),
        ("ROTATION : 0.0", "ROTATION : nan", "camera cam: .CAMERA_MOUNT_ROTATION is nan; 0 is"),
        ("  $CAMERA_MOUNT_ROTATION : 0.0\n", "", "camera cam: has no .CAMERA_MOUNT_ROTATION"),
        ("STAT : Initial", "STAT : Deleted", "line 7: photo p0: .ORI_STAT is Deleted"),
        ("  $ORI_STAT", "  $FOO : 7\n  $ORI_STAT", "line 11: .FOO of .PHOTO is not carried"),
        ("PHOTO_NUM : p1", "PHOTO_NUM : p0", "line 18: photo p0 is there twice"),
        ("   100.0 0 0 900", "   150.0 0 0 900", "photo p0: its .EXT_ORI has .* 150 mm.* 100 mm"),
        ("   0 0 1", "   0 0 -1", "line 7: photo p0: no rotation matrix .*mirrored"),
        ("FOCAL_LENGTH : 100.0", "FOCAL_LENGTH : nan", "camera cam: .FOCAL_LENGTH is nan"),
        ("COLUMNS : 1001", "COLUMNS : 0", "camera cam: its size is 0 x 801 px"),
        ("  $TYPE : cam\n", "", "a .CAMERA without .TYPE"),
        (INPHO[: INPHO.index("$PHOTO")], "", "0 sections .PROJECT"),
        (
            INPHO[INPHO.index("$CAMERA\n") :],
            INPHO[INPHO.index("$CAMERA\n") :] * 2,
            "cam is there t",
        ),
    ],
)
def test_inpho_projects_with_other_units_keys_and_states(tmp_path, old, new, sentence) -> None:
    path = tmp_path / "a.prj"
    assert old in INPHO
    path.write_text(INPHO)
    assert len(import_block(path, "inpho", tmp_path / "good").block.images) == 2
    path.write_text(INPHO.replace(old, new, 1))
    refused(path, "inpho", tmp_path, sentence)


@pytest.mark.parametrize(
    ("old", "new", "is_noted"),
    [
        ("   1 0 0\n", "   1 0 0\n", False),
        ("   1 0 0\n   0 1 0\n   0 0 1\n", "   1 0 0\n   0 -1 0\n   0 0 -1\n", True),
    ],
)
def test_images_that_look_upward_are_stated(tmp_path, old, new, is_noted) -> None:
    path = tmp_path / "a.prj"
    path.write_text(INPHO.replace(old, new))
    notes = import_block(path, "inpho", tmp_path / "p").block.notes
    assert any("2 of 2 images look upward" in note for note in notes) is is_noted


@pytest.mark.parametrize(("x_m", "is_noted"), [(900_000, True), (150_000, False)])
def test_an_image_far_from_all_others_is_stated(tmp_path, x_m, is_noted) -> None:
    """Without measurements nothing else shows a coordinate that was typed wrong."""
    path = tmp_path / "a.prj"
    assert INPHO.count("100.0 20 0 900") == 1
    path.write_text(INPHO.replace("100.0 20 0 900", f"100.0 {x_m} 0 900"))
    notes = import_block(path, "inpho", tmp_path / "p").block.notes
    far = [note for note in notes if "km from the middle" in note]
    assert bool(far) is is_noted
    assert all("2 of 2 images" in note and "p1 450 km" in note for note in far)


def test_the_command_ends_in_one_sentence(scene, tmp_path) -> None:
    path = colmap(scene, tmp_path / "in", 0.0, 0.0)
    (path / "cameras.txt").write_text("1 PINHOLE 1600 1200 0 0 800 600\n")
    done = RUN.invoke(
        app, ["import", "block", str(path), "--from", "colmap", "--out", str(tmp_path / "p")]
    )
    assert isinstance(done.exception, BlockError)
    assert re.search(
        r"camera camera1: its principal distance is 0 px.*correct", str(done.exception)
    )
