"""Blocks of a stitched rig's PAN, colour and pansharpened images, read by pycolmap."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.exchange.block import BlockError
from tests.daemon.postflight.exchange.flown_block import FlownBlock, fly, local_of_world, targets

pycolmap = pytest.importorskip("pycolmap")
pytestmark = pytest.mark.peer

RUN = CliRunner()
BANDS = {
    "pan": ["Pan"],
    "rgbn": ["Red", "Green", "Blue"],
    "rgb": ["Red", "Green", "Blue"],
    "cir": ["Nir", "Red", "Green"],
}


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> FlownBlock:
    folder = tmp_path_factory.mktemp("stitched") / "mission"
    flown = fly(folder, "ultracam-l-mini", seconds=(5.0, 9.0), lens="f_number = 5.6")
    done = RUN.invoke(app, ["pansharpen", str(folder), "--processes", "0"])
    assert done.exit_code == 0, done.output
    return flown


def export(flown: FlownBlock, *more: str):
    return RUN.invoke(
        app,
        ["export", "block", str(flown.path), "--trajectory", str(flown.trajectory), *more],
    )


def folder_of(program: str, stitched: str) -> str:
    """Each image has a folder of its own, so that one export does not replace another one."""
    return program if stitched == "pan" else f"{program}-{stitched}"


@pytest.mark.parametrize("stitched", list(BANDS))
def test_each_image_projects_right_and_has_its_size_and_bands(flown, stitched) -> None:
    done = export(flown, "--to", "colmap", "--stitched", stitched, "--json")
    assert done.exit_code == 0, done.output + str(done.exception)
    about = json.loads(done.stdout)
    folder = Path(about["folder"])
    assert folder.name == folder_of("colmap", stitched)
    model = pycolmap.Reconstruction(folder / "sparse")
    assert len(model.images) == 2 and about["missing"] == []
    pan = flown.rig.virtual_image
    is_colour = stitched == "rgbn"
    ratio = float(pan.colour_ratio) if is_colour else 1.0
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        size = (camera.width, camera.height)
        assert size == (
            (pan.colour_width_px, pan.colour_height_px)
            if is_colour
            else (pan.width_px, pan.height_px)
        )
        columns, rows = np.meshgrid(np.linspace(0, size[0] - 1, 7), np.linspace(0, size[1] - 1, 6))
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
        middle = (np.array(size) - 1) / 2
        of_pan = (pixels - middle) * ratio + (np.array([pan.width_px, pan.height_px]) - 1) / 2
        number = int(image.name.split("_")[0])
        cone = flown.rig.image_cone_name
        world, centre = targets(flown, cone, flown.marks[number], of_pan, raw=False)
        seen = [image.project_point(p) for p in local_of_world(world, about["origin"])]
        assert np.abs(np.array(seen) - 0.5 - pixels).max() < 0.001
        there = local_of_world(centre, about["origin"])[0]
        assert np.abs(image.projection_center() - there).max() < 0.001
        with Image.open(folder / "images" / image.name) as picture:
            assert picture.size == size
            assert picture.mode == ("L" if stitched == "pan" else "RGB")
    assert ratio > 1.0 or not is_colour


@pytest.mark.parametrize("stitched", list(BANDS))
def test_metashape_has_the_bands_of_the_copies(flown, stitched) -> None:
    done = export(flown, "--to", "metashape", "--stitched", stitched, "--no-copies")
    assert done.exit_code == 0, done.output + str(done.exception)
    assert ("without nir" in " ".join(done.output.split())) is (stitched == "rgbn")
    root = ElementTree.parse(
        flown.path / "export/block" / folder_of("metashape", stitched) / "cameras.xml"
    )
    assert [band.get("label") for band in root.iter("band")] == BANDS[stitched]


def test_images_that_a_mission_has_not_are_refused(flown, tmp_path) -> None:
    done = export(flown, "--to", "colmap", "--stitched", "rgb", "--images", "raw")
    assert isinstance(done.exception, BlockError) and "leave --stitched out" in str(done.exception)
    oblique = fly(tmp_path / "oblique", "midas-mini", seconds=(5.0,))
    done = export(oblique, "--to", "colmap", "--stitched", "cir")
    assert isinstance(done.exception, BlockError) and "rig with a virtual image" in str(
        done.exception
    )
    other = fly(tmp_path / "other", "ultracam-l-mini", seconds=(5.0,), lens="f_number = 5.6")
    done = export(other, "--to", "colmap", "--stitched", "cir")
    assert isinstance(done.exception, BlockError) and "syntopic pansharpen" in str(done.exception)
    assert "rgby" in str(export(other, "--to", "colmap", "--stitched", "rgby").exception)
