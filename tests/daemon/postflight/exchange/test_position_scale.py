"""Feet in all coordinates of a block, shown by positions in EXIF of its photographs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from daemon.cli import app
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.exchange.block import Block, BlockError
from daemon.postflight.exchange.colmap import read_colmap
from daemon.postflight.exchange.position_scale import scale_by_photographs, scale_notes
from tests.daemon.postflight.exchange.test_import_block import block_scene, colmap

RUN = CliRunner()
FOOT_M = 0.3048
FRAME = LocalFrame(47.0, 15.0)
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""The block's axes are not those of the earth."""


def photograph(path: Path, place: np.ndarray) -> None:
    """A small JPEG with a position: latitude, longitude, height."""
    exif = Image.Exif()
    gps = exif.get_ifd(0x8825)
    gps[1], gps[2] = "N", (float(place[0]), 0.0, 0.0)
    gps[3], gps[4] = "E", (float(place[1]), 0.0, 0.0)
    gps[5], gps[6] = b"\x00", float(place[2])
    Image.new("L", (4, 3)).save(path, exif=exif)


@pytest.fixture(scope="module")
def scene():
    return block_scene(0.0, 0.0)


@pytest.fixture(scope="module")
def photographs(scene, tmp_path_factory) -> Path:
    """Positions err by 2 m; in a folder below, with names in capitals."""
    folder = tmp_path_factory.mktemp("photographs")
    (folder / "100").mkdir()
    random = np.random.default_rng(5)
    centres = (np.array(scene[1]) + random.normal(0.0, 2.0, (len(scene[1]), 3))) @ TURN.T
    for k, place in enumerate(FRAME.to_geodetic(centres)):
        photograph(folder / "100" / f"{k}.JPG", place)
    return folder


def block_in(scene, folder: Path, unit_m: float) -> Path:
    points, centres, turns, seen = scene
    return colmap((points / unit_m, [c / unit_m for c in centres], turns, seen), folder, 0.0, 0.0)


def imported(path: Path, out: Path, *more: str):
    return RUN.invoke(
        app, ["import", "block", str(path), "--from", "colmap", "--out", str(out), *more, "--json"]
    )


@pytest.mark.parametrize(
    ("unit_m", "named"),
    [
        (FOOT_M, "feet (a factor of 0.3"),
        (0.01, "centimetres (a factor of 0.00"),
        (7.0, "units of 6.9"),
        (1.0, ""),
    ],
)
def test_units_are_named_by_photographs(scene, photographs, tmp_path, unit_m, named) -> None:
    path, out = block_in(scene, tmp_path / "in", unit_m), tmp_path / "out"
    done = imported(path, out, "--metric", "--photographs", str(photographs))
    if named:
        assert done.exit_code != 0 and not out.exists()
        assert named in str(done.exception) and "convert positions and points" in str(
            done.exception
        )
    else:
        assert done.exit_code == 0, done.output + str(done.exception)
    free = imported(path, tmp_path / "free", "--photographs", str(photographs))
    assert free.exit_code == 0, free.output + str(free.exception)
    sentence = named or "in metres by the positions in EXIF of 9 photographs"
    assert any(sentence in note for note in json.loads(free.stdout)["notes"])


def test_photographs_that_show_nothing_are_stated(scene, tmp_path) -> None:
    block = read_colmap(block_in(scene, tmp_path / "in", 1.0))
    folder = tmp_path / "photographs"
    folder.mkdir()
    with pytest.raises(BlockError, match=r"no photograph has the name of one of 9 images, such as"):
        scale_by_photographs(folder, block)
    for k in range(9):
        photograph(folder / f"{k}.jpg", np.array([47.0, 15.0 + 1e-5 * k, 300.0]))
    assert scale_by_photographs(folder, block) is None, "8 m long, with errors of 5 m"
    (folder / "0.jpg").write_bytes(b"\xff\xd8 damaged")
    for k in range(2, 9):
        (folder / f"{k}.jpg").unlink()
    assert scale_by_photographs(folder, block) is None
    done = imported(tmp_path / "in", tmp_path / "out", "--photographs", str(folder))
    assert "do not show the unit of coordinates" in done.stdout


def test_one_wrong_position_does_not_change_the_unit(scene, photographs, tmp_path) -> None:
    block: Block = read_colmap(block_in(scene, tmp_path / "in", FOOT_M))
    folder = tmp_path / "photographs"
    folder.mkdir()
    for path in (photographs / "100").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    photograph(folder / "4.JPG", np.array([48.0, 16.0, 300.0]))
    scale = scale_by_photographs(folder, block)
    assert scale.metres == pytest.approx(FOOT_M, rel=scale.share)
    whole = scale_by_photographs(photographs, block)
    assert whole.metres == pytest.approx(FOOT_M, rel=0.03) and whole.photographs == 9
    with pytest.raises(BlockError, match="in feet"):
        scale_notes(tmp_path, whole, is_metric=True)
