"""Folders of multispectral cameras, in the tags their makers publish, become missions."""

from __future__ import annotations

import json
import struct

import cv2
import numpy as np
import pytest
import tifffile

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.products.band_images import radiance_of
from processing.rig import load_rig
from tests.daemon.multispectral_data import directory, entry, write_image, xmp
from tests.daemon.postflight.multispectral_folders import (
    DEWARP,
    PIXELS,
    RUN,
    dji,
    ideal,
    imported,
    micasense,
    processed,
    refused,
    scene_pixels,
    sequoia,
)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return scene_pixels()


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
