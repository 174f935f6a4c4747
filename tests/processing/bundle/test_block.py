"""A small block of the emulator's: accuracy against truth, and a pattern only one set can model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.aerial_block import AdjustedBlock, evaluate, network_of
from processing.bundle.adjust import adjust
from processing.bundle.adjustment_results import parameters_of
from processing.bundle.network import CameraModel
from processing.bundle.self_calibration import (
    SETS,
    parameter_count,
    parts_of,
    with_self_calibration,
)
from processing.bundle.terms import part_of
from processing.rig import Rig, find_rig
from sim_hw.blocks.aerial import (
    AerialBlock,
    ImageFormat,
    MeasurementErrors,
    ccd_pattern,
    image_grid,
    residuals_after_orientation,
    simulate_block,
    small_plan,
)
from tests.processing.bundle.simulated_networks import aerial


@pytest.fixture(scope="module")
def block() -> AerialBlock:
    return simulate_block(small_plan(), seed=1)


@pytest.fixture(scope="module")
def full(block) -> AdjustedBlock:
    return evaluate(block, "sensors-full")


@pytest.mark.parametrize(
    ("rig_name", "counts"),
    [("ultracam-x", (0, 2, 23, 61)), ("ultracam-d", (0, 2, 23, 61)), ("ultracam-l", (0, 2, 9, 15))],
)
def test_the_sets_have_the_parameters_of_the_topology(rig_name, counts) -> None:
    rig = find_rig(rig_name)
    sensors = sum(len(cone.sensors) for cone in rig.pan_cones)
    cones = len(rig.pan_cones)
    camera = CameraModel("stitched", rig.virtual_image.f_mm)
    found = tuple(
        parameter_count(
            with_self_calibration(
                camera, name, parts_of(rig), master_cone=rig.master_cone, interior=True
            )
        )
        for name in SETS
    )
    assert found == counts
    assert found[2] == 7 + 2 * (sensors - 1)
    assert found[3] == 7 + 6 * (sensors - 1) + 2 * (cones - 1)


def test_every_image_point_belongs_to_the_ccd_that_recorded_it() -> None:
    rig = find_rig("ultracam-x")
    parts = parts_of(rig)
    for index, part in enumerate(parts):
        assert list(part_of(parts, np.array([part.centre_mm]))) == [index]
    image = rig.virtual_image
    half = np.array([image.width_px, image.height_px]) * image.pitch_mm / 2.0
    everywhere = np.random.default_rng(1).uniform(-half, half, (5000, 2))
    share = np.bincount(part_of(parts, everywhere), minlength=9) / 5000
    assert share.min() > 0.08, "nine CCDs of about a ninth each"


def test_without_a_pattern_sigma0_is_the_noise_and_no_parameter_is_needed() -> None:
    plan = replace(small_plan(), errors=MeasurementErrors(pattern_mm=0.0))
    found = evaluate(simulate_block(plan, seed=2), "none")
    assert found.figures["sigma0"] == pytest.approx(1.0, abs=0.03)
    low, high = found.figures["check_squares_bounds"]
    assert low < found.figures["check_squares"] < high


def test_the_set_that_can_model_the_pattern_leaves_none_of_it(full) -> None:
    assert full.figures["sigma0"] == pytest.approx(1.0, abs=0.05)
    assert full.figures["left_rms_um"] < 0.3
    significant = {p.name for p in parameters_of(full.result) if p.t > 4.0}
    assert "perspective-y cone 1" in significant
    assert {"shear SU10", "affinity SU10"} & significant


def test_the_pattern_shows_without_that_set(block, full) -> None:
    radial = evaluate(block, "radial")
    assert radial.figures["sigma0"] > 1.05
    assert radial.figures["left_max_um"] > 1.5
    assert radial.figures["residual_pattern_max_um"] > 2.0 * full.figures["residual_pattern_max_um"]
    assert radial.result.redundancy > full.result.redundancy


def test_check_points_err_as_predicted(full) -> None:
    low, high = full.figures["check_squares_bounds"]
    assert full.figures["checks"] == 20
    assert low < full.figures["check_squares"] < high
    assert full.figures["check_plan_px"] < 0.3
    assert full.figures["check_rms_px"][2] < 0.36
    predicted = np.array(full.checks.predicted_m)
    assert (np.array(full.checks.rms_m) / predicted < 1.5).all()


def test_gnss_shifts_and_drifts_of_every_strip_are_found(block, full) -> None:
    network = network_of(block, "sensors-full")
    result = full.result
    truth = block.true_station + block.true_rotation @ np.array(block.plan.lever_m)
    spread = result.sigma0 * np.sqrt(np.diag(result.cofactor))
    for line in range(len(network.gnss.lines)):
        rows = block.strip == line
        mean = (block.antenna_m[rows] - truth[rows]).mean(axis=0)
        own = spread[result.layout.shift[line]]
        assert (np.abs(result.state.shift[line] - mean) < 4.0 * own).all()


def test_the_planted_pattern_has_the_size_it_is_stated_to_have(block) -> None:
    frame = block.plan.frame
    places = image_grid(frame, 24, 25)
    left = residuals_after_orientation(frame, places, block.pattern.at(places))
    assert np.hypot(*left.T).max() == pytest.approx(2e-3, rel=0.01)


def image_of(rig: Rig) -> ImageFormat:
    """The stitched image of a rig."""
    image = rig.virtual_image
    assert image is not None
    half = image.pitch_mm / 2.0
    return ImageFormat(image.width_px * half, image.height_px * half, image.f_mm, image.pitch_mm)


def test_nine_ccds_off_on_their_own_are_found_by_58_parameters_and_not_by_two() -> None:
    rig = find_rig("ultracam-x")
    plan = small_plan(image_of(rig), "ultracam-x")
    block = simulate_block(plan, 3, ccd_pattern(rig, 3, 2e-3))
    full, radial = evaluate(block, "sensors-full"), evaluate(block, "radial")
    assert full.figures["parameters"] == 58, "61 less the interior orientation"
    assert full.figures["sigma0"] == pytest.approx(1.0, abs=0.05)
    assert radial.figures["sigma0"] > 1.5
    assert radial.figures["left_rms_um"] > 1.0
    assert full.figures["left_rms_um"] < 0.45 < radial.figures["left_rms_um"]
    camera, state = full.result.network.cameras[0], full.result.state
    for gauge in camera.gauges:
        own = [v for t, v in zip(camera.terms, state.terms[0], strict=True) if t.name in gauge]
        assert len(own) == 4
        assert abs(sum(own)) < 1e-12, "the master cone's CCDs carry the datum"


def _sigma_of_f(heights: tuple[float, ...], gnss_sigma_m: float | None) -> float:
    """Of the principal distance, with one shift of all GNSS positions unknown."""
    camera = CameraModel("c", 70.0, free=frozenset({"dx0", "dy0", "df"}))
    simulated = aerial(
        cameras=(camera,), sigma_mm=1e-3, heights=heights, gnss_sigma_m=gnss_sigma_m, lines=3,
        along=5, points=90, relief_m=20.0,
    )  # fmt: skip
    network = simulated.network
    if gnss_sigma_m is not None:
        gnss = network.gnss
        gnss = replace(gnss, line=np.zeros_like(gnss.line), lines=("all",), drift="shift")
        network = replace(network, gnss=gnss)
    return next(p.sigma for p in parameters_of(adjust(network)) if p.name == "df")


def test_interior_orientation_takes_gnss_and_two_heights() -> None:
    both = _sigma_of_f((1000.0, 1500.0, 1000.0), 0.03)
    one_height = _sigma_of_f((1000.0,), 0.03)
    two_heights_alone = _sigma_of_f((1000.0, 1500.0, 1000.0), None)
    assert both < 0.005
    assert one_height > 4.0 * both
    assert two_heights_alone > 4.0 * both
