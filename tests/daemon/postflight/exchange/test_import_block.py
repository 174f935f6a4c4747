"""Blocks of other programs become projects that `syntopic adjust` brings to their truth."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.adjustment.project import read_project
from daemon.postflight.exchange.block import (
    Block,
    BlockCamera,
    BlockError,
    BlockImage,
    BlockPoints,
)
from daemon.postflight.exchange.colmap import colmap_texts, read_colmap
from daemon.postflight.exchange.opensfm import read_opensfm
from processing.geometry.forward_distortion import ForwardDistortion

RUN = CliRunner()
F, K1, K2 = 1500.0, -0.05, 0.01
SIZE = (1600, 1200)


@pytest.fixture(scope="module")
def scene():
    return block_scene(K1, K2)


def block_scene(k1: float, k2: float):
    """Nine nadir images over uneven ground, and their measurements with 0.3 px of noise.

    Projection is written here: vision axes, f, k1, k2 about the middle.
    """
    random = np.random.default_rng(4)
    points = np.column_stack([random.uniform(-150, 150, (120, 2)), random.uniform(-20, 20, 120)])
    centres, turns = [], []
    for k in range(9):
        centres.append(np.array([60.0 * (k % 3 - 1), 60.0 * (k // 3 - 1), 200.0 + random.normal()]))
        tilt = Rotation.from_euler(
            "xyz", random.normal(0, 2, 3) + np.array([0, 0, 30 * k]), degrees=True
        )
        turns.append((tilt * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))).as_matrix())
    seen = []
    for k in range(9):
        x, y, z = ((points - centres[k]) @ turns[k]).T
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        u, v = F * x * radial, F * y * radial
        seen += [
            (k, p, float(u[p] + random.normal(0, 0.3)), float(v[p] + random.normal(0, 0.3)))
            for p in np.flatnonzero((np.abs(u) < 795) & (np.abs(v) < 595)).tolist()
        ]
    return points, centres, turns, seen


def colmap(scene, folder: Path, k1: float = K1, k2: float = K2) -> Path:
    points, centres, turns, seen = scene
    flip = np.diag([1.0, -1.0, -1.0])
    middle = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    model = ForwardDistortion(F, F, *middle, k1=k1, k2=k2)
    block = Block(
        "scene",
        (BlockCamera("camera1", *SIZE, model),),
        tuple(
            BlockImage(f"{k}.jpg", 0, k, c, t @ flip)
            for k, (c, t) in enumerate(zip(centres, turns, strict=True))
        ),
        points=BlockPoints(
            points,
            tuple(str(k + 1) for k in range(len(points))),
            np.array([k for k, *_ in seen]),
            np.array([p for _, p, *_ in seen]),
            np.array([(u + middle[0], v + middle[1]) for *_, u, v in seen]),
        ),
    )
    texts, _ = colmap_texts(block, None)
    folder.mkdir()
    for name, text in texts.items():
        (folder / name).write_text(text)
    return folder


def bundler(scene, folder: Path) -> Path:
    points, centres, turns, seen = scene
    rows = ["# Bundle file v0.3", f"9 {len(points)}"]
    for centre, turn in zip(centres, turns, strict=True):
        r = (turn @ np.diag([1.0, -1.0, -1.0])).T  # looks along -z, y up
        rows += [f"{F} {K1} {K2}", *(" ".join(map(repr, row)) for row in r.tolist())]
        rows.append(" ".join(map(repr, (-r @ centre).tolist())))
    for p, point in enumerate(points):
        rows += [" ".join(map(repr, point.tolist())), "128 128 128"]
        own = [(k, u, v) for k, q, u, v in seen if q == p]
        rows.append(" ".join([str(len(own)), *(f"{k} 0 {u!r} {-v!r}" for k, u, v in own)]))
    folder.mkdir()
    (folder / "bundle.out").write_text("\n".join(rows))
    return folder / "bundle.out"


def bal(scene, folder: Path) -> Path:
    points, centres, turns, seen = scene
    rows = [f"9 {len(points)} {len(seen)}"]
    rows += [f"{k} {p} {float(u)!r} {float(-v)!r}" for k, p, u, v in seen]
    for centre, turn in zip(centres, turns, strict=True):
        r = (turn @ np.diag([1.0, -1.0, -1.0])).T
        values = [*Rotation.from_matrix(r).as_rotvec(), *(-r @ centre), F, K1, K2]
        rows += [repr(float(v)) for v in values]
    rows += [repr(float(v)) for v in points.ravel()]
    folder.mkdir()
    (folder / "problem.txt").write_text("\n".join(rows) + "\n")
    return folder / "problem.txt"


def opensfm(scene, folder: Path) -> Path:
    """Written here by the format of OpenSfM: shares of the longer side about the middle."""
    points, centres, turns, seen = scene
    camera = {
        "projection_type": "perspective", "width": SIZE[0], "height": SIZE[1],
        "focal": F / SIZE[0], "k1": K1, "k2": K2,
    }  # fmt: skip
    shots = {
        f"{k}.jpg": {
            "rotation": Rotation.from_matrix(turn.T).as_rotvec().tolist(),
            "translation": (-turn.T @ centre).tolist(),
            "camera": "camera1",
        }
        for k, (centre, turn) in enumerate(zip(centres, turns, strict=True))
    }
    found = {str(7 + p): {"coordinates": xyz.tolist()} for p, xyz in enumerate(points)}
    content = [{"cameras": {"camera1": camera}, "shots": shots, "points": found}]
    rows = ["OPENSFM_TRACKS_VERSION_v2"]
    for k, p, u, v in [*seen, (0, 9000, 1.0, 1.0)]:
        place = f"{u / SIZE[0]!r}\t{v / SIZE[0]!r}"
        rows.append(f"{k}.jpg\t{7 + p}\t{p}\t{place}\t0.001\t1\t2\t3\t-1\t-1")
    folder.mkdir()
    (folder / "reconstruction.json").write_text(json.dumps(content))
    (folder / "tracks.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("VERSION_v2", "VERSION_v7", "tracks of version 7"),
        ("\t-1\t-1\n", "\n", "line 2: no line of OpenSfM's tracks \\(9 columns"),
        ("0.jpg\t", "0.jpg\t1\t", "12 columns"),
    ],
)
def test_damaged_tracks_of_opensfm_are_refused(scene, tmp_path, old, new, sentence) -> None:
    path = opensfm(scene, tmp_path / "in")
    text = (path / "tracks.csv").read_text()
    assert old in text
    (path / "tracks.csv").write_text(text.replace(old, new, 1))
    with pytest.raises(BlockError, match=sentence):
        read_opensfm(path)


@pytest.mark.parametrize(
    ("program", "write"),
    [("colmap", colmap), ("bundler", bundler), ("bal", bal), ("opensfm", opensfm)],
)
def test_an_imported_block_adjusts_to_the_truth(scene, tmp_path, program, write) -> None:
    path = write(scene, tmp_path / "in")
    done = RUN.invoke(
        app,
        ["import", "block", str(path), "--from", program, "--out", str(tmp_path / "project"),
         "--image-sigma", "0.3", "--position-sigma", "0.05", "0.05", "0.05", "--metric", "--json"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output + str(done.exception)
    content = json.loads(done.stdout)
    assert content["images"] == 9 and 0.0 < content["residuals_px"]["camera1"] < 0.02
    adjusted = RUN.invoke(app, ["adjust", str(tmp_path / "project"), "--json"])
    assert adjusted.exit_code == 0, adjusted.output + str(adjusted.exception)
    report = json.loads(adjusted.stdout)
    assert report["sigma0"] == pytest.approx(1.0, abs=0.1), "0.3 px of noise, stated as 0.3 px"
    project = read_project(tmp_path / "project/project.toml")
    assert np.abs(project.network.stations.position_m - np.array(scene[1])).max() < 1e-6


def imported_and_adjusted(path: Path, out: Path) -> tuple[dict, dict]:
    done = RUN.invoke(
        app,
        ["import", "block", str(path), "--from", "colmap", "--out", str(out), "--image-sigma",
         "0.3", "--position-sigma", "0.05", "0.05", "0.05", "--metric", "--json"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output + str(done.exception)
    adjusted = RUN.invoke(app, ["adjust", str(out), "--json"])
    report = json.loads(adjusted.stdout)
    assert adjusted.exit_code == int(report["sigma0"] > 20.0), adjusted.output
    return json.loads(done.stdout), report


STRONG = (-0.28, 0.12)


def test_a_brown_distortion_that_does_not_fit_keeps_its_model(tmp_path) -> None:
    """As real cameras have it: the ten parameters leave a quarter of a pixel in the corners."""
    path = colmap(block_scene(*STRONG), tmp_path / "in", *STRONG)
    content, report = imported_and_adjusted(path, tmp_path / "project")
    note = content["notes"][-1]
    assert "keeps its own model, opencv" in note and "0.02 px is the limit" in note
    assert content["residuals_px"] == {"camera1": 0.0}
    assert report["sigma0"] == pytest.approx(1.0, abs=0.1)
    (camera,) = read_project(tmp_path / "project/project.toml").network.cameras
    assert camera.model == "opencv"
    assert np.allclose(camera.interior[3:], [*STRONG, 0, 0, 0, 0, 0], atol=1e-9)
    # The other sign of k1 in the file is no longer the camera that took the measurements.
    wrong = colmap(block_scene(*STRONG), tmp_path / "wrong", 0.28, -0.12)
    _, report = imported_and_adjusted(wrong, tmp_path / "other")
    assert report["sigma0"] > 5.0


def changed_camera(path: Path, place: int, value: float) -> None:
    """FULL_OPENCV: fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6."""
    lines = (path / "cameras.txt").read_text().splitlines()
    words = lines[-1].split()
    assert words[1] == "FULL_OPENCV"
    words[4 + place] = repr(value)
    (path / "cameras.txt").write_text("\n".join([*lines[:-1], " ".join(words)]) + "\n")


def test_pixels_that_are_not_square_are_carried_with_the_model(tmp_path) -> None:
    points, centres, turns, seen = block_scene(*STRONG)
    wider = [(k, p, u * 1.001, v) for k, p, u, v in seen]
    path = colmap((points, centres, turns, wider), tmp_path / "in", *STRONG)
    changed_camera(path, 0, F * 1.001)
    _, report = imported_and_adjusted(path, tmp_path / "project")
    assert report["sigma0"] == pytest.approx(1.0, abs=0.1)


def test_another_distortion_that_does_not_fit_is_taken_out_of_the_measurements(tmp_path) -> None:
    path = colmap(block_scene(*STRONG), tmp_path / "in", *STRONG)
    changed_camera(path, 9, 1e-5)
    content, report = imported_and_adjusted(path, tmp_path / "project")
    assert "The measurements are corrected for it" in content["notes"][-1]
    assert report["sigma0"] == pytest.approx(1.0, abs=0.1)
    project = read_project(tmp_path / "project/project.toml")
    (camera,) = project.network.cameras
    assert camera.model == "australis" and not camera.interior.any()
    # Corrected measurements may lie outside the frame.
    assert project.file.camera[0].width_px is None


def test_a_measurement_that_no_ray_has_is_refused(tmp_path) -> None:
    """k1 = -0.6 folds the image over inside its border: the corners have no ray."""
    path = colmap(block_scene(*STRONG), tmp_path / "in", -0.6, 0.0)
    done = RUN.invoke(
        app, ["import", "block", str(path), "--from", "colmap", "--out", str(tmp_path / "p")]
    )
    assert done.exit_code != 0 and not (tmp_path / "p").exists()
    assert re.search(r"has no inverse at \d+ of \d+ measurements", str(done.exception))


@pytest.mark.parametrize("end", ["", "\n", "\n\n", "\n\n\n"])
def test_a_last_image_without_measurements_is_not_lost(tmp_path, end) -> None:
    """Editors remove the empty line of measurements at the end of images.txt."""
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 100 80 50 50 50 40\n")
    (tmp_path / "points3D.txt").write_text("")
    rows = "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 1 0 0 1 b.jpg"
    (tmp_path / "images.txt").write_text(rows + end)
    assert [image.name for image in read_colmap(tmp_path).images] == ["a.jpg", "b.jpg"]


def test_all_three_give_the_same_project(scene, tmp_path) -> None:
    found = []
    for program, write in (("colmap", colmap), ("bundler", bundler), ("bal", bal)):
        out = tmp_path / f"{program}-project"
        path = write(scene, tmp_path / program)
        done = RUN.invoke(app, ["import", "block", str(path), "--from", program, "--out", str(out)])
        assert done.exit_code == 0, done.output + str(done.exception)
        network = read_project(out / "project.toml").network
        table = network.image_points
        order = np.lexsort((table.point, table.image))
        found.append((network, table.xy_mm[order]))
    for other, xy_mm in found[1:]:
        assert np.allclose(xy_mm, found[0][1], atol=1e-8)
        assert np.allclose(other.attitudes.rotation, found[0][0].attitudes.rotation, atol=1e-9)
        assert np.allclose(other.points.xyz_m, found[0][0].points.xyz_m, atol=1e-9)


def test_a_shift_of_half_a_pixel_is_seen_in_the_principal_point(scene, tmp_path) -> None:
    """A file whose pixel centres are at whole numbers, against COLMAP's definition."""
    path = colmap(scene, tmp_path / "in")
    found = []
    for shift in (0.0, -0.5):
        lines = (path / "cameras.txt").read_text().splitlines()
        words = lines[1].split()
        words[6], words[7] = str(float(words[6]) + shift), str(float(words[7]) + shift)
        (path / "cameras.txt").write_text("\n".join([lines[0], " ".join(words)]) + "\n")
        out = tmp_path / f"project{shift}"
        RUN.invoke(app, ["import", "block", str(path), "--from", "colmap", "--out", str(out)])
        (camera,) = read_project(out / "project.toml").network.cameras
        found.append((camera.xp_mm / 1e-3, camera.yp_mm / 1e-3))
    assert np.allclose(found, [(0.0, 0.0), (-0.5, 0.5)], atol=1e-9)


@pytest.mark.parametrize(
    ("program", "write", "old", "new", "sentence"),
    [
        ("bundler", bundler, "# Bundle file v0.3", "# Bundle", "does not begin with"),
        ("bundler", bundler, "1500.0", "inf", "finite number"),
        ("bal", bal, "9 120 ", "9 120000 ", "ends before its last number|an observation"),
        ("bal", bal, "\n0 ", "\n99 ", "an observation of image 99"),
    ],
)
def test_damaged_bundles_are_refused(scene, tmp_path, program, write, old, new, sentence) -> None:
    path = write(scene, tmp_path / "in")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    done = RUN.invoke(
        app, ["import", "block", str(path), "--from", program, "--out", str(tmp_path / "p")]
    )
    assert done.exit_code != 0 and not (tmp_path / "p").exists()
    assert re.search(sentence, str(done.exception))
