"""Files of other programs that were cut, or that belong to another model: refused, or stated.

Each file is imported whole first, and then less of it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.exchange.block import BlockError
from daemon.postflight.exchange.block_project import import_block
from tests.daemon.postflight.exchange.test_import_block import (
    bal,
    block_scene,
    bundler,
    colmap,
    opensfm,
)
from tests.daemon.postflight.exchange.test_import_photogrammetry import bingo, patb

Edit = Callable[[list[str]], list[str]]


@pytest.fixture(scope="module")
def scene():
    return block_scene(0.0, 0.0)


def model(scene, folder: Path) -> Path:
    return colmap(scene, folder, 0.0, 0.0)


def edit(file: Path, change: Edit) -> None:
    lines = file.read_text().split("\n")
    changed = change(lines)
    assert changed != lines
    file.write_text("\n".join(changed))


def refused(path: Path, program: str, out: Path, *words: str) -> None:
    with pytest.raises(BlockError) as caught:
        import_block(path, program, out)
    for word in words:
        assert word in str(caught.value), str(caught.value)
    assert not out.exists()


def announced(file: Path, line: str) -> None:
    """A line of COLMAP's head, which our exporter does not write."""
    file.write_text(f"{line}\n{file.read_text()}")


def test_counts_that_colmap_announces_are_compared(scene, tmp_path) -> None:
    path, out = model(scene, tmp_path / "in"), tmp_path / "out"
    measured = len(scene[3])
    announced(path / "cameras.txt", "# Number of cameras: 1")
    announced(
        path / "images.txt",
        f"# Number of images: 9, mean observations per image: {measured / 9:.6g}",
    )
    announced(
        path / "points3D.txt", f"# Number of points: 120, mean track length: {measured / 120!r}"
    )
    import_block(path, "colmap", tmp_path / "whole")
    for file, old, new, words in (
        ("cameras.txt", "cameras: 1", "cameras: 2", ("announces 2 cameras, and 1 are in it",)),
        ("images.txt", "images: 9", "images: 10", ("announces 10 images, and 9 are in it",)),
        ("points3D.txt", "points: 120", "points: 121", ("announces 121 points, and 120 are in",)),
        (
            "images.txt",
            f"{measured / 9:.6g}",
            f"{(measured + 1) / 9:.6g}",
            (f"announces {measured + 1} measurements, and {measured} were read", "images.txt"),
        ),
    ):
        text = (path / file).read_text()
        assert old in text
        (path / file).write_text(text.replace(old, new))
        refused(path, "colmap", out, file, *words)
        (path / file).write_text(text)


def test_an_image_that_was_cut_off_is_missed_by_its_points(scene, tmp_path) -> None:
    path = model(scene, tmp_path / "in")
    edit(path / "images.txt", lambda lines: [*lines[:-3], ""])
    (path / "frames.txt").unlink()
    refused(path, "colmap", tmp_path / "out", "points3D.txt has a measurement", "in image 9")


def test_images_that_frames_list_are_in_the_model(scene, tmp_path) -> None:
    path = model(scene, tmp_path / "in")
    edit(path / "images.txt", lambda lines: [*lines[:-3], ""])
    refused(path, "colmap", tmp_path / "out", "frames.txt lists 1 images", "(9)", "was cut")


def test_a_line_of_measurements_that_was_cut_is_missed_by_its_points(scene, tmp_path) -> None:
    path = model(scene, tmp_path / "in")
    edit(path / "images.txt", lambda lines: [*lines[:-2], " ".join(lines[-2].split()[:-3]), ""])
    refused(path, "colmap", tmp_path / "out", "which images.txt has not", "1 measurements differ")


def test_tracks_of_another_model_are_refused(scene, tmp_path) -> None:
    """Two images exchanged: as many measurements, but other ones."""
    path = model(scene, tmp_path / "in")

    def exchanged(lines: list[str]) -> list[str]:
        first = next(k for k, line in enumerate(lines) if not line.startswith("#"))
        words = lines[first].split()
        words[8] = {"1": "2", "2": "1"}.get(words[8], "7")
        return [*lines[:first], " ".join(words), *lines[first + 1 :]]

    edit(path / "points3D.txt", exchanged)
    refused(path, "colmap", tmp_path / "out", "measurement of point 1 in image")


def test_points_without_tracks_promise_nothing(scene, tmp_path) -> None:
    path = model(scene, tmp_path / "in")
    edit(path / "points3D.txt", lambda lines: [" ".join(one.split()[:8]) if one[:1] != "#" else one
                                               for one in lines])  # fmt: skip
    done = import_block(path, "colmap", tmp_path / "out")
    assert len(done.block.points.image) == len(scene[3])


def test_tracks_of_opensfm_without_the_last_images_are_refused(scene, tmp_path) -> None:
    path = opensfm(scene, tmp_path / "in")
    whole = import_block(path, "opensfm", tmp_path / "whole")
    assert not any("cut" in note for note in whole.block.notes)
    edit(
        path / "tracks.csv",
        lambda lines: [one for one in lines if not one.startswith(("7.jpg", "8.jpg"))],
    )
    refused(
        path, "opensfm", tmp_path / "out", "tracks.csv: has no measurement of 2 of 9 images",
        "(7.jpg, 8.jpg)", "was cut",
    )  # fmt: skip


def test_an_image_of_a_rig_needs_no_measurement_of_its_own(scene, tmp_path) -> None:
    path = opensfm(scene, tmp_path / "in")
    (content,) = json.loads((path / "reconstruction.json").read_text())
    content["rig_instances"] = {"1": {"rig_camera_ids": {"7.jpg": "a", "8.jpg": "b"}}}
    (path / "reconstruction.json").write_text(json.dumps([content]))
    edit(
        path / "tracks.csv",
        lambda lines: [one for one in lines if not one.startswith("8.jpg")],
    )
    done = import_block(path, "opensfm", tmp_path / "out")
    assert "1 of 9 images have no measurement in the files: 8.jpg" in done.block.notes[0]


def test_points_of_fewer_than_two_measurements_are_counted_by_name(scene, tmp_path) -> None:
    path = opensfm(scene, tmp_path / "in")
    whole = import_block(path, "opensfm", tmp_path / "whole")
    rays = np.bincount([point for _, point, *_ in scene[3]], minlength=120)
    few = [str(7 + p) for p in np.flatnonzero(rays < 2)]
    (before,) = [note for note in whole.block.notes if "fewer than two" in note]
    assert before.startswith(f"{len(few)} of 120 points") and "7" not in few
    edit(path / "tracks.csv", lambda lines: [one for one in lines if one.split("\t")[1:2] != ["7"]])
    done = import_block(path, "opensfm", tmp_path / "out")
    (after,) = [note for note in done.block.notes if "fewer than two" in note]
    assert after.startswith(f"{len(few) + 1} of 120 points have") and ": 7, " in after


@pytest.mark.parametrize(
    ("program", "write", "file"),
    [
        ("bundler", bundler, "bundle.out"),
        ("bal", bal, "problem.txt"),
        ("colmap", model, "points3D.txt"),
        ("opensfm", opensfm, "tracks.csv"),
        ("patb", patb, "block.ori"),
        ("bingo", bingo, "orientation.bingo"),
    ],
)
def test_a_last_line_without_an_end_is_stated(scene, tmp_path, program, write, file) -> None:
    path = write(scene, tmp_path / "in")
    folder = path if path.is_dir() else path.parent
    text = (folder / file).read_text().rstrip("\n")
    (folder / file).write_text(text + "\n")
    whole = import_block(path, program, tmp_path / "whole")
    assert not any("ends within a line" in note for note in whole.block.notes)
    (folder / file).write_text(text)
    cut = import_block(path, program, tmp_path / "cut")
    assert f"{file} ends within a line; if it was cut, copy it again" in cut.block.notes


@pytest.mark.parametrize(("program", "write"), [("bundler", bundler), ("bal", bal)])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 0.999])
def test_a_bundle_that_was_cut_is_refused(scene, tmp_path, program, write, share) -> None:
    path = write(scene, tmp_path / "in")
    text = path.read_text()
    path.write_text(text[: int(share * len(text))])
    refused(path, program, tmp_path / "out", path.name, "ends before its last number; copy it")


def test_a_photo_that_was_cut_off_leaves_its_name_and_single_points(scene, tmp_path) -> None:
    path = patb(scene, tmp_path / "in")
    before = import_block(path, "patb", tmp_path / "whole").block
    text = (path / "block.im").read_text()
    photos = text.split("-99\n")
    (path / "block.im").write_text("-99\n".join(photos[:4]) + "-99\n")
    after = import_block(path, "patb", tmp_path / "out").block
    assert any("5 images without measurements: 5, 6, 7, 8, 9" in note for note in after.notes)
    single = len({p for k, p, *_ in scene[3] if k < 4}) - len(after.points.names)
    assert single > 0
    assert any(f"{single} points are measured in one image only" in note for note in after.notes)
    assert len(before.points.names) > len(after.points.names)
    lines = text.split("\n")
    (path / "block.im").write_text("\n".join(lines[: len(lines) // 2]) + "\n")
    refused(path, "patb", tmp_path / "cut", "block.im", "does not end with -99; copy it again")
