"""Observations that contradict the others: what is good without them, and what is farthest off.

Orientations that are given, control points, and blunders in image points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.exchanged_columns import exchanged_by_shape
from processing import ProcessingError
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.data_snooping import names_of
from processing.bundle.network import Network
from processing.bundle.starting_values import starting_values
from processing.geometry.positions_fit import NotPlacedError, fit_positions

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SUSPICIOUS_SIGMA0: Final = 20.0
"""Sigma0 beyond which an explanation is sought."""

_BETTER: Final = 0.2
"""Share of the sigma0 as given below which a trial explains it."""

_MAX_ITERATIONS: Final = 15
_ROBUST_ITERATIONS: Final = 40
_MAX_ROUNDS: Final = 20
_SIGNIFICANCE: Final = 0.05
_MAX_BLUNDERS: Final = 0.1
"""Share of image points."""

_AWAY: Final = 5.0
"""Distance over that of most from which a place is another one."""

_MIN_CONTROL: Final = 4
_MAX_TRIPLES: Final = 2000
_MAX_NAMED: Final = 5


def explaining(
    network: Network, sigma0: float | None, settings: AdjustmentSettings | None = None
) -> Adjustment | None:
    """Adjust a changed network.

    Args:
        network: to be adjusted; it needs no starting values.
        sigma0: of the adjustment as given; None where it failed.
        settings: None: 15 iterations, no tests.

    Returns:
        The adjustment if its sigma0 is better by far than that as given.
    """
    limit = SUSPICIOUS_SIGMA0 if sigma0 is None else _BETTER * sigma0
    try:
        settings = settings or AdjustmentSettings(max_iterations=_MAX_ITERATIONS)
        result = adjust(starting_values(network), settings)
    except (ProcessingError, ValueError, ArithmeticError, np.linalg.LinAlgError):
        return None
    return result if result.redundancy > 0 and result.sigma0 < limit else None


def contradicting_orientations(network: Network, sigma0: float | None) -> list[str]:
    """Name the images whose given positions are far off, where the block without them is good.

    Args:
        network: as given.
        sigma0: of the adjustment as given; None where it failed.

    Returns:
        A sentence, or nothing.
    """
    stations, attitudes, images = network.stations, network.attitudes, network.images
    free, turned = ~stations.fixed, ~attitudes.fixed
    given = np.isfinite(stations.position_m).all(axis=1) & free
    if not given.any() or (images.head >= 0).any():
        return []
    position = np.where(free[:, None], np.nan, stations.position_m)
    rotation = np.where(turned[:, None, None], np.nan, attitudes.rotation)
    result = explaining(
        replace(
            network,
            stations=replace(stations, position_m=position),
            attitudes=replace(attitudes, rotation=rotation),
        ),
        sigma0,
    )
    if result is None:
        return []
    seen = np.zeros(len(given), bool)
    seen[images.station[np.unique(network.image_points.image)]] = True
    own = np.flatnonzero(given & seen)
    found, start = result.state.station, stations.position_m
    away = np.linalg.norm(found - start, axis=1)
    most = float(np.median(away[own]))
    wrong = [int(k) for k in own[np.argsort(-away[own])] if away[k] > _AWAY * most][:_MAX_NAMED]
    beginning = (
        "the given orientations do not fit the other observations, without them sigma0 is "
        f"{result.sigma0:.4g}: "
    )
    if not wrong:
        return [
            f"{beginning}half of the positions are {most:.3g} m or more off; correct their frame, "
            "unit or angles, or leave them empty"
        ]
    named = [f"{stations.names[k]} is {away[k]:.3g} m off" for k in wrong]
    for a, b in combinations(wrong, 2):
        crosswise = max(
            float(np.linalg.norm(found[a] - start[b])), float(np.linalg.norm(found[b] - start[a]))
        )
        if crosswise <= _AWAY * most:
            named.append(f"{stations.names[a]} and {stations.names[b]} are exchanged")
    return [f"{beginning}{', '.join(named)}; correct these, or leave them empty"]


def contradicting_control(network: Network, sigma0: float | None) -> list[str]:
    """Name the control points that do not fit the block of the image points alone.

    Args:
        network: as given.
        sigma0: of the adjustment as given; None where it failed.

    Returns:
        A sentence, or nothing.
    """
    points = network.points
    weighted = (np.nan_to_num(points.sigma_m, nan=-1.0) >= 0.0).all(axis=1)
    count = np.bincount(network.image_points.point, minlength=len(points.names))
    known = np.flatnonzero(weighted & (count >= 2) & ~points.at_infinity)
    if len(known) < _MIN_CONTROL:
        return []
    xyz, sigma = points.xyz_m.copy(), points.sigma_m.copy()
    xyz[weighted], sigma[weighted] = np.nan, np.nan
    settings = AdjustmentSettings(max_iterations=_MAX_ITERATIONS, minimum_norm=True)
    free = replace(network, points=replace(points, xyz_m=xyz, sigma_m=sigma))
    result = explaining(free, sigma0, settings)
    if result is None:
        return []
    known = known[~result.left_out[known]]
    if len(known) < _MIN_CONTROL:
        return []
    given, found = points.xyz_m[known], result.state.points[known]
    if exchanged := exchanged_by_shape(given, found):
        return exchanged
    fitted = _fit_of_most(found, given)
    if fitted is None:
        return []
    away, limit = np.linalg.norm(fitted - given, axis=1), _most(given, fitted)
    scale = float(np.ptp(fitted, axis=0).max() / np.ptp(found, axis=0).max())
    of_rays = scale * result.sigma0 * np.sqrt(np.einsum("pii->p", result.point_cofactor[known]))
    own = np.hypot(of_rays, np.linalg.norm(points.sigma_m[known], axis=1))
    wrong = [int(k) for k in np.argsort(-away) if away[k] > _AWAY * max(limit, float(own[k]))]
    if not wrong:
        return []
    names = [points.names[k] for k in known]
    named = [
        f"{names[k]} is off by {x:.4g}, {y:.4g}, {z:.4g} m"
        for k in wrong[:_MAX_NAMED]
        for x, y, z in [given[k] - fitted[k]]
    ]
    for a, b in combinations(wrong[:_MAX_NAMED], 2):
        crosswise = np.linalg.norm([fitted[a] - given[b], fitted[b] - given[a]], axis=1).max()
        if crosswise <= _AWAY * limit:
            named.append(f"{names[a]} and {names[b]} are exchanged")
    return [
        f"control contradicts the image points, without it sigma0 is {result.sigma0:.4g}: "
        f"{', '.join(named)} (X, Y, Z, against most of the others): correct coordinates or names"
    ]


def _most(given: Array, fitted: Array) -> float:
    """Distance within which two thirds of the places are."""
    away = np.sort(np.linalg.norm(fitted - given, axis=1))
    return float(away[int(np.ceil(2.0 * len(away) / 3.0)) - 1])


def _fit_of_most(model: Array, given: Array) -> Array | None:
    """Places of the block by the similarity of three points that most of the others fit."""
    best: Array | None = None
    random = np.random.default_rng(1)
    triples: Sequence[tuple[int, ...]] = list(combinations(range(min(len(given), 25)), 3))
    if len(triples) > _MAX_TRIPLES:
        triples = [triples[k] for k in random.choice(len(triples), _MAX_TRIPLES, replace=False)]
    for three in triples:
        rows = np.array(three)
        try:
            fitted = fit_positions(model[rows], given[rows]).applied(model)
        except NotPlacedError:
            continue
        if best is None or _most(given, fitted) < _most(given, best):
            best = fitted
    return best


def planted_blunders(network: Network, sigma0: float | None) -> list[str]:
    """Name the observations that robust weights and data snooping leave out.

    Args:
        network: as given.
        sigma0: of the adjustment as given; None where it failed.

    Returns:
        A sentence where the rest is good, or nothing.
    """
    settings = AdjustmentSettings(
        max_iterations=_ROBUST_ITERATIONS,
        robust=True,
        weight_function="danish",
        significance=_SIGNIFICANCE,
        max_rounds=_MAX_ROUNDS,
    )
    result = explaining(network, sigma0, settings)
    if result is None:
        return []
    table = result.network.image_points
    rows = np.flatnonzero(result.rejected)
    others = names_of(network, result.excluded)
    if not len(rows) + len(others) or len(rows) > _MAX_BLUNDERS * len(table.image):
        return []
    named = [
        f"point {network.points.names[table.point[k]]} in image "
        f"{network.images.names[table.image[k]]}"
        for k in rows
    ] + list(others)
    more = f" and {len(named) - _MAX_NAMED} others" if len(named) > _MAX_NAMED else ""
    return [
        f"blunders: without {', '.join(named[:_MAX_NAMED])}{more} sigma0 is {result.sigma0:.4g}: "
        "correct them, or adjust with --weight-function danish --significance 0.05"
    ]
