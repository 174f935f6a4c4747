"""Files of a folder as people and drones leave them: incomplete, turned, in folders, of 16 bits."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import sealed_exposure
from daemon.postflight.importers.exif_tags import (
    GPS_ALTITUDE_REF,
    ImageTags,
    TagsError,
    position_of,
)
from daemon.postflight.importers.multispectral_tags import ImagesError
from daemon.postflight.importers.photograph_files import check_complete, photograph_paths
from daemon.postflight.importers.photographs import import_photographs
from daemon.postflight.orthomosaic.photographs import photograph_pixels
from daemon.postflight.triangulation.photograph_matching import original_pixels
from processing.pipelines.perspective import perspective_of
from processing.rig import load_rig
from tests.daemon.multispectral_data import directory, entry, even, position, write_image

SIZE = (128, 96)


def pixels(seed: int = 0) -> np.ndarray:
    grey = np.random.default_rng(seed).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    return cv2.resize(grey, SIZE, interpolation=cv2.INTER_CUBIC)


def exif(
    *, place: tuple[float, float, float | None] | None, orientation: int = 1
) -> tuple[bytes, int]:
    """TIFF structure of an EXIF segment, and where it ends."""
    own = [
        entry(37386, "rational", 4.0),
        entry(41486, "rational", 1 / 0.01),
        entry(41488, "short", 4),
    ]
    gps = position(place[0], place[1], place[2] or 0.0) if place else []
    if place and place[2] is None:
        gps = [one for one in gps if one[0] not in (5, 6)]
    image = [entry(271, "ascii", "Maker"), entry(272, "ascii", "X")]
    image += [entry(274, "short", orientation)]

    def links(exif_at: int, gps_at: int) -> list:
        return [entry(34665, "long", exif_at), *([entry(34853, "long", gps_at)] if gps else [])]

    exif_at = even(8 + len(directory([*image, *links(0, 0)], 8)))
    gps_at = even(exif_at + len(directory(own, exif_at)))
    body = b"II*\0" + (8).to_bytes(4, "little") + directory([*image, *links(exif_at, gps_at)], 8)
    body = body.ljust(exif_at, b"\0") + directory(own, exif_at)
    return (body.ljust(gps_at, b"\0") + directory(gps, gps_at) if gps else body), gps_at


def write_jpeg(
    path: Path,
    *,
    place: tuple[float, float, float | None] | None = (47.0, 11.0, 700.0),
    orientation: int = 1,
    relative_m: float | None = None,
    seed: int = 0,
) -> None:
    content = b"Exif\0\0" + exif(place=place, orientation=orientation)[0]
    segments = b"\xff\xe1" + (len(content) + 2).to_bytes(2) + content
    if relative_m is not None:
        packet = (
            b'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta xmlns:x="adobe:ns:meta/"><r:RDF '
            b'xmlns:r="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><r:Description '
            b'xmlns:d="http://www.dji.com/drone-dji/1.0/" d:RelativeAltitude="%+.2f"/></r:RDF>'
            b"</x:xmpmeta>" % relative_m
        )
        segments += b"\xff\xe1" + (len(packet) + 2).to_bytes(2) + packet
    data = cv2.imencode(".jpg", pixels(seed))[1].tobytes()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data[:2] + segments + data[2:])


def folder_of(tmp_path: Path, **changes) -> Path:
    for k in range(3):
        write_jpeg(tmp_path / f"in/P{k}.jpg", seed=k, **changes)
    return tmp_path / "in"


def settings_of(mission: Path, number: int) -> dict:
    record = json.loads((mission / f"L0/{number:06d}/exposure.json").read_text())
    return record["frames"][0]["settings"]


@pytest.mark.parametrize("share", [0.55, 0.97])
def test_a_photograph_that_was_copied_in_part_is_refused_by_name(tmp_path, share) -> None:
    """A decoder fills the rest with grey and reports nothing."""
    folder = folder_of(tmp_path)
    data = (folder / "P1.jpg").read_bytes()
    (folder / "P1.jpg").write_bytes(data[: int(share * len(data))])
    assert cv2.imread(str(folder / "P1.jpg")) is not None
    with pytest.raises(ImagesError, match=r"P1\.jpg: ends before its image does; copy it"):
        import_photographs(folder, tmp_path / "out")


@pytest.mark.parametrize("progressive", [0, 1])
def test_what_a_camera_appends_to_a_photograph_is_not_looked_at(tmp_path, progressive) -> None:
    """Such as a video, with markers of its own in any order."""
    how = [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
    data = cv2.imencode(".jpg", pixels(), how)[1].tobytes()
    path = tmp_path / "a.jpg"
    for behind in (b"", b"\xff\xd9 video \xff\xda more", b"\xff\xda"):
        path.write_bytes(data + behind)
        check_complete(path, is_jpeg=True)
    path.write_bytes(data[:-2])
    with pytest.raises(TagsError):
        check_complete(path, is_jpeg=True)


def test_an_empty_file_is_named_with_the_cure(tmp_path) -> None:
    folder = folder_of(tmp_path)
    (folder / "P9.jpg").write_bytes(b"")
    (folder / "._P0.jpg").write_bytes(b"\0\5\x16\7")
    with pytest.raises(ImagesError) as error:
        import_photographs(folder, tmp_path / "out")
    assert len(error.value.problems) == 1
    assert error.value.problems[0].startswith("P9.jpg: is empty; copy it from the camera's card")


def test_folders_of_a_card_and_other_formats_are_named(tmp_path) -> None:
    write_jpeg(tmp_path / "DCIM/100MEDIA/P0.jpg")
    write_jpeg(tmp_path / "DCIM/100MEDIA/P1.jpg")
    write_jpeg(tmp_path / "DCIM/101MEDIA/P2.jpg")
    with pytest.raises(ImagesError, match=r"holds 0 .* some: 100MEDIA \(2\), 101MEDIA \(1\)\."):
        photograph_paths(tmp_path / "DCIM")
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw/A.DNG").touch()
    with pytest.raises(ImagesError, match=r"Not read: 1 \.dng\. Convert"):
        photograph_paths(tmp_path / "raw")
    folder = folder_of(tmp_path)
    (folder / "A.DNG").touch()
    notes = import_photographs(folder, tmp_path / "out").notes
    assert any(note.startswith("Not read: 1 .dng.") for note in notes)


def test_heights_above_takeoff_stand_in_for_missing_ones(tmp_path) -> None:
    for k, relative in enumerate((100.0, 101.5, -2.25)):
        write_jpeg(
            tmp_path / f"in/P{k}.jpg", place=(47.0, 11.0 + k * 1e-4, None), relative_m=relative,
            seed=k,
        )  # fmt: skip
    found = import_photographs(tmp_path / "in", tmp_path / "out")
    settings = [settings_of(tmp_path / "out", k) for k in (1, 2, 3)]
    assert [one["GpsAltitudeM"] for one in settings] == [100.0, 101.5, -2.25]
    assert {one["HeightSource"] for one in settings} == {"RelativeAltitude"}
    assert any("above the takeoff point" in note for note in found.notes)
    assert not any("ellipsoidal" in note for note in found.notes)
    # One photograph without: heights of two references are not mixed.
    write_jpeg(tmp_path / "in/P3.jpg", place=(47.0, 11.001, None), seed=3)
    found = import_photographs(tmp_path / "in", tmp_path / "zero")
    settings = [settings_of(tmp_path / "zero", k) for k in (1, 2, 3, 4)]
    assert [one["GpsAltitudeM"] for one in settings] == [0.0] * 4
    assert any("taken as 0 m" in note for note in found.notes)
    # One with a height: the others have no position.
    write_jpeg(tmp_path / "in/P4.jpg", seed=4)
    write_jpeg(tmp_path / "in/P5.jpg", seed=5)
    write_jpeg(tmp_path / "in/P6.jpg", seed=6)
    found = import_photographs(tmp_path / "in", tmp_path / "some")
    assert [one.position is None for one in found.photographs] == [True] * 4 + [False] * 3
    assert "HeightSource" not in settings_of(tmp_path / "some", 5)


@pytest.mark.parametrize("relative_m", [None, 80.0])
def test_fewer_heights_than_a_block_needs_are_not_used(tmp_path, relative_m) -> None:
    """Two of five: with these alone there was no block."""
    for k in range(5):
        place = (47.0, 11.0 + k * 1e-4, 700.0 if k < 2 else None)
        write_jpeg(tmp_path / f"in/P{k}.jpg", seed=k, place=place, relative_m=relative_m)
    found = import_photographs(tmp_path / "in", tmp_path / "out")
    assert [one.position[2] for one in found.photographs] == [relative_m or 0.0] * 5
    (note,) = [note for note in found.notes if "GPSAltitude" in note]
    assert "or fewer than 3 photographs have one: " in note


def test_a_height_of_exif_goes_before_that_of_xmp(tmp_path) -> None:
    folder = folder_of(tmp_path, relative_m=80.0)
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes().replace(b"RelativeAltitude", b"AbsoluteAltitude"))
    found = import_photographs(folder, tmp_path / "out").photographs
    assert [one.position[2] for one in found] == [700.0] * 3


NAN = float("nan")


@pytest.mark.parametrize(
    ("reference", "parts", "degrees"),
    [
        ("S", (33.0, 30.0, 0.0), -33.5),
        ("S", (-33.0, -30.0, 0.0), -33.5),
        ("S", (-33.0, 30.0, 0.0), -33.5),
        ("N", (33.0, 59.0, 60.0), 34.0),
        ("N", (-33.0, 30.0, 0.0), None),
        ("N", (33.0, 61.0, 0.0), None),
        ("N", (33.0, 0.0, 61.0), None),
        ("N", (33.0, 30.0, NAN), None),
        ("n", (33.0, 30.0, 0.0), None),
        ("S", (91.0, 0.0, 0.0), None),
    ],
)
def test_degrees_of_exif_that_are_no_angle_are_no_position(reference, parts, degrees) -> None:
    """Signed parts are of programs that wrote the sign in addition to the reference."""
    gps = {1: reference, 2: parts, 3: "E", 4: (11.0, 0.0, 0.0), 6: (12.5,)}
    found = position_of(ImageTags("jpeg", 4, 3, gps=gps))
    assert (found is None) == (degrees is None)
    assert found is None or found[0] == pytest.approx(degrees, abs=1e-12)


@pytest.mark.parametrize(
    ("reference", "sign"),
    [((0.0,), 1), ((1.0,), -1), ((2.0,), 1), ((3.0,), -1), ("1", -1), (b"\x01", -1), (None, 1)],
)
def test_heights_below_their_reference_are_negative(reference, sign) -> None:
    """Numbers of EXIF 2.32 (sea level) and 3.0 (ellipsoid and sea level)."""
    gps = {1: "N", 2: (47.0, 0.0, 0.0), 3: "E", 4: (11.0, 0.0, 0.0), 6: (12.5,)}
    if reference is not None:
        gps[GPS_ALTITUDE_REF] = reference
    assert position_of(ImageTags("jpeg", 4, 3, gps=gps)) == (47.0, 11.0, sign * 12.5)


def test_the_orientation_of_exif_stays_with_the_photograph(tmp_path) -> None:
    folder = folder_of(tmp_path)
    write_jpeg(folder / "P1.jpg", orientation=6, seed=1)
    import_photographs(folder, tmp_path / "out")
    assert settings_of(tmp_path / "out", 2)["Orientation"] == 6
    assert "Orientation" not in settings_of(tmp_path / "out", 1)


@pytest.mark.parametrize("bits", [12, 16])
def test_sixteen_bit_photographs_keep_their_words(tmp_path, bits) -> None:
    """Of 12 bits in words of 16, only the upper four would be left of eight."""
    words = (pixels().astype(np.uint16) << (bits - 8)) + 5
    for k in range(3):
        write_image(
            tmp_path / f"in/P{k}.tif", words + k, b"", make="Phase One", model="iXM-100",
            focal_mm=4.0, per_mm=1 / 0.01, gps=(47.0 + k * 1e-4, 15.5, 900.0),
        )  # fmt: skip
    import_photographs(tmp_path / "in", tmp_path / "out")
    mission = Mission.open(tmp_path / "out")
    (head,) = load_rig(mission.rig_path).cones
    exposure = sealed_exposure(mission, 1)
    assert exposure is not None
    colours = original_pixels(mission, exposure, perspective_of(head), grey=False)
    assert colours.dtype == np.uint16 and (colours == words).all()
    grey = original_pixels(mission, exposure, perspective_of(head), grey=True)
    expected = cv2.cvtColor(pixels(), cv2.COLOR_RGB2GRAY).astype(float)
    assert grey.dtype == np.uint8 and grey.std() > 40.0
    assert np.corrcoef(grey.ravel(), expected.ravel())[0, 1] > 0.99
    window = (32, 32, 64, 32)
    planes = photograph_pixels(mission, 1, head, ("pan", "red", "green", "blue"), window)
    assert np.abs(planes[1:].transpose(1, 2, 0) - words[32:64, 32:96].astype(int)).max() <= 2
