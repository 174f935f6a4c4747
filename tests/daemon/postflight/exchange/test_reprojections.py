"""Measurements of another convention than the block's own points and orientations are refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from daemon.postflight.exchange.block import BlockError
from daemon.postflight.exchange.block_project import import_block
from tests.daemon.postflight.exchange.test_import_block import (
    K1,
    K2,
    SIZE,
    F,
    bal,
    block_scene,
    bundler,
    colmap,
    opensfm,
)

W, H = SIZE
FLIP = np.diag([1.0, -1.0, -1.0])


def _with_measurements(path: Path, x: float, y: float) -> Path:
    """A BAL problem whose image coordinates are multiplied."""
    lines = path.read_text().splitlines()
    count = int(lines[0].split()[2])
    for k in range(1, count + 1):
        image, point, u, v = lines[k].split()
        lines[k] = f"{image} {point} {x * float(u)!r} {y * float(v)!r}"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [
        (1.0, -1.0, "their y is reversed"),
        (0.5, 0.5, "multiplied by 2 about the principal point"),
        (1.5, 1.5, "multiplied by 0.66"),
    ],
)
def test_reversed_and_scaled_measurements_are_refused(tmp_path, x, y, words) -> None:
    path = _with_measurements(bal(block_scene(K1, K2), tmp_path / "in"), x, y)
    with pytest.raises(BlockError, match=words):
        import_block(path, "bal", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_measurements_within_a_tenth_are_left_to_the_adjustment(tmp_path) -> None:
    path = _with_measurements(bal(block_scene(K1, K2), tmp_path / "in"), 1.1, 1.1)
    import_block(path, "bal", tmp_path / "out")


def test_a_model_with_byte_order_marks_is_read(tmp_path) -> None:
    path = colmap(block_scene(K1, K2), tmp_path / "in")
    for file in path.iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert import_block(path, "colmap", tmp_path / "out").block.images


@pytest.fixture(scope="module")
def scene():
    return block_scene(K1, K2)


def refused(path: Path, program: str, out: Path, words: str) -> None:
    with pytest.raises(BlockError, match=words) as caught:
        import_block(path, program, out)
    assert path.name in str(caught.value) and not out.exists()


def with_lines(path: Path, change: Callable[[int, list[str]], list[str]]) -> None:
    """Change the words of every line that is no comment, by its number among these."""
    rows, number = [], 0
    for row in path.read_text().split("\n"):
        if row.startswith("#"):
            rows.append(row)
            continue
        rows.append(" ".join(change(number, row.split())))
        number += 1
    path.write_text("\n".join(rows))


def measured(path: Path, change: Callable[[float, float], tuple[float, float]]) -> None:
    """Change the measurements of COLMAP's `images.txt`, whose first pixel's centre is at 0.5."""

    def of(number: int, words: list[str]) -> list[str]:
        if number % 2 == 0:
            return words
        triples = zip(words[::3], words[1::3], words[2::3], strict=True)
        return [w for x, y, p in triples for w in (*map(repr, change(float(x), float(y))), p)]

    with_lines(path / "images.txt", of)


def posed(path: Path, change: Callable[[np.ndarray, np.ndarray], list[float]]) -> None:
    """Change quaternion and translation of COLMAP's images; rigs and frames do not hold then."""
    for name in ("rigs.txt", "frames.txt"):
        (path / name).unlink()

    def of(number: int, words: list[str]) -> list[str]:
        if number % 2 or not words:
            return words
        values = np.array(words[1:8], float)
        return [words[0], *(repr(float(v)) for v in change(values[:4], values[4:])), *words[8:]]

    with_lines(path / "images.txt", of)


def camera(path: Path, text: str) -> None:
    (path / "cameras.txt").write_text(f"1 {text}\n")


def rotation_of(wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(wxyz, -1))


def pose(turn: Rotation, shift: np.ndarray) -> list[float]:
    return [*np.roll(turn.as_quat(), 1), *shift]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x, y: (y, x), "their columns and rows are exchanged"),
        (lambda x, y: (x, H - y), "their y is reversed"),
        (lambda x, y: (W - x, y), "their x is reversed"),
        (lambda x, y: (W - x, H - y), "their x and y are reversed"),
        (lambda x, y: (H - y, x), "they are turned by 90 degrees"),
        (lambda x, y: (y, W - x), "they are turned by 90 degrees"),
        (lambda x, y: (x - W / 2, y - H / 2), "their origin, .* is 800, 600 px away"),
        (lambda x, y: (x - W / 2, H / 2 - y), "their y is reversed, and their origin"),
        (lambda x, y: ((x - W / 2) * 0.004, (y - H / 2) * 0.004), "multiplied by 2[45].* and shif"),
        (lambda x, y: (x * 2.0, y * 2.0), "multiplied by 0.5 and shifted"),
    ],
)
def test_measurements_of_colmap_with_other_axes_origins_and_units(
    scene, tmp_path, change, words
) -> None:
    path = colmap(scene, tmp_path / "in")
    import_block(path, "colmap", tmp_path / "good")
    measured(path, change)
    refused(path, "colmap", tmp_path / "out", words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda q, t: pose(rotation_of(q).inv(), -rotation_of(q).inv().apply(t)),
            "world from the camera",
        ),
        (lambda q, t: pose(rotation_of(q).inv(), t), "the rotations are transposed"),
        (
            lambda q, t: pose(rotation_of(q), -rotation_of(q).inv().apply(t)),
            "translations are the projec",
        ),
        (lambda q, t: [*np.roll(q, -1), *t], "the quaternions are x, y, z, w"),
        (
            lambda q, t: pose(Rotation.from_matrix(FLIP) * rotation_of(q), FLIP @ t),
            "measurements are of points behind their images: y and z of the camera axes",
        ),
        (lambda q, t: pose(rotation_of(q), -t), "neither reversed or exchanged axes"),
    ],
)
def test_poses_of_colmap_of_another_convention(scene, tmp_path, change, words) -> None:
    path = colmap(scene, tmp_path / "in")
    posed(path, lambda q, t: [*q, *t])
    import_block(path, "colmap", tmp_path / "good")
    path = colmap(scene, tmp_path / "other")
    posed(path, change)
    refused(path, "colmap", tmp_path / "out", words)


@pytest.mark.parametrize(
    ("order", "factor", "words"),
    [
        ((1, 0, 2), 1.0, "columns X and Y of the points are exchanged"),
        ((0, 2, 1), 1.0, "columns Y and Z of the points are exchanged"),
        ((1, 2, 0), 1.0, "columns X, Y and Z of the points are exchanged"),
        ((0, 1, 2), (1, -1, 1), "Y of the points is reversed"),
        ((0, 1, 2), 0.3048, "the points are in metres and the orientations in feet"),
        ((0, 1, 2), 1e3, "the points are in millimetres and the orientations in metres"),
    ],
)
def test_points_of_colmap_with_other_columns_and_units(
    scene, tmp_path, order, factor, words
) -> None:
    path = colmap(scene, tmp_path / "in")

    def change(number: int, line: list[str]) -> list[str]:
        if not line:
            return line
        xyz = np.array(line[1:4], float)[list(order)] * factor
        return [line[0], *map(repr, xyz.tolist()), *line[4:]]

    with_lines(path / "points3D.txt", change)
    refused(path, "colmap", tmp_path / "out", words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"PINHOLE {H} {W} {F} {F} 800 600", "columns and rows are exchanged in one of them"),
        (f"PINHOLE {W} {H} {F} {F} 600 800", "columns and rows are exchanged in one of them"),
        (f"PINHOLE {W // 2} {H // 2} {F} {F} 800 600", "the size of the camera, or the origin"),
    ],
)
def test_cameras_of_colmap_with_columns_and_rows_exchanged(tmp_path, text, words) -> None:
    path = colmap(block_scene(0.0, 0.0), tmp_path / "in")
    camera(path, text)
    refused(path, "colmap", tmp_path / "out", words)


def test_a_principal_point_whose_x_and_y_are_exchanged(tmp_path) -> None:
    points, centres, turns, seen = block_scene(0.0, 0.0)
    moved = [(k, p, u - 160.0, v + 120.0) for k, p, u, v in seen if abs(u - 160) < W / 2 - 1]
    path = colmap((points, centres, turns, moved), tmp_path / "in", 0.0, 0.0)
    measured(path, lambda x, y: (x, min(y, H - 0.1)))
    camera(path, f"PINHOLE {W} {H} {F} {F} 640 720")
    import_block(path, "colmap", tmp_path / "good")
    camera(path, f"PINHOLE {W} {H} {F} {F} 720 640")
    refused(path, "colmap", tmp_path / "out", "x and y of the principal point are exchanged")
    camera(path, f"PINHOLE {H} {W} {F} {F} 640 720")
    refused(path, "colmap", tmp_path / "out", "columns and rows of the camera are exchanged: 0 lie")


def test_a_camera_and_measurements_that_are_exchanged_alike(tmp_path) -> None:
    """Portrait for landscape throughout: only the projections show it."""
    path = colmap(block_scene(0.0, 0.0), tmp_path / "in", 0.0, 0.0)
    measured(path, lambda x, y: (y, x))
    camera(path, f"PINHOLE {H} {W} {F} {F} 600 800")
    refused(path, "colmap", tmp_path / "out", "their columns and rows are exchanged")


@pytest.mark.parametrize(
    ("program", "write"), [("bundler", bundler), ("bal", bal), ("opensfm", opensfm)]
)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda u, v: (v, u), "their columns and rows are exchanged"),
        (lambda u, v: (u, -v), "their y is reversed"),
        (lambda u, v: (u + W / 2, v + H / 2), "their origin, .* is -800, -600 px away"),
        (lambda u, v: (0.75 * u, 0.75 * v), "multiplied by 1.33"),
    ],
)
def test_measurements_of_other_programs(scene, tmp_path, program, write, change, words) -> None:
    points, centres, turns, seen = scene
    good = import_block(write(scene, tmp_path / "good"), program, tmp_path / "project")
    assert not [note for note in good.block.notes if "projections" in note or "outside" in note]
    other = [(k, p, *change(u, v)) for k, p, u, v in seen]
    path = write((points, centres, turns, other), tmp_path / "in")
    refused(path, program, tmp_path / "out", words)


def test_a_bundle_with_axes_of_computer_vision(scene, tmp_path) -> None:
    points, centres, turns, seen = scene
    # The writer turns into Bundler's axes: twice is not at all.
    other = [turn @ FLIP for turn in turns]
    path = bundler((points, centres, other, seen), tmp_path / "in")
    refused(path, "bundler", tmp_path / "out", "y and z of the camera axes are reversed")


def test_rotation_vectors_in_degrees_are_refused(scene, tmp_path) -> None:
    path = opensfm(scene, tmp_path / "in")
    (content,) = json.loads((path / "reconstruction.json").read_text())
    for shot in content["shots"].values():
        shot["rotation"] = np.degrees(shot["rotation"]).tolist()
    (path / "reconstruction.json").write_text(json.dumps([content]))
    refused(path, "opensfm", tmp_path / "out", "angles have another order or unit")


def test_pixels_that_are_counted_from_another_origin_are_stated(scene, tmp_path) -> None:
    path = colmap(scene, tmp_path / "in")
    measured(path, lambda x, y: (x - 0.5, y - 0.5))
    notes = import_block(path, "colmap", tmp_path / "out").block.notes
    assert any(
        "projections of the points are 0.5" in note and "another origin" in note for note in notes
    )


def test_measurements_that_fit_hardly_are_stated_with_their_distance(scene, tmp_path) -> None:
    path = colmap(scene, tmp_path / "in", K1 + 0.05, K2)
    notes = import_block(path, "colmap", tmp_path / "out", sigma_px=0.3).block.notes
    assert any(
        "--image-sigma states 0.3 px" in note and "sign of the dis" in note for note in notes
    )
    same = import_block(path, "colmap", tmp_path / "same", sigma_px=30.0).block.notes
    assert not any("projections" in note for note in same)


def test_single_measurements_outside_of_their_image_are_named(scene, tmp_path) -> None:
    path = colmap(scene, tmp_path / "in")
    count = iter(range(10_000))
    measured(path, lambda x, y: (x + 2.0 * W, y) if next(count) < 2 else (x, y))
    notes = import_block(path, "colmap", tmp_path / "out").block.notes
    assert any("2 of " in note and "lie outside of their image" in note for note in notes)
    assert any("0.jpg, 1600 x 1200 px" in note for note in notes)


def with_poses(path: Path, order: dict[int, int], shift_m: float = 0.0) -> Path:
    """Give images of a model the poses of others, and move the last one."""
    for name in ("rigs.txt", "frames.txt"):
        (path / name).unlink()
    rows = (path / "images.txt").read_text().split("\n")
    at = [k for k, row in enumerate(rows) if row.endswith(".jpg")]
    given = [rows[k].split() for k in at]
    for k, row in enumerate(at):
        words = given[k].copy()
        words[1:8] = given[order.get(k, k)][1:8]
        if k == 8:
            words[5] = repr(float(words[5]) + shift_m)
        rows[row] = " ".join(words)
    (path / "images.txt").write_text("\n".join(rows))
    return path


def test_orientations_of_two_images_that_are_exchanged_are_named(scene, tmp_path) -> None:
    path = with_poses(colmap(scene, tmp_path / "in"), {2: 5, 5: 2})
    words = (
        r"measurements of 2 of 9 images .*: 2.jpg \(\d+ px; near with the orientation of 5.jpg\), "
        r"5.jpg \(\d+ px; near with the orientation of 2.jpg\)"
    )
    refused(path, "colmap", tmp_path / "out", words)


def test_one_image_of_another_adjustment_is_named(scene, tmp_path) -> None:
    path = with_poses(colmap(scene, tmp_path / "in"), {}, shift_m=30.0)
    refused(path, "colmap", tmp_path / "out", r"of 1 of 9 images .*: 8.jpg \(\d+ px\)\. Their")


def test_an_image_that_fits_a_little_worse_is_left_to_the_adjustment(scene, tmp_path) -> None:
    path = with_poses(colmap(scene, tmp_path / "in"), {}, shift_m=0.5)
    assert len(import_block(path, "colmap", tmp_path / "out").block.images) == 9
