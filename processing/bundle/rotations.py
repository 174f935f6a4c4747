"""Many rotations at once: from small rotation vectors, to omega, phi, kappa and their covariance.

Unknown rotations are improved by a rotation vector about the camera's own axes, R exp([d]x), which
has no singular attitude; angles are for display. The order of angles is that of
`processing.geometry.rotation`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL = 1e-8


def skew(vectors: Array) -> Array:
    """Cross product matrices [v]x (n, 3, 3) of vectors (n, 3)."""
    result = np.zeros((len(vectors), 3, 3))
    result[:, 0, 1], result[:, 0, 2] = -vectors[:, 2], vectors[:, 1]
    result[:, 1, 0], result[:, 1, 2] = vectors[:, 2], -vectors[:, 0]
    result[:, 2, 0], result[:, 2, 1] = -vectors[:, 1], vectors[:, 0]
    return result


def rotations_from_vectors(vectors: Array) -> Array:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3), rad (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)
    safe = np.where(angle < _SMALL, 1.0, angle)
    first = np.where(angle < _SMALL, 1.0, np.sin(safe) / safe)
    second = np.where(angle < _SMALL, 0.5, (1.0 - np.cos(safe)) / safe**2)
    k = skew(vectors)
    return np.asarray(
        np.eye(3)
        + first[:, None, None] * k
        + second[:, None, None] * np.einsum("nij,njk->nik", k, k)
    )


def vectors_from_rotations(rotations: Array) -> Array:
    """Rotation vectors (n, 3), rad, of rotations (n, 3, 3) below half a turn."""
    vector = 0.5 * np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        axis=1,
    )
    sine = np.linalg.norm(vector, axis=1)
    angle = np.arctan2(sine, (np.trace(rotations, axis1=1, axis2=2) - 1.0) / 2.0)
    safe = np.where(sine < _SMALL, 1.0, sine)
    return np.asarray(vector * np.where(sine < _SMALL, 1.0, angle / safe)[:, None])


def omega_phi_kappa(rotations: Array) -> Array:
    """Angles (n, 3), rad, of R = Rx(omega) Ry(phi) Rz(kappa)."""
    r = rotations
    return np.stack(
        [
            np.arctan2(-r[:, 1, 2], r[:, 2, 2]),
            np.arcsin(np.clip(r[:, 0, 2], -1.0, 1.0)),
            np.arctan2(-r[:, 0, 1], r[:, 0, 0]),
        ],
        axis=1,
    )


def angles_by_rotation_vector(rotations: Array) -> Array:
    """d(omega, phi, kappa) / d(rotation vector about the camera's axes), (n, 3, 3).

    At phi = +-90 degrees omega and kappa cannot be separated and the elements grow without bound.
    """
    angles = omega_phi_kappa(rotations)
    sp, cp = np.sin(angles[:, 1]), np.cos(angles[:, 1])
    sk, ck = np.sin(angles[:, 2]), np.cos(angles[:, 2])
    result = np.zeros((len(rotations), 3, 3))
    result[:, 0, 0], result[:, 0, 1] = ck / cp, -sk / cp
    result[:, 1, 0], result[:, 1, 1] = sk, ck
    result[:, 2, 0], result[:, 2, 1] = -ck * sp / cp, sk * sp / cp
    result[:, 2, 2] = 1.0
    return result
