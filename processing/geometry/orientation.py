"""Conversion of aircraft attitude to the angles of photogrammetry; only this module does it.

Inertial systems report roll, pitch and heading of the body against the local level (north, east,
down); photogrammetry uses omega, phi, kappa of the camera against a map grid (east, north, up).
The conversion takes two constant matrices, the boresight, and the convergence of the meridian.
Conversion goes through the matrix, never by renaming angles. Rotations are (3, 3), float64.

Source: docs/mathematics/coordinates.md#from-roll-pitch-heading-to-the-grid.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BODY_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Camera x right, y forward, z up; body x forward, y right, z down. Its own inverse."""

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
GIMBAL_LOCK_COSINE = 1e-9


def level_from_body(roll_rad: float, pitch_rad: float, heading_rad: float) -> Array:
    """Local level (north, east, down) from body: Rz(heading) Ry(pitch) Rx(roll) (ARINC 705)."""
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    ch, sh = math.cos(heading_rad), math.sin(heading_rad)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[ch, -sh, 0.0], [sh, ch, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ about_y @ about_x)


def grid_from_enu(azimuth_of_north_rad: float) -> Array:
    """Map grid from local east, north, up.

    Args:
        azimuth_of_north_rad: direction of true north in the grid, clockwise from grid north; the
            convergence of the meridian with the opposite sign.
    """
    c, s = math.cos(azimuth_of_north_rad), math.sin(azimuth_of_north_rad)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def grid_from_camera(
    *,
    level_from_imu: Array,
    imu_from_body: Array,
    body_from_camera: Array,
    azimuth_of_north_rad: float,
) -> Array:
    """Rotation from camera to map grid: what omega, phi and kappa are taken from.

    Args:
        level_from_imu: north, east, down from the axes the receiver speaks of.
        imu_from_body: boresight; identity where the inertial unit is aligned with the camera.
        body_from_camera: of a head; `BODY_FROM_CAMERA` times master_from_cone.
        azimuth_of_north_rad: see `grid_from_enu`.
    """
    return np.asarray(
        grid_from_enu(azimuth_of_north_rad)
        @ ENU_FROM_NED
        @ level_from_imu
        @ imu_from_body
        @ body_from_camera
    )


def omega_phi_kappa(rotation: Array) -> tuple[float, float, float]:
    """Angles of R = Rx(omega) Ry(phi) Rz(kappa), radians; at phi = +-90 deg omega is set to 0."""
    phi = math.asin(_in_range(rotation[0, 2]))
    if abs(math.cos(phi)) < GIMBAL_LOCK_COSINE:
        return 0.0, phi, math.atan2(rotation[1, 0], rotation[1, 1])
    omega = math.atan2(-rotation[1, 2], rotation[2, 2])
    kappa = math.atan2(-rotation[0, 1], rotation[0, 0])
    return omega, phi, kappa


def phi_omega_kappa(rotation: Array) -> tuple[float, float, float]:
    """Angles (phi, omega, kappa) of R = Ry(phi) Rx(omega) Rz(kappa), radians.

    At omega = +-90 deg phi is set to 0.
    """
    omega = math.asin(_in_range(-rotation[1, 2]))
    if abs(math.cos(omega)) < GIMBAL_LOCK_COSINE:
        return 0.0, omega, math.atan2(-rotation[0, 1], rotation[0, 0])
    phi = math.atan2(rotation[0, 2], rotation[2, 2])
    kappa = math.atan2(rotation[1, 0], rotation[1, 1])
    return phi, omega, kappa


def on_level_ground(
    centre_m: Array, grid_from_camera: Array, image_mm: Array, f_mm: float, ground_m: float
) -> Array:
    """Where image rays meet a level plane.

    Args:
        centre_m: projection centre, grid east, north, height, (3,).
        grid_from_camera: rotation, (3, 3).
        image_mm: image points, x right, y up, (n, 2).
        f_mm: principal distance.
        ground_m: height of the plane, in the height system of `centre_m`.

    Returns:
        (n, 3) grid coordinates; NaN for a ray that does not come down.
    """
    rays = np.column_stack([image_mm, np.full(len(image_mm), -f_mm)]) @ grid_from_camera.T
    down = rays[:, 2] < 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (ground_m - centre_m[2]) / rays[:, 2]
    reach = np.where(down & (reach > 0.0), reach, np.nan)
    return np.asarray(centre_m + rays * reach[:, None])


def _in_range(value: float) -> float:
    return max(-1.0, min(1.0, float(value)))
