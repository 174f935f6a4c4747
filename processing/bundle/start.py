"""Starting values: orientation of an image from known points, object points from oriented images.

Neither is an adjustment; both are good enough for one to converge.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def resected(xy_mm: Array, xyz_m: Array, f_mm: float) -> tuple[Array, Array]:
    """Projection centre and rotation of an image from four or more known points (SQPnP).

    Args:
        xy_mm: ideal image coordinates about the principal point, (n, 2).
        xyz_m: object points, (n, 3); they may lie in a plane.
        f_mm: principal distance.

    Returns:
        station (3,) m and object_from_camera (3, 3).

    Raises:
        ValueError: fewer than four points, or no solution.
    """
    if len(xy_mm) < 4:
        raise ValueError(f"{len(xy_mm)} known points in an image; a resection takes four")
    centre = xyz_m.mean(axis=0)
    # Computer vision looks along +z with y down.
    flipped = xy_mm * np.array([1.0, -1.0]) / f_mm
    found, rotation, shift = cv2.solvePnP(
        xyz_m - centre, flipped, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
    )
    if not found:
        raise ValueError("no resection: are the known points in one line?")
    camera_from_object = np.diag([1.0, -1.0, -1.0]) @ cv2.Rodrigues(rotation)[0]
    station = centre - cv2.Rodrigues(rotation)[0].T @ shift.ravel()
    return np.asarray(station), np.asarray(camera_from_object.T)


def intersected(
    points: int, point: Indices, station_m: Array, direction: Array
) -> tuple[Array, NDArray[np.int64]]:
    """Object points nearest to their rays.

    Args:
        points: how many there are.
        point: (m,) which point a ray belongs to.
        station_m: (m, 3) where it starts.
        direction: (m, 3) where it goes, object axes, any length.

    Returns:
        coordinates (points, 3), NaN where rays are parallel or fewer than two, and the number of
        rays of each point (points,).
    """
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    normal = np.zeros((points, 3, 3))
    right = np.zeros((points, 3))
    np.add.at(normal, point, across)
    np.add.at(right, point, np.einsum("mij,mj->mi", across, station_m))
    rays = np.bincount(point, minlength=points)
    result = np.full((points, 3), np.nan)
    values = np.linalg.eigvalsh(normal)
    good = (rays >= 2) & (values[:, 0] > 1e-9 * np.maximum(values[:, 2], 1e-300))
    result[good] = np.linalg.solve(normal[good], right[good][:, :, None])[:, :, 0]
    return result, rays
