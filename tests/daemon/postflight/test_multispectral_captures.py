"""Images of multispectral cameras are grouped into captures, and captures into missions."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.importers.multispectral import gps_ns_from_utc
from processing.quality.report import Flag, Verdict
from processing.rig import load_rig
from tests.daemon.multispectral_data import write_image, xmp
from tests.daemon.postflight.multispectral_folders import (
    SIZE,
    dji,
    imported,
    micasense,
    processed,
    refused,
    scene_pixels,
)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return scene_pixels()


@pytest.mark.parametrize(
    ("tags", "offset", "hour"),
    [
        ({"UTCAtExposure": "2024-05-06T05:08:09.250000"}, None, 5),
        ({"UTCAtExposure": "2024:05:06 05:08:09.250000"}, None, 5),
        ({}, "+02:00", 5),
        ({}, None, None),
        ({"UTCAtExposure": "yesterday"}, None, None),
    ],
)
def test_local_time_is_not_taken_for_utc(scene, tmp_path, tags, offset, hour) -> None:
    for band in ("Green", "NIR"):
        dji(tmp_path / "in", scene, band, f"{band}.tif", tags=tags, offset=offset)
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    exposure = json.loads((tmp_path / "out/L0/000001/exposure.json").read_text())
    noted = any("clock is not stated to be UTC" in note for note in camera["notes"])
    if hour is None:
        assert noted and exposure["mark_gps_ns"] is None and exposure["mark_source"] == "none"
    else:
        at = datetime(2024, 5, 6, hour, 8, 9, 250_000, tzinfo=UTC)
        assert not noted and int(exposure["mark_gps_ns"]) == gps_ns_from_utc(at)


def test_two_cameras_in_one_folder_are_two_missions(scene, tmp_path) -> None:
    """A Dual: both cameras write the same capture into one folder."""
    red = ("Blue", "Green", "Red", "NIR", "Red edge")
    blue = ("Blue-444", "Green-531", "Red-650", "Red edge-705", "Red edge-740")
    for number, band in enumerate(red, 1):
        name = f"IMG_0000_{number}.tif"
        micasense(tmp_path / "in", scene, band, name, "RedEdge-M", "RX02-1")
    for number, band in enumerate(blue, 6):
        name = f"IMG_0000_{number}.tif"
        micasense(tmp_path / "in", scene, band, name, "RedEdge-M", "RX02-2")
    cameras = imported(tmp_path / "in", tmp_path / "out")
    assert [(c["serial"], c["exposures"], c["frames"]) for c in cameras] == [
        ("RX02-1", 1, 5), ("RX02-2", 1, 5)
    ]  # fmt: skip
    bands = [
        [c.bands[0] for c in load_rig(Path(camera["mission"]) / "rig.toml").cones]
        for camera in cameras
    ]
    assert sorted(bands[0]) == ["blue", "green", "nir", "red", "red_edge"]
    assert bands[1] == ["blue", "green", "red", "red_edge", "red_edge_2"]


def test_captures_of_a_sentera_6x_are_named_by_their_unique_id(scene, tmp_path) -> None:
    """Two captures within a second, in a folder a band; the heads have serial numbers."""
    bands = ("Blue", "Green", "Red", "Red Edge", "Near Infrared")
    for number, band in enumerate(bands):
        for capture in range(2):
            values = {
                "BandName": band, "CentralWavelength": "560", "ModelType": "perspective",
                "PrincipalPoint": "0.55,0.41", "PerspectiveFocalLength": "8.0",
                "PerspectiveFocalLengthUnits": "mm", "ImageUniqueID": f"6x-{capture}",
                "PerspectiveDistortion": "-0.1,0.1,0,0.0002,0.0003",
            }  # fmt: skip
            write_image(
                tmp_path / f"in/{band}/IMG_{capture:04d}.tif", scene, xmp(values), make="Sentera",
                model="21244-00_3.2MP-GS", serial=f"S{number}", subsec=None, per_mm=1 / 0.00345,
            )  # fmt: skip
    colour = xmp({"BandName": "<r:Seq><r:li>Blue</r:li><r:li>Green</r:li><r:li>Red</r:li></r:Seq>"})
    write_image(tmp_path / "in/RGB/a.tif", scene, colour, make="Sentera", model="20MP")
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    assert (camera["serial"], camera["exposures"], camera["frames"]) == ("S0", 2, 10)
    assert camera["missing"] == []
    assert "band Blue Green Red is not processed: 1 images are left out" in camera["notes"]
    rig = load_rig(tmp_path / "out/rig.toml")
    assert [sensor.serial for sensor in rig.sensors] == ["S0", "S1", "S2", "S4", "S3"]


def test_a_group_with_one_of_five_bands_is_degraded_and_not_usable(scene, tmp_path) -> None:
    for number, band in enumerate(("Blue", "Green", "Red", "NIR", "Red edge"), 1):
        micasense(tmp_path / "in", scene, band, f"IMG_0000_{number}.tif", "RedEdge-M", "R1")
    other = {"tags": {"CaptureId": "cap2"}}
    micasense(tmp_path / "in", scene, "Green", "IMG_0001_2.tif", "RedEdge-M", "R1", **other)
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    assert camera["missing"] == [f"exposure 2 has no frame of {s}" for s in ("B", "R", "N", "E")]
    exposure = json.loads((tmp_path / "out/L0/000002/exposure.json").read_text())
    assert exposure["state"] == "degraded"
    report = processed(tmp_path / "out", 2).report
    assert report.verdict is Verdict.REFLY and Flag.FRAME_MISSING in report.flags
    assert any("Only 20% of the image holds data" in one.sentence for one in report.findings)
    assert processed(tmp_path / "out", 1).report.verdict is Verdict.GOOD


def test_a_group_without_one_of_five_bands_stays_usable(scene, tmp_path) -> None:
    for number, band in enumerate(("Blue", "Green", "Red", "Red edge"), 1):
        micasense(tmp_path / "in", scene, band, f"IMG_0000_{number}.tif", "RedEdge-M", "R1")
    imported(tmp_path / "in", tmp_path / "out")
    assert processed(tmp_path / "out", 1).report.verdict is Verdict.USABLE
    near_infrared = load_rig(tmp_path / "out/rig.toml").cone("N")
    assert near_infrared.wavelengths_nm == () and near_infrared.sensors[0].width_px == SIZE[0]


def test_captures_without_a_name_are_grouped_by_time(scene, tmp_path) -> None:
    """Two of one second apart, whose files are not in the order of time."""
    nameless = {"CaptureUUID": ""}
    for second, first in ((9, 10), (11, 0)):
        for number, band in enumerate(("Green", "Red", "RedEdge", "NIR")):
            dji(
                tmp_path / "in", scene, band, f"DJI_{first + number:04d}.TIF", tags=nameless,
                taken=f"2024:05:06 07:08:{second:02d}", subsec=str(10 + number),
            )  # fmt: skip
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    assert (camera["exposures"], camera["frames"], camera["missing"]) == (2, 8, [])
    dji(tmp_path / "in", scene, "NIR", "DJI_0099.TIF", tags=nameless, taken="")
    sentence = refused(tmp_path / "in", tmp_path / "other")
    assert (
        "DJI_0099.TIF: neither CaptureId, CaptureUUID, ImageUniqueID nor DateTimeOriginal"
        in sentence
    )


@pytest.mark.parametrize(
    "name", ["IMG_{0:04d}_{1}.TIF", "DJI_202405060708{2:02d}_{0:04d}_MS_{3}.TIF"]
)
def test_captures_a_second_apart_are_grouped_by_the_names_of_files(scene, tmp_path, name) -> None:
    """The first has no green band, which that of the second would stand in for by time alone."""
    nameless = {"CaptureUUID": ""}
    bands = (("Green", "G"), ("Red", "R"), ("RedEdge", "RE"), ("NIR", "NIR"))
    for capture in (1, 2):
        for number, (band, code) in enumerate(bands, 1):
            if (capture, number) == (1, 1):
                continue
            # Clocks of whole seconds; the last band's is one further.
            second = 7 + capture + (number == 4)
            dji(
                tmp_path / "in", scene, band, name.format(capture, number, second, code),
                tags=nameless, taken=f"2024:05:06 07:08:{second:02d}", subsec=None,
            )  # fmt: skip
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    assert (camera["exposures"], camera["frames"]) == (2, 7)
    assert camera["missing"] == ["exposure 1 has no frame of G"]


def test_names_that_contradict_times_do_not_make_captures(scene, tmp_path) -> None:
    """A counter that began again in the same folder: ten seconds between files of one number."""
    nameless = {"CaptureUUID": ""}
    for number, (band, second) in enumerate(
        (("Green", 8), ("Red", 8), ("RedEdge", 18), ("NIR", 18)), 1
    ):
        dji(
            tmp_path / "in", scene, band, f"IMG_0001_{number}.TIF", tags=nameless,
            taken=f"2024:05:06 07:08:{second:02d}",
        )  # fmt: skip
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    assert camera["exposures"] == 2


def test_bands_of_another_size_are_left_out_by_name(scene, tmp_path) -> None:
    for number, band in enumerate(("Blue", "Green", "Red", "NIR", "Red edge", "LWIR"), 1):
        name = f"IMG_0000_{number}.tif"
        pixels = scene if band != "LWIR" else scene[:120, :160]
        micasense(tmp_path / "in", pixels, band, name, "Altum", "AL05-1")
    micasense(tmp_path / "in", scene, "Panchro", "IMG_0000_7.tif", "Altum", "AL05-1")
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    assert camera["frames"] == 5 and camera["notes"] == [
        "band LWIR is not processed: 1 images are left out",
        "band Panchro is not processed: 1 images are left out",
    ]
