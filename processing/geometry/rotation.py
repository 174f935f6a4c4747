"""Rotations in space: from angles, vectors and matrices, and back; only this module converts them.

A rotation is a matrix (..., 3, 3), named `a_from_b`. Angles exist in three orders: omega, phi,
kappa; phi, omega, kappa; roll, pitch, heading. Conversion between orders goes through the matrix.
Unknown rotations are improved by a rotation vector about the camera's own axes, R exp([w]x), which
has no singular attitude; angles are for files and display.

Gimbal lock: where the middle angle is within 1e-7 rad of +-90 degrees, the angle applied first to
the vector (kappa; kappa; roll) is 0. The matrix is then reproduced to 1e-7, elsewhere to rounding.

Source: docs/explanation/mathematics/coordinates.md#rotation-matrix; scipy.spatial.transform.Rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
AngleOrder = Literal["XYZ", "YXZ", "ZYX"]


def rotation_from_angles(axes: str, angles_rad: Sequence[float] | Array) -> Array:
    """Rotation matrices of turns about axes that turn along.

    Args:
        axes: "XYZ" is R = Rx(first) Ry(second) Rz(third).
        angles_rad: shape (..., len(axes)).

    Returns:
        Matrices, shape (..., 3, 3); NaN where an angle is NaN.

    Example:
        >>> rotation_from_angles("Z", [np.pi / 2]).round(3) @ [1.0, 0.0, 0.0]
        array([0., 1., 0.])
    """
    return np.asarray(Rotation.from_euler(axes, angles_rad).as_matrix())


def angles_from_rotation(axes: AngleOrder, rotation: Array) -> Array:
    """Angles, rad, of R = R(axes[0], first) R(axes[1], second) R(axes[2], third).

    Args:
        axes: "XYZ" for omega, phi, kappa; "YXZ" for phi, omega, kappa; "ZYX" for heading, pitch,
            roll.
        rotation: matrices, shape (..., 3, 3).

    Returns:
        Shape (..., 3), the second within +-pi/2; at gimbal lock the third is 0. NaN where the
        matrix is NaN.
    """
    known = Rotation.from_matrix(rotation, assume_valid=True)
    return np.asarray(known.as_euler(axes, suppress_warnings=True))


def rotation_matrix(omega_rad: float, phi_rad: float, kappa_rad: float) -> Array:
    """R = Rx(omega) Ry(phi) Rz(kappa), camera to object, shape (3, 3)."""
    return rotation_from_angles("XYZ", [omega_rad, phi_rad, kappa_rad])


def omega_phi_kappa(rotation: Array) -> Array:
    """Angles (..., 3), rad, of R = Rx(omega) Ry(phi) Rz(kappa); at phi = +-90 deg kappa is 0."""
    return angles_from_rotation("XYZ", rotation)


def phi_omega_kappa(rotation: Array) -> Array:
    """Angles (..., 3), rad, of R = Ry(phi) Rx(omega) Rz(kappa); at omega = +-90 deg kappa is 0."""
    return angles_from_rotation("YXZ", rotation)


def level_from_body(roll_rad: float, pitch_rad: float, heading_rad: float) -> Array:
    """Local level (north, east, down) from body: Rz(heading) Ry(pitch) Rx(roll) (ARINC 705)."""
    return rotation_from_angles("ZYX", [heading_rad, pitch_rad, roll_rad])


def roll_pitch_heading(rotation: Array) -> Array:
    """Angles (..., 3), rad, of Rz(heading) Ry(pitch) Rx(roll); at pitch = +-90 deg roll is 0."""
    return angles_from_rotation("ZYX", rotation)[..., ::-1]


def rotations_from_vectors(vectors: Array) -> Array:
    """Rotation matrices exp([w]x), shape (..., 3, 3), of rotation vectors (..., 3), rad."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def vectors_from_rotations(rotations: Array) -> Array:
    """Rotation vectors, shape (..., 3), rad, at most half a turn, of rotations (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotations, assume_valid=True).as_rotvec())


def skew(vectors: Array) -> Array:
    """Cross product matrices [v]x (n, 3, 3) of vectors (n, 3)."""
    result = np.zeros((len(vectors), 3, 3))
    result[:, 0, 1], result[:, 0, 2] = -vectors[:, 2], vectors[:, 1]
    result[:, 1, 0], result[:, 1, 2] = vectors[:, 2], -vectors[:, 0]
    result[:, 2, 0], result[:, 2, 1] = -vectors[:, 1], vectors[:, 0]
    return result


def angles_by_rotation_vector(axes: AngleOrder, rotations: Array) -> Array:
    """Derivatives of the three angles by a rotation vector about the camera's axes, R exp([w]x).

    At gimbal lock two angles cannot be separated and their elements grow without bound.

    Args:
        axes: as of `angles_from_rotation`.
        rotations: matrices, shape (..., 3, 3).

    Returns:
        d(angles) / d(vector), shape (..., 3, 3), a row for each angle.
    """
    first, second, third = ("XYZ".index(axis) for axis in axes)
    angles = angles_from_rotation(axes, rotations)
    last = rotation_from_angles(axes[2], angles[..., 2:])
    sine, cosine = np.sin(angles[..., 1, None]), np.cos(angles[..., 1, None])
    by_first = last[..., first, :] / cosine
    cyclic = 1.0 if (second - first) % 3 == 1 else -1.0
    by_third = last[..., third, :] - cyclic * sine * by_first
    return np.stack([by_first, last[..., second, :], by_third], axis=-2)
