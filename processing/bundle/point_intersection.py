"""Combined intersection: object points from oriented images, with the orientations' covariance.

Orientations, heads and cameras are not changed. Their covariance, common errors included, is
propagated into the points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.equations import equations
from processing.bundle.network import Network, NetworkError
from processing.bundle.normal_equations import point_normals
from processing.bundle.undetermined_points import undetermined_points
from processing.bundle.unknowns import ParameterLayout, apply_corrections, initial_values, layout_of

Array = NDArray[np.float64]

_MAX_ITERATIONS: Final = 30
_CONVERGED_M: Final = 1e-6


@dataclass(frozen=True)
class IntersectedPoints:
    """Object points (p, 3) m and covariances (p, 3, 3) m squared; NaN where rays do not fix them.

    `of_image_m2` is the part of the covariances that image coordinates alone account for.
    """

    xyz_m: Array
    covariance_m2: Array
    of_image_m2: Array


def orientation_layout(network: Network) -> ParameterLayout:
    """Columns of everything whose errors are propagated: what the network leaves free.

    Args:
        network: orientations as they are used.

    Returns:
        The layout, without points that their rays do not fix.
    """
    return layout_of(network, undetermined_points(network, initial_values(network)))


def propagated_covariance(
    layout: ParameterLayout,
    calibration: Adjustment | None,
    *,
    position_m: Array,
    attitude_rad: Array,
) -> Array:
    """Covariance of the columns of directly georeferenced exposures.

    The boresight is taken as the average, over the calibration's exposures, of inertial against
    adjusted attitudes; so all attitudes share the calibration's error of their mean, together with
    its correlations with heads and cameras.

    Args:
        layout: from `orientation_layout`.
        calibration: where heads, cameras and boresight were determined; None: they are exact.
        position_m: sigma of every station's coordinates, shape (3,), m.
        attitude_rad: sigma of every inertial attitude about the rig's axes, shape (3,), rad.

    Returns:
        Shape (c, c), metres and radians.

    Source: docs/explanation/mathematics/navigation.md#combined-intersection.
    """
    covariance = np.zeros((layout.columns, layout.columns))
    n = 0
    if calibration is not None:
        at = {u: k for k, u in enumerate(calibration.layout.unknowns)}
        by = np.zeros((layout.columns, len(at)))
        for k, unknown in enumerate(layout.unknowns):
            if unknown in at and _outlives_block(unknown.kind):
                by[k, at[unknown]] = 1.0
        n = int((calibration.layout.attitude >= 0).all(axis=1).sum())
        for axis in range(3):
            rotated, adjusted = layout.attitude[:, axis], calibration.layout.attitude[:, axis]
            adjusted = adjusted[adjusted >= 0]
            by[np.ix_(rotated[rotated >= 0], adjusted)] = 1.0 / len(adjusted)
        covariance = calibration.sigma0**2 * by @ calibration.cofactor @ by.T
    for axis in range(3):
        station, rotated = layout.station[:, axis], layout.attitude[:, axis]
        station, rotated = station[station >= 0], rotated[rotated >= 0]
        covariance[station, station] += position_m[axis] ** 2
        covariance[rotated, rotated] += attitude_rad[axis] ** 2
        if n:
            covariance[np.ix_(rotated, rotated)] += attitude_rad[axis] ** 2 / n
    return np.asarray(covariance)


def intersect_points(
    network: Network, layout: ParameterLayout, covariance: Array
) -> IntersectedPoints:
    """Intersect every object point by least squares of its image coordinates.

    Args:
        network: orientations as they are used; object coordinates are starting values, their sigmas
            are not used.
        layout: from `orientation_layout` of the same network.
        covariance: of its columns, shape (c, c), metres and radians.

    Returns:
        Coordinates and covariances of all object points of the network.

    Raises:
        NetworkError: no convergence.

    Source: docs/explanation/mathematics/navigation.md#combined-intersection.
    """
    network = replace(
        network,
        points=replace(network.points, sigma_m=np.full_like(network.points.sigma_m, np.nan)),
    )
    state = initial_values(network)
    weight = np.ones(len(network.image_points.image))
    nothing = np.zeros(layout.columns)
    points = layout.eliminated_points
    for _ in range(_MAX_ITERATIONS):
        rows = equations(network, layout, state, weight)
        own = rows.point >= 0
        who, part = rows.point[own], rows.point_part[own]
        normal = point_normals(rows, layout)
        right = np.zeros((len(points), 3))
        np.add.at(right, who, part * rows.misclosure[own, None])
        step = np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], dtype=np.float64)
        state = apply_corrections(state, layout, nothing, step)
        if np.abs(step).max(initial=0.0) < _CONVERGED_M:
            break
    else:
        raise NetworkError(
            ["object points do not converge; are the orientations those of the images?"]
        )
    cofactor = np.linalg.inv(normal)
    by_column = np.zeros((len(points), 3, layout.columns))
    np.add.at(by_column, who, part[:, :, None] * rows.reduced[own].toarray()[:, None, :])
    moved = -np.einsum("pij,pjc->pic", cofactor, by_column)
    carried = np.einsum("pic,cd,pjd->pij", moved, covariance, moved, optimize=True)
    xyz = np.full((len(layout.locked), 3), np.nan)
    image, total_covariance = np.full((len(xyz), 3, 3), np.nan), np.full((len(xyz), 3, 3), np.nan)
    xyz[points] = state.points[points]
    image[points], total_covariance[points] = cofactor, cofactor + carried
    return IntersectedPoints(xyz, total_covariance, image)


def _outlives_block(kind: str) -> bool:
    """Whether an unknown holds beyond the block it was determined in."""
    return kind in ("camera", "head rotation", "head offset")
