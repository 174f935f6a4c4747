"""A camera of two PAN cones and a Bayer head (ultracam-l), over real imagery of the emulator.

One overlap between two single sensors: a projective layer holds only thanks to green, and green
comes out of a Bayer head. The earlier experiment without either is included for comparison.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest

from processing.geometry.placement import (
    SensorPlacement,
    nominal_placements,
    vip_mm_from_raw,
    vip_px_from_mm,
)
from processing.geometry.projective import apply_projective
from processing.mosaic.free_mosaic import free_mosaic
from processing.mosaic.pan_only import pan_only_mosaic
from processing.pipelines.stitched import Pipeline, PipelineSettings, Product
from processing.quality.figures.stitching import DisplacedSensorFigures, PrecisionFigures
from processing.quality.report import Flag, Verdict
from processing.rig import Rig, find_rig
from tests.processing.emulated_exposure import EmulatedExposure, after_similarity, expose, rms
from tests.processing.synthetic import make_truth, tie_points_of


@dataclass(frozen=True)
class Flown:
    """An emulated exposure, and what the pipeline made of it."""

    emulated: EmulatedExposure
    pipeline: Pipeline
    product: Product


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    emulated = expose("ultracam-l-mini", tmp_path_factory.mktemp("emulated"), height_px=2300)
    pipeline = Pipeline(emulated.world.rig, None, PipelineSettings())
    product = pipeline.process(emulated.frames, emulated.conditions)
    colour = {name: band.copy() for name, band in product.colour.items()}
    product_copy = replace(
        product, pan=product.pan.copy(), valid=product.valid.copy(), colour=colour
    )
    return Flown(emulated, pipeline, product_copy)


def test_the_stitched_geometry_is_within_its_bars(flown: Flown) -> None:
    errors, inner = flown.emulated.errors_px(flown.product.geometry["free"])
    assert rms(inner) < 0.02 and np.hypot(*inner.T).max() < 0.06
    assert rms(errors) < 0.1 and np.hypot(*errors.T).max() < 0.3


def test_sixteen_unknowns_and_none_of_them_undetermined(flown: Flown) -> None:
    mosaic = flown.product.mosaic
    assert (mosaic.rank, mosaic.constraints, len(mosaic.values)) == (16, 0, 16)
    assert mosaic.undetermined == ()
    counts = flown.product.tie_points.counts()
    assert counts["SU00", "SU10"] > 200
    assert counts["SU00", "RGB"] > 1200 and counts["SU10", "RGB"] > 1200
    # Without a radiometric calibration defect columns stay, and are named; nothing else is.
    (finding,) = flown.product.report.findings
    assert finding.flag is Flag.FRAME_CORRUPT and "Calibrate the defects" in finding.sentence
    assert flown.product.report.verdict is Verdict.USABLE


def test_nothing_is_stated_of_a_displacement_that_cannot_be_seen(flown: Flown) -> None:
    validity = flown.product.validity
    assert validity is not None and validity.displaced is None and not validity.relative
    assert set(validity.observability.values()) == {"unobservable"}
    assert flown.product.report.figures.of(DisplacedSensorFigures).displaced_sensor is None


def test_the_bayer_heads_colours_share_greens_place_and_nir_comes_to_it(flown: Flown) -> None:
    product = flown.product
    assert list(product.colour) == ["red", "green", "blue", "nir"]
    assert [(b.band, b.registered) for b in product.bands] == [("nir", True)]
    image = flown.emulated.world.image
    for name, bar in (("RGB", 0.1), ("N", 0.2)):
        sensor = flown.emulated.world.rig.sensor(name)
        c, r = np.meshgrid(
            np.linspace(40, sensor.width_px - 40, 15), np.linspace(20, sensor.height_px - 20, 11)
        )
        raw = np.stack([c.ravel(), r.ravel()], axis=1)
        xy = vip_mm_from_raw(product.mosaic.placements[name], raw)
        if name == "N":
            (nir,) = product.bands
            xy = apply_projective(np.linalg.inv(nir.band_from_green), xy)
        assert (
            rms(flown.emulated.errors_of(name, raw, vip_px_from_mm(image, xy))) < bar * 2
        )  # PAN px


def test_all_bands_have_the_light_of_the_ground(flown: Flown) -> None:
    colour = flown.product.colour
    shape = (
        flown.emulated.world.image.colour_height_px,
        flown.emulated.world.image.colour_width_px,
    )
    for band in colour.values():
        assert band.shape == shape
        assert (band[4:-4, 4:-4] > 0).mean() > 0.99
    inner = {name: band[50:-50, 50:-50].astype(float).ravel() for name, band in colour.items()}
    # Neighbouring bands look alike, and yet they are not copies of each other.
    assert 0.7 < np.corrcoef(inner["red"], inner["green"])[0, 1] < 0.9999
    assert 0.7 < np.corrcoef(inner["blue"], inner["green"])[0, 1] < 0.9999


@pytest.fixture(scope="module")
def full_size() -> Rig:
    return find_rig("ultracam-l")


def misfit_px(
    rig: Rig, placements: Mapping[str, SensorPlacement], truth: Mapping[str, SensorPlacement]
) -> float:
    """RMS of how the right sensor lies against the left, after a similarity of the whole, px."""
    image = rig.virtual_image
    assert image is not None
    put, belongs = [], []
    for name in ("SU00", "SU10"):
        sensor = rig.sensor(name)
        c, r = np.meshgrid(
            np.linspace(0, sensor.width_px - 1, 12), np.linspace(0, sensor.height_px - 1, 15)
        )
        raw = np.stack([c.ravel(), r.ravel()], axis=1)
        put.append(vip_px_from_mm(image, vip_mm_from_raw(placements[name], raw)))
        belongs.append(vip_px_from_mm(image, vip_mm_from_raw(truth[name], raw)))
    vip = np.concatenate(put)
    return rms(after_similarity(vip, np.concatenate(belongs) - vip))


def test_without_green_and_precorrection_the_right_half_is_bent(full_size: Rig) -> None:
    rng = np.random.default_rng(1)
    truth = make_truth(full_size, rng, layer_px=0.0, sensor_px=0.0)
    points = tie_points_of(truth, rng, per_overlap=800, per_sensor=1900)
    start = nominal_placements(full_size, dict.fromkeys(full_size.probes, 30.0), {})
    regular = free_mosaic(full_size, start, points)
    experiment = pan_only_mosaic(full_size, start, points)
    assert experiment.rank == 4 + 4 and experiment.constraints == 4
    assert misfit_px(full_size, regular.placements, truth.placements) < 0.03
    assert misfit_px(full_size, experiment.placements, truth.placements) > 0.08


def test_the_layer_of_the_experiment_is_a_similarity(full_size: Rig) -> None:
    rng = np.random.default_rng(2)
    truth = make_truth(full_size, rng)
    points = tie_points_of(truth, rng, per_overlap=400, per_sensor=10)
    found = pan_only_mosaic(full_size, truth.start, points).placements["SU10"].layer
    f = full_size.cone("1").lens.f_mm
    layer = found / found[2, 2]
    assert layer[0, 0] == pytest.approx(layer[1, 1], abs=1e-9)
    assert layer[0, 1] == pytest.approx(-layer[1, 0], abs=1e-9)
    assert np.abs(layer[2, :2]).max() * f < 1e-9


@pytest.mark.parametrize(
    ("missing", "bar", "pan"),
    [("RGB", 0.05, 0.99), ("N", 0.02, 0.99), ("SU10", 0.01, 0.5), ("SU00", 0.05, 0.5)],
)
def test_a_missing_frame_leaves_an_image_of_what_is_there(
    flown: Flown, missing: str, bar: float, pan: float
) -> None:
    frames = {name: frame for name, frame in flown.emulated.frames.items() if name != missing}
    product = flown.pipeline.process(frames, flown.emulated.conditions)
    errors, inner = flown.emulated.errors_px(product.geometry["free"])
    assert rms(inner) < bar
    assert (product.valid > 0).mean() == pytest.approx(pan, abs=0.06)
    assert Flag.FRAME_MISSING in product.report.flags
    stated = product.report.figures.of(PrecisionFigures).stitched_sigma_px
    assert isinstance(stated, float) and rms(errors) < np.sqrt(2.0) * stated
