"""The orders of angles, their gimbal locks and derivatives, against formulas written out here."""

from __future__ import annotations

import math
import warnings
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from processing.geometry.rotation import (
    AngleOrder,
    angles_by_rotation_vector,
    angles_from_rotation,
    level_from_body,
    omega_phi_kappa,
    phi_omega_kappa,
    roll_pitch_heading,
    rotation_from_angles,
    rotation_matrix,
    rotations_from_vectors,
    skew,
    vectors_from_rotations,
)

ORDERS: tuple[AngleOrder, ...] = ("XYZ", "YXZ", "ZYX")
ANGLE = st.floats(-math.pi, math.pi)


def about(axis: str, angle_rad: float) -> np.ndarray:
    """A turn about one axis, counter-clockwise seen from its tip."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    k = "XYZ".index(axis)
    i, j = (k + 1) % 3, (k + 2) % 3
    result = np.eye(3)
    result[i, i], result[i, j], result[j, i], result[j, j] = c, -s, s, c
    return result


def written_out(order: AngleOrder, angles: tuple[float, float, float]) -> np.ndarray:
    first, second, third = (about(a, v) for a, v in zip(order, angles, strict=True))
    return first @ second @ third


@given(ANGLE, ANGLE, ANGLE)
def test_every_order_is_the_product_of_three_turns(a: float, b: float, c: float) -> None:
    assert rotation_matrix(a, b, c) == pytest.approx(written_out("XYZ", (a, b, c)), abs=1e-14)
    assert level_from_body(a, b, c) == pytest.approx(written_out("ZYX", (c, b, a)), abs=1e-14)


def test_a_rotation_of_the_camera_by_the_documented_formula() -> None:
    o, p, k = 0.3, -0.7, 1.9
    row = [math.cos(p) * math.cos(k), -math.cos(p) * math.sin(k), math.sin(p)]
    assert rotation_matrix(o, p, k)[0] == pytest.approx(row, abs=1e-15)
    assert rotation_matrix(o, p, k)[1, 2] == pytest.approx(-math.sin(o) * math.cos(p), abs=1e-15)


@given(ANGLE, st.floats(-1.57, 1.57), ANGLE)
def test_angles_come_back_out_of_the_matrix(a: float, b: float, c: float) -> None:
    for order in ORDERS:
        found = angles_from_rotation(order, written_out(order, (a, b, c)))
        off = (found - [a, b, c] + math.pi) % (2 * math.pi) - math.pi
        assert np.abs(off).max() < 1e-9
    names = written_out("XYZ", (a, b, c)), written_out("YXZ", (a, b, c))
    np.testing.assert_array_equal(omega_phi_kappa(names[0]), angles_from_rotation("XYZ", names[0]))
    np.testing.assert_array_equal(phi_omega_kappa(names[1]), angles_from_rotation("YXZ", names[1]))


def test_roll_pitch_heading_is_the_inverse_of_level_from_body() -> None:
    assert roll_pitch_heading(level_from_body(0.1, -0.2, 3.0)) == pytest.approx([0.1, -0.2, 3.0])


@pytest.mark.parametrize(("order", "sign"), list(product(ORDERS, (1.0, -1.0))))
@pytest.mark.parametrize("away_rad", [0.0, 1e-12, 1e-9, 9e-8])
def test_at_gimbal_lock_the_last_angle_is_zero(
    order: AngleOrder, sign: float, away_rad: float
) -> None:
    rotation = written_out(order, (0.3, sign * (math.pi / 2 - away_rad), 0.2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        angles = angles_from_rotation(order, rotation)
    assert angles[2] == 0.0
    assert angles[1] == pytest.approx(sign * (math.pi / 2 - away_rad), abs=1e-12)
    assert np.abs(rotation_from_angles(order, angles) - rotation).max() < 1e-7
    # About the same axis in space, or about the opposite one.
    same_sense = sign if order == "XYZ" else -sign
    assert angles[0] == pytest.approx(0.3 + same_sense * 0.2, abs=1e-6)


@pytest.mark.parametrize(("order", "sign"), list(product(ORDERS, (1.0, -1.0))))
@pytest.mark.parametrize("away_rad", [1.1e-7, 1e-6, 1e-4, 1e-2])
def test_near_gimbal_lock_all_three_angles_come_back(
    order: AngleOrder, sign: float, away_rad: float
) -> None:
    expected = (0.3, sign * (math.pi / 2 - away_rad), 0.2)
    rotation = written_out(order, expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        angles = angles_from_rotation(order, rotation)
    assert np.abs(rotation_from_angles(order, angles) - rotation).max() < 1e-14
    assert angles == pytest.approx(expected, abs=1e-15 / away_rad + 1e-12)


def test_rounding_beyond_one_gives_a_right_angle() -> None:
    for beyond in (1.0 + 1e-12, -1.0 - 1e-12):
        quarter = math.copysign(math.pi / 2, beyond)
        about_y = np.array([[0.0, 0.0, beyond], [0.0, 1.0, 0.0], [-beyond, 0.0, 0.0]])
        assert omega_phi_kappa(about_y) == pytest.approx((0.0, quarter, 0.0))
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -beyond], [0.0, beyond, 0.0]])
        assert phi_omega_kappa(about_x) == pytest.approx((0.0, quarter, 0.0))


def test_many_rotations_at_once_and_none() -> None:
    angles = np.random.default_rng(3).uniform(-1.5, 1.5, (7, 3))
    rotations = rotation_from_angles("XYZ", angles)
    assert rotations.shape == (7, 3, 3)
    assert omega_phi_kappa(rotations) == pytest.approx(angles, abs=1e-12)
    assert omega_phi_kappa(np.empty((0, 3, 3))).shape == (0, 3)
    assert rotations_from_vectors(np.empty((0, 3))).shape == (0, 3, 3)


def test_an_unknown_rotation_has_unknown_angles_and_leaves_the_others() -> None:
    both = np.stack([np.eye(3), np.full((3, 3), np.nan)])
    assert np.isfinite(omega_phi_kappa(both)).tolist() == [[True] * 3, [False] * 3]
    assert np.isnan(rotation_matrix(math.nan, 0.0, 0.0)).any()


@given(st.tuples(ANGLE, ANGLE, ANGLE))
def test_a_rotation_vector_is_axis_and_angle(vector: tuple[float, float, float]) -> None:
    w = np.array(vector)
    angle = float(np.linalg.norm(w))
    rotation = rotations_from_vectors(w)
    assert rotation @ w == pytest.approx(w, abs=1e-12)
    assert np.trace(rotation) == pytest.approx(1 + 2 * math.cos(angle), abs=1e-12)
    if 1e-6 < angle < math.pi - 1e-6:
        # Source: Rodrigues' formula.
        k = skew(w[None])[0] / angle
        by_formula = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k
        assert rotation == pytest.approx(by_formula, abs=1e-12)
    if angle < math.pi - 1e-6:
        assert vectors_from_rotations(rotation) == pytest.approx(w, abs=1e-9)


def test_a_small_rotation_vector_keeps_its_digits() -> None:
    small = np.array([3e-9, -2e-10, 1e-11])
    assert vectors_from_rotations(rotations_from_vectors(small)) == pytest.approx(small, rel=1e-6)


@pytest.mark.parametrize("order", ORDERS)
def test_derivatives_of_the_angles_agree_with_differences(order: AngleOrder) -> None:
    angles = np.random.default_rng(5).uniform(-1.3, 1.3, (20, 3))
    rotations, step = rotation_from_angles(order, angles), 1e-6
    by_vector = angles_by_rotation_vector(order, rotations)
    for axis in range(3):
        small = rotations_from_vectors(np.eye(3)[axis] * step)
        ahead = angles_from_rotation(order, rotations @ small)
        behind = angles_from_rotation(order, rotations @ small.T)
        assert np.abs((ahead - behind) / (2 * step) - by_vector[:, :, axis]).max() < 1e-8
    assert angles_by_rotation_vector(order, rotations[0]) == pytest.approx(by_vector[0])
