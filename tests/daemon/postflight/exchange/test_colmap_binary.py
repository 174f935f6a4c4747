"""Binary models of COLMAP, written by pycolmap, are the text models in other bytes."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.exchange.block import Block, BlockError
from daemon.postflight.exchange.block_project import import_block
from daemon.postflight.exchange.colmap import read_colmap
from daemon.postflight.exchange.colmap_records import _MODELS
from tests.daemon.postflight.exchange.flown_block import fly
from tests.daemon.postflight.exchange.test_colmap import export
from tests.daemon.postflight.exchange.test_import_block import block_scene, colmap

pycolmap = pytest.importorskip("pycolmap")
pytestmark = pytest.mark.peer
PARTS = ("cameras", "images", "points3D", "rigs", "frames")


def both(text: Path, folder: Path) -> tuple[Path, Path]:
    """A model as pycolmap writes it: text, and binary."""
    model = pycolmap.Reconstruction(text)
    for name in ("text", "binary"):
        (folder / name).mkdir(parents=True)
    model.write_text(folder / "text")
    model.write_binary(folder / "binary")
    assert {path.name for path in (folder / "binary").iterdir()} == {f"{p}.bin" for p in PARTS}
    return folder / "text", folder / "binary"


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> tuple[Path, Path]:
    """A scene with measurements."""
    folder = tmp_path_factory.mktemp("measured")
    return both(colmap(block_scene(-0.05, 0.01), folder / "model"), folder)


@pytest.fixture(scope="module")
def of_rig(tmp_path_factory) -> tuple[Path, Path]:
    """Five heads of a rig, with distortion."""
    folder = tmp_path_factory.mktemp("of-rig")
    flown = fly(folder / "mission", "midas-mini", seconds=(5.0, 9.0))
    _, exported = export(flown, "--images", "raw", "--no-copies", to="colmap")
    return both(exported / "sparse", folder)


def same(one: Block, other: Block) -> None:
    assert [i.name for i in one.images] == [i.name for i in other.images]
    assert [(i.camera, i.frame) for i in one.images] == [(i.camera, i.frame) for i in other.images]
    for a, b in zip(one.images, other.images, strict=True):
        assert np.abs(a.centre_m - b.centre_m).max() < 1e-9
        assert np.abs(a.rotation - b.rotation).max() < 1e-12
    assert [c.model for c in one.cameras] == [c.model for c in other.cameras]
    assert [(c.width_px, c.height_px) for c in one.cameras] == [
        (c.width_px, c.height_px) for c in other.cameras
    ]
    by_name = [
        {
            (block.points.names[p], block.images[i].name): tuple(xy)
            for p, i, xy in zip(
                block.points.point, block.points.image, block.points.px.tolist(), strict=True
            )
        }
        for block in (one, other)
    ]
    assert by_name[0] == by_name[1]
    assert dict(zip(one.points.names, one.points.xyz_m.tolist(), strict=True)) == dict(
        zip(other.points.names, other.points.xyz_m.tolist(), strict=True)
    )


@pytest.mark.parametrize("of", ["measured", "of_rig"])
def test_both_forms_of_a_model_are_the_same_block(of, request) -> None:
    text, binary = request.getfixturevalue(of)
    same(read_colmap(text), read_colmap(binary))


def test_a_binary_model_is_imported_by_the_command(measured, tmp_path) -> None:
    done = import_block(measured[1], "colmap", tmp_path / "project")
    assert len(done.block.images) == 9 and len(done.block.points.px) > 300
    assert (tmp_path / "project/project.toml").exists()


def test_numbers_of_camera_models_are_those_of_pycolmap() -> None:
    for number, (name, count) in _MODELS.items():
        camera = pycolmap.Camera.create_from_model_name(1, name, 1000.0, 100, 80)
        assert (camera.model.value, len(camera.params)) == (number, count)


def copied(folder: Path, tmp_path: Path) -> Path:
    target = tmp_path / "model"
    target.mkdir()
    for path in folder.iterdir():
        (target / path.name).write_bytes(path.read_bytes())
    return target


@pytest.mark.parametrize("part", PARTS)
def test_files_that_were_cut_or_have_more_are_refused(measured, tmp_path, part) -> None:
    folder = copied(measured[1], tmp_path)
    path = folder / f"{part}.bin"
    whole = path.read_bytes()
    for cut in (4, 12, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(BlockError, match=f"{part}.bin: ends before its last record"):
            read_colmap(folder)
    path.write_bytes(whole + b"\0" * 3)
    with pytest.raises(BlockError, match=f"{part}.bin: 3 bytes behind its last record"):
        read_colmap(folder)
    path.unlink()
    if part in ("cameras", "images", "points3D"):
        with pytest.raises(BlockError, match=part):
            read_colmap(folder)


def test_a_count_that_no_file_can_hold_is_refused_at_once(measured, tmp_path) -> None:
    folder = copied(measured[1], tmp_path)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 2**62))
    with pytest.raises(BlockError, match=r"points3D\.bin: ends before its last record"):
        read_colmap(folder)


def test_a_camera_model_that_is_not_carried_is_refused_by_name(measured, tmp_path) -> None:
    folder = copied(measured[1], tmp_path)
    path = folder / "cameras.bin"
    written = path.read_bytes()
    for number, sentence in ((5, "OPENCV_FISHEYE is not carried"), (99, "model 99, which is not")):
        path.write_bytes(written[:12] + struct.pack("<i", number) + written[16:])
        with pytest.raises(BlockError, match=sentence):
            read_colmap(folder)


def test_the_text_model_holds_where_both_are_there(measured, tmp_path) -> None:
    folder = copied(measured[0], tmp_path)
    (folder / "cameras.bin").write_bytes(b"of another day")
    assert any("not the binary model" in note for note in read_colmap(folder).notes)


def test_points_of_another_model_are_refused(measured, tmp_path) -> None:
    folder = copied(measured[1], tmp_path)
    other = both(colmap(block_scene(-0.02, 0.0), tmp_path / "other"), tmp_path / "there")[1]
    model = pycolmap.Reconstruction(other)
    model.delete_observation(model.images[1].image_id, 0)
    model.write_binary(other)
    (folder / "points3D.bin").write_bytes((other / "points3D.bin").read_bytes())
    with pytest.raises(BlockError, match="are of different models"):
        read_colmap(folder)


def test_frames_of_another_model_are_refused(of_rig, tmp_path) -> None:
    folder = copied(of_rig[0], tmp_path)
    path = folder / "frames.txt"
    lines = path.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    words = lines[at].split()
    words[6] = repr(float(words[6]) + 0.01)
    path.write_text("\n".join([*lines[:at], " ".join(words), *lines[at + 1 :]]) + "\n")
    with pytest.raises(BlockError, match="is another one than that of its frame and rig"):
        read_colmap(folder)


def test_an_inertial_unit_of_a_rig_is_no_camera(of_rig, tmp_path) -> None:
    """It has the number of a camera, and a pose of its own."""
    folder = copied(of_rig[0], tmp_path)
    path = folder / "rigs.txt"
    before = read_colmap(folder)

    def with_unit(match: re.Match[str]) -> str:
        rig, count, rest = match.groups()
        return f"{rig} {int(count) + 1} {rest} IMU 2 1 1 0 0 0 9 9 9"

    text = re.sub(r"^(\d+) (\d+) (CAMERA .*?) *$", with_unit, path.read_text(), flags=re.MULTILINE)
    assert "IMU" in text
    path.write_text(text)
    same(before, read_colmap(folder))
    frames = folder / "frames.txt"
    own = re.sub(
        r"^(\d+(?: \S+){8}) 5 (CAMERA .*?) *$", r"\1 6 \2 IMU 2 1", frames.read_text(),
        flags=re.MULTILINE,
    )  # fmt: skip
    assert own.count("IMU") == 2
    frames.write_text(own)
    same(before, read_colmap(folder))
    path.write_text(re.sub(r" IMU 2 1 1 0 0 0 9 9 9", "", text))
    with pytest.raises(BlockError, match="sensors are announced, 5 are listed"):
        read_colmap(folder)
