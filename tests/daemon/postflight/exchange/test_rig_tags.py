"""Tags by which programs group images: bands and places in a rig, of products and of heads."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from daemon.cli import app
from tests.daemon.postflight.exchange.flown_block import FlownBlock, fly

pytestmark = pytest.mark.peer

RUN = CliRunner()
GROUPING = ("RigName", "RigCameraIndex", "RigRelatives", "CaptureUUID")


def tags(files: Iterable[Path]) -> dict[str, dict]:
    """XMP and EXIF of files by their stem, as exiftool reads them."""
    if shutil.which("exiftool") is None:
        pytest.skip("exiftool is not here; apt-get install libimage-exiftool-perl")
    names = [str(path) for path in sorted(files)]
    done = subprocess.run(
        ["exiftool", "-json", "-n", "-XMP-Camera:all", "-EXIF:Model", *names],
        capture_output=True, check=True, timeout=60,
    )  # fmt: skip
    return {Path(one["SourceFile"]).stem: one for one in json.loads(done.stdout)}


def band_groups(found: dict[str, dict]) -> set[str]:
    """Bands that OpenDroneMap sorts images by: names in one word, RGB where there are none."""
    names = [one.get("BandName", "RGB") for one in found.values()]
    words = ["".join(n) if isinstance(n, list) else n for n in names]
    return {re.sub("[^A-Za-z0-9]+", "", word) for word in words}


def export(flown: FlownBlock, *words: str) -> dict:
    kind, *options = words
    done = RUN.invoke(
        app,
        ["export", kind, str(flown.path), "--trajectory", str(flown.trajectory), *options,
         "--json"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output + str(done.exception)
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def stitched(tmp_path_factory) -> FlownBlock:
    folder = tmp_path_factory.mktemp("stitched") / "mission"
    flown = fly(folder, "ultracam-l-mini", seconds=(5.0,), lens="f_number = 5.6")
    done = RUN.invoke(app, ["pansharpen", str(folder), "--processes", "0"])
    assert done.exit_code == 0, done.output
    return flown


@pytest.fixture(scope="module")
def heads(tmp_path_factory) -> FlownBlock:
    """Raw frames of cones with one to four sensors."""
    folder = tmp_path_factory.mktemp("heads") / "mission"
    return fly(folder, "ultracam-x-mini", seconds=(5.0,), lens="f_number = 4.0")


def on_axis_px(flown: FlownBlock, name: str, pixels: np.ndarray) -> np.ndarray:
    """Where the emulator's sensor has pixels, against its cone's axis, x right and y up, in px."""
    cone, sensor = flown.rig.cone_of(name), flown.rig.sensor(name)
    seen = flown.truth().directions(
        cone, sensor, pixels[:, 0], pixels[:, 1],
        sensor_c=sensor.calibration_c, cone_c=cone.calibration_c,
    )  # fmt: skip
    seen = seen @ flown.truth().master_from_cone(cone)
    return np.asarray(seen[:, :2] / -seen[:, 2:] * cone.lens.f_mm / sensor.pitch_mm)


def test_stitched_products_of_one_export_are_no_bands_of_one_rig(stitched) -> None:
    export(stitched, "pictures", "--as", "jpeg")
    export(stitched, "pictures", "--as", "jpeg", "--level", "3", "--bits", "8")
    export(stitched, "pictures", "--as", "jpeg", "--level", "3")
    folder = stitched.path / "export/jpeg"
    products = {path.name: path for path in folder.iterdir()}
    assert set(products) == {"pan", "rgbn", "rgb-8", "cir-8", "rgb-16", "cir-16"}
    together: dict[str, dict] = {}
    for name, product in products.items():
        found = tags(product.iterdir())
        assert set(found) == {f"000001_{name}"}
        assert len(band_groups(found)) == 1, name
        assert not [key for one in found.values() for key in one if key in GROUPING]
        together |= found
    # All of them in one folder would be registered as three bands.
    assert band_groups(together) == {"pan", "redgreenblue", "nirredgreen"}


def test_the_command_names_the_folders_of_the_products(stitched) -> None:
    words = ["export", "pictures", str(stitched.path), "--as", "jpeg"]
    done = RUN.invoke(app, [*words, "--trajectory", str(stitched.trajectory)])
    output = " ".join(done.output.split())
    assert "Products have a folder each: pan, rgbn. Give a program one of them" in output


def raw_copies(flown: FlownBlock, program: str, *options: str) -> dict[str, dict]:
    """Tags of the copies of raw frames of the first exposure."""
    done = export(flown, "block", "--to", program, "--images", "raw", *options)
    return tags((Path(done["folder"]) / "images").glob("000001_*.jpg"))


def test_every_sensor_of_a_cone_has_an_index_and_a_rotation_of_its_own(heads) -> None:
    found = raw_copies(heads, "metashape")
    sensors = [sensor.name for sensor in heads.rig.sensors]
    assert [found[f"000001_{name}"]["RigCameraIndex"] for name in sensors] == list(range(13))
    assert {one["RigRelativesReferenceRigCameraIndex"] for one in found.values()} == {0}
    assert len({one["CaptureUUID"] for one in found.values()}) == 1
    assert len({one["Model"] for one in found.values()}) == 13
    assert found["000001_SU01"]["BandName"] == "pan"

    for name in ("SU01", "SU02", "SU03"):
        turn = np.radians([float(v) for v in found[f"000001_{name}"]["RigRelatives"].split(",")])
        assert np.abs(turn[:2]).max() < 1e-7, "sensors of one cone have one axis"
        # Axes of vision have y and z reversed, so that the angle about z is, too.
        of_rows = [heads.rig.sensor(one).rotation_rad for one in ("SU00", name)]
        assert turn[2] == pytest.approx(of_rows[0] - of_rows[1], abs=2e-8)
        assert abs(turn[2]) > 1e-5


def test_raw_frames_state_their_own_principal_point(heads) -> None:
    found = raw_copies(heads, "pix4d")
    assert {one["RigRelativesReferenceRigCameraIndex"] for one in found.values()} == {0}
    for name in ("SU00", "SU01", "SU03", "SU30", "G"):
        sensor = heads.rig.sensor(name)
        stated_mm = [float(v) for v in found[f"000001_{name}"]["PrincipalPoint"].split(",")]
        column, row = np.array(stated_mm) / sensor.pitch_mm - 0.5
        assert np.abs(on_axis_px(heads, name, np.array([[column, row]]))).max() < 1.0, name
    assert float(found["000001_SU01"]["PrincipalPoint"].split(",")[0]) < 0.0, "beyond the frame"


def test_opendronemap_does_not_sort_heads_of_one_band_by_bands(heads) -> None:
    assert band_groups(raw_copies(heads, "opensfm")) == {"RGB"}
    assert "pan" in band_groups(raw_copies(heads, "colmap"))


def test_heads_at_different_instants_have_no_tags_of_a_rig(tmp_path) -> None:
    flown = fly(tmp_path / "mission", "ultracam-l-mini", seconds=(5.0, 9.0), is_syntopic=True)
    found = raw_copies(flown, "pix4d")
    assert not [key for one in found.values() for key in one if key in GROUPING]
    found = raw_copies(flown, "metashape", "--rig", "yes")
    assert [one["RigCameraIndex"] for _, one in sorted(found.items())] == [3, 2, 0, 1]


@pytest.mark.parametrize(("later_ns", "has_tags"), [(900_000, True), (1_100_000, False)])
def test_pictures_of_heads_at_different_instants_have_no_tags_of_a_rig(
    tmp_path, later_ns, has_tags
) -> None:
    flown = fly(tmp_path / "mission", "midas-mini", seconds=(5.0,))
    path = flown.path / "rig.toml"
    head, first, rest = path.read_text().partition("position_mm")
    path.write_text(f"{head}mark_to_mid_exposure_ns = {later_ns}\n{first}{rest}")
    marks = flown.path / "trajectory.csv"
    lines = marks.read_text().splitlines()
    shifted = [f"{int(line.split(',')[0]) + 10**8},{line.split(',', 1)[1]}" for line in lines[1:]]
    marks.write_text("\n".join([*lines, *shifted]) + "\n")
    export(flown, "pictures", "--as", "jpeg")
    found = tags((flown.path / "export/jpeg").iterdir())
    assert len(found) == 5
    assert all(("RigCameraIndex" in one) is has_tags for one in found.values())


def test_a_raw_frame_of_a_bayer_head_is_in_the_colours_that_its_tags_name(tmp_path) -> None:
    import tifffile

    flown = fly(tmp_path / "mission", "ultracam-l-mini", seconds=(5.0,))
    path = flown.path / "L0/000001/RGB.tif"
    sensor = flown.rig.sensor("RGB")
    mosaic = np.full((sensor.height_px, sensor.width_px), 0, np.uint16)
    levels = {"R": 3000, "G": 2000, "B": 400}
    for place, letter in enumerate(sensor.colour_filter_array):
        mosaic[place // 2 :: 2, place % 2 :: 2] = levels[letter]
    mosaic[:8] = 4000
    tifffile.imwrite(path, mosaic)
    found = raw_copies(flown, "metashape")
    assert found["000001_RGB"]["BandName"] == ["red", "green", "blue"]
    with Image.open(flown.path / "export/block/metashape/images/000001_RGB.jpg") as picture:
        assert picture.mode == "RGB" and picture.size == (sensor.width_px, sensor.height_px)
        red, green, blue = np.asarray(picture)[100:-100, 100:-100].reshape(-1, 3).mean(axis=0)
    assert red > green + 20 > blue + 60
