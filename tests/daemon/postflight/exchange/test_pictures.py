"""Exported pictures, read by exiftool, rio-cogeo and GDAL (through rasterio)."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.store.level0 import read_description
from daemon.postflight.export.embedded_exif import (
    EmbeddedExifError,
    append_to_jp2,
    embed_in_tiff,
)
from daemon.postflight.export.exif import PictureMetadata
from sim_hw.world.true_camera import projection_centre_m
from tests.daemon.postflight.exchange.flown_block import FLIGHT, FlownBlock, fly

rasterio = pytest.importorskip("rasterio", reason="pip install 'syntopic[geotiff]'")
pytestmark = pytest.mark.peer

RUN = CliRunner()
SHOT = PictureMetadata(
    camera="camera", serial="", name="picture", gps_ns=1_448_000_000_000_000_000, latitude_deg=47.0,
    longitude_deg=15.0, height_m=900.0, position_sigma_m=None, f_mm=70.0, pixel_um=6.0,
    exposure_time_s=None, yaw_pitch_roll_deg=(0.0, 0.0, 0.0), omega_phi_kappa_deg=(0.0, 0.0, 0.0),
    centre_m=(0.0, 0.0, 0.0), crs="EPSG:32633", remark="",
)  # fmt: skip
RIG_LINES = 'serial = "UCL-0815"\n'


@pytest.fixture(scope="module")
def stitched(tmp_path_factory) -> FlownBlock:
    """Two exposures of a stitched rig with RGBN and Level-3."""
    folder = tmp_path_factory.mktemp("stitched") / "mission"
    flown = fly(folder, "ultracam-l-mini", seconds=(5.0, 9.0), lens="f_number = 5.6")
    text = (
        (folder / "rig.toml")
        .read_text()
        .replace('name = "ultracam', RIG_LINES + 'name = "ultracam', 1)
    )
    text = text.replace('bands = ["nir"]', 'bands = ["nir"]\nwavelengths_nm = [800.0]')
    rgb = 'bands = ["red", "green", "blue"]'
    assert rgb in text
    text = text.replace(rgb, rgb + "\nwavelengths_nm = [640.0, 550.0, 470.0]")
    (folder / "rig.toml").write_text(text)
    done = RUN.invoke(app, ["pansharpen", str(folder), "--processes", "0"])
    assert done.exit_code == 0, done.output
    return flown


def export(flown: FlownBlock, kind: str, *more: str) -> dict[str, Path]:
    done = RUN.invoke(
        app,
        ["export", "pictures", str(flown.path), "--as", kind, "--only", "1", "--json",
         "--trajectory", str(flown.trajectory), "--crs", "EPSG:32633", *more],
    )  # fmt: skip
    assert done.exit_code == 0, done.output + str(done.exception)
    content = json.loads(done.stdout)
    return {Path(name).stem: Path(content["folder"]) / name for name in content["files"]}


def tags(path: Path) -> dict:
    if shutil.which("exiftool") is None:
        pytest.skip("exiftool is not here; apt-get install libimage-exiftool-perl")
    done = subprocess.run(
        ["exiftool", "-json", "-n", "-G1", str(path)], capture_output=True, check=True, timeout=60
    )
    return json.loads(done.stdout)[0]


@pytest.mark.parametrize(
    ("kind", "driver"), [("cog", "GTiff"), ("tiff", "GTiff"), ("jp2", "JP2OpenJPEG")]
)
def test_rasters_have_bands_interpretation_and_the_pixels_of_level_2(
    stitched, kind, driver
) -> None:
    files = export(stitched, kind)
    assert set(files) == {"000001_pan", "000001_rgbn"}
    with rasterio.open(files["000001_rgbn"]) as raster:
        assert raster.driver == driver and raster.dtypes == ("uint16",) * 4
        names = [interpretation.name for interpretation in raster.colorinterp]
        # JPEG 2000 has no interpretation for near infrared; the sidecar has its name.
        assert names == ["red", "green", "blue", "undefined" if kind == "jp2" else "nir"]
        assert raster.descriptions == ("red", "green", "blue", "nir")
        assert len(raster.gcps[0]) == 25
        if kind != "jp2":
            assert set(raster.block_shapes) == {(512, 512)}
        pixels = raster.read()
        assert "Camera:BandName" in raster.tags(ns="xml:XMP")["xml:XMP"]
    with rasterio.open(files["000001_pan"]) as raster:
        assert [i.name for i in raster.colorinterp] == ["gray"]
    plain = tifffile.imread(stitched.path / "L2/000001/rgbn.tif")
    assert (pixels == plain).all(), "lossless"
    assert not list((stitched.path / "export" / kind).rglob(".*")), "nothing of a writer is left"


def test_rio_cogeo_finds_every_cog_valid(stitched) -> None:
    cog_validate = pytest.importorskip("rio_cogeo.cogeo").cog_validate
    for files in (export(stitched, "cog"), export(stitched, "cog", "--level", "3", "--bits", "8")):
        for path in files.values():
            is_valid, errors, warnings = cog_validate(str(path), quiet=True)
            assert is_valid and not errors and not warnings, (path.name, errors, warnings)


@pytest.mark.parametrize("bits", [16, 8])
def test_level_3_has_full_resolution_in_both_depths(stitched, bits) -> None:
    files = export(stitched, "tiff", "--level", "3", "--bits", str(bits))
    assert set(files) == {f"000001_rgb-{bits}", f"000001_cir-{bits}"}
    virtual = stitched.rig.virtual_image
    for name, bands in (("rgb", ("red", "green", "blue")), ("cir", ("nir", "red", "green"))):
        with rasterio.open(files[f"000001_{name}-{bits}"]) as raster:
            assert (raster.width, raster.height) == (virtual.width_px, virtual.height_px)
            assert set(raster.dtypes) == {f"uint{bits}"} and raster.descriptions == bands
            assert [i.name for i in raster.colorinterp] == ["red", "green", "blue"]
            pixels = raster.read()
        source = stitched.path / f"L3/000001/{name}-{bits}.tif"
        plain = np.moveaxis(tifffile.imread(source), -1, 0)
        assert (pixels == (plain & 0xFFFE if bits == 16 else plain)).all()
        assert tuple(read_description(source)["bands"]) == bands


def test_a_jpeg_states_that_near_infrared_is_left_out(stitched) -> None:
    found = tags(export(stitched, "jpeg")["000001_rgbn"])
    assert "without nir: a JPEG holds three bands" in found["IFD0:ImageDescription"]
    assert found["XMP-Camera:BandName"] == ["red", "green", "blue"]
    cir = tags(export(stitched, "jpeg", "--level", "3", "--bits", "8")["000001_cir-8"])
    assert cir["XMP-Camera:BandName"] == ["nir", "red", "green"]
    assert cir["XMP-Camera:CentralWavelength"] == [800, 640, 550]
    assert "without" not in cir["IFD0:ImageDescription"]


@pytest.mark.parametrize("kind", ["jpeg", "cog", "tiff", "jp2"])
def test_exiftool_reads_every_tag_of_a_stitched_picture(stitched, kind) -> None:
    files = export(stitched, kind, "--attitude-sigma", "5", "6", "8")
    found = tags(files["000001_pan"])
    assert not [key for key in found if "Warning" in key or "Error" in key]
    virtual = stitched.rig.virtual_image
    pose = FLIGHT.pose(stitched.marks[1])
    roll, pitch, heading = np.degrees(FLIGHT.attitude_rad(pose))
    diagonal_mm = np.hypot(virtual.width_px, virtual.height_px) * virtual.pitch_um * 1e-3
    expected = {
        "IFD0:Make": "Syntopic",
        "ExifIFD:FNumber": 5.6,
        "ExifIFD:FocalLength": virtual.f_mm,
        "ExifIFD:FocalLengthIn35mmFormat": round(virtual.f_mm * np.hypot(36, 24) / diagonal_mm),
        "ExifIFD:FocalPlaneXResolution": pytest.approx(1e4 / virtual.pitch_um, rel=1e-6),
        "ExifIFD:FocalPlaneYResolution": pytest.approx(1e4 / virtual.pitch_um, rel=1e-6),
        "ExifIFD:SerialNumber": "UCL-0815",
        "ExifIFD:ImageUniqueID": "000001_pan",
        "XMP-Camera:ModelType": "perspective",
        "XMP-Camera:PerspectiveFocalLength": virtual.f_mm,
        "XMP-Camera:PerspectiveDistortion": "0,0,0,0,0",
        "XMP-Camera:BandName": "pan",
        "XMP-Camera:Yaw": pytest.approx(heading % 360, abs=1e-3),
        "XMP-Camera:Pitch": pytest.approx(pitch, abs=1e-3),
        "XMP-Camera:Roll": pytest.approx(roll, abs=1e-3),
        "XMP-Camera:IMURollAccuracy": 0.005,
        "XMP-Camera:IMUPitchAccuracy": 0.006,
        "XMP-Camera:IMUYawAccuracy": 0.008,
        "XMP-drone-dji:FlightPitchDegree": f"{pitch:+.4f}",
        "XMP-tiff:Model": stitched.rig.title,
    }
    for key, value in expected.items():
        assert found.get(key) == value, (key, found.get(key))
    place = [found[f"GPS:GPS{name}"] for name in ("Latitude", "Longitude", "Altitude")]
    truth = FLIGHT.geodetic(projection_centre_m(stitched.rig.cone(stitched.rig.master_cone), pose))
    assert place == pytest.approx(truth, abs=1e-3)
    # A trajectory as CSV states no accuracy: none is written.
    assert not [key for key in found if "GPSXYAccuracy" in key or "RtkStd" in key]


@pytest.mark.parametrize("kind", ["cog", "tiff", "jp2"])
def test_exif_of_rasters_is_that_of_the_jpeg(stitched, kind) -> None:
    jpeg = tags(export(stitched, "jpeg")["000001_pan"])
    found = tags(export(stitched, kind)["000001_pan"])
    assert not [key for key in found if "Warning" in key or "Error" in key]
    own = {k: v for k, v in jpeg.items() if k.split(":")[0] in ("ExifIFD", "GPS")}
    assert len(own) >= 25 and {k: found.get(k) for k in own} == own
    for key in ("Make", "Model", "ImageDescription", "Software", "ModifyDate"):
        assert found[f"IFD0:{key}"] == jpeg[f"IFD0:{key}"], key


def test_exif_has_no_place_in_other_files(tmp_path) -> None:
    path = tmp_path / "plain.tif"
    shot = SHOT
    for options, sentence in (
        ({"bigtiff": True}, "no classic TIFF"),
        ({"byteorder": ">"}, "no classic TIFF"),
        ({}, "no entry"),
    ):
        tifffile.imwrite(path, np.zeros((8, 8), np.uint16), **options)
        before = path.read_bytes()
        with pytest.raises(EmbeddedExifError, match=sentence):
            embed_in_tiff(path, shot)
        assert path.read_bytes() == before
    path.write_bytes(b"\0\0\0\x0cjP  \r\n\x87\n\0\0\0\0jp2c\xff\x4f")
    with pytest.raises(EmbeddedExifError, match="no length"):
        append_to_jp2(path, shot)


def test_heads_have_rig_tags_of_multi_band_readers(tmp_path) -> None:
    flown = fly(tmp_path / "mission", "midas-mini", seconds=(5.0,))
    files = export(flown, "jpeg")
    found = {name: tags(files[f"000001_{name}"]) for name in ("nadir", "5", "7")}
    names = [cone.name for cone in flown.rig.cones]
    assert len({one["XMP-Camera:CaptureUUID"] for one in found.values()}) == 1
    for name, one in found.items():
        assert one["XMP-Camera:RigCameraIndex"] == names.index(name)
        assert one["XMP-Camera:RigRelativesReferenceRigCameraIndex"] == 0
        assert one["ExifIFD:FNumber"] == 4
        # The tag of EXIF is an integer; the pixel size gives the exact value.
        f_mm = flown.rig.cone(name).lens.f_mm
        assert one["XMP-Camera:PerspectiveFocalLength"] == pytest.approx(f_mm)
        assert isinstance(one["ExifIFD:FocalLengthIn35mmFormat"], int)
    relatives = [float(v) for v in found["5"]["XMP-Camera:RigRelatives"].split(",")]
    # Head 5 looks ahead: 44.96 deg about x, which vision axes share with ours.
    assert relatives[0] == pytest.approx(np.degrees(0.784784024), abs=1e-4)
    assert found["nadir"]["XMP-Camera:RigRelatives"] == "0.000000,0.000000,0.000000"


def test_accuracies_of_the_receiver_reach_the_tags(stitched, tmp_path) -> None:
    """From the flight's own navigation, which states them."""
    from daemon.mission.log.flight_log import FlightLog
    from daemon.mission.log.log_records import message_of
    from tests.daemon.orientation.test_orientation import sample_at

    mission = Path(shutil.copytree(stitched.path, tmp_path / "mission"))
    (mission / "log").mkdir()
    log = FlightLog.create(mission / "log")
    mark = stitched.marks[1]
    for step in range(-20, 21):
        log.write(message_of(sample_at(mark + step * 10_000_000)))
    log.close()
    done = RUN.invoke(
        app, ["export", "pictures", str(mission), "--as", "jpeg", "--only", "1", "--json"]
    )
    assert done.exit_code == 0, done.output
    content = json.loads(done.stdout)
    found = tags(Path(content["folder"]) / "pan/000001_pan.jpg")
    # At least those of the receiver (formats.md): 0.02 m and 0.03 m.
    assert 0.02 <= found["XMP-Camera:GPSXYAccuracy"] < 0.03
    assert 0.03 <= found["XMP-Camera:GPSZAccuracy"] < 0.04
    assert found["GPS:GPSHPositioningError"] == pytest.approx(
        found["XMP-Camera:GPSXYAccuracy"], abs=1e-4
    )
    assert found["XMP-drone-dji:RtkStdHgt"] == pytest.approx(
        found["XMP-Camera:GPSZAccuracy"], abs=1e-4
    )


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--as", "png"], "cog, tiff, jp2, jpeg are right"),
        (["--level", "3", "--bits", "12"], "Level-3 has 16 and 8"),
        (["--level", "2", "--bits", "8"], "Level-2 has 16 bits"),
    ],
)
def test_what_cannot_be_exported_is_refused(stitched, options, sentence) -> None:
    done = RUN.invoke(app, ["export", "pictures", str(stitched.path), *options])
    assert done.exit_code != 0
    assert sentence in " ".join(str(done.exception or "").split()) + done.output
