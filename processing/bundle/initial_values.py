"""Starting values: orientation of an image from known points, object points from oriented images.

Neither is an adjustment; both are good enough for one to converge.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.bundle.camera_model import ideal_mm, principal_distance_mm
from processing.bundle.network import Network, NetworkError
from processing.geometry.rotation import rotations_from_vectors

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def resect(xy_mm: Array, xyz_m: Array, f_mm: float) -> tuple[Array, Array]:
    """Projection centre and rotation of an image from four or more known points (SQPnP).

    Args:
        xy_mm: ideal image coordinates about the principal point, shape (n, 2), mm.
        xyz_m: object points, shape (n, 3), m; they may lie in a plane.
        f_mm: principal distance.

    Returns:
        Station, shape (3,), m, and object_from_camera, shape (3, 3).

    Raises:
        ValueError: fewer than four points, or no solution.

    Example:
        A camera 100 m above the middle of a square of 20 m looks down.

        >>> corners_m = np.array([[-10.0, -10, 0], [10, -10, 0], [10, 10, 0], [-10, 10, 0]])
        >>> station_m, rotation = resect(corners_m[:, :2] * 0.5, corners_m, f_mm=50.0)
        >>> station_m.round(4) + 0.0, np.allclose(rotation, np.eye(3))
        (array([  0.,   0., 100.]), True)
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
    object_from_vision = rotations_from_vectors(rotation.ravel()).T
    station = centre - object_from_vision @ shift.ravel()
    return np.asarray(station), np.asarray(object_from_vision @ np.diag([1.0, -1.0, -1.0]))


def intersect(
    points: int, point: Indices, station_m: Array, direction: Array
) -> tuple[Array, NDArray[np.int64]]:
    """Object points nearest to their rays.

    Args:
        points: how many there are.
        point: which point a ray belongs to, shape (m,).
        station_m: where it starts, shape (m, 3), m.
        direction: where it goes, object axes, any length, shape (m, 3).

    Returns:
        Coordinates, shape (points, 3), m, NaN where rays are parallel or fewer than two, and the
        number of rays of each point, shape (points,).

    Example:
        Two rays that pass each other at 2 m meet in the middle.

        >>> station_m = np.array([[0.0, 0.0, 10.0], [10.0, 2.0, 0.0]])
        >>> direction = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
        >>> xyz_m, rays = intersect(1, np.array([0, 0]), station_m, direction)
        >>> xyz_m.round(6) + 0.0, rays
        (array([[0., 1., 0.]]), array([2]))
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


def completed(network: Network) -> Network:
    """Fill in what has no starting value (NaN): orientations by resection, points by intersection.

    Images are oriented from four or more points whose coordinates are known or were intersected
    before, points from two or more oriented images, in turn until nothing more is found. Lens
    corrections are applied as far as the cameras' starting values hold them.

    Args:
        network: observations; stations, attitudes and points may be NaN.

    Returns:
        The network with starting values. Points that no two images see have the mean of the others.

    Raises:
        NetworkError: images that this does not reach.
    """
    station, attitude = network.stations.position_m.copy(), network.attitudes.rotation.copy()
    xyz = network.points.xyz_m.copy()
    table, images = network.image_points, network.images
    ideal = np.empty_like(table.xy_mm)
    for index, camera in enumerate(network.cameras):
        rows = images.camera[table.image] == index
        terms = np.array([term.value for term in camera.terms])
        ideal[rows] = ideal_mm(camera, camera.interior, terms, table.xy_mm[rows])
    distance = np.array(
        [principal_distance_mm(camera, camera.interior) for camera in network.cameras]
    )
    while True:
        before = _missing_values(station, attitude, xyz)
        for image in range(len(images.names)):
            s, a = images.station[image], images.attitude[image]
            if np.isfinite(station[s]).all() and np.isfinite(attitude[a]).all():
                continue
            rows = np.flatnonzero(table.image == image)
            rows = rows[np.isfinite(xyz[table.point[rows]]).all(axis=1)]
            if len(rows) < 4 or network.points.at_infinity[table.point[rows]].any():
                continue
            try:
                place, rotations = resect(
                    ideal[rows], xyz[table.point[rows]], distance[images.camera[image]]
                )
            except (ValueError, cv2.error):
                continue
            if images.head[image] >= 0:
                head = network.heads[images.head[image]]
                rotations = rotations @ head.rotation.T
                place = place - rotations @ head.offset_m
            if not np.isfinite(station[s]).all():
                station[s] = place
            if not np.isfinite(attitude[a]).all():
                attitude[a] = rotations
        xyz = _intersect_open(network, ideal, distance, station, attitude, xyz)
        left = _missing_values(station, attitude, xyz)
        if left == before or left == (0, 0, 0):
            break
    problems = _undetermined_problems(network, station, attitude)
    if problems:
        raise NetworkError(problems)
    missing = np.asarray(np.isnan(xyz).any(axis=1))
    # Exposures without image points and points that no two images see take no part; any place does.
    station[np.isnan(station).any(axis=1)] = 0.0
    attitude[np.isnan(attitude).any(axis=(1, 2))] = np.eye(3)
    xyz[missing] = np.nanmean(xyz, axis=0) if not missing.all() else 0.0
    return replace(
        network,
        stations=replace(network.stations, position_m=station),
        attitudes=replace(network.attitudes, rotation=attitude),
        points=replace(network.points, xyz_m=xyz),
    )


def _missing_values(station: Array, attitude: Array, xyz: Array) -> tuple[int, int, int]:
    return (
        int(np.isnan(station).any(axis=1).sum()),
        int(np.isnan(attitude).any(axis=(1, 2)).sum()),
        int(np.isnan(xyz).any(axis=1).sum()),
    )


def _intersect_open(
    network: Network, ideal: Array, distance: Array, station: Array, attitude: Array, xyz: Array
) -> Array:
    table, images = network.image_points, network.images
    rotations = attitude[images.attitude].copy()
    place = station[images.station].copy()
    for image in np.flatnonzero(images.head >= 0):
        head = network.heads[images.head[image]]
        place[image] = place[image] + rotations[image] @ head.offset_m
        rotations[image] = rotations[image] @ head.rotation
    wanted = np.asarray(np.isnan(xyz).any(axis=1))
    oriented = np.asarray(np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(place).all(axis=1))
    rows = np.flatnonzero(wanted[table.point] & oriented[table.image])
    if not rows.size:
        return xyz
    of = table.image[rows]
    ray = np.column_stack([ideal[rows], -distance[images.camera[of]]])
    found, _ = intersect(
        len(xyz), table.point[rows], place[of], np.einsum("nij,nj->ni", rotations[of], ray)
    )
    return np.where(wanted[:, None], found, xyz)


def _undetermined_problems(network: Network, station: Array, attitude: Array) -> list[str]:
    used = np.unique(network.image_points.image)
    images = network.images
    lost = [
        images.names[k]
        for k in used
        if not np.isfinite(station[images.station[k]]).all()
        or not np.isfinite(attitude[images.attitude[k]]).all()
    ]
    if not lost:
        return []
    return [
        f"{len(lost)} images have no orientation and see too few known points for one "
        f"({', '.join(lost[:5])}{', ...' if len(lost) > 5 else ''}): give theirs, four points "
        "with coordinates in each, or three in a block without any orientation whose images see "
        "20 points"
    ]
