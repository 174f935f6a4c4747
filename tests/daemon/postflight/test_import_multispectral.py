"""Folders of multispectral cameras, in the tags their makers publish, become missions."""

from __future__ import annotations

import json
import struct
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from daemon.cli import app
from daemon.configuration.model import PlanSection
from daemon.mission.layout import Mission
from daemon.mission.store.store import load_level0
from daemon.postflight.importers.multispectral import gps_ns_from_utc, import_multispectral
from daemon.postflight.importers.multispectral_tags import ImagesError
from daemon.products.band_images import radiance_of
from daemon.products.exposure_conditions import conditions_of
from processing.geometry.placement import vip_mm_from_raw
from processing.image.band_registration import band_placements
from processing.pipelines.bands import BandPipeline, BandProduct
from processing.quality.report import Flag, Verdict
from processing.rig import load_rig
from tests.daemon.multispectral_data import directory, entry, write_image, xmp

RUN = CliRunner()
SIZE = (320, 240)
DEWARP = "2022-04-05;1913.333,1913.333,10.5,-7.25,-0.35,0.15,0.0003,-0.0002,-0.05"


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    """Fields of several sizes, with detail for the registration; words of 16 bits."""
    random = np.random.default_rng(3)
    grey = sum(
        cv2.resize(random.normal(0, 1.0, (h, h * 4 // 3)).astype(np.float32), SIZE) * 500
        for h in (6, 12, 30, 60, 120)
    )
    return np.clip(12000 + grey, 4200, 60000).astype(np.uint16)


def sequoia(folder: Path, scene, band: str, name: str, capture: str = "C1", **changes) -> None:
    """Parrot Sequoia: a fisheye in Pix4D's namespace, 10 bits at the top of a word."""
    wavelength = {"Green": 550, "Red": 660, "Red edge": 735, "NIR": 790}[band]
    values = {
        "BandName": band, "CentralWavelength": str(wavelength), "WavelengthFWHM": "40",
        "ModelType": "fisheye", "PrincipalPoint": "0.61,0.44", "CaptureUUID": capture,
        "FisheyePolynomial": "0,1,-0.025178575,0.167834214",
        "FisheyeAffineMatrix": "463.0,0,0,463.0",
        "SensorModel": "1000.0,60.0,0.1", **changes.pop("tags", {}),
    }  # fmt: skip
    values = {key: value for key, value in values.items() if value}
    more = {"serial": "PS1", "per_mm": 1 / 0.00375, **changes}
    write_image(folder / name, scene & 0xFFC0, xmp(values), make="Parrot", model="Sequoia", **more)


def dji(folder: Path, scene, band: str, name: str, model: str = "M3M", **changes) -> None:
    """DJI: Brown's model about the optical centre plus an offset, in attributes."""
    values = {
        "BandName": band, "CentralWavelength": "560(+/-16)nm", "DewarpData": DEWARP,
        "CalibratedOpticalCenterX": "160.0", "CalibratedOpticalCenterY": "120.0",
        "CaptureUUID": "U1", "DroneSerialNumber": "D1", **changes.pop("tags", {}),
    }  # fmt: skip
    values = {key: value for key, value in values.items() if value}
    more = {"black": 4096, "focal_mm": 5.74, **changes}
    packet = xmp(values, as_attributes=True)
    write_image(folder / name, scene, packet, make="DJI", model=model, **more)


def micasense(folder: Path, scene, band: str, name: str, model: str, serial: str, **changes):
    values = {
        "BandName": band, "CentralWavelength": "560", "WavelengthFWHM": "27",
        "ModelType": "perspective", "PrincipalPoint": "0.6,0.45",
        "PerspectiveFocalLength": "5.5", "PerspectiveFocalLengthUnits": "mm",
        "PerspectiveDistortion": "-0.1,0.1,0,0.0002,0.0003", "CaptureId": "cap1",
        "RadiometricCalibration": "1e-4,1e-7,1e-6", "VignettingCenter": "160,120",
        "VignettingPolynomial": "0,0,0,0,0,0", **changes.pop("tags", {}),
    }  # fmt: skip
    values = {key: value for key, value in values.items() if value is not None}
    more = {"black": 4800, "per_mm": 1 / 0.00345, **changes}
    write_image(
        folder / name, scene & 0xFFF0, xmp(values), make="MicaSense", model=model,
        serial=serial, **more,
    )  # fmt: skip


def imported(folder: Path, out: Path) -> list[dict]:
    done = RUN.invoke(app, ["import", "multispectral", str(folder), "--out", str(out), "--json"])
    assert done.exit_code == 0, done.output + str(done.exception)
    return json.loads(done.stdout)["cameras"]


def refused(folder: Path, out: Path) -> str:
    with pytest.raises(ImagesError) as error:
        import_multispectral(folder, out)
    assert not out.exists()
    return str(error.value)


def ideal(rig, sensor: str, pixels: np.ndarray) -> np.ndarray:
    """Ideal points of raw pixels, x right, y down, in units of the focal length."""
    placement = band_placements(rig, {})[sensor]
    return vip_mm_from_raw(placement, pixels) / rig.cone("G").lens.f_mm * [1, -1]


def processed(path: Path, number: int) -> BandProduct:
    mission = Mission.open(path)
    rig = load_rig(mission.rig_path)
    frames, exposure = load_level0(mission.level0(number), rig)
    conditions = conditions_of(exposure, rig, PlanSection.model_validate({}), Flag(0))
    radiance = radiance_of(rig, mission.path / "radiometry")
    return BandPipeline(rig, radiance).process(frames, conditions)


PIXELS = np.stack(np.meshgrid(np.linspace(0, 319, 9), np.linspace(0, 239, 7)), -1).reshape(-1, 2)


def test_a_sequoia_with_its_fisheye_becomes_a_mission_that_is_processed(scene, tmp_path) -> None:
    for band, code in (("Green", "GRE"), ("Red", "RED"), ("Red edge", "REG"), ("NIR", "NIR")):
        sequoia(tmp_path / "in", scene, band, f"IMG_0000_{code}.TIF")
        sequoia(tmp_path / "in", scene, band, f"IMG_0001_{code}.TIF", capture="C2")
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    assert (camera["camera"], camera["serial"]) == ("Parrot Sequoia", "PS1")
    assert (camera["exposures"], camera["frames"], camera["missing"]) == (2, 8, [])
    assert "radiometric tags are not read" in camera["notes"][0]
    assert "no BlackLevel is stated" in camera["notes"][1]
    assert max(camera["lens_fit_px"].values()) < 0.1
    rig = load_rig(tmp_path / "out/rig.toml")
    assert {c.bands[0]: c.wavelengths_nm for c in rig.cones} == {
        "green": (550.0,), "red": (660.0,), "red_edge": (735.0,), "nir": (790.0,)
    }  # fmt: skip
    assert all((s.bits, s.justified) == (10, "left") for s in rig.sensors)
    # Pix4D's formula, solved here for the angle of each pixel by bisection.
    away = PIXELS - np.array([0.61, 0.44]) / 0.00375
    rho = np.hypot(*away.T) / 463.0
    low, high = np.zeros(len(rho)), np.ones(len(rho))
    for _ in range(60):
        middle = (low + high) / 2
        value = middle - 0.025178575 * middle**2 + 0.167834214 * middle**3
        low, high = np.where(value < rho, middle, low), np.where(value < rho, high, middle)
    r = np.tan(low * np.pi / 2)
    expected = away / np.hypot(*away.T)[:, None] * r[:, None]
    assert np.abs(ideal(rig, "N", PIXELS) - expected).max() * 295 < 0.1
    product = processed(tmp_path / "out", 1)
    assert {b.band for b in product.registrations if b.registered} == {"red", "red_edge", "nir"}
    assert set(product.units.values()) == {"DN"}


@pytest.mark.parametrize(
    ("model", "bands"),
    [("FC6360", ("Blue", "Green", "Red", "RedEdge", "NIR")), ("M3M", ("Green", "Red", "NIR"))],
)
def test_images_of_dji_are_placed_as_opencv_does(scene, tmp_path, model, bands) -> None:
    for number, band in enumerate(bands):
        dji(tmp_path / "in", scene, band, f"DJI_00{number}.TIF", model)
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    assert (camera["camera"], camera["serial"], camera["exposures"]) == (f"DJI {model}", "D1", 1)
    missing = ["exposure 1 has no frame of E"] if model == "M3M" else []
    assert camera["missing"] == missing, "a Mavic 3 M has a red edge band, this folder has none"
    rig = load_rig(tmp_path / "out/rig.toml")
    known = {c.bands[0]: c.wavelengths_nm for c in rig.cones}
    assert known["green"] == (560.0,) and known["red_edge"] == (() if missing else (560.0,))
    sensor = rig.sensor("N")
    assert (sensor.black_dn, sensor.bits, sensor.pitch_um) == (4096.0, 16, pytest.approx(3.0))
    matrix = np.array([[1913.333, 0, 170.5], [0, 1913.333, 112.75], [0, 0, 1.0]])
    terms = np.array([-0.35, 0.15, 0.0003, -0.0002, -0.05])
    criteria = (cv2.TERM_CRITERIA_COUNT, 100, 0.0)
    expected = cv2.undistortPoints(PIXELS[:, None], matrix, terms, criteria=criteria)[:, 0]
    assert np.abs(ideal(rig, "N", PIXELS) - expected).max() * 1913 < 0.05
    exposure = Mission.open(tmp_path / "out").level0(1) / "exposure.json"
    state = json.loads(exposure.read_text())["state"]
    assert state == ("degraded" if missing else "complete")


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


@pytest.mark.parametrize(
    "tags",
    [
        {"PrincipalPoint": "160,120"},
        {"PrincipalPoint": "-0.6,0.44"},
        {"FisheyeAffineMatrix": "0.463,0,0,0.463"},
        {"FisheyeAffineMatrix": "463000,0,0,463000"},
    ],
    ids=["pixels", "left of the image", "f too short", "f too long"],
)
def test_a_lens_in_other_units_is_refused(scene, tmp_path, tags) -> None:
    sequoia(tmp_path / "in", scene, "Green", "a.tif", tags=tags)
    assert "its tags are in units that are not known" in refused(tmp_path / "in", tmp_path / "out")


def test_positions_and_settings_stay_with_the_frame(scene, tmp_path) -> None:
    place = (47.123456, 15.987654, 912.5)
    dji(tmp_path / "in", scene, "Green", "a.tif", gps=place, iso=200)
    imported(tmp_path / "in", tmp_path / "out")
    exposure = json.loads((tmp_path / "out/L0/000001/exposure.json").read_text())
    (frame,) = exposure["frames"]
    found = frame["settings"]
    assert (found["GpsLatitudeDeg"], found["GpsLongitudeDeg"]) == pytest.approx(place[:2], abs=1e-9)
    assert (found["GpsAltitudeM"], found["Gain"], found["BlackLevel"]) == (912.5, 2.0, 4096.0)
    assert frame["exposure_time_us"] == pytest.approx(2000.0)


@pytest.mark.parametrize(
    ("focal", "units"), [("5.5", "mm"), ("5.5", ""), ("1594.2029", ""), ("1594.2029", "px")]
)
def test_a_focal_length_is_in_mm_or_in_pixels(scene, tmp_path, focal, units) -> None:
    """Older RedEdge wrote pixels without a unit; Pix4D specifies mm."""
    tags = {"PerspectiveFocalLength": focal, "PerspectiveFocalLengthUnits": units}
    micasense(tmp_path / "in", scene, "Green", "a.tif", "RedEdge-M", "R1", tags=tags)
    imported(tmp_path / "in", tmp_path / "out")
    lens = load_rig(tmp_path / "out/rig.toml").cone("G").lens
    assert lens.f_mm == pytest.approx(5.5, rel=1e-6)


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


def test_vignetting_of_a_rededge_p_is_a_polynomial_of_column_and_row(scene, tmp_path) -> None:
    tags = {
        "VignettingPolynomial2DName": "0,0,1,0,0,2",
        "VignettingPolynomial2D": "0.8,0.2,-0.1",
        "VignettingPolynomial": None,
        "VignettingCenter": None,
    }
    micasense(tmp_path / "in", scene, "Green", "a.tif", "RedEdge-P", "PR02-1", tags=tags)
    imported(tmp_path / "in", tmp_path / "out")
    found = json.loads((tmp_path / "out/radiometry/G.json").read_text())
    assert found["vignetting"] == [0.8, 0.2, -0.1]
    assert found["vignetting_powers"] == [[0, 0], [1, 0], [0, 2]]
    rig = load_rig(tmp_path / "out/rig.toml")
    assert radiance_of(rig, tmp_path / "out/radiometry")["G"].vignetting_powers[2] == (0, 2)
    for name, sentence in (
        ("0,0,1,0,0", "pairs of powers from 0 to 8"),
        ("0,0,1,0,0,-2", "pairs of powers from 0 to 8"),
        ("0,0,1,0", "XMP VignettingPolynomial2D has 3 values; 2 are needed"),
        (None, "has no VignettingPolynomial2DName"),
    ):
        own = tags | {"VignettingPolynomial2DName": name}
        micasense(tmp_path / "other", scene, "Green", "a.tif", "RedEdge-P", "PR02-1", tags=own)
        assert sentence in refused(tmp_path / "other", tmp_path / "two")


def test_an_image_that_dji_dewarped_has_no_distortion_left(scene, tmp_path) -> None:
    dji(tmp_path / "in", scene, "Green", "a.tif", tags={"DewarpFlag": "1"})
    dji(tmp_path / "raw", scene, "Green", "a.tif", tags={"DewarpFlag": "0"})
    imported(tmp_path / "in", tmp_path / "out")
    imported(tmp_path / "raw", tmp_path / "two")
    corner = np.array([[0.0, 0.0]])
    for folder, is_straight in (("out", True), ("two", False)):
        rig = load_rig(tmp_path / folder / "rig.toml")
        straight_px = corner - [170.5, 112.75]
        away_px = np.abs(ideal(rig, "G", corner) * 1913.333 - straight_px).max()
        assert away_px < 0.001 if is_straight else away_px > 0.3


def test_a_thumbnail_of_exif_is_no_second_image(scene, tmp_path) -> None:
    """A second directory with a compressed JPEG; one with words of its own is refused."""
    path = tmp_path / "in/a.tif"
    dji(path.parent, scene, "Green", "a.tif")
    written = path.read_bytes()
    at = int.from_bytes(written[4:8], "little")
    link = at + 2 + 12 * int.from_bytes(written[at : at + 2], "little")

    def with_second(entries: list) -> bytes:
        data = written[:link] + len(written).to_bytes(4, "little") + written[link + 4 :]
        return data + directory(entries, len(written))

    thumbnail = [entry(259, "short", 6), entry(513, "long", 8), entry(514, "long", 100)]
    path.write_bytes(with_second(thumbnail))
    (camera,) = imported(path.parent, tmp_path / "out")
    assert camera["frames"] == 1
    sides = [entry(256, "long", 320), entry(257, "long", 240), entry(258, "short", 16)]
    path.write_bytes(
        with_second([*sides, entry(259, "short", 1), entry(273, "long", 8), entry(279, "long", 8)])
    )
    assert "holds several images (page 2)" in refused(path.parent, tmp_path / "two")


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


def test_radiometric_tags_that_nothing_uses_are_named(scene, tmp_path) -> None:
    tags = {"Irradiance": "812.5", "SensorGain": "1.2", "VignettingData": "1,2,3,4,5,6"}
    dji(tmp_path / "dji", scene, "Green", "a.tif", tags=tags)
    (camera,) = imported(tmp_path / "dji", tmp_path / "one")
    (note,) = [one for one in camera["notes"] if "nothing uses" in one]
    assert note.endswith(": Irradiance, SensorGain, VignettingData")
    tags = {"HorizontalIrradiance": "0.9", "VignettingPolynomial": "0,0,0,0,0,0"}
    micasense(tmp_path / "mica", scene, "Green", "IMG_0000_2.tif", "RedEdge-M", "R1", tags=tags)
    (camera,) = imported(tmp_path / "mica", tmp_path / "two")
    (note,) = [one for one in camera["notes"] if "nothing uses" in one]
    assert note.endswith(": HorizontalIrradiance")


def test_the_black_level_of_dji_may_be_in_its_xmp(scene, tmp_path) -> None:
    for band, changes in (("Green", {}), ("NIR", {"black": 4000})):
        tags = {"BlackCurrent": "4096"}
        dji(tmp_path / "in", scene, band, f"{band}.tif", tags=tags, **{"black": None, **changes})
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    rig = load_rig(tmp_path / "out/rig.toml")
    assert (rig.sensor("G").black_dn, rig.sensor("N").black_dn) == (4096.0, 4000.0)
    assert not any("BlackLevel" in note for note in camera["notes"])


def test_a_place_below_the_sea_has_a_negative_height(scene, tmp_path) -> None:
    dji(tmp_path / "in", scene, "Green", "a.tif", gps=(31.5, 35.5, 410.0))
    path = tmp_path / "in/a.tif"
    path.write_bytes(path.read_bytes().replace(entry_of_reference(0), entry_of_reference(1)))
    imported(tmp_path / "in", tmp_path / "out")
    record = json.loads((tmp_path / "out/L0/000001/exposure.json").read_text())
    assert record["frames"][0]["settings"]["GpsAltitudeM"] == pytest.approx(-410.0)


def entry_of_reference(value: int) -> bytes:
    """GPSAltitudeRef as it is in the file, a byte."""
    code, kind, count, raw = entry(5, "byte", bytes([value]))
    return struct.pack("<HHI", code, kind, count) + raw.ljust(4, b"\0")


def test_an_unknown_camera_is_refused_with_what_is_missing(scene, tmp_path) -> None:
    write_image(
        tmp_path / "in/a.tif", scene, xmp({"CentralWavelength": "550"}), make="Acme", model="Six",
        time_s=None, focal_mm=None,
    )  # fmt: skip
    assert refused(tmp_path / "in", tmp_path / "out") == (
        "a.tif: Acme Six: has no BandName in XMP, no lens: ModelType with its parameters, or "
        "DewarpData in XMP, no ExposureTime in EXIF, no FocalPlaneXResolution in EXIF"
    )
    sequoia(tmp_path / "two", scene, "Red", "b.tif", tags={"FisheyeAffineMatrix": ""})
    sentence = refused(tmp_path / "two", tmp_path / "out")
    assert sentence == "b.tif: Parrot Sequoia: has no FisheyeAffineMatrix in XMP"
    micasense(tmp_path / "three", scene, "Mauve", "c.tif", "RedEdge-M", "R1")
    assert "band 'mauve'; known are blue" in refused(tmp_path / "three", tmp_path / "out")


def test_a_camera_that_is_not_known_by_name_is_taken_and_this_is_stated(scene, tmp_path) -> None:
    """Pix4D's tags: a focal length without a unit is in millimetres."""
    values = {
        "ModelType": "perspective", "PrincipalPoint": "0.48,0.36", "PerspectiveFocalLength": "4.5",
        "PerspectiveDistortion": "-0.1,0.1,0,0.0002,0.0003", "CaptureUUID": "U1",
    }  # fmt: skip
    for band in ("Green", "NIR"):
        packet = xmp(values | {"BandName": band})
        write_image(
            tmp_path / f"in/{band}.tif", scene, packet, make="Acme", model="Two", per_mm=1 / 0.003
        )
    (camera,) = imported(tmp_path / "in", tmp_path / "out")
    assert camera["notes"][-1].startswith("Acme Two is not a known camera: bands that are not")
    rig = load_rig(tmp_path / "out/rig.toml")
    assert rig.cone("G").lens.f_mm == pytest.approx(4.5)
    assert [c.bands[0] for c in rig.cones] == ["green", "nir"]


@pytest.mark.parametrize(
    ("tags", "sentence"),
    [
        ({"FisheyePolynomial": "0.1,1,0,0"}, "begins with 0 and a positive number"),
        ({"FisheyePolynomial": "0,-1,0,0"}, "focal length of -295 px"),
        ({"FisheyePolynomial": "0,1,0,-9"}, "folds the frame over"),
        ({"FisheyePolynomial": "0,1,nan"}, "finite number"),
        ({"FisheyePolynomial": ",".join(["0"] * 50)}, "50 values"),
        ({"FisheyeAffineMatrix": "1,2,3"}, "3 values; 4 are needed"),
        ({"ModelType": "cylindrical"}, "ModelType is 'cylindrical'"),
    ],
)
def test_a_fisheye_that_cannot_be_one_is_refused(scene, tmp_path, tags, sentence) -> None:
    sequoia(tmp_path / "in", scene, "Green", "a.tif", tags=tags)
    assert sentence in refused(tmp_path / "in", tmp_path / "out")


@pytest.mark.parametrize("dewarp", ["2022;1,2,3", "2022;0,0,0,0,0,0,0,0,0", "x;a,b,c,d,e,f,g,h,i"])
def test_a_damaged_dewarp_is_refused(scene, tmp_path, dewarp) -> None:
    dji(tmp_path / "in", scene, "Green", "a.tif", tags={"DewarpData": dewarp})
    assert "a.tif: not a usable image" in refused(tmp_path / "in", tmp_path / "out")


def test_two_calibrations_of_one_serial_number_are_refused(scene, tmp_path) -> None:
    dji(tmp_path / "in", scene, "Green", "a.tif")
    other = {"DewarpData": DEWARP.replace("10.5", "11.5"), "CaptureUUID": "U2"}
    dji(tmp_path / "in", scene, "Green", "b.tif", tags=other)
    sentence = refused(tmp_path / "in", tmp_path / "out")
    assert "b.tif: another camera or calibration than a.tif" in sentence


def test_the_words_are_those_of_the_file(scene, tmp_path) -> None:
    dji(tmp_path / "in", scene, "Green", "a.tif")
    dji(tmp_path / "in", scene, "NIR", "b.tif")
    imported(tmp_path / "in", tmp_path / "out")
    assert np.array_equal(tifffile.imread(tmp_path / "out/L0/000001/N.tif"), scene)


def test_sixteen_bit_photographs_of_phase_one_are_a_block(tmp_path) -> None:
    """TIFF with the focal length and pixel pitch in EXIF, as Capture One exports IIQ."""
    random = np.random.default_rng(1)
    for k in range(3):
        pixels = random.integers(0, 65536, (96, 128, 3), dtype=np.uint16)
        write_image(
            tmp_path / f"in/P{k:04d}.tif", pixels, b"", make="Phase One", model="iXM-100",
            serial="MM01", focal_mm=4.0, per_mm=1 / 0.00376, gps=(47.0 + k * 1e-4, 15.5, 900.0),
        )  # fmt: skip
    done = RUN.invoke(
        app,
        ["import", "photographs", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--json"],
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    content = json.loads(done.stdout)
    assert (content["camera"], content["photographs"]) == ("Phase One iXM-100", 3)
    assert content["f_px"] == pytest.approx(4.0 / 0.00376, rel=1e-5)
    assert content["pixel_um"] == pytest.approx(3.76, rel=1e-5)
    # Another camera in the folder, of the same model, has its own interior orientation.
    write_image(
        tmp_path / "in/Q.tif", pixels, b"", make="Phase One", model="iXM-100", serial="MM02",
        focal_mm=4.0, per_mm=1 / 0.00376, gps=(47.0, 15.5, 900.0),
    )  # fmt: skip
    done = RUN.invoke(
        app,
        ["import", "photographs", str(tmp_path / "in"), "--out", str(tmp_path / "two"), "--json"],
    )
    content = json.loads(done.stdout)
    assert (content["heads"], content["photographs"]) == (["C1", "C2"], 4)
    assert "MM01" in str(content) and "MM02" in str(content)


def test_the_former_name_is_refused_with_the_present_one(tmp_path) -> None:
    done = RUN.invoke(app, ["import", "rededge", str(tmp_path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 2 and "Use 'multispectral'" in " ".join(done.output.split())
    assert "rededge" not in RUN.invoke(app, ["import", "--help"]).output.replace("RedEdge", "")
