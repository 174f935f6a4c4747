"""The free mosaic: rank, datum, recovery of a planted truth, honest covariance, degraded input."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from processing.geometry.placement import corrected_mm_from_raw, vip_mm_from_raw
from processing.geometry.similarity import apply_similarity, fit_similarity
from processing.geometry.topology import counts
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN
from processing.mosaic.free_mosaic import Mosaic, free_mosaic, vip_precision_px
from processing.mosaic.model import vip_and_design
from processing.rig import Rig, find_rig
from tests.processing import oracle
from tests.processing.geometry.test_topology import side_by_side_rig
from tests.processing.synthetic import (
    Truth,
    make_truth,
    mosaic_model_of,
    no_tie_points,
    tie_points_of,
)

Array = NDArray[np.float64]
MINI = find_rig("ultracam-x-mini")
PITCH_MM = 7.2e-3


def image_points(truth: Truth, mosaic: Mosaic) -> tuple[Array, Array]:
    """Where PAN pixels fall by the mosaic and in truth, px (n, 2) each."""
    found, true = [], []
    for name, placement in truth.placements.items():
        if placement.cone.role != "pan":
            continue
        w, h = placement.sensor.width_px, placement.sensor.height_px
        columns, rows = np.meshgrid(np.linspace(0, w - 1, 9), np.linspace(0, h - 1, 7))
        raw = np.stack([columns.ravel(), rows.ravel()], axis=1)
        found.append(vip_mm_from_raw(mosaic.placements[name], raw))
        true.append(vip_mm_from_raw(placement, raw))
    return np.concatenate(found) / PITCH_MM, np.concatenate(true) / PITCH_MM


def inner_error_px(truth: Truth, mosaic: Mosaic) -> Array:
    """Lengths of the errors after a best-fit similarity."""
    found, true = image_points(truth, mosaic)
    fitted = apply_similarity(fit_similarity(found, true), found)
    return np.asarray(np.hypot(*(fitted - true).T))


def test_rank_is_52_without_constraints_and_64_with_them() -> None:
    rng = np.random.default_rng(1)
    truth = make_truth(MINI, rng)
    mosaic = free_mosaic(MINI, truth.start, tie_points_of(truth, rng))
    expected = counts(MINI)
    assert len(mosaic.values) == expected.parameters == 64
    assert mosaic.constraints == expected.constraints == 12
    assert (mosaic.rank, mosaic.constrained_rank) == (expected.unknowns, 64) == (52, 64)
    assert mosaic.redundancy == mosaic.observations - 64 + 12
    numbers = mosaic.redundancy_numbers[~mosaic.outliers]
    assert numbers.sum() == pytest.approx(mosaic.redundancy, rel=1e-6)
    assert mosaic.undetermined == ()


def test_two_single_sensor_cones_have_16_unknowns_and_need_no_constraint() -> None:
    rig = side_by_side_rig()
    rng = np.random.default_rng(2)
    truth = make_truth(rig, rng)
    mosaic = free_mosaic(rig, truth.start, tie_points_of(truth, rng))
    assert (mosaic.rank, mosaic.constraints, len(mosaic.values)) == (16, 0, 16)
    assert inner_error_px(truth, mosaic).max() < 0.2


def test_points_and_derivatives_are_those_of_equation_1_and_2() -> None:
    """Points against OpenCV, derivatives against differences of the oracle's points."""
    rng = np.random.default_rng(3)
    truth = make_truth(MINI, rng)
    model, start = truth.model, truth.start["SU10"]
    raw = rng.uniform(0, (1247, 831), (30, 2))
    u = corrected_mm_from_raw(start, raw)

    def by_oracle(values: Array) -> Array:
        first, layer = model.sensors["SU10"], model.layers["1"]
        s, d = start.similarity, values[first : first + 4]
        similarity = (s.x_mm + d[0], s.y_mm + d[1], s.rotation_rad + d[2], s.scale * (1.0 + d[3]))
        correction = np.append(values[layer : layer + 8], 0.0).reshape(3, 3) + np.eye(3)
        size = np.diag([model.half_size_mm, model.half_size_mm, 1.0])
        p = size @ correction @ np.linalg.inv(size) @ start.layer
        return oracle.placed(p, similarity, u) / PITCH_MM

    points, columns, design = vip_and_design(model, start, u, truth.values)
    np.testing.assert_allclose(points, by_oracle(truth.values), atol=1e-9)
    np.testing.assert_allclose(
        points, vip_mm_from_raw(truth.placements["SU10"], raw) / PITCH_MM, atol=1e-9
    )
    for k, column in enumerate(columns):
        step = np.zeros(len(truth.values))
        step[column] = model.units[column]
        slope = (by_oracle(truth.values + step) - by_oracle(truth.values - step)) / 2.0
        np.testing.assert_allclose(
            design[k].T * model.units[column], slope, atol=1e-6, err_msg=model.names[column]
        )


def test_exact_tie_points_give_the_planted_geometry_back() -> None:
    rng = np.random.default_rng(4)
    truth = make_truth(MINI, rng, sensor_px=2.0, layer_px=4.0)
    points = tie_points_of(truth, rng, sigma_pp_px=1e-6, sigma_pc_px=1e-6)
    mosaic = free_mosaic(MINI, truth.start, points)
    assert inner_error_px(truth, mosaic).max() < 1e-4
    assert np.abs(mosaic.residuals_px).max() < 1e-4


def test_the_datum_holds_for_accumulated_corrections() -> None:
    rng = np.random.default_rng(5)
    truth = make_truth(MINI, rng, sensor_px=2.0)
    mosaic = free_mosaic(MINI, truth.start, tie_points_of(truth, rng))
    names = ["SU00", "SU01", "SU02", "SU03"]
    x = np.array([truth.start[n].similarity.x_mm for n in names])
    y = np.array([truth.start[n].similarity.y_mm for n in names])
    x, y = x - x.mean(), y - y.mean()
    dx = np.array([mosaic.value(f"{n}.x") for n in names])
    dy = np.array([mosaic.value(f"{n}.y") for n in names])
    assert np.abs(dx).max() > 1e-3
    assert abs(dx.sum()) < 1e-12
    assert abs(dy.sum()) < 1e-12
    assert abs((x * dx + y * dy).sum()) < 1e-11
    assert abs((-y * dx + x * dy).sum()) < 1e-11
    for a, b in (("SU10", "SU11"), ("SU20", "SU21")):
        for what in ("x", "y", "rotation", "scale"):
            assert abs(mosaic.value(f"{a}.{what}") + mosaic.value(f"{b}.{what}")) < 1e-12


def test_the_datum_leaves_the_smallest_sum_of_squares_at_the_master_sensors() -> None:
    """No shift, scale or turn of the image brings them nearer to their calibration.

    Source: Ladstädter et al. (2010), eq. 6.
    """
    rng = np.random.default_rng(5)
    truth = make_truth(MINI, rng, sensor_px=2.0)
    points = tie_points_of(truth, rng)
    names = ["SU00", "SU01", "SU02", "SU03"]
    placed = [truth.start[n].similarity for n in names]
    calibrated = np.array([[place.x_mm, place.y_mm] for place in placed])

    def found(mosaic: Mosaic) -> Array:
        moved = [[mosaic.value(f"{n}.x"), mosaic.value(f"{n}.y")] for n in names]
        return np.asarray(calibrated + np.array(moved))

    def squares(places: Array) -> float:
        return float(np.sum((places - calibrated) ** 2))

    ours = found(free_mosaic(MINI, truth.start, points))
    nearest = apply_similarity(fit_similarity(ours, calibrated), ours)
    assert squares(ours) == pytest.approx(squares(nearest), rel=1e-4)
    other = found(free_mosaic(MINI, truth.start, points, excluded_datum_sensors=("SU02",)))
    assert squares(other) > 1.1 * squares(ours)


def test_the_choice_of_the_datum_does_not_touch_the_inner_geometry() -> None:
    """To second order in the noise: a smaller mosaic has smaller residuals (0.003 px at 0.1 px)."""
    rng = np.random.default_rng(6)
    truth = make_truth(MINI, rng)
    points = tie_points_of(truth, rng, sigma_pp_px=0.01, sigma_pc_px=0.03)
    one = free_mosaic(MINI, truth.start, points)
    other = free_mosaic(MINI, truth.start, points, excluded_datum_sensors=("SU02",))
    assert other.datum_sensors == ("SU00", "SU01", "SU03")
    first, second = image_points(truth, one)[0], image_points(truth, other)[0]
    assert np.abs(first - second).max() > 0.1
    fitted = apply_similarity(fit_similarity(second, first), second)
    assert np.abs(fitted - first).max() < 1e-4
    assert one.sigma0 == pytest.approx(other.sigma0, rel=1e-3)
    np.testing.assert_allclose(one.redundancy_numbers, other.redundancy_numbers, atol=1e-5)


def test_errors_are_as_large_as_the_covariance_states() -> None:
    """Pooled e' Sigma^-1 e lies in its 99.9 % interval; 99 % of errors are inside 3 sigma."""
    total, degrees, within = 0.0, 0, []
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        truth = make_truth(MINI, rng)
        noisy = tie_points_of(truth, rng, per_overlap=60, per_sensor=150)
        exact = tie_points_of(
            truth, rng, per_overlap=60, per_sensor=150, sigma_pp_px=1e-7, sigma_pc_px=1e-7
        )
        # Exact points carry the truth into the same datum.
        mosaic, reference = (free_mosaic(MINI, truth.start, p) for p in (noisy, exact))
        units = mosaic.model.units
        error = (mosaic.values - reference.values) / units
        covariance = mosaic.covariance / np.outer(units, units)
        eigenvalues, directions = np.linalg.eigh(covariance)
        good = eigenvalues > 1e-9 * eigenvalues[-1]
        assert good.sum() == 52
        total += float(np.sum((directions[:, good].T @ error) ** 2 / eigenvalues[good]))
        degrees += 52
        within.append(np.abs(error) / np.sqrt(np.diag(covariance)))
    low, high = (float(chi2.ppf(p, degrees)) for p in (0.0005, 0.9995))
    assert low < total < high
    assert np.mean(np.concatenate(within) < 3.0) > 0.99
    assert np.concatenate(within).max() < 5.0


def test_variance_components_find_what_each_class_of_points_is_worth() -> None:
    rng = np.random.default_rng(7)
    truth = make_truth(MINI, rng)
    points = tie_points_of(truth, rng, sigma_pp_px=0.05, sigma_pc_px=0.6)
    mosaic = free_mosaic(MINI, truth.start, points)
    # Redundancy 10,000: the sigmas are known to two percent at worst.
    assert mosaic.sigma_pp_px == pytest.approx(0.05, rel=0.06)
    assert mosaic.sigma_pc_px == pytest.approx(0.6, rel=0.06)
    assert mosaic.sigma0 == pytest.approx(0.5, rel=0.06)
    assert mosaic.sigma0_px == pytest.approx(0.05, rel=0.06)
    assert mosaic.sigma0_um == pytest.approx(7.2 * mosaic.sigma0_px)


def test_outliers_are_found_and_do_not_move_the_result() -> None:
    rng = np.random.default_rng(8)
    truth = make_truth(MINI, rng)
    clean = tie_points_of(truth, rng)
    bad = rng.choice(len(clean), len(clean) // 20, replace=False)
    raw_a = clean.raw_a.copy()
    angle = rng.uniform(0, 2 * np.pi, len(bad))
    length = rng.uniform(2.5, 8.0, len(bad))
    raw_a[bad] += np.stack([length * np.cos(angle), length * np.sin(angle)], axis=1)
    with_blunders = dataclasses.replace(clean, raw_a=raw_a)
    mosaic = free_mosaic(MINI, truth.start, with_blunders)
    flagged = np.flatnonzero(mosaic.outliers)
    assert set(bad) <= set(flagged)
    assert len(flagged) < len(bad) + 0.002 * len(clean)
    assert mosaic.sigma0 == pytest.approx(1.0, abs=0.05)
    found = image_points(truth, mosaic)[0]
    undisturbed = image_points(truth, free_mosaic(MINI, truth.start, clean))[0]
    assert np.abs(found - undisturbed).max() < 0.05


def test_three_to_four_iterations_are_enough() -> None:
    rng = np.random.default_rng(9)
    truth = make_truth(MINI, rng, sensor_px=2.0, layer_px=5.0)
    mosaic = free_mosaic(MINI, truth.start, tie_points_of(truth, rng))
    assert 3 <= mosaic.iterations <= 5


def test_points_of_the_colour_master_make_the_mosaic_several_times_more_precise() -> None:
    rng = np.random.default_rng(10)
    truth = make_truth(MINI, rng)
    points = tie_points_of(truth, rng)
    pan_points = tie_points_of(truth, rng, without_kind=PAN_TO_COLOUR)
    with_green = free_mosaic(MINI, truth.start, points)
    without = free_mosaic(MINI, truth.start, pan_points)
    assert without.rank == 44
    assert set(without.undetermined) == {n for n in without.parameter_names if n[:2] == "G."}
    rms = [float(np.sqrt(np.mean(inner_error_px(truth, m) ** 2))) for m in (with_green, without)]
    assert rms[0] < 0.06
    assert rms[1] > 2.0 * rms[0]


def test_points_where_four_sensors_meet_count_three_quarters() -> None:
    rng = np.random.default_rng(11)
    truth = make_truth(MINI, rng, sensor_px=0.0, layer_px=0.0)
    points = tie_points_of(truth, rng)
    mosaic = free_mosaic(MINI, truth.start, points)
    strip = (points.overlap == 0) & ~mosaic.outliers
    row = points.raw_a[:, 1]
    # SU00 and SU10: the lower end of the strip is the corner with SU20 and SU30.
    at_corner = strip & (row > 720)
    on_strip = strip & (row < 400) & (row > 100)
    uncertainty = 1.0 - mosaic.redundancy_numbers.mean(axis=1)
    assert at_corner.sum() > 5
    assert uncertainty[at_corner].mean() < uncertainty[on_strip].mean() * 1.6


@pytest.mark.parametrize("missing", ["SU01", "SU10", "SU30", "G"])
def test_a_missing_frame_leaves_its_unknowns_at_their_start_and_names_them(missing: str) -> None:
    rng = np.random.default_rng(12)
    truth = make_truth(MINI, rng)
    points = tie_points_of(truth, rng, without=(missing,))
    mosaic = free_mosaic(MINI, truth.start, points)
    cone = MINI.cone_of(missing)
    owner = missing if len(cone.sensors) > 1 else cone.name
    assert {name.split(".")[0] for name in mosaic.undetermined} == {owner}
    for name in mosaic.undetermined:
        assert mosaic.value(name) == pytest.approx(0.0, abs=1e-9)
    assert missing not in mosaic.datum_sensors
    reduced_truth = dataclasses.replace(
        truth,
        placements={n: p for n, p in truth.placements.items() if n != missing},
    )
    assert np.sqrt(np.mean(inner_error_px(reduced_truth, mosaic) ** 2)) < (
        0.3 if missing == "G" else 0.1
    )


def test_no_points_at_all_leave_everything_at_its_start() -> None:
    start = make_truth(MINI, np.random.default_rng(13)).start
    mosaic = free_mosaic(MINI, start, no_tie_points(MINI))
    assert set(mosaic.undetermined) == set(mosaic.parameter_names)
    assert not mosaic.values.any()
    assert mosaic.placements["SU00"].similarity == start["SU00"].similarity
    assert mosaic.observations == 0


@pytest.mark.parametrize("per_overlap", [1, 2, 5])
def test_a_handful_of_points_never_raises_and_never_runs_away(per_overlap: int) -> None:
    rng = np.random.default_rng(14)
    truth = make_truth(MINI, rng, layer_px=1.0)
    points = tie_points_of(truth, rng, per_overlap=per_overlap, without_kind=PAN_TO_COLOUR)
    mosaic = free_mosaic(MINI, truth.start, points)
    assert mosaic.undetermined
    assert inner_error_px(truth, mosaic).max() < 40.0
    assert np.isfinite(mosaic.covariance).all()


def test_an_empty_overlap_is_bridged_by_the_colour_master() -> None:
    rng = np.random.default_rng(15)
    truth = make_truth(MINI, rng)
    points = tie_points_of(truth, rng, without_kind=PAN_TO_PAN)
    mosaic = free_mosaic(MINI, truth.start, points)
    assert mosaic.undetermined == ()
    assert mosaic.used[("SU00", "SU10")] == 0
    assert np.sqrt(np.mean(inner_error_px(truth, mosaic) ** 2)) < 0.3


def test_the_stated_precision_in_the_image_is_the_true_one() -> None:
    """Pooled over 15 mosaics: normalised errors of image points in the mosaic's own datum."""
    normalised = []
    for seed in range(15):
        rng = np.random.default_rng(300 + seed)
        truth = make_truth(MINI, rng)
        noisy = free_mosaic(MINI, truth.start, tie_points_of(truth, rng))
        exact = free_mosaic(
            MINI, truth.start, tie_points_of(truth, rng, sigma_pp_px=1e-7, sigma_pc_px=1e-7)
        )
        for name in ("SU00", "SU11", "SU30"):
            raw = np.array([[10.0, 10.0], [600.0, 400.0], [1200.0, 800.0]])
            error = vip_mm_from_raw(noisy.placements[name], raw) - vip_mm_from_raw(
                exact.placements[name], raw
            )
            normalised.append(error / PITCH_MM / vip_precision_px(noisy, name, raw))
    assert np.sqrt(np.mean(np.concatenate(normalised) ** 2)) == pytest.approx(1.0, abs=0.2)


def test_27000_points_are_adjusted_in_half_a_second() -> None:
    """In processor seconds on one core, the best of three."""
    rig: Rig = find_rig("ultracam-x")
    rng = np.random.default_rng(16)
    truth = make_truth(rig, rng)
    points = tie_points_of(truth, rng, per_overlap=850, per_sensor=1900)
    assert len(points) > 27_000
    used = []
    for _ in range(3):
        begin = time.thread_time()
        mosaic = free_mosaic(rig, truth.start, points)
        used.append(time.thread_time() - begin)
    assert min(used) < 0.5
    assert np.sqrt(np.mean(inner_error_px(truth, mosaic) ** 2)) < 0.03
    assert mosaic_model_of(rig).names == mosaic.parameter_names
