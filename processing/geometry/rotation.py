"""Rotations in space: from angles, vectors and matrices, and back; only this module converts them.

A rotation is a matrix (..., 3, 3), named `a_from_b`. Angles exist in three orders: omega, phi,
kappa; phi, omega, kappa; roll, pitch, heading. Conversion between orders goes through the matrix.
Unknown rotations are improved by a rotation vector about the camera's own axes, R exp([w]x), which
has no singular attitude; angles are for files and display.

Gimbal lock: where the middle angle is within 1e-7 rad of +-90 degrees, the angle applied first to
the vector (kappa; kappa; roll) is 0. The matrix is then reproduced to 1e-7, elsewhere to rounding.

Source: docs/explanation/mathematics/coordinates.md#rotation-matrix;
scipy.spatial.transform.Rotation.
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
    """Angles of R = R(axes[0], first) R(axes[1], second) R(axes[2], third).

    Args:
        axes: "XYZ" for omega, phi, kappa; "YXZ" for phi, omega, kappa; "ZYX" for heading, pitch,
            roll.
        rotation: matrices, shape (..., 3, 3).

    Returns:
        Shape (..., 3), rad, the second within +-pi/2; at gimbal lock the third is 0. NaN where the
        matrix is NaN.

    Example:
        >>> angles_from_rotation("ZYX", rotation_from_angles("ZYX", [1.0, 0.2, -0.3])).round(6)
        array([ 1. ,  0.2, -0.3])
    """
    known = Rotation.from_matrix(rotation, assume_valid=True)
    return np.asarray(known.as_euler(axes, suppress_warnings=True))


def rotation_matrix(omega_rad: float, phi_rad: float, kappa_rad: float) -> Array:
    """R = Rx(omega) Ry(phi) Rz(kappa), camera to object.

    Args:
        omega_rad: about x, primary.
        phi_rad: about the turned y.
        kappa_rad: about the camera's z.

    Returns:
        Shape (3, 3).

    Source: docs/explanation/mathematics/coordinates.md#rotation-matrix.

    Example:
        Kappa of 90 degrees: the image's x axis points along object y.

        >>> rotation_matrix(0.0, 0.0, np.pi / 2).round(6) @ [1.0, 0.0, 0.0]
        array([0., 1., 0.])
    """
    return rotation_from_angles("XYZ", [omega_rad, phi_rad, kappa_rad])


def omega_phi_kappa(rotation: Array) -> Array:
    """Angles of R = Rx(omega) Ry(phi) Rz(kappa).

    Args:
        rotation: matrices, shape (..., 3, 3), camera to object.

    Returns:
        (omega, phi, kappa), shape (..., 3), rad; at phi = +-90 deg kappa is 0.

    Example:
        >>> np.degrees(omega_phi_kappa(rotation_matrix(0.0, 0.0, np.pi / 2))).round(6) + 0.0
        array([ 0.,  0., 90.])
    """
    return angles_from_rotation("XYZ", rotation)


def phi_omega_kappa(rotation: Array) -> Array:
    """Angles of R = Ry(phi) Rx(omega) Rz(kappa).

    Args:
        rotation: matrices, shape (..., 3, 3), camera to object.

    Returns:
        (phi, omega, kappa), shape (..., 3), rad; at omega = +-90 deg kappa is 0.

    Example:
        The order of the angles matters where two are not zero: of omega = 0.3, phi = 0.4 the other
        order makes sin(omega) = sin(0.3) cos(0.4) and tan(phi) = tan(0.4) / cos(0.3).

        >>> phi_omega_kappa(rotation_matrix(0.3, 0.4, 0.0)).round(4)
        array([0.4166, 0.2757, 0.1199])
    """
    return angles_from_rotation("YXZ", rotation)


def level_from_body(roll_rad: float, pitch_rad: float, heading_rad: float) -> Array:
    """Local level (north, east, down) from body: Rz(heading) Ry(pitch) Rx(roll) (ARINC 705).

    Args:
        roll_rad: right wing down is positive.
        pitch_rad: nose up is positive.
        heading_rad: clockwise from north.

    Returns:
        Shape (3, 3).

    Example:
        Heading east: the body's forward axis is (north, east, down) = (0, 1, 0).

        >>> level_from_body(0.0, 0.0, np.pi / 2).round(6) @ [1.0, 0.0, 0.0]
        array([0., 1., 0.])
    """
    return rotation_from_angles("ZYX", [heading_rad, pitch_rad, roll_rad])


def roll_pitch_heading(rotation: Array) -> Array:
    """Angles of Rz(heading) Ry(pitch) Rx(roll).

    Args:
        rotation: level_from_body, shape (..., 3, 3).

    Returns:
        (roll, pitch, heading), shape (..., 3), rad; at pitch = +-90 deg roll is 0.

    Example:
        >>> roll_pitch_heading(level_from_body(0.1, -0.2, 1.5)).round(6)
        array([ 0.1, -0.2,  1.5])
    """
    return angles_from_rotation("ZYX", rotation)[..., ::-1]


def rotations_from_vectors(vectors: Array) -> Array:
    """Rotation matrices exp([w]x) of rotation vectors.

    Args:
        vectors: direction is the axis, length the angle, shape (..., 3), rad.

    Returns:
        Shape (..., 3, 3).

    Example:
        >>> rotations_from_vectors(np.array([0.0, 0.0, np.pi / 2])).round(6) @ [1.0, 0.0, 0.0]
        array([0., 1., 0.])
    """
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def vectors_from_rotations(rotations: Array) -> Array:
    """Rotation vectors of rotation matrices, the inverse of `rotations_from_vectors`.

    Args:
        rotations: shape (..., 3, 3).

    Returns:
        Shape (..., 3), rad, at most half a turn long.

    Example:
        >>> vectors_from_rotations(rotation_matrix(0.0, 0.25, 0.0)).round(6)
        array([0.  , 0.25, 0.  ])
    """
    return np.asarray(Rotation.from_matrix(rotations, assume_valid=True).as_rotvec())


def rotations_from_quaternions(wxyz: Sequence[float] | Array) -> Array:
    """Rotation matrices of quaternions, which are normalised.

    Args:
        wxyz: w, x, y, z, shape (..., 4), not all zero.

    Returns:
        Shape (..., 3, 3).

    Raises:
        ValueError: a quaternion is zero.

    Example:
        >>> rotations_from_quaternions([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]).round(6) @ [1, 0, 0]
        array([0., 1., 0.])
    """
    xyzw = np.roll(np.asarray(wxyz, float), -1, axis=-1)
    return np.asarray(Rotation.from_quat(xyzw).as_matrix())


def quaternions_from_rotations(rotations: Array) -> Array:
    """Quaternions w, x, y, z of rotation matrices, with w not negative.

    Args:
        rotations: shape (..., 3, 3).

    Returns:
        Shape (..., 4).

    Example:
        >>> quaternions_from_rotations(rotation_matrix(0.0, 0.0, np.pi)).round(6) + 0.0
        array([0., 0., 0., 1.])
    """
    known = Rotation.from_matrix(rotations, assume_valid=True)
    return np.roll(known.as_quat(canonical=True), 1, axis=-1)


def skew(vectors: Array) -> Array:
    """Cross product matrices [v]x of vectors: [v]x w = v x w.

    Args:
        vectors: shape (n, 3).

    Returns:
        Shape (n, 3, 3).

    Example:
        >>> skew(np.array([[0.0, 0.0, 1.0]]))[0] @ [1.0, 0.0, 0.0]
        array([0., 1., 0.])
    """
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

    Example:
        >>> angles_by_rotation_vector("XYZ", rotation_matrix(0.0, 0.0, np.pi / 2)).round(6) + 0.0
        array([[ 0., -1.,  0.],
               [ 1.,  0.,  0.],
               [ 0.,  0.,  1.]])
    """
    first, second, third = ("XYZ".index(axis) for axis in axes)
    angles = angles_from_rotation(axes, rotations)
    last = rotation_from_angles(axes[2], angles[..., 2:])
    sine, cosine = np.sin(angles[..., 1, None]), np.cos(angles[..., 1, None])
    by_first = last[..., first, :] / cosine
    cyclic = 1.0 if (second - first) % 3 == 1 else -1.0
    by_third = last[..., third, :] - cyclic * sine * by_first
    return np.stack([by_first, last[..., second, :], by_third], axis=-2)
