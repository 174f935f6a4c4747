"""Adjusted projects with their measurements for BINGO, PATB, Pix4D and Inpho, and back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.adjustment.project import read_project
from daemon.postflight.exchange.adjusted_block import FREE_SCALE
from daemon.postflight.exchange.block import BlockError
from daemon.postflight.exchange.block_project import READERS, import_block
from daemon.postflight.exchange.project_export import export_project
from tests.daemon.postflight.exchange.test_import_block import K1, K2, F, block_scene, colmap

RUN = CliRunner()
PROGRAMS = ("bingo", "patb", "pix4d", "inpho")
MEASUREMENTS = {
    "bingo": "block_bingo.txt",
    "patb": "block.im",
    "pix4d": "block_bingo.txt",
    "inpho": "block.prj",
}
SAME = ("cameras.txt", "photos.txt", "frame.json", "angles.txt")
FRAME = {"latitude_deg": 47.0, "longitude_deg": 15.0}
SIGMA_PX = 0.3


@pytest.fixture(scope="module")
def scene():
    return block_scene(K1, K2)


@pytest.fixture(scope="module")
def project(scene, tmp_path_factory) -> Path:
    """A free network with distortion, in a stated frame."""
    folder = tmp_path_factory.mktemp("measured")
    import_block(colmap(scene, folder / "in"), "colmap", folder / "project", sigma_px=SIGMA_PX)
    (folder / "project" / "frame.json").write_text(json.dumps(FRAME))
    return folder / "project"


@pytest.fixture(scope="module")
def exported(project, tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("exported")
    for program in PROGRAMS:
        export_project(project, program, folder / program)
    return {program: folder / program for program in PROGRAMS}


def adjusted(folder: Path) -> float:
    done = RUN.invoke(app, ["adjust", str(folder), "--json"])
    assert done.exit_code == 0, done.output
    return float(json.loads(done.stdout)["sigma0"])


@pytest.mark.parametrize("program", PROGRAMS)
def test_exported_imported_and_exported_again(project, exported, tmp_path, program) -> None:
    folders = [exported[program]]
    for round_trip in range(2 if program == "patb" else 1):
        again = tmp_path / f"project-{round_trip}"
        done = import_block(folders[-1], program, again, sigma_px=SIGMA_PX)
        assert done.block.frame is not None and done.block.is_metric
        folders.append(tmp_path / f"files-{round_trip}")
        export_project(again, program, folders[-1])
    # Residuals of corrected measurements are those of an image that is a little larger.
    is_same = program == "pix4d"
    assert adjusted(again) == pytest.approx(adjusted(project), abs=1e-3 if is_same else 0.02)
    compare(program, *folders[:2], 5e-4 if is_same else 0.02)
    if program == "patb":
        compare(program, *folders[1:], 5e-4)


def compare(program: str, first: Path, second: Path, to_m: float) -> None:
    """Measurements and cameras are the same; the rest was adjusted again from rounded values."""
    names = {path.name for path in first.iterdir()}
    assert {path.name for path in second.iterdir()} == names
    for name in names:
        one, other = (first / name).read_text(), (second / name).read_text()
        if name == "angles.txt":
            one, other = (text.split("note: ")[0] for text in (one, other))
        is_fitted = program == "pix4d" and name in ("cameras.txt", "camera1.cam")
        if not is_fitted and name in (MEASUREMENTS[program], *SAME) and name != "block.prj":
            assert one == other, name
            continue
        if name == "block.prj":
            kept = [row for row in one.splitlines() if row.endswith("{ * }")]
            assert kept == [row for row in other.splitlines() if row.endswith("{ * }")] != []
        to = 10 * to_m if name == "object_points.txt" else to_m
        if is_fitted:
            to = 1e-4 if name == "camera1.cam" else 1e-5
        for a, b in zip(one.splitlines(), other.splitlines(), strict=True):
            for x, y in zip(a.split(), b.split(), strict=True):
                assert x == y or float(x) == pytest.approx(float(y), rel=0.0, abs=to), name


def rotations(program: str, folder: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Places and rotations by the programs' own descriptions, written here."""
    if program == "patb":
        words = (folder / "orientation.ori").read_text().split()
        rows = [words[k : k + 13] for k in range(0, len(words), 13)]
        return [(np.array(r[1:4], float), np.array(r[4:], float).reshape(3, 3)) for r in rows]
    if program == "inpho":
        lines = (folder / "block.prj").read_text().splitlines()
        at = [k for k, line in enumerate(lines) if "$EXT_ORI" in line]
        return [
            (
                np.array(lines[k + 1].split()[1:], float),
                np.array([lines[k + n].split() for n in (2, 3, 4)], float),
            )
            for k in at
        ]
    name, order, per_deg = (
        ("orientation.bingo", "YXZ", 0.9)
        if program == "bingo"
        else ("external_camera_parameters.txt", "XYZ", 1.0)
    )
    rows = [line.split() for line in (folder / name).read_text().splitlines()]
    return [
        (
            np.array(row[1:4], float),
            Rotation.from_euler(
                order, np.array(row[4:], float) * per_deg, degrees=True
            ).as_matrix(),
        )
        for row in rows
        if row[0] != "imageName"
    ]


@pytest.mark.parametrize("program", ["bingo", "patb", "inpho"])
def test_points_project_onto_measurements_without_distortion(scene, exported, program) -> None:
    """Collinearity alone, with f of cameras.txt, on coordinates as the files have them."""
    folder = exported[program]
    f_mm, x0, y0 = map(float, (folder / "cameras.txt").read_text().splitlines()[1].split()[1:4])
    assert f_mm == pytest.approx(F * 1e-3, abs=1e-6)
    xyz = {
        row.split()[0]: np.array(row.split()[1:4], float)
        for row in (folder / "object_points.txt").read_text().splitlines()[1:]
    }
    found, image, off = rotations(program, folder), -1, []
    for row in (folder / MEASUREMENTS[program]).read_text().splitlines():
        words = row.split()
        if row.startswith("$PHOTO") or (program != "inpho" and len(words) == 2):
            image += 1
        elif words and words[0] in xyz and len(words) >= 3:
            centre, turn = found[image]
            x, y, z = turn.T @ (xyz[words[0]] - centre)
            scale = 1e-3 if program == "patb" else 1.0
            own = np.array(words[1:3], float) * scale
            if program != "inpho":
                own -= [x0, y0]
            off.append(own - [-f_mm * x / z, -f_mm * y / z])
    off_px = np.array(off) * 1e3
    assert len(off_px) > 300 and np.sqrt((off_px**2).mean()) < SIGMA_PX
    raw = np.array([(u, v) for *_, u, v in scene[3]])
    assert np.abs(raw).max() * abs(K1) * (np.hypot(*raw.T).max() / F) ** 2 > 5.0, (
        "it has distortion"
    )


def test_the_format_grows_where_corrected_corners_need_it(exported) -> None:
    rows = {p: (exported[p] / "cameras.txt").read_text().splitlines()[1].split() for p in PROGRAMS}
    assert rows["pix4d"][-2:] == ["1600", "1200"]
    assert rows["bingo"][-2:] == rows["patb"][-2:] == rows["inpho"][-2:] != ["1600", "1200"]
    assert (
        "measurements are corrected for distortion, by "
        in (exported["bingo"] / "angles.txt").read_text()
    )


def test_names_that_patb_does_not_know_become_numbers(project, tmp_path) -> None:
    named = tmp_path / "named"
    named.mkdir()
    for path in project.iterdir():
        text = path.read_text()
        if path.name == "points.csv":
            text = text.replace("\n12,", "\nchurch,")
        if path.name == "image_points.csv":
            text = text.replace(",12,", ",church,")
        (named / path.name).write_text(text)
    (named / "frame.json").unlink()
    assert "church" in read_project(named / "project.toml").network.points.names
    done = RUN.invoke(
        app, ["export", "project", str(named), "--to", "patb", "--out", str(tmp_path / "out")]
    )
    assert done.exit_code == 0, done.output
    assert "points have numbers in PATB's files" in done.output.replace("\n", " ")
    assert FREE_SCALE in done.output.replace("\n", " ")
    assert f"note: {FREE_SCALE}\n" in (tmp_path / "out" / "angles.txt").read_text()
    rows = (tmp_path / "out" / "object_points.txt").read_text().splitlines()
    (row,) = [row.split() for row in rows if row.endswith(" church")]
    assert row[0].isdigit() and f"\n{row[0]:>10} " in (tmp_path / "out" / "block.im").read_text()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (" 1.00 2 { * }", " 2.00 2 { * }", "a weight other than 1 is not carried"),
        ("  $END_POINTS\n", "", "has no \\$END_POINTS; copy it again"),
        ("    {point} ", "    {other} ", "is twice in this photo"),
        (" 1.00 2 { * }", "", None),
    ],
)
def test_damaged_measurements_of_inpho_are_refused(exported, tmp_path, old, new, sentence) -> None:
    text = (exported["inpho"] / "block.prj").read_text()
    measured = [row.split()[0] for row in text.splitlines() if row.endswith("{ * }")]
    old = old.replace("{point}", measured[0])
    assert old in text
    (tmp_path / "block.prj").write_text(text.replace(old, new.replace("{other}", measured[1])))
    if sentence is None:
        assert len(READERS["inpho"](tmp_path).points.image) > 300
        return
    with pytest.raises(BlockError, match=sentence):
        READERS["inpho"](tmp_path)


def test_measurements_of_inpho_are_of_the_system_of_its_principal_point(exported, tmp_path) -> None:
    """The affine moved by 40 px, with the principal point moved back: the same camera."""
    text = (exported["inpho"] / "block.prj").read_text()
    block = READERS["inpho"](exported["inpho"])
    changed = []
    for line in text.splitlines():
        words = line.split()
        if line.endswith("{ * }"):
            line = f"    {words[0]} {float(words[1]) + 0.04:.6f} {words[2]} 1.00 2 {{ * }}"
        elif len(words) == 3 and words[1] == "0.000000000000" and float(words[0]) > 0:
            line = f"    {words[0]} {words[1]} {float(words[2]) - 0.04 * float(words[0]):.6f}"
        elif "$PRINCIPAL_POINT_PPA" in line:
            line = "  $PRINCIPAL_POINT_PPA : 0.040000 0.000000"
        changed.append(line)
    (tmp_path / "block.prj").write_text("\n".join(changed) + "\n")
    moved = READERS["inpho"](tmp_path)
    assert moved.cameras[0].model.cx_px == pytest.approx(block.cameras[0].model.cx_px, abs=1e-5)
    assert np.abs(moved.points.px - block.points.px).max() < 1e-5


def test_y_of_inpho_reversed_is_named(exported, tmp_path) -> None:
    rows = []
    for line in (exported["inpho"] / "block.prj").read_text().splitlines():
        words = line.split()
        if line.endswith("{ * }"):
            line = f"    {words[0]} {words[1]} {-float(words[2]):.6f} 1.00 2 {{ * }}"
        rows.append(line)
    (tmp_path / "block.prj").write_text("\n".join(rows) + "\n")
    with pytest.raises(BlockError, match="y of the measurements reversed"):
        READERS["inpho"](tmp_path)


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--to", "patb", "--unit", "deg"), "patb has angles of its own"),
        (("--to", "colmap", "--unit", "deg"), "colmap has no angles"),
        (("--to", "bingo", "--angles", "heading-roll-pitch"), "omega-phi-kappa"),
    ],
)
def test_angles_that_a_program_does_not_take_are_refused(project, tmp_path, more, sentence) -> None:
    out = tmp_path / "out"
    done = RUN.invoke(app, ["export", "project", str(project), "--out", str(out), *more])
    assert done.exit_code == 2 or done.exit_code == 1
    assert sentence in f"{done.output}{done.stderr}{done.exception}" and not out.exists()
