"""Columns of control coordinates that are exchanged, such as easting and northing, or Y and Z."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.initial_values import completed
from processing.bundle.network import Network, NetworkError
from processing.geometry.positions_fit import NotPlacedError, fit_positions

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MIN_CONTROL: Final = 4
_MAX_CONTROL: Final = 60
_BETTER: Final = 0.1
"""Share of the distance as given below which an exchange explains it."""

_EXCHANGES: Final = tuple(order for order in permutations(range(3)) if order != (0, 1, 2))
_MIRRORED: Final = tuple(order for order in _EXCHANGES if np.linalg.det(np.eye(3)[list(order)]) < 0)


def control_of_given_exposures(network: Network) -> tuple[Indices, Array]:
    """Intersect the rays of control points from the given exposures.

    Args:
        network: as given.

    Returns:
        Indices of up to 60 control points in two or more images, shape (n,), and their places,
        shape (n, 3), m; none where an exposure has no orientation.
    """
    points = network.points
    given = np.asarray(np.isfinite(points.xyz_m).all(axis=1) & ~points.at_infinity)
    weighted = np.asarray((np.nan_to_num(points.sigma_m, nan=-1.0) >= 0.0).all(axis=1))
    control = given & weighted
    table, images = network.image_points, network.images
    rays = np.bincount(table.point, minlength=len(points.names))
    own = np.flatnonzero(control & (rays >= 2))[:_MAX_CONTROL]
    rotation = network.attitudes.rotation[images.attitude].reshape(-1, 9)
    placed = np.column_stack([network.stations.position_m[images.station], rotation])
    oriented = np.asarray(np.isfinite(placed).all(axis=1))
    nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    if not len(own) or not oriented[table.image].all():
        return nothing
    unknown = np.where(control[:, None], np.nan, points.xyz_m)
    try:
        found = completed(replace(network, points=replace(points, xyz_m=unknown))).points.xyz_m
    except NetworkError:
        return nothing
    return own, found[own]


def exchanged_columns(network: Network) -> list[str]:
    """Name the columns of control that are exchanged, by the rays of the given exposures.

    Args:
        network: as given.

    Returns:
        A sentence, or nothing.
    """
    own, found = control_of_given_exposures(network)
    if len(own) < _MIN_CONTROL:
        return []
    given = network.points.xyz_m[own]

    def distance(order: tuple[int, ...]) -> float:
        return float(np.median(np.linalg.norm(given[:, order] - found, axis=1)))

    best = min(_EXCHANGES, key=distance)
    return _sentence(best, distance(best), distance((0, 1, 2)))


def exchanged_by_shape(given: Array, found: Array) -> list[str]:
    """Name the columns of control that are exchanged, by the shape of the block.

    An exchange in a circle is a rotation, which no shape shows.

    Args:
        given: control, shape (n, 3), m.
        found: the same points of the image points alone, in a frame of their own, shape (n, 3).

    Returns:
        A sentence, or nothing.
    """
    if len(given) < _MIN_CONTROL:
        return []

    def distance(order: tuple[int, ...]) -> float:
        try:
            fitted = fit_positions(found, given[:, order]).applied(found)
        except NotPlacedError:
            return float("inf")
        return float(np.median(np.linalg.norm(fitted - given[:, order], axis=1)))

    # Every exchange of two columns mirrors; all three have one shape.
    best = distance(_MIRRORED[0])
    if not best < _BETTER * distance((0, 1, 2)):
        return []
    return [
        "the control points are mirrored against the image points: two of their columns x_m, y_m "
        f"and z_m are exchanged, or one has the wrong sign; then half of them are within {best:.3g}"
        f" m, now within {distance((0, 1, 2)):.3g} m"
    ]


def _sentence(order: tuple[int, ...], best: float, as_given: float) -> list[str]:
    if not best < _BETTER * as_given:
        return []
    columns = ("x_m", "y_m", "z_m")
    moved = [columns[k] for k in range(3) if order[k] != k]
    what = f"columns {moved[0]} and {moved[1]}" if len(moved) == 2 else "columns x_m, y_m and z_m"
    return [
        f"{what} of the control points are exchanged: in the other order half of the points are "
        f"within {best:.3g} m of where the rays of the given exposures intersect, now within "
        f"{as_given:.3g} m"
    ]
