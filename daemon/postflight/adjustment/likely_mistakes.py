"""Mistakes that explain a bad adjustment: attitudes, units, mirrored coordinates, separate blocks.

The trials cost an adjustment and are made only where sigma0 is far off or nothing converged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.contradictions import (
    SUSPICIOUS_SIGMA0,
    contradicting_control,
    contradicting_orientations,
    explaining,
    planted_blunders,
)
from daemon.postflight.adjustment.exchanged_columns import (
    control_of_given_exposures,
    exchanged_columns,
)
from daemon.postflight.adjustment.given_projections import (
    degrees_for_metres,
    misplaced_control,
    principal_distance_ratio,
    turned_attitudes,
)
from daemon.postflight.adjustment.separate_blocks import unplaced_blocks
from processing.bundle.camera_model import perspective_mm
from processing.bundle.network import Network, no_distances, no_gnss
from processing.bundle.rank_diagnosis import RankDefect

Array = NDArray[np.float64]

_AS_GOOD: Final = 1.5
"""Ratio of sigma0 within which two explanations are named."""

_OTHER_DISTANCE: Final = 1.2
"""Ratio of principal distances from which another one is tried."""

_CONSTANT: Final = 5.0
"""Mean difference in height over the others from which it is that of two height systems."""

_UNITS: Final = (
    (1000.0, "millimetres"),
    (100.0, "centimetres"),
    (1.0 / 0.3048, "feet"),
    (1.0 / 1000.0, "kilometres"),
)
_UNIT_WITHIN: Final = 0.1
_SCALE_BEYOND: Final = 1.5
_MIN_CONTROL: Final = 3
_MIN_BASE: Final = 0.02
"""Extent of the exposures over the distance of the control."""

_DATUM_DEFECTS: Final = 7
_MAX_LISTED: Final = 5
_AWAY: Final = 5.0
"""Distance over that of most from which an antenna position is another one."""

_CROSSWISE: Final = 0.1
"""Of the distance of two antennas: as near to each other's positions they are exchanged."""

_LENGTH_UNITS: Final = (
    (10.0, "centimetres"),
    (25.4, "inches"),
    (1000.0, "metres"),
)
_UNIT_EXACT: Final = 0.02


def likely_mistakes(network: Network, sigma0: float | None) -> list[str]:
    """Turn attitudes, mirror image coordinates, compare scales, and try another principal distance.

    A rotation of image coordinates by 180 degrees, such as both signs reversed, is taken by the
    attitudes and is no mistake where these are not given.

    Args:
        network: as given, before starting values were completed.
        sigma0: of the adjustment as given; None where it failed.

    Returns:
        A sentence for what explains the observations; otherwise empty.
    """
    found = degrees_for_metres(network) or turned_attitudes(network)
    if found or _is_at_one_place(network):
        # Rays from one place intersect anywhere, whatever is changed.
        return found
    return (
        _mirrored(network, sigma0)
        or contradicting_orientations(network, sigma0)
        or _another_principal_distance(network, sigma0)
        or _control_of_another_unit(network)
        or exchanged_columns(network)
        or misplaced_control(network)
        or _contradicting_distances(network, sigma0)
        or _positions_or_principal_distance(network, sigma0)
        or contradicting_control(network, sigma0)
        or planted_blunders(network, sigma0)
    )


def control_sentences(network: Network, defects: Sequence[RankDefect]) -> tuple[str, ...]:
    """Sentences of a network without datum; one for a block of one or two control points.

    Args:
        network: as given.
        defects: directions that nothing determines.

    Returns:
        One sentence for each block that nothing places, or one in place of those of the rotations
        and the scale about the control points.
    """
    if unplaced := unplaced_blocks(network):
        return tuple(unplaced)
    if few := _images_of_few_points(network):
        return tuple(few)
    seen = np.unique(network.image_points.point)
    known = np.asarray((np.nan_to_num(network.points.sigma_m, nan=-1.0) >= 0.0).all(axis=1))
    control = [network.points.names[k] for k in seen if known[k] and not _is_direction(network, k)]
    about = {1: 4, 2: 1}.get(len(control))
    sentences = tuple(defect.sentence for defect in defects)
    given = int(known.sum())
    if given and not control and len(defects) == _DATUM_DEFECTS:
        first = network.points.names[int(np.flatnonzero(known)[0])]
        return (
            f"none of the {given} control points ({first}, ...) has an image point: measure them, "
            "or give their names in image_points.csv as in points.csv",
        )
    others = len(network.gnss.station) or len(network.distances.point_a)
    held = network.stations.fixed.any() or network.attitudes.fixed.any()
    attitudes = len(network.measured_attitudes.attitude)
    if about is None or len(defects) != about or others or held or attitudes:
        return sentences
    are = "is the only control point" if len(control) == 1 else "are the only control points"
    return (
        f"{' and '.join(control)} {are} with image points, and the block can be turned"
        + (" and scaled about it" if len(control) == 1 else " about the line through them")
        + ": three control points that are not on one line, GNSS positions, or --free-network "
        "are needed",
    )


def _images_of_few_points(network: Network) -> list[str]:
    """Images that too few object points orient: an orientation has six unknowns."""
    images, gnss, bearings = network.images, network.gnss, network.measured_attitudes
    count = np.bincount(network.image_points.image, minlength=len(images.names))
    alone = np.bincount(images.station, minlength=len(network.stations.names)) == 1
    observed = np.isin(images.station, gnss.station) | np.isin(images.attitude, bearings.attitude)
    held = network.stations.fixed[images.station] | network.attitudes.fixed[images.attitude]
    few = (count > 0) & (count < _MIN_CONTROL) & alone[images.station] & ~observed & ~held
    names = [images.names[k] for k in np.flatnonzero(few)]
    if not names:
        return []
    more = ", ..." if len(names) > _MAX_LISTED else ""
    return [
        f"{len(names)} images have less than three image points ({', '.join(names[:_MAX_LISTED])}"
        f"{more}), which do not orient them: measure more points in them, or leave them out"
    ]


def _is_direction(network: Network, point: int) -> bool:
    return bool(network.points.at_infinity[point])


def _is_at_one_place(network: Network) -> bool:
    """Whether all exposures are given at one place, against the distance of known points."""
    points, images = network.points, network.images
    known = points.xyz_m[np.isfinite(points.xyz_m).all(axis=1) & ~points.at_infinity]
    station = network.stations.position_m[np.unique(images.station[network.image_points.image])]
    if not len(known) or len(station) < 2 or not np.isfinite(station).all():
        return False
    depth = float(np.median(np.linalg.norm(known - station.mean(axis=0), axis=1)))
    return float(np.ptp(station, axis=0).max()) < _MIN_BASE * depth


def _control_of_another_unit(network: Network) -> list[str]:
    """Distances between control points against those of their intersections from the exposures."""
    points = network.points
    own, found = control_of_given_exposures(network)
    if len(own) < _MIN_CONTROL:
        return []
    first, second = np.triu_indices(len(own), 1)
    apart = np.linalg.norm(points.xyz_m[own[first]] - points.xyz_m[own[second]], axis=1)
    of_rays = np.linalg.norm(found[first] - found[second], axis=1)
    usable = of_rays > 0.0
    if not usable.any():
        return []
    ratio = float(np.median(apart[usable] / of_rays[usable]))
    if 1.0 / _SCALE_BEYOND < ratio < _SCALE_BEYOND:
        return []
    units = [name for factor, name in _UNITS if abs(np.log(ratio / factor)) < _UNIT_WITHIN]
    reversed_ = [name for factor, name in _UNITS if abs(np.log(ratio * factor)) < _UNIT_WITHIN]
    hint = "one of them is of another unit, or the principal distance is wrong"
    if units:
        hint = f"the control points may be in {units[0]}"
    if reversed_:
        other = f"the positions of the exposures in {reversed_[0]}"
        hint = f"{hint}, or {other}" if units else other.replace(" in ", " may be in ", 1)
    return [
        f"control points are {ratio:.4g} times as far apart as the rays of the given exposures "
        f"intersect: {hint}"
    ]


def _another_principal_distance(network: Network, sigma0: float | None) -> list[str]:
    """Free principal distances, from that which the given orientations and coordinates have."""
    ratio = principal_distance_ratio(network)
    if 1.0 / _OTHER_DISTANCE < ratio < _OTHER_DISTANCE:
        return []
    found = _freed_principal_distance(network, sigma0, ratio)
    return [] if found is None else [found[1]]


def _freed_principal_distance(
    network: Network, sigma0: float | None, ratio: float
) -> tuple[float, str] | None:
    """Sigma0 with principal distances free, and the sentence; None where these do not explain it.

    Args:
        network: as given.
        sigma0: of the adjustment as given; None where it failed.
        ratio: of the starting values and the given principal distances.
    """
    cameras = tuple(
        replace(camera, f_mm=camera.f_mm * ratio, free=camera.free | {"df"})
        for camera in network.cameras
    )
    result = explaining(replace(network, cameras=cameras), sigma0)
    if result is None:
        return None
    estimated = [
        perspective_mm(camera, result.state.interior[k])[0] for k, camera in enumerate(cameras)
    ]
    found = [
        f"{f_mm:.5g} mm (f_mm {given.f_mm:g})"
        for f_mm, given in zip(estimated, network.cameras, strict=True)
    ]
    sentence = (
        f"the principal distance is wrong: estimated, it is {', '.join(found)} and sigma0 is "
        f"{result.sigma0:.4g}"
    )
    shares = [f / given.f_mm for f, given in zip(estimated, network.cameras, strict=True)]
    for factor, unit in _LENGTH_UNITS:
        if all(abs(share * factor - 1.0) < _UNIT_EXACT for share in shares):
            sentence += f": the image coordinates may be in {unit}, millimetres are right"
        if all(abs(share / factor - 1.0) < _UNIT_EXACT for share in shares):
            sentence += f": f_mm may be in {unit}, millimetres are right"
    return result.sigma0, sentence


def _positions_or_principal_distance(network: Network, sigma0: float | None) -> list[str]:
    """Antenna positions and a principal distance that is off by little: the better one first.

    A wrong principal distance moves exposures up or down as wrong heights of antennas do.
    """
    found = [
        one
        for one in (
            _contradicting_positions(network, sigma0),
            _freed_principal_distance(network, sigma0, 1.0)
            if not any("df" in camera.free for camera in network.cameras)
            else None,
        )
        if one is not None
    ]
    found.sort()
    if not found or found[0][0] > SUSPICIOUS_SIGMA0:
        return []
    best = found[0][0]
    return [sentence for own, sentence in found if own < _AS_GOOD * best]


def _contradicting_distances(network: Network, sigma0: float | None) -> list[str]:
    """The distance that is farthest off, where the block without distances is good."""
    given = network.distances
    if not len(given.point_a):
        return []
    result = explaining(replace(network, distances=no_distances()), sigma0)
    if result is None:
        return []
    xyz, names = result.state.points, network.points.names
    length = np.linalg.norm(xyz[given.point_b] - xyz[given.point_a], axis=1)
    worst = int(np.argmax(np.abs(given.distance_m - length) / given.sigma_m))
    return [
        f"distances contradict the other observations, without them sigma0 is {result.sigma0:.4g}: "
        f"{names[given.point_a[worst]]} to {names[given.point_b[worst]]} is given as "
        f"{given.distance_m[worst]:.6g} m and adjusted to {length[worst]:.6g} m"
    ]


def _contradicting_positions(network: Network, sigma0: float | None) -> tuple[float, str] | None:
    """By how much antenna positions are off, where the block without them is good.

    Args:
        network: as given.
        sigma0: of the adjustment as given; None where it failed.

    Returns:
        Sigma0 without them, and the sentence.
    """
    given = network.gnss
    if not len(given.station):
        return None
    result = explaining(replace(network, gnss=no_gnss()), sigma0)
    if result is None:
        return None
    rotation = result.state.attitude[given.attitude]
    lever = np.einsum("nij,nj->ni", rotation, given.lever_m)
    antenna = result.state.station[given.station] + lever
    beginning = (
        "antenna positions contradict the other observations, without them sigma0 is "
        f"{result.sigma0:.4g}: "
    )
    if named := _other_positions(network, antenna):
        return result.sigma0, f"{beginning}{', '.join(named)}"
    mean = (given.position_m - antenna).mean(axis=0)
    spread = (given.position_m - antenna).std(axis=0)
    sentence = (
        f"{beginning}on average they are {mean[0]:.3g}, {mean[1]:.3g}, {mean[2]:.3g} m "
        f"off in X, Y, Z (standard deviations {spread[0]:.2g}, {spread[1]:.2g}, {spread[2]:.2g} m)"
    )
    if abs(mean[2]) > _CONSTANT * max(spread[2], abs(mean[0]), abs(mean[1])):
        sentence += ": are they ellipsoidal heights, and the control points' above sea level?"
    elif (spread > np.abs(mean)).any():
        sentence += ": is their unit another one, or are X and Y exchanged?"
    return result.sigma0, sentence


def _other_positions(network: Network, antenna: Array) -> list[str]:
    """Exposures whose antenna positions are farther off than those of most, and exchanged ones.

    Args:
        network: as given.
        antenna: positions without the given ones, (n, 3) m.
    """
    given, names = network.gnss, network.stations.names
    off = given.position_m - antenna
    off = off - np.median(off, axis=0)
    away = np.linalg.norm(off, axis=1)
    own = np.nan_to_num(given.sigma_m, posinf=0.0).max(axis=1)
    limit = _AWAY * max(float(np.median(away)), float(np.median(own)))
    wrong = [int(k) for k in np.argsort(-away) if away[k] > limit]
    if not wrong or len(wrong) > len(away) / 2:
        return []
    found = [
        f"{names[given.station[k]]} is {away[k]:.3g} m farther off than most"
        for k in wrong[:_MAX_LISTED]
    ]
    if len(wrong) > _MAX_LISTED:
        found.append(f"{len(wrong) - _MAX_LISTED} others too")
    for a, b in combinations(wrong[:_MAX_LISTED], 2):
        crosswise = max(
            float(np.linalg.norm(given.position_m[a] - antenna[b])),
            float(np.linalg.norm(given.position_m[b] - antenna[a])),
        )
        if crosswise <= max(limit, _CROSSWISE * float(np.linalg.norm(antenna[a] - antenna[b]))):
            pair = sorted((names[given.station[a]], names[given.station[b]]))
            found.append(f"{pair[0]} and {pair[1]} are exchanged")
    return found


def _mirrored(network: Network, sigma0: float | None) -> list[str]:
    table = network.image_points
    mirrored = replace(table, xy_mm=table.xy_mm * np.array([1.0, -1.0]))
    result = explaining(replace(network, image_points=mirrored), sigma0)
    if result is None:
        return []
    return [
        "image coordinates are mirrored: y points down (as rows of pixels do), x and y are "
        f"exchanged, or X and Y of the control are; with y reversed sigma0 is {result.sigma0:.4g}"
    ]
