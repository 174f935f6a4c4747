"""Whole exposures through the pipeline, against the truth they were made from."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from processing.geometry.placement import nominal_placements, vip_mm_from_raw, vip_px_from_mm
from processing.image.lattice import colour_raster
from processing.mosaic.mosaic_plots import residuals_svg
from processing.mosaic.residual_vectors import residual_vectors
from processing.pipelines.kernel_compilation import kernels, variants
from processing.pipelines.stitched import Conditions, Pipeline, PipelineSettings, Product
from processing.quality.figures import FIGURES
from processing.quality.figures.circumstances import DcFigures
from processing.quality.figures.image import ValidFigures
from processing.quality.figures.stitching import (
    DisplacedSensorFigures,
    DisplacementFigures,
    MethodFigures,
    TiePointFigures,
)
from processing.quality.report import Flag, Verdict, as_json
from processing.radiometry.level1 import exposed_rows, level1_counts_per_dn
from processing.rig import Rig, find_rig
from tests.processing.synthetic_exposure import Exposure, expose

DISPLACED = (0.6, -0.4)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return find_rig("ultracam-x-mini")


@pytest.fixture(scope="module")
def pipeline(rig: Rig) -> Pipeline:
    pipeline = Pipeline(rig, {}, PipelineSettings(baselines=True))
    pipeline.warm_up()
    return pipeline


@pytest.fixture(scope="module")
def exposure(rig: Rig) -> Exposure:
    """Twelve kelvin above calibration, six TDI shifts, SU01 displaced, SU20 darker."""
    return expose(
        rig, dc_k=12.0, displaced={"SU01": DISPLACED}, tdi_shifts=6, brightness={"SU20": 0.93}
    )


def conditions(rig: Rig, exposure: Exposure) -> Conditions:
    return Conditions(
        temperatures_c=exposure.temperatures_c,
        temperature_age_s=dict.fromkeys(exposure.temperatures_c, 1.0),
        exposure_time_s={sensor.name: 0.004 for sensor in rig.sensors},
        tdi_shifts=exposure.tdi_shifts,
        ground_speed_mps=64.0,
        height_above_ground_m=600.0,
        roll_rad=0.01,
        pitch_rad=-0.01,
        angular_rate_rad_per_s=(0.001, 0.001, 0.0),
        crab_rad=0.02,
        time_sigma_ns=60.0,
        simulated=True,
    )


def errors_px(
    rig: Rig, exposure: Exposure, geometry: Mapping[str, NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Error of every VIP node: absolute, and after the best similarity (lengths, px)."""
    image = rig.virtual_image
    assert image is not None
    truth = nominal_placements(exposure.true_rig, exposure.temperatures_c, exposure.tdi_shifts)
    put, seen = [], []
    for cone in rig.pan_cones:
        for sensor in cone.sensors:
            if f"{sensor.name}.raw" in geometry:
                xy = vip_mm_from_raw(truth[sensor.name], geometry[f"{sensor.name}.raw"])
                seen.append(vip_px_from_mm(image, xy))
                put.append(geometry[f"{sensor.name}.vip"])
    a = np.concatenate(seen) @ [1, 1j]
    b = np.concatenate(put) @ [1, 1j]
    ac, bc = a - a.mean(), b - b.mean()
    similarity = np.vdot(bc, ac) / np.vdot(bc, bc)
    return np.abs(a - b), np.abs(ac - similarity * bc)


def rms(lengths: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(lengths**2)))


@pytest.fixture(scope="module")
def product(rig: Rig, pipeline: Pipeline, exposure: Exposure) -> Product:
    """One product with pixel arrays of its own, for the pipeline goes on to others."""
    processed = pipeline.process(exposure.frames, conditions(rig, exposure))
    return replace(
        processed,
        pan=processed.pan.copy(),
        valid=processed.valid.copy(),
        colour={band: raster.copy() for band, raster in processed.colour.items()},
    )


def test_the_free_mosaic_is_within_the_bars_where_the_fixed_method_is_not(
    rig: Rig, exposure: Exposure, product: Product
) -> None:
    absolute, inner = errors_px(rig, exposure, product.geometry["free"])
    assert rms(inner) < 0.02 and inner.max() < 0.05
    assert rms(absolute) < 0.03 and absolute.max() < 0.06
    _, inner_fixed = errors_px(rig, exposure, product.geometry["fixed"])
    _, inner_no_tdm = errors_px(rig, exposure, product.geometry["fixed-no-tdm"])
    assert rms(inner_fixed) > 3 * rms(inner)
    assert rms(inner_no_tdm) > 3 * rms(inner_fixed) / 2


def test_the_displaced_sensor_is_named_with_its_displacement(product: Product) -> None:
    figures = product.report.figures
    assert figures.of(DisplacedSensorFigures).displaced_sensor == "SU01"
    moved = figures.of(DisplacementFigures)
    x, y, sigma = moved.displacement_x_px, moved.displacement_y_px, moved.displacement_sigma_px
    assert x is not None and y is not None and sigma is not None
    assert abs(x - DISPLACED[0]) < 3 * sigma and abs(y - DISPLACED[1]) < 3 * sigma
    assert product.report.verdict is Verdict.USABLE
    assert product.report.flags == Flag.DISPLACED_SENSOR | Flag.SIMULATED
    assert product.mosaic.datum_sensors == ("SU00", "SU02", "SU03")
    assert product.equal_datum.datum_sensors == ("SU00", "SU01", "SU02", "SU03")


def test_the_darker_head_is_balanced_and_no_step_is_left_at_its_seams(product: Product) -> None:
    gains = product.balance.gains
    others = [gain for name, gain in gains.items() if name != "SU20"]
    assert gains["SU20"] / np.mean(others) == pytest.approx(1 / 0.93, rel=3e-3)
    assert np.ptp(others) < 3e-3


def test_the_pixels_show_the_scene_where_the_geometry_states(
    rig: Rig, exposure: Exposure, product: Product
) -> None:
    """The image-based check: grey values against an undisturbed exposure's, at the same places."""
    clean = expose(rig, seed=5)
    found = Pipeline(rig, {}, PipelineSettings()).process(
        clean.frames, replace(conditions(rig, clean), temperatures_c=clean.temperatures_c)
    )
    seen = (product.valid > 0) & (found.valid > 0)
    gain = np.median(product.pan[seen] / found.pan[seen].astype(float))
    low = [
        ndimage.gaussian_filter(p.astype(np.float32), 1.0)
        for p in (product.pan / gain, found.pan.astype(np.float64))
    ]
    inside = ndimage.binary_erosion(seen, iterations=6)
    difference = (low[0] - low[1])[inside]
    # Both exposures have their own photon and read noise; its share after smoothing is known.
    sensor = rig.sensor("SU00")
    electrons = 1200 * sensor.electrons_per_dn + sensor.read_noise_e**2
    noise = 8 * np.sqrt(electrons) / sensor.electrons_per_dn * np.sqrt(2 / (4 * np.pi))
    assert np.std(difference) < 1.6 * noise
    gradient = np.gradient(low[1])
    for axis in (0, 1):
        slope = gradient[axis][inside]
        shift = float(np.dot(slope, difference) / np.dot(slope, slope))
        assert abs(shift) < 0.02


def test_validity_gives_the_sensor_of_every_pixel(product: Product) -> None:
    names = product.sensors
    assert set(np.unique(product.valid)) <= set(range(len(names) + 1))
    assert names[product.valid[200, 300] - 1] == "SU00"
    assert names[product.valid[1113, 1740] - 1] == "SU30"
    assert np.array_equal(product.valid == 0, product.pan == 0)
    assert 0.99 < float(product.report.figures.of(ValidFigures).valid_fraction or 0) < 1.0


def test_colour_lies_on_pan(rig: Rig, product: Product) -> None:
    image = rig.virtual_image
    assert image is not None
    raster = colour_raster(image)
    ratio = raster.ratio
    high, wide = raster.height_px * ratio, raster.width_px * ratio
    pan = ndimage.gaussian_filter(product.pan[:high, :wide].astype(np.float64), 1.5)
    # Smoothed after sampling: what folded over at three pixels' spacing is not the colour's place.
    reduced = ndimage.gaussian_filter(pan[1::ratio, 1::ratio], 2.0)
    window = (slice(60, -60), slice(60, -60))
    reference = reduced[window]
    slopes = np.gradient(reduced)
    assert set(product.colour) == {"green", "red", "blue", "nir"}
    for band, bar in (("green", 0.01), ("red", 0.015), ("blue", 0.015), ("nir", 0.04)):
        assert product.colour[band].shape == (raster.height_px, raster.width_px)
        colour = ndimage.gaussian_filter(product.colour[band].astype(np.float64), 2.0)[window]
        gain = np.cov(colour.ravel(), reference.ravel())[0, 1] / np.var(reference)
        off = (colour - colour.mean()) / gain - (reference - reference.mean())
        for slope in slopes:
            s = slope[window]
            assert abs(float(np.sum(s * off) / np.sum(s * s))) < bar


def test_every_figure_is_documented_and_the_report_is_json(rig: Rig, product: Product) -> None:
    bands, cones = set(product.colour), {cone.name for cone in rig.cones}
    documented = {
        name.replace("<band>", band).replace("<cone>", cone)
        for name in FIGURES
        for band in bands
        for cone in cones
    }
    assert product.report.figures.as_json().keys() <= documented
    text = json.dumps(as_json(product.report), allow_nan=False)
    assert json.loads(text)["figures"]["tie_points_pp"] > 1500


def test_residuals_can_be_drawn(rig: Rig, product: Product) -> None:
    svg = residuals_svg(rig, product.tie_points, product.mosaic, product.validity)
    texts = [e.text or "" for e in ET.fromstring(svg).iter() if e.tag.endswith("text")]
    assert any("SU01 displaced by" in text for text in texts)
    assert len(svg) < 400_000


def test_residuals_are_reported_as_numbers(rig: Rig, product: Product) -> None:
    vector_data = residual_vectors(rig, product.tie_points, product.mosaic)
    figures = product.report.figures
    pan = {sensor.name for cone in rig.pan_cones for sensor in cone.sensors}
    used = sum(one["used"] for one in vector_data["overlaps"] if set(one["sensors"]) <= pan)
    assert used == figures.of(TiePointFigures).tie_points_pp
    vectors = np.array(vector_data["vectors"])
    assert 300 <= len(vectors) <= 600
    assert (vectors[:, :2] > -20).all()
    assert (vectors[:, 0] < vector_data["width_px"] + 20).all()
    assert (vectors[:, 1] < vector_data["height_px"] + 20).all()
    # A residual is small; of what is left out, some are not.
    assert np.median(np.hypot(*vectors[vectors[:, 4] == 0, 2:4].T)) < 0.2
    assert len(json.dumps(vector_data)) < 40_000


@pytest.mark.trust
def test_an_exposure_time_that_cannot_be_is_named_and_changes_no_other_frame(
    rig: Rig, pipeline: Pipeline, exposure: Exposure, product: Product
) -> None:
    usual = conditions(rig, exposure)
    planted = replace(usual, exposure_time_s={**usual.exposure_time_s, "SU10": 1e-8, "N": 100.0})
    found = pipeline.process(exposure.frames, planted)
    figures = found.report.figures.as_json()
    assert figures["exposure_implausible_sensors"] == "SU10, N"
    assert figures["exposure_unknown_sensors"] is None
    assert found.report.flags == product.report.flags | Flag.UNDEREXPOSED
    assert "an impossible exposure time of SU10, N: it is not used" in " ".join(
        finding.sentence for finding in found.report.findings
    )
    both = (found.pan > 0) & (product.pan > 0)
    assert np.count_nonzero(both) == np.count_nonzero(product.pan > 0)
    change = found.pan[both] / product.pan[both]
    assert np.quantile(np.abs(change - 1.0), 0.999) < 0.01


def test_nothing_compiles_after_the_warm_up(
    rig: Rig, pipeline: Pipeline, exposure: Exposure
) -> None:
    before = variants()
    assert len(kernels()) >= 15
    ready = {name.rsplit(".", 1)[1] for name, count in before.items() if count}
    assert ready >= {
        "_flat_pass",
        "select_features",
        "match_patches",
        "refine_patches",
        "_node_means",
        "_cheapest_path",
        "_feather",
        "_resample",
        "_block_means",
    }
    for frame in exposure.frames.values():
        frame.flags.writeable = False
    pipeline.process(exposure.frames, conditions(rig, exposure))
    few = {name: frame for name, frame in exposure.frames.items() if name not in ("SU30", "G")}
    pipeline.process(few, conditions(rig, exposure))
    assert variants() == before


def test_the_same_frames_give_the_same_pixels(
    rig: Rig, pipeline: Pipeline, exposure: Exposure, product: Product
) -> None:
    again = pipeline.process(exposure.frames, conditions(rig, exposure))
    assert np.array_equal(again.pan, product.pan)
    assert all(np.array_equal(again.colour[band], product.colour[band]) for band in again.colour)
    assert as_json(again.report) == as_json(product.report)


@pytest.mark.parametrize(
    "missing",
    [("SU10",), ("SU01", "SU30"), ("G",), ("SU10", "SU11"), ("R", "N")],
    ids="+".join,
)
def test_a_missing_frame_leaves_a_hole_and_a_usable_image(
    rig: Rig, pipeline: Pipeline, exposure: Exposure, missing: tuple[str, ...]
) -> None:
    frames = {name: frame for name, frame in exposure.frames.items() if name not in missing}
    processed = pipeline.process(frames, conditions(rig, exposure))
    assert processed.report.verdict is Verdict.USABLE
    assert processed.report.flags & Flag.FRAME_MISSING
    assert processed.report.figures.of(MethodFigures).missing_sensors == missing
    absent = [processed.sensors.index(name) + 1 for name in missing if name in processed.sensors]
    assert not np.isin(processed.valid & 0x7F, absent).any()
    assert not any(f"{name}.raw" in processed.geometry["free"] for name in missing)
    _, inner = errors_px(rig, exposure, processed.geometry["free"])
    assert rms(inner) < 0.05
    for band, name in (("red", "R"), ("green", "G"), ("nir", "N")):
        assert bool(processed.colour[band].any()) == (name not in missing)


def test_without_any_frame_there_is_a_verdict_and_no_exception(
    rig: Rig, pipeline: Pipeline
) -> None:
    processed = pipeline.process({}, Conditions())
    assert processed.report.verdict is Verdict.REFLY
    assert not processed.valid.any() and not processed.pan.any()
    json.dumps(as_json(processed.report), allow_nan=False)


def test_open_water_is_placed_by_calibration_and_reports_it(rig: Rig, pipeline: Pipeline) -> None:
    water = expose(rig, dc_k=12.0, contrast=0.0)
    processed = pipeline.process(water.frames, conditions(rig, water))
    assert processed.report.flags & Flag.TIE_POINTS
    assert processed.report.verdict is not Verdict.GOOD
    absolute, _ = errors_px(rig, water, processed.geometry["free"])
    assert absolute.max() < 0.01


def test_a_probe_that_is_open_or_impossible_is_flagged(
    rig: Rig, pipeline: Pipeline, exposure: Exposure
) -> None:
    readings = dict(exposure.temperatures_c) | {"1": None, "2": 300.0}
    processed = pipeline.process(
        exposure.frames, replace(conditions(rig, exposure), temperatures_c=readings)
    )
    assert processed.report.flags & Flag.TEMPERATURE_MISSING
    assert processed.report.flags & Flag.TEMPERATURE_RANGE
    assert processed.report.figures.of(DcFigures).dc_k_by_cone["1"] is None


def test_the_fixed_method_can_be_chosen(rig: Rig, exposure: Exposure) -> None:
    processed = Pipeline(rig, {}, PipelineSettings(method="fixed")).process(
        exposure.frames, conditions(rig, exposure)
    )
    assert processed.report.figures.of(MethodFigures).method == "fixed"
    assert set(processed.geometry) == {"fixed"} and processed.validity is None


def test_a_frame_of_another_size_is_refused(
    rig: Rig, pipeline: Pipeline, exposure: Exposure
) -> None:
    bad = dict(exposure.frames) | {"SU00": np.zeros((10, 10), np.uint16)}
    with pytest.raises(ValueError, match="raw of SU00 is"):
        pipeline.process(bad, conditions(rig, exposure))


def test_a_rig_that_cannot_be_composed_is_refused(rig: Rig) -> None:
    with pytest.raises(ValueError, match="no virtual image"):
        Pipeline(replace(rig, virtual_image=None))


@pytest.mark.trust
def test_each_frame_is_corrected_with_its_own_exposure_time_and_tdi(
    pipeline: Pipeline, rig: Rig, exposure: Exposure
) -> None:
    usual = conditions(rig, exposure)
    corrected = pipeline._correct(pipeline._read(exposure.frames, usual))
    before = {name: level1_frame.copy() for name, level1_frame in corrected.level1.items()}
    short = exposure.frames["SU01"].astype(np.float64)
    black = rig.sensor("SU01").black_dn
    frames = {**exposure.frames, "SU01": np.rint((short - black) / 2 + black).astype(np.uint16)}
    deviating = replace(
        usual,
        exposure_time_s={**usual.exposure_time_s, "SU01": 0.002},
        tdi_shifts={**usual.tdi_shifts, "SU01": 9},
    )
    after = pipeline._correct(pipeline._read(frames, deviating)).level1
    for name, level1_frame in after.items():
        if name != "SU01":
            assert np.array_equal(level1_frame, before[name]), name
    rows = exposed_rows(rig.sensor("SU01"), 9)
    assert not after["SU01"][: rows[0]].any()  # entering rows of nine shifts, not of six
    seen = np.s_[rows[0] : rows[1] + 1]
    half_a_dn = level1_counts_per_dn(rig.sensor("SU01").bits) * 1.01
    change = after["SU01"][seen].astype(int) - before["SU01"][seen].astype(int)
    assert np.abs(change).max() <= half_a_dn + 2
    assert abs(change.mean()) < 1.0
