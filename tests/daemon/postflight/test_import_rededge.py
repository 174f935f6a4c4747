"""A foreign five-head camera: its folder becomes a mission, its bands measure right."""

from __future__ import annotations

import json
import shutil
import struct
from datetime import UTC, datetime

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
from daemon.postflight.importers.multispectral_tags import ImagesError, read_image
from daemon.products.band_images import radiance_of
from daemon.products.exposure_conditions import conditions_of
from processing.geometry.placement import vip_mm_from_raw, vip_px_from_mm
from processing.geometry.projective import apply_projective
from processing.image.band_registration import band_placements, reference_image
from processing.pipelines.bands import BandPipeline
from processing.quality.report import Flag
from processing.rig import load_rig
from tests.daemon.rededge_data import RECORDED, needs_recording, packet, write_tiff

PANEL_IN_BLUE = np.array([[809, 613], [648, 615], [646, 454], [808, 452]], np.float64)
"""Corners of the panel in the undistorted image of band 1, columns and rows."""
PUBLISHED = {
    "blue": 0.170284, "green": 0.179400, "red": 0.162217, "nir": 0.106470, "red_edge": 0.130811,
}  # fmt: skip


@pytest.fixture(scope="module")
def processed(tmp_path_factory):
    """The recorded camera, imported and processed: mission, rig, reports by exposure."""
    path = tmp_path_factory.mktemp("rededge") / "field"
    (output,) = _run_json(["import", "multispectral", str(RECORDED), "--out", str(path), "--json"])[
        "cameras"
    ]
    assert output["exposures"] == 2 and output["frames"] == 10 and output["missing"] == []
    assert max(output["lens_fit_px"].values()) < 0.03
    mission = Mission.open(path)
    reports = _run_json(["process", str(path), "--json"])["exposures"]
    return mission, load_rig(mission.rig_path), {r["exposure"]: r for r in reports}


def _run_json(arguments):
    """Output of the command as JSON."""
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@needs_recording
def test_the_mission_holds_the_camera_s_words_and_its_calibration(processed):
    mission, rig, _ = processed
    assert mission.numbers() == [1, 2]
    for number, image in ((1, "IMG_0000"), (2, "IMG_0001")):
        load_level0(mission.level0(number), rig)
        for sensor, head in (("B", 1), ("G", 2), ("R", 3), ("N", 4), ("E", 5)):
            reference = tifffile.imread(RECORDED / "0000SET" / "000" / f"{image}_{head}.tif")
            undistorted = tifffile.imread(mission.level0(number) / f"{sensor}.tif")
            assert np.array_equal(undistorted, reference)
    wavelengths = {c.bands[0]: c.wavelengths_nm for c in rig.cones}
    assert wavelengths == {
        "blue": (475.0,), "green": (560.0,), "red": (668.0,), "nir": (840.0,), "red_edge": (717.0,)
    }  # fmt: skip
    blue = rig.cone("B")
    assert blue.sensors[0].justified == "left" and blue.sensors[0].black_dn == 300.0
    assert blue.lens.f_mm == pytest.approx(1449.3582467 * 0.00375, rel=1e-6)


@needs_recording
def test_pictures_of_registered_bands_are_refused_with_the_files_to_take(processed):
    mission, *_ = processed
    done = CliRunner().invoke(app, ["export", "pictures", str(mission.path), "--as", "tiff"])
    sentence = " ".join(str(done.exception).split())
    assert done.exit_code != 0 and "L2/<exposure>/blue.tif" in sentence, sentence


@needs_recording
def test_the_lens_of_the_rig_undoes_the_distortion_as_opencv_does(processed):
    _, rig, _ = processed
    blue = rig.cone("B")
    matrix = np.array([[1449.3582467, 0, 627.6347], [0, 1449.3582467, 479.8587], [0, 0, 1.0]])
    output = np.array([-0.0967965553, 0.1404189347, 0.000275838377, 0.000660072954, -0.0229808426])
    raw = np.stack(np.meshgrid(np.linspace(0, 1279, 17), np.linspace(0, 959, 13)), -1).reshape(
        -1, 2
    )
    reference = cv2.undistortPoints(
        raw[:, None], matrix, output, criteria=(cv2.TERM_CRITERIA_COUNT, 100, 0.0)
    )[:, 0]
    undistorted = vip_mm_from_raw(band_placements(rig, {})["B"], raw) / rig.cone("G").lens.f_mm
    error_px = np.abs(undistorted * [1, -1] - reference).max() * 1449.36
    assert error_px < 0.03
    assert blue.lens.serial == "1777777"


@needs_recording
def test_the_panel_has_the_published_radiance_in_all_five_bands(processed):
    mission, rig, reports = processed
    image, blue = reference_image(rig), rig.cone("B")
    sensor = blue.sensors[0]
    # The undistorted image of band 1 has its principal point where the raw one has it.
    middle = np.array([(sensor.width_px - 1) / 2, (sensor.height_px - 1) / 2])
    principal = middle + np.array([-sensor.x_mm, sensor.y_mm]) / sensor.pitch_mm
    panel_mm = (PANEL_IN_BLUE - principal) * [1, -1] * sensor.pitch_mm
    panel_mm *= image.f_mm / blue.lens.f_mm
    (found,) = (b for b in reports[1]["bands"] if b["band"] == "blue")
    reference_from_blue = np.linalg.inv(np.array(found["band_from_reference"]))
    panel = vip_px_from_mm(image, apply_projective(reference_from_blue, panel_mm))
    mask = np.zeros((image.height_px, image.width_px), np.uint8)
    cv2.fillConvexPoly(mask, np.rint(panel).astype(np.int32), 1)
    for band, published in PUBLISHED.items():
        raster = tifffile.imread(mission.level2(1) / f"{band}.tif")
        assert float(raster[mask > 0].mean()) == pytest.approx(published, rel=1e-3), band


@needs_recording
def test_the_bands_of_the_flight_frame_fit_within_a_quarter_of_a_pixel(processed):
    _, _, reports = processed
    bands = {band["band"]: band for band in reports[2]["bands"]}
    assert set(bands) == {"blue", "red", "nir", "red_edge"}
    for name, band in bands.items():
        assert band["registered"] and band["points"] > 1500, name
        assert band["rms_px"] < 0.25, name
        assert 2.0 < np.hypot(*band["shift_px"]) < 16.5, name
    assert all(band["rms_px"] < 0.35 for band in reports[1]["bands"])


@needs_recording
def test_registered_bands_lie_on_each_other_in_the_product(processed):
    """The products are matched once more, by phase correlation: no shift is left."""
    mission, _, _ = processed
    rasters = {b: tifffile.imread(mission.level2(2) / f"{b}.tif") for b in PUBLISHED}
    window = np.s_[220:732, 380:892]
    hanning = cv2.createHanningWindow((512, 512), cv2.CV_64F)
    green = rasters["green"][window].astype(np.float64)
    for band in ("blue", "red", "red_edge"):
        other = rasters[band][window].astype(np.float64)
        (dx, dy), _ = cv2.phaseCorrelate(green / green.mean(), other / other.mean(), hanning)
        assert np.hypot(dx, dy) < 0.15, band


@needs_recording
def test_the_saturation_flag_is_raised_on_the_flight_frame_and_not_on_the_panel(processed):
    mission, _, reports = processed
    assert "OVEREXPOSED" in reports[2]["flags"] and reports[2]["verdict"] == "usable"
    assert reports[2]["figures"]["saturated_fraction"] == pytest.approx(0.001488, abs=1e-6)
    assert reports[1]["flags"] == [] and reports[1]["verdict"] == "good"
    mask = tifffile.imread(mission.level2(2) / "blue-mask.tif")
    assert 0.0014 < np.mean(mask & 2 != 0) < 0.01
    quality = json.loads((mission.level2(2) / "quality.json").read_text())
    assert quality["units"]["nir"] == "W/m2/sr/nm"


@needs_recording
def test_a_missing_reference_band_is_reported_and_leaves_the_others_as_calibrated(processed):
    mission, rig, _ = processed
    radiance = radiance_of(rig, mission.path / "radiometry")
    pipeline = BandPipeline(rig, radiance)
    frames, exposure = load_level0(mission.level0(2), rig)
    del frames["G"]
    output = conditions_of(exposure, rig, PlanSection.model_validate({}), Flag(0))
    product = pipeline.process(frames, output)
    assert set(product.bands) == set(PUBLISHED) - {"green"} and radiance
    assert not any(band.registered for band in product.registrations)
    assert Flag.FRAME_MISSING in product.report.flags and Flag.TIE_POINTS in product.report.flags


@needs_recording
def test_images_of_two_cameras_and_doubled_images_are_refused_and_leave_nothing(tmp_path):
    folder = tmp_path / "set"
    folder.mkdir()
    source = RECORDED / "0000SET" / "000" / "IMG_0000_1.tif"
    shutil.copy(source, folder / "IMG_0000_1.tif")
    shutil.copy(source, folder / "IMG_0007_1.tif")
    with pytest.raises(ImagesError, match=r"IMG_0007_1.tif: its capture has another image"):
        import_multispectral(folder, tmp_path / "out")
    changed = source.read_bytes().replace(b"0.00014648541280593884", b"0.00014648541280593984")
    (folder / "IMG_0007_1.tif").write_bytes(changed.replace(b"5v25BtsZg3BQ", b"5v25BtsZg3BX"))
    with pytest.raises(ImagesError, match=r"another camera or calibration than IMG_0000_1\.tif"):
        import_multispectral(folder, tmp_path / "out")
    assert [entry.name for entry in tmp_path.iterdir()] == ["set"]


@needs_recording
def test_a_damaged_image_is_reported_by_name(tmp_path):
    folder = tmp_path / "set"
    folder.mkdir()
    file_bytes = (RECORDED / "0000SET" / "000" / "IMG_0000_1.tif").read_bytes()
    (folder / "short.tif").write_bytes(file_bytes[:300_000])
    (folder / "torn.tif").write_bytes(file_bytes[: len(file_bytes) - 5000])
    with pytest.raises(ImagesError) as refused:
        import_multispectral(folder, tmp_path / "out")
    assert len(refused.value.problems) == 2
    assert refused.value.problems[0].startswith("short.tif: ")


@needs_recording
def test_damaged_tags_end_in_a_sentence_or_in_an_image_and_never_otherwise(tmp_path):
    """Single bytes of header and tags are changed, everything else stays."""
    file_bytes = (RECORDED / "0000SET" / "000" / "IMG_0000_1.tif").read_bytes()
    (first,) = struct.unpack_from("<I", file_bytes, 4)
    rng = np.random.default_rng(11)
    refused = 0
    for _ in range(250):
        damaged = bytearray(file_bytes)
        for at in rng.integers(first, len(file_bytes), 3):
            damaged[at] = rng.integers(0, 256)
        damaged[rng.integers(first, first + 300)] ^= 1 << rng.integers(0, 8)
        path = tmp_path / "a.tif"
        path.write_bytes(damaged)
        try:
            read_image(path)
        except ImagesError as error:
            refused += 1
            assert error.problems[0].startswith("a.tif: ")
    assert refused > 50


def test_images_without_what_the_calibration_needs_are_refused(tmp_path):
    write_tiff(tmp_path / "a.tif", packet())
    with pytest.raises(ImagesError, match=r"a\.tif: .*has no EXIF"):
        import_multispectral(tmp_path, tmp_path / "out")
    (tmp_path / "a.tif").write_bytes(b"II*\0")
    with pytest.raises(ImagesError, match=r"a\.tif: not a usable image"):
        import_multispectral(tmp_path, tmp_path / "out")


def test_an_empty_folder_and_a_mission_that_is_there_are_refused(tmp_path):
    with pytest.raises(ImagesError, match="holds 0 TIFF images"):
        import_multispectral(tmp_path, tmp_path / "out")
    with pytest.raises(ImagesError, match="is there already"):
        import_multispectral(tmp_path, tmp_path)


def test_gps_time_counts_the_leap_seconds_of_its_day():
    assert gps_ns_from_utc(datetime(1980, 1, 6, tzinfo=UTC)) == 14 * 10**9
    # 2017-10-19T20:42:10 UTC is second 420148 of GPS week 1971, 18 leap seconds included.
    instant = datetime(2017, 10, 19, 20, 42, 10, tzinfo=UTC)
    assert gps_ns_from_utc(instant) == (1971 * 604_800 + 420_148) * 10**9
