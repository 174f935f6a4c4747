"""What differs between an export and what is read from it: the table of the exchange page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.exchange.block import Block, rig_of, with_rig
from daemon.postflight.exchange.colmap import colmap_texts, read_colmap
from daemon.postflight.exchange.inpho_reader import read_inpho
from daemon.postflight.exchange.metashape_reader import read_metashape
from daemon.postflight.exchange.opensfm import read_opensfm
from daemon.postflight.exchange.photogrammetry_reader import named_orientations
from daemon.postflight.exchange.pix4d_reader import read_pix4d
from tests.daemon.postflight.exchange.flown_block import FlownBlock, fly
from tests.daemon.postflight.exchange.test_colmap import SECONDS, export

CRS = ("--crs", "EPSG:32633")
Poses = dict[str, tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> FlownBlock:
    return fly(tmp_path_factory.mktemp("round-trips") / "mission", "midas-mini", seconds=SECONDS)


def poses(block: Block) -> Poses:
    return {Path(one.name).stem: (one.centre_m, one.rotation) for one in block.images}


def largest(one: Poses, other: Poses) -> tuple[float, float]:
    """Largest differences of places, m, and of elements of matrices."""
    assert set(one) == set(other) and len(one) == 20
    return (
        max(float(np.abs(one[name][0] - other[name][0]).max()) for name in one),
        max(float(np.abs(one[name][1] - other[name][1]).max()) for name in one),
    )


def test_local_frames_of_three_programs_differ_in_the_last_digits(flown) -> None:
    found = {}
    for program, read, name in (
        ("colmap", read_colmap, "sparse"),
        ("opensfm", read_opensfm, "reconstruction.json"),
        ("metashape", read_metashape, "cameras.xml"),
    ):
        _, folder = export(flown, "--images", "raw", to=program)
        found[program] = read(folder / name)
    reference = poses(found["colmap"])
    for program in ("opensfm", "metashape"):
        place_m, matrix = largest(poses(found[program]), reference)
        assert place_m < 1e-8 and matrix < 1e-12
    assert [one.name for one in found["colmap"].cameras] == [f"camera{k}" for k in range(1, 6)]
    assert found["metashape"].cameras[0].bands and not found["colmap"].cameras[0].bands
    for block in found.values():
        assert all(image.eo is None and image.sigma_m is None for image in block.images)


@pytest.mark.parametrize("images", ["raw", "perspective"])
def test_colmap_written_again_differs_in_digits_and_in_the_model_of_a_distortion(
    flown, images
) -> None:
    _, folder = export(flown, "--images", images, to="colmap")
    block = read_colmap(folder / "sparse")
    rig = rig_of(block, 0)
    texts, _ = colmap_texts(with_rig(block, rig), rig)
    for name, text in texts.items():
        written = (folder / "sparse" / name).read_text()
        if name == "points3D.txt" or (name == "cameras.txt" and images == "perspective"):
            assert text == written
            continue
        if name == "cameras.txt":
            assert " OPENCV " in written and " FULL_OPENCV " in text
            continue
        for a, b in zip(text.splitlines(), written.splitlines(), strict=True):
            for x, y in zip(a.split(), b.split(), strict=True):
                assert x == y or float(x) == pytest.approx(float(y), rel=1e-10, abs=1e-10)


def test_grid_formats_differ_by_their_decimals(flown) -> None:
    _, folder = export(flown, *CRS, to="patb")
    rows = [line.split() for line in (folder / "orientation.ori").read_text().splitlines()]
    names = [line.split()[1] for line in (folder / "photos.txt").read_text().splitlines()]
    patb = {
        Path(name).stem: (
            np.array(rows[3 * k][1:], float),
            np.array(rows[3 * k + 1] + rows[3 * k + 2], float).reshape(3, 3),
        )
        for k, name in enumerate(names)
    }
    _, folder = export(flown, *CRS, to="inpho")
    assert largest(poses(read_inpho(folder)), patb) == (0.0, 0.0)
    _, folder = export(flown, *CRS, to="bingo")
    rows_of = named_orientations(folder / "orientation.bingo", "YXZ", "gon")
    bingo = {Path(name).stem: (one.centre_m, one.rotation) for name, one in rows_of.items()}
    _, folder = export(flown, *CRS, to="pix4d")
    for found in (bingo, poses(read_pix4d(folder))):
        place_m, matrix = largest(found, patb)
        assert 1e-6 < place_m < 1e-4 and matrix < np.radians(1e-7) * 2
