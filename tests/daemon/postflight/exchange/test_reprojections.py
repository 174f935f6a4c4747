"""Measurements of another convention than the block's own points and orientations are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.postflight.exchange.block import BlockError
from daemon.postflight.exchange.block_project import import_block
from tests.daemon.postflight.exchange.test_import_block import K1, K2, bal, block_scene, colmap


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
