"""Any sensor or any cone may be missing: an image, its validity, its accuracy, and a flag."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from processing.matching.tie_points import TiePointSettings
from processing.pipelines.stitched import Pipeline, PipelineSettings, Product
from processing.quality.figures.circumstances import EstimatedDcFigures
from processing.quality.figures.stitching import AdjustmentFigures, MethodFigures
from processing.quality.nominal_area import nominal_area
from processing.quality.report import Flag, Verdict, as_json
from processing.rig import Rig, find_rig
from tests.processing.synthetic_exposure import Exposure, expose
from tests.processing.test_pipeline import conditions, errors_px, rms

RIG = find_rig("ultracam-x-mini")
SINGLE = [(sensor.name,) for sensor in RIG.sensors]
CONES = [tuple(s.name for s in cone.sensors) for cone in RIG.cones]
MASTER = CONES[0]
CASES = list(dict.fromkeys(SINGLE + CONES))
"""Cones of one sensor are among the single ones."""


@pytest.fixture(scope="module")
def exposure() -> Exposure:
    return expose(RIG, dc_k=12.0, tdi_shifts=6)


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    few = TiePointSettings(points_per_overlap=200, points_per_sensor=400)
    return Pipeline(RIG, {}, PipelineSettings(interpolation="bilinear", tie_points=few))


@pytest.fixture(scope="module")
def complete_product(pipeline: Pipeline, exposure: Exposure) -> Product:
    product_copy = pipeline.process(exposure.frames, conditions(RIG, exposure))
    return replace(product_copy, pan=product_copy.pan.copy(), valid=product_copy.valid.copy())


def number(product: Product, figure: str) -> float:
    value = product.report.figures.as_json()[figure]
    assert isinstance(value, float | int)
    return float(value)


def pan_sensors(rig: Rig) -> set[str]:
    return {sensor.name for cone in rig.pan_cones for sensor in cone.sensors}


def test_every_sensor_and_every_cone_has_its_case() -> None:
    assert len(SINGLE) == 13 and len(CONES) == 8 and len(CASES) == 16


def test_the_complete_camera_states_its_accuracy(
    complete_product: Product, exposure: Exposure
) -> None:
    absolute, _ = errors_px(RIG, exposure, complete_product.geometry["free"])
    stated = number(complete_product, "stitched_sigma_px")
    assert 0.01 < stated < 0.04
    # Errors are lengths of two coordinates; the calibration of this exposure is without error.
    assert rms(absolute) < np.sqrt(2.0) * stated
    assert (
        complete_product.report.flags == Flag.SIMULATED
        and complete_product.report.verdict is Verdict.GOOD
    )


@pytest.mark.parametrize("missing", CASES, ids="+".join)
def test_what_is_missing_leaves_an_image_that_reports_it(
    pipeline: Pipeline, exposure: Exposure, complete_product: Product, missing: tuple[str, ...]
) -> None:
    frames = {name: frame for name, frame in exposure.frames.items() if name not in missing}
    product_copy = pipeline.process(frames, conditions(RIG, exposure))
    figures = product_copy.report.figures
    json.dumps(as_json(product_copy.report), allow_nan=False)

    assert product_copy.report.flags & Flag.FRAME_MISSING
    assert figures.of(MethodFigures).missing_sensors == missing
    expected = Verdict.REFLY if missing == MASTER else Verdict.USABLE
    assert product_copy.report.verdict is expected
    assert not product_copy.report.flags & (
        Flag.DC_DISAGREEMENT | Flag.DISPLACED_SENSOR | Flag.SIGMA0
    )

    absent = [
        product_copy.sensors.index(name) + 1 for name in missing if name in product_copy.sensors
    ]
    contributing = product_copy.valid & 0x7F
    assert not np.isin(contributing, absent).any()
    assert np.array_equal(product_copy.valid == 0, product_copy.pan == 0)
    lost = np.isin(complete_product.valid & 0x7F, absent)
    assert (product_copy.valid[~lost] > 0).sum() >= (complete_product.valid[~lost] > 0).sum() - 200
    for band, name in (("red", "R"), ("green", "G"), ("blue", "B"), ("nir", "N")):
        assert bool(product_copy.colour[band].any()) == (name not in missing)

    absolute, inner = errors_px(RIG, exposure, product_copy.geometry["free"])
    stated, before = (
        number(product_copy, "stitched_sigma_px"),
        number(complete_product, "stitched_sigma_px"),
    )
    assert rms(inner) < 0.02 and inner.max() < 0.05
    assert rms(absolute) < np.sqrt(2.0) * stated
    # It grows where what is missing carried the datum, and never shrinks.
    assert stated > 0.98 * before
    if set(missing) < set(MASTER):
        assert stated > 1.08 * before
    if missing == MASTER:
        # Only the platform calibration places the image.
        assert stated > 0.5
    assert set(missing) & pan_sensors(RIG) <= set(_held(product_copy)) or missing == ("SU30",)


def test_without_any_probe_the_image_is_as_unsure_as_temperatures_are(
    pipeline: Pipeline, exposure: Exposure
) -> None:
    unread = dict.fromkeys(exposure.temperatures_c)
    product_copy = pipeline.process(
        exposure.frames, replace(conditions(RIG, exposure), temperatures_c=unread)
    )
    assert product_copy.report.flags == Flag.TEMPERATURE_MISSING | Flag.SIMULATED
    absolute, inner = errors_px(RIG, exposure, product_copy.geometry["free"])
    # It is 12 K warmer than is taken for granted.
    assert rms(inner) < 0.02 < 0.3 < rms(absolute)
    assert rms(absolute) < np.sqrt(2.0) * number(product_copy, "stitched_sigma_px")


@pytest.mark.parametrize(("name", "lost"), [("SU02", 0.5), ("N", 1.0)])
def test_a_frame_that_was_read_out_in_part_is_reported(
    pipeline: Pipeline, exposure: Exposure, name: str, lost: float
) -> None:
    frame = exposure.frames[name].copy()
    frame[round((1.0 - lost) * len(frame)) :] = 0
    product_copy = pipeline.process(
        dict(exposure.frames) | {name: frame}, conditions(RIG, exposure)
    )
    assert (
        product_copy.report.flags & Flag.FRAME_CORRUPT
        and product_copy.report.verdict is Verdict.USABLE
    )
    assert number(product_copy, "unread_worst_fraction") == pytest.approx(lost, abs=0.03)
    assert any(f"of {name} was not read out" in f.sentence for f in product_copy.report.findings)


@pytest.mark.trust
@pytest.mark.parametrize("missing", [("SU02",), ("SU10", "SU30"), ("N",), ("G", "SU11")])
def test_the_valid_area_is_that_of_the_pixels_and_what_calibration_states(
    pipeline: Pipeline, exposure: Exposure, missing: tuple[str, ...]
) -> None:
    frames = {name: frame for name, frame in exposure.frames.items() if name not in missing}
    product_copy = pipeline.process(frames, conditions(RIG, exposure))
    assert valid_shares(product_copy) == pytest.approx(pixel_shares(product_copy), abs=0.005)
    nominal = nominal_area(RIG, missing)
    for band in ("pan", "red", "green", "blue", "nir"):
        differs = nominal.mask(band) != product_copy.valid_area.mask(band)
        assert differs.mean() < 0.02, band
    worst = min(valid_shares(product_copy).items(), key=lambda one: one[1])
    assert number(product_copy, "valid_worst_fraction") == pytest.approx(worst[1], abs=1e-9)
    (finding,) = (f for f in product_copy.report.findings if f.flag is Flag.FRAME_MISSING)
    assert f"{1 - worst[1]:.0%} of {worst[0]} has no valid pixels" in finding.sentence


@pytest.mark.trust
@pytest.mark.parametrize(("name", "band"), [("SU02", "pan"), ("N", "nir"), ("R", "red")])
def test_lines_that_were_not_read_out_are_no_data(
    pipeline: Pipeline, exposure: Exposure, name: str, band: str
) -> None:
    frame = exposure.frames[name].copy()
    frame[len(frame) // 2 :] = 0
    without = {key: one for key, one in exposure.frames.items() if key != name}
    gone = 1.0 - valid_shares(pipeline.process(without, conditions(RIG, exposure)))[band]
    product_copy = pipeline.process(without | {name: frame}, conditions(RIG, exposure))
    half = 1.0 - valid_shares(product_copy)[band]
    # A seam stays in the middle of the overlap, so a PAN head takes a little more than its half.
    assert 0.45 * gone < half < 0.7 * gone
    assert valid_shares(product_copy) == pytest.approx(pixel_shares(product_copy), abs=0.005)


def valid_shares(product_copy: Product) -> dict[str, float]:
    return {
        band: product_copy.valid_area.share(band) for band in ("pan", "red", "green", "blue", "nir")
    }


def pixel_shares(product_copy: Product) -> dict[str, float]:
    return {
        name: float((band > 0).mean())
        for name, band in {"pan": product_copy.pan, **product_copy.colour}.items()
    }


def _held(product_copy: Product) -> list[str]:
    return list(product_copy.report.figures.of(AdjustmentFigures).undetermined)


def test_a_stuck_probe_is_reported_by_the_stitching(pipeline: Pipeline, exposure: Exposure) -> None:
    stuck = dict(exposure.temperatures_c) | {"1": 20.0}
    product_copy = pipeline.process(
        exposure.frames, replace(conditions(RIG, exposure), temperatures_c=stuck)
    )
    assert (
        product_copy.report.flags & Flag.DC_DISAGREEMENT
        and product_copy.report.verdict is Verdict.USABLE
    )
    assert product_copy.report.figures.of(EstimatedDcFigures).dc_disagreement == ("1",)
    estimated, sigma = (
        number(product_copy, "dc_estimated_k"),
        number(product_copy, "dc_estimated_sigma_k"),
    )
    assert abs(estimated - 12.0) < 4.0 * sigma and sigma < 0.5


def test_without_a_probe_the_others_stand_in_and_the_image_is_as_good(
    pipeline: Pipeline, exposure: Exposure, complete_product: Product
) -> None:
    open_probe = dict(exposure.temperatures_c) | {"0": None}
    product_copy = pipeline.process(
        exposure.frames, replace(conditions(RIG, exposure), temperatures_c=open_probe)
    )
    assert product_copy.report.flags == Flag.TEMPERATURE_MISSING | Flag.SIMULATED
    absolute, _ = errors_px(RIG, exposure, product_copy.geometry["free"])
    assert rms(absolute) < 0.02
    assert number(product_copy, "stitched_sigma_px") > 3.0 * number(
        complete_product, "stitched_sigma_px"
    )
