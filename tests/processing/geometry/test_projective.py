"""Homographies against homogeneous vectors, numeric derivatives and turned rays."""

from __future__ import annotations

import numpy as np
import pytest

from processing.geometry.projective import (
    apply_projective,
    chained_jacobian,
    projective_jacobian,
    rotation_homography,
)
from processing.geometry.rotation import rotation_matrix

# No two elements alike, no zero, no one: every one of them matters.
H = np.array([[1.3, 0.2, 0.7], [-0.15, 0.9, -0.4], [0.03, -0.02, 1.7]])
POINTS = np.array([[2.0, -3.0], [-5.0, 4.0], [7.0, 1.5]])


def test_points_go_as_homogeneous_vectors_do() -> None:
    homogeneous = np.column_stack([POINTS, np.ones(3)]) @ H.T
    expected = homogeneous[:, :2] / homogeneous[:, 2:]
    np.testing.assert_allclose(apply_projective(H, POINTS), expected, rtol=1e-14)


def test_the_jacobian_agrees_with_numeric_differences() -> None:
    step = 1e-6
    numeric = np.empty((3, 2, 2))
    for axis in range(2):
        off = np.eye(2)[axis] * step
        ahead, behind = apply_projective(H, POINTS + off), apply_projective(H, POINTS - off)
        numeric[:, :, axis] = (ahead - behind) / (2.0 * step)
    np.testing.assert_allclose(projective_jacobian(H, POINTS), numeric, rtol=1e-7)


def test_the_jacobian_of_two_homographies_is_the_chained_one() -> None:
    second = np.array([[0.8, -0.3, 0.1], [0.25, 1.1, 0.6], [-0.01, 0.04, 1.2]])
    chained = chained_jacobian(
        projective_jacobian(second, apply_projective(H, POINTS)), projective_jacobian(H, POINTS)
    )
    np.testing.assert_allclose(chained, projective_jacobian(second @ H, POINTS), rtol=1e-13)


def test_a_rotation_homography_meets_what_the_rotated_ray_meets() -> None:
    rotation = rotation_matrix(0.11, -0.07, 0.2)
    f_cone_mm, f_master_mm = 80.0, 105.0
    homography = rotation_homography(rotation, f_cone_mm, f_master_mm)
    rays = np.column_stack([POINTS, np.full(3, -f_cone_mm)]) @ rotation.T
    expected = rays[:, :2] / -rays[:, 2:] * f_master_mm
    np.testing.assert_allclose(apply_projective(homography, POINTS), expected, rtol=1e-12)
    assert homography[2, 2] == pytest.approx(1.0, abs=1e-15)
