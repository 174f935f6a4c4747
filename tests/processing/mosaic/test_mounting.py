"""Turns of converging heads: shifts of residuals and covariances made by hand."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import vip_mm_from_raw
from processing.geometry.rotation import rotation_matrix
from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic.estimated_dc import EstimatedDc, combined_dc
from processing.mosaic.free_mosaic import Mosaic, free_mosaic
from processing.mosaic.mounting import (
    _affine_shift,
    _middle_mm,
    check_platform,
    place_covariance,
    verified_mosaic,
)
from processing.rig import find_rig
from tests.processing.mosaic.test_precision import uneven
from tests.processing.synthetic import make_truth, tie_points_of

Array = NDArray[np.float64]
DMC = uneven(find_rig("dmc-mini"))
X_MINI = uneven(find_rig("ultracam-x-mini"))


@functools.cache
def adjusted() -> tuple[Mosaic, TiePoints]:
    rng = np.random.default_rng(3)
    truth = make_truth(DMC, rng, sensor_px=0.1, layer_px=0.5)
    points = tie_points_of(truth, rng, per_overlap=60, per_sensor=60)
    points.sigma_px[::3] *= 0.5
    return free_mosaic(DMC, truth.start, points), points


@pytest.mark.parametrize("dc_k", [0.0, 7.0])
def test_a_head_with_one_sensor_seems_rotated_by_its_place(dc_k: float) -> None:
    cone = DMC.cone("2")
    (sensor,) = cone.sensors
    found = place_covariance(cone, {sensor.name: dc_k})
    place_mm = np.hypot(sensor.position_sigma_um, sensor.drift.sigma_um_per_k * dc_k) * 1e-3
    rotation = rotation_matrix(*cone.rotation_rad)
    across = (place_mm / cone.lens.f_mm) ** 2
    expected = rotation @ np.diag([across, across, 0.0]) @ rotation.T
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=across * 1e-9)


@pytest.mark.parametrize(("sensors", "is_datum"), [(2, True), (3, True), (4, True), (4, False)])
def test_a_cone_of_several_seems_rotated_by_the_mean_of_their_places(
    sensors: int, is_datum: bool
) -> None:
    cone = X_MINI.cone("0")
    cone = dataclasses.replace(cone, sensors=cone.sensors[:sensors], rotation_rad=(0.0, 0.0, 0.0))
    found = place_covariance(cone, {}, is_datum=is_datum)
    sigma_mm = np.repeat([s.position_sigma_um * 1e-3 for s in cone.sensors], 2)
    place = np.array([[s.x_mm, s.y_mm] for s in cone.sensors])
    x, y = (place - place.mean(axis=0)).T
    # Rotation and shift by least squares of displaced places.
    rows = [np.column_stack([-y, np.ones(sensors), np.zeros(sensors)])]
    rows += [np.column_stack([x, np.zeros(sensors), np.ones(sensors)])]
    fit = np.linalg.pinv(np.stack(rows, axis=1).reshape(-1, 3))
    rotation_variance, across, _ = np.sum((fit * sigma_mm) ** 2, axis=1)
    about_z = rotation_variance if is_datum and sensors > 2 else 0.0
    across /= cone.lens.f_mm**2
    np.testing.assert_allclose(found, np.diag([across, across, about_z]), rtol=1e-9, atol=1e-20)


def test_the_shift_of_a_head_is_that_of_its_residuals_at_its_middle() -> None:
    mosaic, points = adjusted()
    name, number = "2", points.names.index("P2")
    rng = np.random.default_rng(4)
    at, sign = np.zeros((len(points), 2)), np.zeros(len(points))
    for side, raw, s in ((points.sensor_a, points.raw_a, -1.0), (points.sensor_b, points.raw_b, 1)):
        rows = side == number
        at[rows] = vip_mm_from_raw(mosaic.placements["P2"], raw[rows]) / mosaic.model.pitch_mm
        sign[rows] = s
    arm = at - _middle_mm(DMC, mosaic, name)[0] / mosaic.model.pitch_mm
    linear = np.array([[2e-4, -1e-4], [3e-4, 5e-5]])
    moved = [0.7, -0.4] + arm @ linear.T + 0.05 * rng.standard_normal((len(points), 2))
    with_shift = dataclasses.replace(mosaic, residuals_px=sign[:, None] * moved)
    shift, sigma, affine, count = _affine_shift(DMC, with_shift, points, name)
    rows = (sign != 0.0) & (points.kind == PAN_TO_PAN) & ~mosaic.outliers
    assert count == int(rows.sum())
    weight = 1.0 / points.sigma_px[rows] ** 2
    design = np.column_stack([np.ones(count), arm[rows]])
    cofactor = np.linalg.inv(design.T @ (design * weight[:, None]))
    fit = cofactor @ (design.T * weight) @ moved[rows]
    left = np.sum(weight[:, None] * (moved[rows] - design @ fit) ** 2, axis=0) / (count - 3)
    np.testing.assert_allclose(shift, fit[0], rtol=1e-6)
    np.testing.assert_allclose(affine, fit[1:].T, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(sigma, np.sqrt(left * cofactor[0, 0]), rtol=1e-6)


def test_heads_without_a_significant_shift_stay_where_the_adjustment_put_them() -> None:
    mosaic, points = adjusted()
    verified = verified_mosaic(DMC, mosaic, points)
    np.testing.assert_array_equal(verified.values, mosaic.values)


@pytest.mark.parametrize(("sigmas", "moved"), [(4.5, False), (9.0, True)])
def test_only_a_shift_far_beyond_its_sigma_turns_heads(sigmas: float, moved: bool) -> None:
    mosaic, points = adjusted()
    name, number = "2", points.names.index("P2")
    shift, sigma, _, _ = _affine_shift(DMC, mosaic, points, name)
    sign = (points.sensor_b == number) * 1.0 - (points.sensor_a == number) * 1.0
    wanted = np.array([sigmas, 0.0]) * sigma - shift
    residuals = mosaic.residuals_px + sign[:, None] * wanted
    shifted = dataclasses.replace(mosaic, residuals_px=residuals)
    verified = verified_mosaic(DMC, shifted, points)
    assert bool(np.any(verified.values != mosaic.values)) is moved


def test_heads_that_tie_points_leave_open_are_not_compared() -> None:
    mosaic, points = adjusted()
    every = check_platform(DMC, mosaic, points, {})
    assert every is not None and [head.cone for head in every.heads] == ["1", "2", "3", "4"]
    assert every.degrees_of_freedom == 9
    some = dataclasses.replace(mosaic, undetermined=("2.omega", "3.kappa"))
    check = check_platform(DMC, some, points, {})
    assert check is not None and [head.cone for head in check.heads] == ["1", "4"]
    assert check.degrees_of_freedom == 3
    one = dataclasses.replace(mosaic, undetermined=("1.phi", "2.omega", "3.kappa"))
    assert check_platform(DMC, one, points, {}) is None
    assert check_platform(DMC, dataclasses.replace(mosaic, redundancy=0.0), points, {}) is None


def test_estimates_of_cones_are_weighed_by_their_variances() -> None:
    def estimate(cone: str, k: float | None, sigma: float | None) -> EstimatedDc:
        return EstimatedDc(cone, k, sigma, None, 10.0, 3.0, False)

    found = combined_dc(
        [estimate("0", 1.0, 0.5), estimate("1", 3.0, 1.0), estimate("2", None, 1.0)]
    )
    assert found == pytest.approx((7.0 / 5.0, 5.0**-0.5))
    assert combined_dc([estimate("0", None, None), estimate("1", 2.0, None)]) is None
