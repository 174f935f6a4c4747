"""An adjusted project in other programs: pycolmap reads measurements and projects points."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.adjustment.project import CheckPoints, read_project
from daemon.postflight.adjustment.project_file import (
    AdjustmentHeadSection,
    AdjustSection,
    CameraSection,
    ProjectFile,
)
from daemon.postflight.adjustment.project_writer import write_project
from daemon.postflight.exchange.adjusted_block import block_of_project
from daemon.postflight.exchange.block import Block, BlockError
from daemon.postflight.exchange.block_project import import_block
from daemon.postflight.exchange.colmap import read_colmap
from daemon.postflight.exchange.opensfm import read_opensfm
from processing.bundle.network import HeadMounting
from tests.daemon.postflight.exchange.test_import_block import K1, K2, F, block_scene, colmap
from tests.processing.bundle.simulated_networks import aerial

pycolmap = pytest.importorskip("pycolmap")
pytestmark = pytest.mark.peer

RUN = CliRunner()
SIGMA_PX = 0.3
FRAME = {"latitude_deg": 47.0, "longitude_deg": 15.0}


@pytest.fixture(scope="module")
def scene():
    return block_scene(K1, K2)


@pytest.fixture
def project(scene, tmp_path) -> Path:
    """Of a COLMAP model, with positions that are 5 cm accurate, in a stated frame."""
    out = tmp_path / "project"
    import_block(
        colmap(scene, tmp_path / "in"), "colmap", out,
        sigma_px=SIGMA_PX, position_sigma_m=(0.05, 0.05, 0.05), is_metric=True,
    )  # fmt: skip
    (out / "frame.json").write_text(json.dumps(FRAME))
    return out


def export(project: Path, program: str, out: Path) -> dict:
    done = RUN.invoke(
        app, ["export", "project", str(project), "--to", program, "--out", str(out), "--json"]
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    return json.loads(done.stdout)


def residuals(model) -> np.ndarray:
    """Measured less projected by pycolmap, px, (n, 2)."""
    found = []
    for image in model.images.values():
        for keypoint in image.points2D:
            if keypoint.has_point3D():
                seen = image.project_point(model.points3D[keypoint.point3D_id].xyz)
                found.append(keypoint.xy - seen)
    return np.array(found)


def test_pycolmap_reads_every_measurement_and_projects_the_points_onto_it(
    scene, project, tmp_path
) -> None:
    done = export(project, "colmap", tmp_path / "sparse")
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    points, centres, _, seen = scene
    rays = np.bincount([p for _, p, *_ in seen], minlength=len(points))
    seen = [one for one in seen if rays[one[1]] > 1]
    names = points_by_name(project)
    assert (len(model.images), done["images"], done["image_points"]) == (9, 9, len(seen))
    images = {image.name: image for image in model.images.values()}
    for k, p, u, v in seen:
        track = model.points3D[names[str(p + 1)] + 1].track
        (place,) = [
            images[f"{k}.jpg"].points2D[one.point2D_idx].xy
            for one in track.elements
            if one.image_id == images[f"{k}.jpg"].image_id
        ]
        assert np.abs(place - [u + 800.0, v + 600.0]).max() < 1e-6
    off = residuals(model)
    assert len(off) == len(seen)
    redundancy = 1.0 - (3 * len(model.points3D) + 6 * 9) / off.size
    assert np.sqrt((off**2).mean()) == pytest.approx(SIGMA_PX * np.sqrt(redundancy), rel=0.1)
    assert np.abs(np.median(off, axis=0)).max() < 0.05, "no shift of half a pixel"
    for name, image in images.items():
        assert np.abs(image.projection_center() - centres[int(name[0])]).max() < 0.2
    for name, k in names.items():
        assert np.linalg.norm(model.points3D[k + 1].xyz - points[int(name) - 1]) < 2.0


def points_by_name(project: Path) -> dict[str, int]:
    block, _ = block_of_project(project)
    return {name: k for k, name in enumerate(block.points.names)}


def test_estimated_parameters_are_exported_and_not_the_given_ones(scene, tmp_path) -> None:
    path = colmap(scene, tmp_path / "in")
    text = (path / "cameras.txt").read_text()
    assert " 1500.0 1500.0 " in text
    (path / "cameras.txt").write_text(text.replace(" 1500.0 1500.0 ", " 1503.0 1503.0 "))
    out = tmp_path / "project"
    import_block(
        path, "colmap", out, sigma_px=SIGMA_PX, position_sigma_m=(0.05, 0.05, 0.05), is_metric=True
    )
    toml = (out / "project.toml").read_text()
    changed = re.sub(
        r"(\[\[camera\]\]\n)", r'\1free = ["df"]\nsigma = { df = 0.01 }\n', toml, count=1
    )
    assert changed != toml
    (out / "project.toml").write_text(changed)
    export(out, "colmap", tmp_path / "sparse")
    (camera,) = pycolmap.Reconstruction(tmp_path / "sparse").cameras.values()
    adjusted = json.loads(RUN.invoke(app, ["adjust", str(out), "--json"]).stdout)
    (estimated,) = adjusted["cameras"]
    assert abs(estimated["principal_distance_mm"] - F * 1e-3) < 3e-3
    assert camera.focal_length_x == pytest.approx(
        estimated["principal_distance_mm"] * 1e3, abs=0.01
    )
    off = residuals(pycolmap.Reconstruction(tmp_path / "sparse"))
    assert np.sqrt((off**2).mean()) < SIGMA_PX


def sorted_measurements(block: Block) -> np.ndarray:
    points = block.points
    order = np.lexsort((points.point, points.image))
    return np.column_stack([points.image, points.point, points.px])[order]


@pytest.mark.parametrize(("program", "read"), [("colmap", read_colmap), ("opensfm", read_opensfm)])
def test_imported_and_exported_again_it_is_the_same_block(project, tmp_path, program, read) -> None:
    first = tmp_path / "first"
    export(project, program, first)
    again = tmp_path / "again"
    import_block(
        first, program, again,
        sigma_px=SIGMA_PX, position_sigma_m=(0.05, 0.05, 0.05), is_metric=True,
    )  # fmt: skip
    # The positions of the file are the adjusted ones: observed again, they change nothing.
    (again / "frame.json").write_text(json.dumps(FRAME))
    export(again, program, tmp_path / "second")
    one, other = read(first), read(tmp_path / "second")
    assert np.abs(one.points.xyz_m - other.points.xyz_m).max() < 0.5
    assert sorted_measurements(one) == pytest.approx(sorted_measurements(other), abs=1e-6)
    for a, b in zip(one.images, other.images, strict=True):
        assert a.name == b.name and np.abs(a.centre_m - b.centre_m).max() < 0.02
    if program == "opensfm":
        assert one.frame.name == other.frame.name and one.points.names == other.points.names


def test_both_programs_hold_the_same_block(project, tmp_path) -> None:
    export(project, "colmap", tmp_path / "sparse")
    export(project, "opensfm", tmp_path / "sfm")
    one, other = read_colmap(tmp_path / "sparse"), read_opensfm(tmp_path / "sfm")
    for a, b in zip(one.images, other.images, strict=True):
        assert np.abs(a.centre_m - b.centre_m).max() < 1e-9
        assert np.abs(a.rotation - b.rotation).max() < 1e-9
    assert np.abs(one.points.xyz_m - other.points.xyz_m).max() < 1e-9
    assert np.abs(sorted_measurements(one) - sorted_measurements(other)).max() < 1e-9


def test_measurements_that_the_adjustment_rejects_are_left_out(project, tmp_path) -> None:
    path = project / "image_points.csv"
    lines = path.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if not line.startswith(("#", "image")))
    words = lines[at].split(",")
    header = next(line for line in lines if line.startswith("image,")).split(",")
    column = header.index("x_mm") if "x_mm" in header else header.index("column_px")
    words[column] = repr(float(words[column]) + (0.05 if "x_mm" in header else 50.0))
    lines[at] = ",".join(words)
    path.write_text("\n".join(lines) + "\n")
    toml = (project / "project.toml").read_text()
    (project / "project.toml").write_text(
        toml.replace("[adjust]\n", "[adjust]\nreject_beyond = 5.0\n", 1)
    )
    before = len(read_project(project / "project.toml").network.image_points.image)
    done = export(project, "colmap", tmp_path / "sparse")
    assert done["image_points"] == before - 1
    assert np.abs(residuals(pycolmap.Reconstruction(tmp_path / "sparse"))).max() < 2.0


def test_heads_of_an_exposure_have_poses_of_their_own(tmp_path) -> None:
    sigma_mm, pixel_mm = 1e-3, 4e-3
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    head = HeadMounting("h", turn, np.array([0.4, 0.1, 0.0]))
    network = aerial(seed=3, sigma_mm=sigma_mm, points=80, gnss_sigma_m=0.05, heads=(head,)).network
    (camera,) = network.cameras
    reach = np.abs(network.image_points.xy_mm).max(axis=0)
    section = CameraSection(
        name=camera.name, f_mm=camera.f_mm, xp_mm=camera.xp_mm, yp_mm=camera.yp_mm,
        pixel_um=pixel_mm * 1e3, width_px=2 * int(reach[0] / pixel_mm + 2),
        height_px=2 * int(reach[1] / pixel_mm + 2),
        **dict(zip(("dx0", "dy0", "df", "k1", "k2", "k3", "p1", "p2", "b1", "b2"),
                   map(float, camera.interior), strict=True)),
    )  # fmt: skip
    heads = AdjustmentHeadSection(name="h", kappa_deg=90.0, x_m=0.4, y_m=0.1)
    file = ProjectFile(
        format=1, name="heads", adjust=AdjustSection(), camera=(section,), head=(heads,)
    )
    write_project(
        tmp_path / "p", file, network, CheckPoints((), np.zeros((0, 3)), np.zeros((0, 3)))
    )
    export(tmp_path / "p", "colmap", tmp_path / "sparse")
    off = residuals(pycolmap.Reconstruction(tmp_path / "sparse"))
    assert np.sqrt((off**2).mean()) < 1.2 * sigma_mm / pixel_mm


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (r"width_px = \d+\n", "", "states no pixel size or format; add pixel_um"),
        (r"\[adjust\]\n", "[adjust]\nrefraction = true\n", "earth curvature or refraction"),
    ],
)
def test_projects_that_no_program_can_hold_are_refused(
    project, tmp_path, old, new, sentence
) -> None:
    path = project / "project.toml"
    text = path.read_text()
    changed = re.sub(old, new, text, count=1)
    assert changed != text
    path.write_text(changed)
    done = RUN.invoke(
        app, ["export", "project", str(project), "--to", "colmap", "--out", str(tmp_path / "x")]
    )
    assert isinstance(done.exception, BlockError), done.output + repr(done.exception)
    assert re.search(sentence, str(done.exception)) and not (tmp_path / "x").exists()


def test_a_project_that_contradicts_itself_is_refused(scene, tmp_path) -> None:
    """Stated as accurate to 0.005 px, measurements of 0.3 px contradict each other."""
    out = tmp_path / "project"
    import_block(colmap(scene, tmp_path / "in"), "colmap", out, sigma_px=0.005)
    with pytest.raises(BlockError, match=r"sigma0 [56]\d.*contradict each other"):
        block_of_project(out)


def test_a_folder_that_is_there_and_another_program_are_refused(project, tmp_path) -> None:
    (tmp_path / "there").mkdir()
    for program, out, sentence in (
        ("colmap", "there", "is there already"),
        ("bluh", "new", "colmap, opensfm, bingo, patb, pix4d, inpho are right"),
    ):
        done = RUN.invoke(
            app, ["export", "project", str(project), "--to", program, "--out", str(tmp_path / out)]
        )
        assert done.exit_code != 0 and sentence in str(done.exception)
    (project / "frame.json").unlink()
    done = RUN.invoke(
        app, ["export", "project", str(project), "--to", "opensfm", "--out", str(tmp_path / "n")]
    )
    assert "OpenSfM states the frame" in str(done.exception)
