"""Blocks of BINGO and PATB, in the forms of published descriptions and of our own exporter."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.adjustment.project import read_project
from daemon.postflight.exchange.block import BlockError
from daemon.postflight.exchange.block_project import import_block
from daemon.postflight.exchange.inpho_reader import read_inpho
from daemon.postflight.exchange.photogrammetry_reader import read_bingo, read_patb
from daemon.postflight.exchange.pix4d_reader import read_pix4d
from tests.daemon.postflight.exchange.flown_block import fly
from tests.daemon.postflight.exchange.test_colmap import SECONDS, export
from tests.daemon.postflight.exchange.test_import_block import SIZE, F, block_scene

RUN = CliRunner()
PITCH_MM = 0.004
FLIP = np.diag([1.0, -1.0, -1.0])
ANGLES = "phi, omega, kappa of R = Ry(phi) Rx(omega) Rz(kappa), grid from camera"


@pytest.fixture(scope="module")
def scene():
    return block_scene(0.0, 0.0)


def camera_file(folder: Path) -> None:
    folder.mkdir()
    row = f"X20 {F * PITCH_MM} 0 0 {PITCH_MM * 1e3} {SIZE[0]} {SIZE[1]}\n"
    (folder / "cameras.txt").write_text("# name f x0 y0 pixel columns rows\n" + row)


def rows_of(seen, k: int, unit: float = 1.0) -> list[str]:
    """Point, x, y of image k; y up."""
    return [
        f"{1000 + p} {u * PITCH_MM * unit:.6f} {-v * PITCH_MM * unit:.6f}"
        for image, p, u, v in seen
        if image == k
    ]


def bingo(scene, folder: Path) -> Path:
    """As our exporter writes the orientation, and as Pix4D documents the measurements."""
    _, centres, turns, seen = scene
    camera_file(folder)
    lines, measured = [], []
    for k, (centre, turn) in enumerate(zip(centres, turns, strict=True)):
        angles = Rotation.from_matrix(turn @ FLIP).as_euler("YXZ", degrees=True) / 0.9
        lines.append(" ".join([f"P{k}", *(f"{v:.7f}" for v in (*centre, *angles))]))
        measured += [f"P{k} X20", *rows_of(seen, k), ""]
    (folder / "orientation.bingo").write_text("\n".join(lines) + "\n")
    (folder / "angles.txt").write_text(
        f"coordinate system: EPSG:32633, heights ellipsoidal\nangles: {ANGLES}\nunit: gon\n"
    )
    (folder / "block_bingo.txt").write_text("\n".join(measured) + "\n")
    return folder


def pix4d(scene, folder: Path) -> Path:
    """With the external parameters of Pix4D, whose names have the suffix of the files."""
    bingo(scene, folder)
    (folder / "orientation.bingo").unlink()
    (folder / "angles.txt").unlink()
    lines = ["imageName X Y Z Omega Phi Kappa"]
    for k, (centre, turn) in enumerate(zip(scene[1], scene[2], strict=True)):
        angles = Rotation.from_matrix(turn @ FLIP).as_euler("XYZ", degrees=True)
        lines.append(" ".join([f"P{k}.JPG", *(f"{v:.7f}" for v in (*centre, *angles))]))
    path = folder / "block_calibrated_external_camera_parameters.txt"
    path.write_text("\n".join(lines) + "\n")
    return folder


def patb(scene, folder: Path, unit: float = 1e3) -> Path:
    _, centres, turns, seen = scene
    camera_file(folder)
    orientation, measured = "", []
    for k, (centre, turn) in enumerate(zip(centres, turns, strict=True)):
        r = (turn @ FLIP).ravel()
        place = "".join(f"{v:16.5f}" for v in centre)
        orientation += f"{k + 1:16d}{'':16}{place}\n"
        orientation += "".join(f"{v:16.12f}" for v in r[:5]) + "\n"
        orientation += "".join(f"{v:16.12f}" for v in r[5:]) + "\n"
        measured += [f"{k + 1} {F * PITCH_MM * unit}", *rows_of(seen, k, unit), "-99"]
    (folder / "block.ori").write_text(orientation)
    (folder / "block.im").write_text("\n".join(measured) + "\n")
    return folder


@pytest.mark.parametrize(
    ("program", "write"),
    [("bingo", bingo), ("pix4d", pix4d), ("patb", patb)],
)
def test_an_imported_block_adjusts_to_the_truth(scene, tmp_path, program, write) -> None:
    path, out = write(scene, tmp_path / "in"), tmp_path / "project"
    done = RUN.invoke(
        app,
        ["import", "block", str(path), "--from", program, "--out", str(out), "--image-sigma",
         "0.3", "--position-sigma", "0.05", "0.05", "0.05", "--metric", "--json"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output + str(done.exception)
    content = json.loads(done.stdout)
    assert (content["images"], content["residuals_px"]) == (9, {"X20": 0.0})
    assert "fit with a median of 0." in content["notes"][-1]
    adjusted = RUN.invoke(app, ["adjust", str(out), "--json"])
    assert adjusted.exit_code == 0, adjusted.output + str(adjusted.exception)
    assert json.loads(adjusted.stdout)["sigma0"] == pytest.approx(1.0, abs=0.1)
    network = read_project(out / "project.toml").network
    assert np.abs(network.stations.position_m - np.array(scene[1])).max() < 1e-4
    found = dict(zip(network.points.names, network.points.xyz_m, strict=True))
    truth = {str(1000 + p): xyz for p, xyz in enumerate(scene[0])}
    # 0.3 px at 1500 px from 200 m are 4 cm; of two rays of a short base several times that.
    off = [np.linalg.norm(xyz - truth[name]) for name, xyz in found.items()]
    assert len(found) > 90 and np.median(off) < 0.1


def test_the_focal_length_states_micrometres_or_millimetres_of_patb(scene, tmp_path) -> None:
    one = read_patb(patb(scene, tmp_path / "um"))
    other = read_patb(patb(scene, tmp_path / "mm", unit=1.0))
    assert np.allclose(one.points.px, other.points.px, atol=1e-2)


def turned(path: Path, write) -> None:
    rows = [line.split() for line in path.read_text().splitlines()]
    path.write_text("\n".join(" ".join(write(row) if len(row) == 3 else row) for row in rows))


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda row: [row[0], row[1], str(-float(row[2]))], "with y of the measurements reversed"),
        (lambda row: [row[0], row[2], row[1]], "with x and y of the measurements exchanged"),
        (lambda row: [row[0], str(-float(row[1])), row[2]], "with x of the measurements reversed"),
        (
            lambda row: [row[0], *(str(-float(v)) for v in row[1:])],
            "with x and y of the measurements reversed",
        ),
        (lambda row: [row[0], *(str(float(v) * 250) for v in row[1:])], "measurements in px"),
        (lambda row: [row[0], *(str(float(v) * 1000) for v in row[1:])], "measurements in um"),
        (lambda row: [row[0], *(str(float(v) + 3) for v in row[1:])], "outside of the image"),
        (
            lambda row: [row[0], *(str(float(v) * 0.25) for v in row[1:])],
            "the rays miss each other",
        ),
        (lambda row: [*row, "0.004"], "4 columns"),
        (lambda row: [row[0], row[1], "nan"], "finite number"),
    ],
    ids=[
        *("y down", "exchanged", "x left", "both", "pixels", "micrometres", "another origin"),
        *("another pixel size", "accuracy", "nan"),
    ],
)
def test_measurements_of_another_convention_are_refused(scene, tmp_path, wrong, sentence) -> None:
    folder = bingo(scene, tmp_path / "in")
    turned(folder / "block_bingo.txt", wrong)
    with pytest.raises(BlockError, match=sentence):
        read_bingo(folder)


def angles_written(folder: Path, old: str, new: str) -> None:
    text = (folder / "angles.txt").read_text()
    assert old in text
    (folder / "angles.txt").write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("unit: gon", "unit: deg", "with phi-omega-kappa in gon they miss"),
        ("unit: gon", "unit: rad", "unit 'rad'"),
        (ANGLES, ANGLES.replace("phi, omega", "kappa, omega"), "omega-phi-kappa or"),
        (
            ANGLES,
            "omega, phi, kappa of R = Rx(omega) Ry(phi) Rz(kappa), grid from camera",
            "with phi-omega-kappa in gon they miss",
        ),
        ("EPSG:32633", "EPSG:2263", "are in US survey foot, and metres are read"),
        ("EPSG:32633", "EPSG:4326", "are in degree, and metres are read"),
        ("EPSG:32633", "EPSG:32633+6360", "are in US survey foot, metre, and metres are read"),
    ],
)
def test_angles_of_another_unit_or_order_are_refused(scene, tmp_path, old, new, sentence) -> None:
    folder = bingo(scene, tmp_path / "in")
    angles_written(folder, old, new)
    with pytest.raises(BlockError, match=sentence):
        read_bingo(folder)


def orientations(path: Path, change) -> None:
    """Change place and angles of each line with seven words."""
    rows = []
    for row in map(str.split, path.read_text().splitlines()):
        is_pose = len(row) == 7 and row[1] != "X"
        if is_pose:
            row = [row[0], *(f"{v:.9f}" for v in change(np.array(row[1:], float)))]
        rows.append(" ".join(row))
    path.write_text("\n".join(rows) + "\n")


def other_order(row: np.ndarray, given: str, taken: str) -> list[float]:
    turn = Rotation.from_euler(given, row[3:], degrees=True)
    return [*row[:3], *turn.as_euler(taken, degrees=True)]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda row: [row[1], row[0], *row[2:]], "with X and Y of the places exchanged"),
        (lambda row: [*row[:3], *np.radians(row[3:])], "with omega-phi-kappa in rad they miss"),
        (lambda row: [*row[:3], *(row[3:] / 0.9)], "with omega-phi-kappa in gon they miss"),
        (lambda row: other_order(row, "XYZ", "YXZ"), "with phi-omega-kappa in deg they miss"),
        (
            lambda row: [*row[:3], *Rotation.from_euler("XYZ", row[3:], degrees=True).inv()
                         .as_euler("XYZ", degrees=True)],
            "with transposed rotations they miss",
        ),
    ],
    ids=["northing first", "radians", "gon", "order", "transposed"],
)  # fmt: skip
def test_orientations_of_pix4d_of_another_convention(scene, tmp_path, change, sentence) -> None:
    folder = pix4d(scene, tmp_path / "in")
    (path,) = folder.glob("*external*.txt")
    orientations(path, change)
    with pytest.raises(BlockError, match=sentence):
        read_pix4d(folder)


def test_matrices_of_patb_that_are_transposed_are_named(scene, tmp_path) -> None:
    folder = patb(scene, tmp_path / "in")
    rows = grouped((folder / "block.ori").read_text())
    text = ""
    for first, *two in rows:
        turn = np.array(" ".join(two).split(), float).reshape(3, 3).T.ravel()
        text += first + "\n"
        text += " ".join(f"{v:.12f}" for v in turn[:5]) + "\n"
        text += " ".join(f"{v:.12f}" for v in turn[5:]) + "\n"
    (folder / "block.ori").write_text(text)
    with pytest.raises(BlockError, match="with transposed rotations they miss each other by 0"):
        read_patb(folder)


@pytest.mark.parametrize(
    ("code", "is_metric", "word"),
    [
        ("EPSG:32633", True, "UTM_Zone_33N"),
        (None, False, "do not state the unit of coordinates"),
    ],
)
def test_the_coordinate_system_of_pix4d_states_the_unit(
    scene, tmp_path, code, is_metric, word
) -> None:
    folder = pix4d(scene, tmp_path / "in")
    if code is not None:
        (folder / "block_wkt.prj").write_text(CRS(code).to_wkt("WKT1_ESRI"))
    for measurements in (True, False):
        if not measurements:
            (folder / "block_bingo.txt").unlink()
        block = read_pix4d(folder)
        assert block.is_metric is is_metric and any(word in note for note in block.notes)
    (folder / "block_wkt.prj").write_text(CRS("EPSG:2263").to_wkt("WKT1_ESRI"))
    with pytest.raises(BlockError, match="are in US survey foot"):
        read_pix4d(folder)


@pytest.mark.parametrize(
    ("file", "old", "new", "sentence"),
    [
        ("block.im", "-99\n2 ", "2 ", "line \\d+: '2 6000.0'"),
        ("block.im", "1 6000.0", "1 7000.0", "focal length 7000 is that of 0 cameras"),
        ("block.ori", "\n  ", "\n  9", "no rotation matrix"),
        ("block.ori", "\n", " 1.0\n", "records of 5, 5 and 4 numbers"),
        ("cameras.txt", "X20 6.0", "X20 -6.0", "f, pixel size and sides are positive"),
        ("cameras.txt", "1600 1200", "1600", "6 columns; 7 are right"),
        ("cameras.txt", "1600 1200", "1200 1600", r"outside of the image .*cameras.txt right\?"),
    ],
)
def test_damaged_files_of_patb_are_refused(scene, tmp_path, file, old, new, sentence) -> None:
    folder = patb(scene, tmp_path / "in")
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))
    with pytest.raises(BlockError, match=sentence):
        read_patb(folder)


def test_a_size_that_no_image_has_is_refused(scene, tmp_path) -> None:
    """Millimetres from the middle of 1e30 pixels would have no digits left."""
    folder = bingo(scene, tmp_path / "in")
    text = (folder / "cameras.txt").read_text()
    assert text.count(" 1600 1200") == 1
    (folder / "cameras.txt").write_text(text.replace(" 1600 ", " 1e30 "))
    with pytest.raises(BlockError, match=r"camera X20: its size is .* no image is larger than"):
        import_block(folder, "bingo", tmp_path / "out")


def test_weights_and_images_without_orientation_are_refused_by_name(scene, tmp_path) -> None:
    folder = patb(scene, tmp_path / "in")
    text = (folder / "block.im").read_text()
    lines = text.splitlines()
    (folder / "block.im").write_text("\n".join([lines[0], lines[1] + " 3", *lines[2:]]))
    with pytest.raises(BlockError, match="weight group other than 0 or 1 is not carried"):
        read_patb(folder)
    (folder / "block.im").write_text(text)
    rows = (folder / "block.ori").read_text().splitlines()
    (folder / "block.ori").write_text("\n".join(rows[3:]))
    with pytest.raises(BlockError, match="1 images with measurements have no orientation: 1"):
        read_patb(folder)
    for name in ("block.im", "cameras.txt"):
        (folder / name).unlink()
        with pytest.raises(BlockError, match=f"has no {name}|0 files"):
            read_patb(folder)


@pytest.mark.parametrize(("program", "read"), [("bingo", read_bingo), ("patb", read_patb)])
def test_our_own_export_comes_back(tmp_path, program, read) -> None:
    """Measurements are computed from the exported files themselves, by the test's own formula."""
    flown = fly(tmp_path / "mission", "midas-mini", seconds=SECONDS)
    _, folder = export(flown, "--crs", "EPSG:32633", to=program)
    cameras = {
        words[0]: [float(v) for v in words[1:]]
        for words in map(str.split, (folder / "cameras.txt").read_text().splitlines()[1:])
    }
    photos = [line.split() for line in (folder / "photos.txt").read_text().splitlines()]
    poses = []
    if program == "bingo":
        for row in map(str.split, (folder / "orientation.bingo").read_text().splitlines()):
            values = np.array(row[1:], float)
            turn = Rotation.from_euler("YXZ", values[3:] * 0.9, degrees=True).as_matrix()
            poses.append((values[:3], turn))
    else:
        numbers = (folder / "orientation.ori").read_text().splitlines()
        for k in range(0, len(numbers), 3):
            turn = np.array(" ".join(numbers[k + 1 : k + 3]).split(), float).reshape(3, 3)
            poses.append((np.array(numbers[k].split()[1:], float), turn))
    ground = poses[0][0] + np.array([0, 0, -1000.0])
    spread = np.stack(np.meshgrid(*[np.linspace(-700, 700, 21)] * 2), -1).reshape(-1, 2)
    points = ground + np.column_stack([spread, np.zeros(len(spread))])
    measured, seen = [], 0
    for (number, name, camera), (centre, turn) in zip(photos, poses, strict=True):
        f, x0, y0, pitch_um, columns, rows = cameras[camera]
        x, y, z = ((points - centre) @ turn).T
        x, y = x0 - f * x / z, y0 - f * y / z
        half = np.array([columns, rows]) / 2 * pitch_um * 1e-3
        inside = np.flatnonzero((z < 0) & (abs(x) < half[0]) & (abs(y) < half[1]))
        head = f"{name.removesuffix('.jpg')} {camera}" if program == "bingo" else f"{number} {f}"
        measured += [head, *(f"{k} {x[k]:.9f} {y[k]:.9f}" for k in inside.tolist()), "-99"]
        seen += len(inside)
    name = "x_bingo.txt" if program == "bingo" else "x.im"
    (folder / name).write_text("\n".join(measured) + "\n")
    block = read(folder)
    assert len(block.images) == 20 and seen > 100
    truth = points[[int(point) for point in block.points.names]]
    assert len(truth) > 15 and np.abs(block.points.xyz_m - truth).max() < 0.05
    assert "EPSG:32633" in block.notes[0]


def cam_file(folder: Path, k1: float, k2: float, width: int = SIZE[0]) -> None:
    """Pix4D's camera file: the principal point from the corner of the first pixel."""
    px, py = SIZE[0] / 2 * PITCH_MM, SIZE[1] / 2 * PITCH_MM
    (folder / "X20.cam").write_text(
        "Pix4D camera calibration file 0\n"
        f"#Focal Length mm assuming a sensor width of {width * PITCH_MM:g}x{SIZE[1] * PITCH_MM:g}mm"
        f"\nF {F * PITCH_MM}\n#Principal Point mm\nPx {px}\nPy {py}\n#Symmetrical Lens Distortion "
        f"Coeffs\nK1 {k1}\nK2 {k2}\nK3 0.0\n#Tangential Lens Distortion Coeffs\nT1 0.0\nT2 0.0\n"
    )


def test_the_distortion_of_pix4d_s_camera_file_is_carried(tmp_path) -> None:
    folder = pix4d(block_scene(-0.28, 0.12), tmp_path / "in")
    cam_file(folder, -0.28, 0.12)
    block = read_pix4d(folder)
    assert float(block.notes[-1].split()[-2]) < 0.5, block.notes[-1]
    # With the other sign the rays miss each other by pixels, which the note states.
    cam_file(folder, 0.28, -0.12)
    assert float(read_pix4d(folder).notes[-1].split()[-2]) > 3.0
    cam_file(folder, -0.28, 0.12, width=2 * SIZE[0])
    with pytest.raises(BlockError, match=r"a sensor of 12.8 x 4.8 mm; cameras.txt has 6.4 x 4.8"):
        read_pix4d(folder)
    cam_file(folder, -0.28, 0.12)
    text = (folder / "X20.cam").read_text()
    (folder / "X20.cam").write_text(text + "K4 0.1\n")
    with pytest.raises(BlockError, match=r"'K4 0\.1' is not carried"):
        read_pix4d(folder)


@pytest.mark.parametrize(("program", "read"), [("pix4d", read_pix4d), ("inpho", read_inpho)])
def test_files_of_pix4d_and_inpho_come_back_as_they_went(tmp_path, program, read) -> None:
    flown = fly(tmp_path / "mission", "midas-mini", seconds=SECONDS)
    _, other = export(flown, "--crs", "EPSG:32633", to="patb")
    matrices = np.array(
        [" ".join(rows).split() for rows in grouped((other / "orientation.ori").read_text())],
        float,
    )
    names = [line.split()[1] for line in (other / "photos.txt").read_text().splitlines()]
    _, folder = export(flown, "--crs", "EPSG:32633", to=program)
    block = read(folder)
    found = {one.name.removesuffix(".jpg"): one for one in block.images}
    for name, row in zip(names, matrices, strict=True):
        one = found[name.removesuffix(".jpg")]
        assert np.abs(one.centre_m - row[1:4]).max() < 1e-4
        assert np.abs(one.rotation - row[4:].reshape(3, 3)).max() < 3e-9
        assert name.endswith(f"_{block.cameras[one.camera].name}.jpg")
    rig = {cone.name: cone for cone in flown.rig.cones}
    for camera in block.cameras:
        sensor, model = rig[camera.name].sensors[0], camera.model
        middle = ((camera.width_px - 1) / 2, (camera.height_px - 1) / 2)
        assert (camera.width_px, camera.height_px) == (sensor.width_px, sensor.height_px)
        assert model.is_pinhole and np.allclose((model.cx_px, model.cy_px), middle, atol=1e-5)
        assert model.fx_px * camera.pitch_mm == pytest.approx(rig[camera.name].lens.f_mm, rel=1e-6)
    done = RUN.invoke(
        app,
        ["import", "block", str(folder), "--from", program, "--out", str(tmp_path / "p"), "--json"],
    )
    assert done.exit_code == 0 and json.loads(done.stdout)["images"] == 20
    assert "no image measurements" in json.loads(done.stdout)["notes"][-1]


def grouped(text: str) -> list[list[str]]:
    rows = text.splitlines()
    return [rows[k : k + 3] for k in range(0, len(rows), 3)]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("$PIXEL_REFERENCE : CenterTopLeft", "$PIXEL_REFERENCE : OriginTopLeft", "CenterTopLeft"),
        ("  $FOCAL_LENGTH", "  $DISTORTION_TYPE : 2\n  $FOCAL_LENGTH", "without distortion"),
        ("  $ORI_STAT", "  $PHOTO_POINTS :\n  $ORI_STAT", "no point is measured in two"),
        ("$PROJECT 5.0.0", "$POINTS\n$END\n$PROJECT 5.0.0", "section .POINTS is not carried"),
        ("$CAMERA_ID : nadir", "$CAMERA_ID : other", "camera 'other' is not in the file"),
        ("$EXT_ORI :", "$ORI_STAT :", "line 12: .ORI_STAT is there twice"),
        ("$EXT_ORI :", "$EXT_ORI_OLD :", ".EXT_ORI_OLD of .PHOTO is not carried"),
        ("$TYPE : nadir", "$TYPE : nadir\n  $CCD_ROWS : many", "is not understood|CenterTopLeft"),
    ],
)
def test_inpho_projects_that_cannot_be_carried_are_refused(
    inpho_text, tmp_path, old, new, sentence
) -> None:
    assert old in inpho_text
    (tmp_path / "a.prj").write_text(inpho_text.replace(old, new, 1))
    if "many" in new:
        text = inpho_text.replace("$CCD_ROWS : ", "$CCD_ROWS : many", 1)
        (tmp_path / "a.prj").write_text(text)
    with pytest.raises(BlockError, match=sentence):
        read_inpho(tmp_path)


@pytest.fixture(scope="module")
def inpho_text(tmp_path_factory) -> str:
    flown = fly(tmp_path_factory.mktemp("inpho") / "mission", "midas-mini", seconds=SECONDS[:1])
    _, folder = export(flown, "--crs", "EPSG:32633", to="inpho")
    (path,) = folder.glob("*.prj")
    return path.read_text()
