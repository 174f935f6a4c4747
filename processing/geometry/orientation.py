"""From the attitude of the aircraft to that of the camera on a map grid; only here.

Inertial systems report roll, pitch and heading of the body against the local level (north, east,
down); photogrammetry uses omega, phi, kappa of the camera against a map grid (east, north, up).
The conversion takes two constant matrices, the boresight, and the convergence of the meridian.
Angles and matrices are converted by `processing.geometry.rotation`. Rotations are (3, 3), float64.

Source: docs/explanation/mathematics/coordinates.md#from-roll-pitch-heading-to-the-grid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.geometry.rotation import rotation_from_angles

Array = NDArray[np.float64]

BODY_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Camera x right, y forward, z up; body x forward, y right, z down. Its own inverse."""

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def grid_from_enu(azimuth_of_north_rad: float) -> Array:
    """Map grid from local east, north, up.

    Args:
        azimuth_of_north_rad: direction of true north in the grid, clockwise from grid north; the
            convergence of the meridian with the opposite sign.

    Returns:
        Rotation, shape (3, 3).

    Example:
        True north 90 degrees clockwise from grid north points along grid east.

        >>> grid_from_enu(np.pi / 2).round(3) @ [0.0, 1.0, 0.0]
        array([1., 0., 0.])
    """
    return rotation_from_angles("Z", [-azimuth_of_north_rad])


def grid_from_camera(
    *,
    level_from_imu: Array,
    imu_from_body: Array,
    body_from_camera: Array,
    azimuth_of_north_rad: float,
) -> Array:
    """Rotation from camera to map grid: what omega, phi and kappa are taken from.

    Args:
        level_from_imu: north, east, down from the axes of the receiver, shape (3, 3).
        imu_from_body: boresight, shape (3, 3); identity where the inertial unit is aligned with
            the camera.
        body_from_camera: of a head, shape (3, 3); `BODY_FROM_CAMERA` times master_from_cone.
        azimuth_of_north_rad: see `grid_from_enu`.

    Returns:
        Rotation, shape (3, 3).

    Example:
        Level flight to the east: image up (y) is east, image right (x) is south.

        >>> from processing.geometry.rotation import level_from_body
        >>> rotation = grid_from_camera(
        ...     level_from_imu=level_from_body(0.0, 0.0, np.pi / 2),
        ...     imu_from_body=np.eye(3),
        ...     body_from_camera=BODY_FROM_CAMERA,
        ...     azimuth_of_north_rad=0.0,
        ... )
        >>> (rotation @ [0.0, 1.0, 0.0]).round(6) + 0.0
        array([1., 0., 0.])
        >>> (rotation @ [1.0, 0.0, 0.0]).round(6) + 0.0
        array([ 0., -1.,  0.])
    """
    return np.asarray(
        grid_from_enu(azimuth_of_north_rad)
        @ ENU_FROM_NED
        @ level_from_imu
        @ imu_from_body
        @ body_from_camera
    )


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

    Example:
        From 1000 m with f = 100 mm, 10 mm in the image are 100 m on the ground.

        >>> centre_m = np.array([500.0, 200.0, 1000.0])
        >>> on_level_ground(centre_m, np.eye(3), np.array([[10.0, 0.0]]), f_mm=100.0, ground_m=0.0)
        array([[600., 200.,   0.]])
    """
    rays = np.column_stack([image_mm, np.full(len(image_mm), -f_mm)]) @ grid_from_camera.T
    down = rays[:, 2] < 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (ground_m - centre_m[2]) / rays[:, 2]
    reach = np.where(down & (reach > 0.0), reach, np.nan)
    return np.asarray(centre_m + rays * reach[:, None])
