"""Photographs with positions in EXIF become a mission: tags, cameras, copies, heights."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.importers.exif_tags import (
    TagsError,
    focal_length_px_of,
    pitch_mm_of,
    position_of,
    read_tags,
)
from processing.rig import load_rig
from tests.daemon.postflight.seneca_photographs import SENECA, USED, WIDTH, needs_seneca, reduced

RUN = CliRunner()

pytestmark = needs_seneca


def test_tags_of_a_real_photograph() -> None:
    tags = read_tags(SENECA / "IMG_0484.jpg")
    assert (tags.width_px, tags.height_px) == (3600, 2700)
    # 4000 px were taken; the file has 3600 of the same field.
    assert pitch_mm_of(tags) == pytest.approx(25.4 / 16393.4426 * 4000 / 3600, rel=1e-6)
    assert focal_length_px_of(tags)[0] == pytest.approx(2497.74, abs=0.01)
    latitude, longitude, height = position_of(tags)
    assert latitude == pytest.approx(41 + 2 / 60 + 12.28308 / 3600, abs=1e-9)
    assert longitude == pytest.approx(-(83 + 18 / 60 + 22.57884 / 3600), abs=1e-9)
    assert height == pytest.approx(282.196, abs=1e-3)


def test_a_cropped_photograph_has_no_pixel_size(tmp_path) -> None:
    path = reduced(484, tmp_path, pixels=np.full((900, 1000, 3), 90, np.uint8))
    assert pitch_mm_of(read_tags(path)) is None
    assert focal_length_px_of(read_tags(path)) is None


@pytest.mark.parametrize("cut", [3, 40, 700, 5000])
def test_a_photograph_that_ends_early_is_refused_by_name(tmp_path, cut) -> None:
    path = tmp_path / "short.jpg"
    path.write_bytes((SENECA / "IMG_0484.jpg").read_bytes()[:cut])
    with pytest.raises(TagsError, match=r"short\.jpg"):
        read_tags(path)


def refused(folder: Path, out: Path, *options: str) -> str:
    done = RUN.invoke(app, ["import", "photographs", str(folder), "--out", str(out), *options])
    assert done.exit_code != 0 and not out.exists()
    return " ".join(str(done.exception or done.output).split())


def test_every_camera_of_a_folder_is_a_head(tmp_path) -> None:
    folder = tmp_path / "mixed"
    folder.mkdir()
    for number in USED[:3]:
        reduced(number, folder)
    other = SENECA.parent / "caliterra" / "IMG_9419.jpg"
    (folder / other.name).write_bytes(other.read_bytes())
    out = tmp_path / "out"
    done = RUN.invoke(app, ["import", "photographs", str(folder), "--out", str(out), "--json"])
    about = json.loads(done.stdout)
    assert about["heads"] == ["C1", "C2"] and "SX260" in str(about["notes"])
    rig = load_rig(out / "rig.toml")
    assert [cone.sensors[0].width_px for cone in rig.cones] == [WIDTH, 4000]
    assert (out / "L0/000004/C2.jpg").read_bytes() == other.read_bytes()


def test_a_copy_of_a_photograph_is_left_out(tmp_path) -> None:
    """The original keeps its name, by which control is measured, though the copy sorts before."""
    folder = tmp_path / "copies"
    folder.mkdir()
    for number in USED[:3]:
        reduced(number, folder)
    original = min(folder.iterdir())
    copy = folder / f"{original.stem} (1){original.suffix}"
    copy.write_bytes(original.read_bytes())
    assert min(folder.iterdir()) == copy
    out = tmp_path / "out"
    done = RUN.invoke(app, ["import", "photographs", str(folder), "--out", str(out), "--json"])
    about = json.loads(done.stdout)
    assert about["photographs"] == 3
    assert f"{copy.name} is a copy of {original.name} and left out." in about["notes"]


def test_photographs_of_a_zoom_lens_are_refused(tmp_path) -> None:
    for k in range(21):
        reduced(484, tmp_path, name=f"{k}.jpg", pixels=np.full((90, 120 + 4 * k, 3), 90, np.uint8))
    options = ("--focal-mm", "5", "--pixel-um", "5")
    assert "21 cameras or settings" in refused(tmp_path, tmp_path / "out", *options)


@pytest.mark.soak
def test_two_cameras_are_adjusted_together_with_an_interior_orientation_each(tmp_path) -> None:
    """Three of the photographs reduced to two thirds are those of another camera."""
    folder = tmp_path / "both"
    folder.mkdir()
    for number in USED:
        whole = cv2.imread(str(SENECA / f"IMG_{number:04d}.jpg"))
        width = 600 if number in (492, 495, 505) else WIDTH
        pixels = cv2.resize(whole, (width, width * 3 // 4), interpolation=cv2.INTER_AREA)
        reduced(number, folder, pixels=pixels)
    mission = tmp_path / "mission"
    RUN.invoke(app, ["import", "photographs", str(folder), "--out", str(mission)])
    done = RUN.invoke(app, ["triangulate", str(mission), "--json"])
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    found = json.loads(done.stdout)["photographs"]
    large, small = found["cameras"]
    assert (large["photographs"], small["photographs"]) == (4, 3)
    assert small["f_px"] / large["f_px"] == pytest.approx(600 / WIDTH, rel=0.01)
    assert any(one.startswith("C2: 3 photographs do not") for one in done_cautions(done))
    options = ["--no-level", "--threads", "1", "--gsd", "0.4", "--json"]
    done = RUN.invoke(app, ["orthomosaic", str(mission), *options])
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    assert json.loads(done.stdout)["images_used"] == len(USED)


def done_cautions(done) -> list[str]:
    return json.loads(done.stdout)["cautions"]


def test_photographs_without_positions_or_focal_length_are_refused(tmp_path) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    for k in range(3):
        cv2.imwrite(str(bare / f"{k}.jpg"), np.full((600, 800, 3), 90, np.uint8))
    assert "--focal-mm" in refused(bare, tmp_path / "out")
    sentence = refused(bare, tmp_path / "out", "--focal-mm", "5", "--pixel-um", "5")
    assert "0 of 3 photographs have a position" in sentence and "GPSLatitudeRef N or S" in sentence


def without_height(path: Path, xmp: str = "") -> None:
    """Give GPSAltitude (tag 6, one rational) a number that EXIF does not use."""
    data = path.read_bytes()
    for order in ("<", ">"):
        tag, other = (struct.pack(f"{order}HHI", code, 5, 1) for code in (6, 102))
        data = data.replace(tag, other)
    packet = b"http://ns.adobe.com/xap/1.0/\0" + xmp.encode()
    segment = b"\xff\xe1" + struct.pack(">H", len(packet) + 2) + packet if xmp else b""
    path.write_bytes(data[:2] + segment + data[2:])


XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-'
    'syntax-ns#"><rdf:Description xmlns:d="http://www.dji.com/drone-dji/1.0/" '
    'd:AbsoluteAltitude="+312.50" d:RelativeAltitude="+80.1"/></rdf:RDF></x:xmpmeta>'
)


@pytest.mark.parametrize(
    ("changed", "xmp", "heights", "sentence"),
    [
        (range(4), "", [0.0] * 4, "photographs have one: all heights"),
        (range(1), "", [None, 280.0, 280.0, 280.0], "1 photographs have no position"),
        (range(4), XMP, [312.5] * 4, "taken as ellipsoidal"),
        (range(4), "<broken", [0.0] * 4, "no GPSAltitude"),
    ],
    ids=["none", "one without", "in XMP", "damaged XMP"],
)
def test_positions_without_height(tmp_path, changed, xmp, heights, sentence) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for k in range(4):
        path = reduced(484 + k, folder, pixels=np.full((675, 900, 3), 90, np.uint8))
        if k in changed:
            without_height(path, xmp)
    options = ["--out", str(tmp_path / "out"), "--json"]
    done = RUN.invoke(app, ["import", "photographs", str(folder), *options])
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    assert sentence in " ".join(json.loads(done.stdout)["notes"])
    for k, height in enumerate(heights, start=1):
        record = json.loads((tmp_path / f"out/L0/{k:06d}/exposure.json").read_text())
        found = record["frames"][0]["settings"].get("GpsAltitudeM")
        assert found == (height if height is None else pytest.approx(height, abs=8.0))
