"""Mistakes that show where given object points are projected with the given orientations.

Attitudes of another convention, or of one image that is turned; another principal distance; control
points at a wrong place.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.network import Network
from processing.geometry.rotation import omega_phi_kappa, rotation_matrix

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

_TURNS: Final = (
    ("turned by 180 degrees about the camera's z axis (kappa)", (0.0, 0.0, np.pi)),
    ("turned by 90 degrees about the camera's z axis (kappa)", (0.0, 0.0, np.pi / 2.0)),
    ("turned by -90 degrees about the camera's z axis (kappa)", (0.0, 0.0, -np.pi / 2.0)),
    ("turned by 180 degrees about the camera's x axis (it looks away)", (np.pi, 0.0, 0.0)),
    ("turned by 180 degrees about the camera's y axis (it looks away)", (0.0, np.pi, 0.0)),
)
_INVERSE: Final = "those of the object in the camera; camera to object is right"
_UNITS: Final = (
    ("in radians; degrees are right", 180.0 / np.pi),
    ("in gons; degrees are right", 180.0 / 200.0),
)
_BETTER: Final = 0.2
"""Share of the distance as given below which a turn explains it."""

_BEHIND: Final = 10.0
"""In place of a distance, in principal distances."""

_MISPLACED: Final = 5.0
"""Distance from the image points over that of half of the control points."""

_HIGH: Final = 500.0
_MIN_POINTS: Final = 3
_MIN_CONTROL: Final = 4
_MAX_NAMED: Final = 5


def degrees_for_metres(network: Network) -> list[str]:
    """Name coordinates whose X and Y are geographic degrees.

    Args:
        network: as given.

    Returns:
        A sentence for control points or exposures that are 500 times as high as they are wide, and
        within 360 and 90.
    """
    points, found = network.points, []
    control = (np.nan_to_num(points.sigma_m, nan=-1.0) >= 0.0).all(axis=1) & ~points.at_infinity
    placed = np.isfinite(network.stations.position_m).all(axis=1)
    for what, place in (
        ("control points", points.xyz_m[control]),
        ("exposures", network.stations.position_m[placed]),
    ):
        if len(place) < _MIN_POINTS:
            continue
        wide, high = np.ptp(place[:, :2], axis=0).max(), np.abs(place[:, 2]).max()
        geographic = (np.abs(place[:, :2]) <= (360.0, 90.0)).all()
        if geographic and 0.0 < wide < 1.0 and high > _HIGH * wide:
            found.append(
                f"X and Y of the {what} extend over {wide:.3g} and heights reach {high:.4g}: they "
                "are degrees of longitude and latitude; bring them to a map grid in metres"
            )
    return found


def turned_attitudes(network: Network) -> list[str]:
    """Name a convention or images whose attitudes turned fit the image points better by far.

    Args:
        network: as given; what has no starting value takes no part.

    Returns:
        A sentence, or nothing.
    """
    table, images = network.image_points, network.images
    own = _usable(network)
    if not own.size:
        return []
    rotation = network.attitudes.rotation[images.attitude]
    trials = [rotation @ rotation_matrix(*angles) for _, angles in _TURNS]
    trials.append(np.swapaxes(rotation, 1, 2))
    names = [*(name for name, _ in _TURNS), _INVERSE]
    angles = omega_phi_kappa(np.where(np.isfinite(rotation), rotation, np.eye(3)))
    for name, factor in _UNITS:
        trials += [_turned_by(factor * angles), _turned_by(factor * (angles % (2.0 * np.pi)))]
        names += [name, name]
    given = _distances(network, own, rotation)
    turned = [_distances(network, own, trial) for trial in trials]
    whole = [float(np.median(distance)) for distance in turned]
    best = int(np.argmin(whole))
    as_given = float(np.median(given))
    if whole[best] < _BETTER * as_given:
        return [
            f"the attitudes are {names[best]}: with that undone half of the image points are "
            f"within {whole[best]:.3g} mm of where their object points project, now within "
            f"{as_given:.3g} mm"
        ]
    found: dict[str, list[str]] = {}
    for image in np.unique(table.image[own]):
        rows = table.image[own] == image
        of_image = float(np.median(given[rows]))
        each = [float(np.median(distance[rows])) for distance in turned]
        best = int(np.argmin(each))
        if of_image > as_given / _BETTER and each[best] < _BETTER * of_image:
            found.setdefault(names[best], []).append(images.names[image])
    return [
        f"the attitude of image {', '.join(who[:_MAX_NAMED])}"
        + (f" and {len(who) - _MAX_NAMED} others" if len(who) > _MAX_NAMED else "")
        + f" is {name}: correct it, or leave its angles empty"
        for name, who in found.items()
    ]


def _turned_by(angles: Array) -> Array:
    """Rotations of omega, phi and kappa, shape (n, 3), rad."""
    return np.array([rotation_matrix(*own) for own in angles]).reshape(-1, 3, 3)


def principal_distance_ratio(network: Network) -> float:
    """By how much the principal distances are to be multiplied to fit the image points.

    Args:
        network: as given.

    Returns:
        Median ratio of the distances of image points and of projections from the principal point;
        1 where nothing is oriented or known.
    """
    own = _usable(network)
    if not own.size:
        return 1.0
    rotation = network.attitudes.rotation[network.images.attitude]
    measured, projected, behind = _projections(network, own, rotation)
    length = np.linalg.norm(projected, axis=1)
    usable = ~behind & (length > 0.0)
    if not usable.any():
        return 1.0
    along = np.einsum("ni,ni->n", measured, projected)[usable] / length[usable] ** 2
    return float(np.median(along)) if np.median(along) > 0.0 else 1.0


def misplaced_control(network: Network) -> list[str]:
    """Name control points that are projected much farther from their image points than most.

    Args:
        network: as given.

    Returns:
        A sentence, or nothing.
    """
    own = _usable(network)
    points, table = network.points, network.image_points
    control = np.asarray((np.nan_to_num(points.sigma_m, nan=-1.0) >= 0.0).all(axis=1))
    own = own[control[table.point[own]]]
    which = np.unique(table.point[own])
    if len(which) < _MIN_CONTROL:
        return []
    distance = _distances(network, own, network.attitudes.rotation[network.images.attitude])
    away = np.array([np.median(distance[table.point[own] == k]) for k in which])
    most = float(np.median(away))
    wrong = [int(k) for k in np.argsort(-away) if away[k] > _MISPLACED * most]
    if not wrong:
        return []
    named = [f"{points.names[which[k]]} by {away[k]:.3g} mm" for k in wrong[:_MAX_NAMED]]
    exchanged = ", or two of them are exchanged" if len(wrong) > 1 else ""
    return [
        "control points are projected away from their image points with the given exposures, half "
        f"of them by less than {most:.2g} mm, but {', '.join(named)}: their coordinates or names "
        f"are wrong{exchanged}"
    ]


def _usable(network: Network) -> Indices:
    """Image points of known object points in oriented images without a head."""
    table, images = network.image_points, network.images
    rotation = network.attitudes.rotation[images.attitude]
    station = network.stations.position_m[images.station]
    oriented = np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(station).all(axis=1)
    known = np.isfinite(network.points.xyz_m).all(axis=1) & ~network.points.at_infinity
    plain = oriented & (images.head < 0)
    own = np.flatnonzero(plain[table.image] & known[table.point])
    count = np.bincount(table.image[own], minlength=len(images.names))
    return own[count[table.image[own]] >= _MIN_POINTS]


def _projections(network: Network, rows: Indices, rotation: Array) -> tuple[Array, Array, Flags]:
    """Measured and projected places about the principal point, mm, and what is behind."""
    table, images = network.image_points, network.images
    image = table.image[rows]
    f = np.array([one.f_mm for one in network.cameras])[images.camera[image]]
    centre = np.array([(one.xp_mm, one.yp_mm) for one in network.cameras])[images.camera[image]]
    station = network.stations.position_m[images.station[image]]
    ray = network.points.xyz_m[table.point[rows]] - station
    seen = np.einsum("nji,nj->ni", rotation[image], ray)
    behind = seen[:, 2] >= 0.0
    depth = np.where(behind, -1.0, seen[:, 2])
    return table.xy_mm[rows] - centre, -f[:, None] * seen[:, :2] / depth[:, None], behind


def _distances(network: Network, rows: Indices, rotation: Array) -> Array:
    """From image points to the projections of their object points, (n,) mm."""
    measured, projected, behind = _projections(network, rows, rotation)
    distance = np.linalg.norm(measured - projected, axis=1)
    far = _BEHIND * max(one.f_mm for one in network.cameras)
    return np.where(behind, far, distance)
