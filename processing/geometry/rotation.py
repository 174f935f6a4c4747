"""Rotation matrices from angles; only this module fixes the order omega, phi, kappa.

R = Rx(omega) Ry(phi) Rz(kappa), camera to object, radians. Other orders convert through the matrix.

Source: docs/mathematics/coordinates.md#rotation-matrix.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation_matrix(omega_rad: float, phi_rad: float, kappa_rad: float) -> Array:
    """R = Rx(omega) Ry(phi) Rz(kappa), shape (3, 3)."""
    co, so = math.cos(omega_rad), math.sin(omega_rad)
    cp, sp = math.cos(phi_rad), math.sin(phi_rad)
    ck, sk = math.cos(kappa_rad), math.sin(kappa_rad)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, co, -so], [0.0, so, co]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[ck, -sk, 0.0], [sk, ck, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_x @ about_y @ about_z)
