"""Object points that are one: measured in other images under other names, with equal coordinates.

Matches of pairs of images give a point of its own to each pair. After an adjustment such points are
found by their coordinates and become one point with all rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.bundle.network import ImagePoints, Network

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

_LIMIT: Final = 16.27
"""Squared distance over its covariance: chi-square of three at 99.9 %."""

_SIGMAS: Final = 4.1
_NEIGHBOURS: Final = 24
"""Other points around one that are compared with it."""


class _Pair(NamedTuple):
    """Two points and the squared distance between them over its covariance."""

    size: float
    first: int
    second: int


def joined_points(
    network: Network, xyz_m: Array, covariance_m2: Array, named: Flags | None = None
) -> tuple[Network, int]:
    """Join object points of the same place that no image sees twice.

    Args:
        network: observations.
        xyz_m: adjusted coordinates, shape (points, 3), m.
        covariance_m2: of each point, shape (points, 3, 3); NaN where a point was not adjusted.
        named: points that are not joined with each other and give the joined point its name, such
            as control and check points, shape (points,); None: those with a weight.

    Returns:
        The network with fewer points, and how many fewer there are.

    Source: docs/explanation/mathematics/bundle.md#joined-points.
    """
    points, table = network.points, network.image_points
    if named is None:
        named = named_points(network)
    group = np.arange(len(points.names))
    members = [[k] for k in range(len(group))]
    order = np.argsort(table.point, kind="stable")
    begin = np.searchsorted(table.point[order], np.arange(len(group) + 1))
    images = [set(table.image[order[a:b]].tolist()) for a, b in pairwise(begin)]
    own_name = [bool(one) for one in named]
    for pair in _pairs(xyz_m, covariance_m2, ~points.at_infinity):
        a, b = int(group[pair.first]), int(group[pair.second])
        if a == b or images[a] & images[b] or (own_name[a] and own_name[b]):
            continue
        if own_name[b]:
            a, b = b, a
        images[a] |= images[b]
        own_name[a] = own_name[a] or own_name[b]
        group[members[b]] = a
        members[a] += members[b]
    return _with_groups(network, xyz_m, group)


def named_points(network: Network, others: Sequence[str] = ()) -> Flags:
    """Points whose names are kept: control, and others.

    Args:
        network: its points.
        others: further names, such as check points.

    Returns:
        Shape (points,).
    """
    weighted = (np.nan_to_num(network.points.sigma_m, nan=-1.0) >= 0.0).any(axis=1)
    return np.asarray(weighted | np.isin(network.points.names, list(others)))


def _pairs(xyz_m: Array, covariance_m2: Array, finite: Flags) -> list[_Pair]:
    """Pairs within the limit, the nearest first."""
    usable = np.flatnonzero(finite & np.isfinite(covariance_m2).all(axis=(1, 2)))
    if len(usable) < 2:
        return []
    tree = cKDTree(xyz_m[usable])
    spread = np.sqrt(np.einsum("pii->p", covariance_m2[usable]))
    count = min(_NEIGHBOURS + 1, len(usable))
    found = tree.query(xyz_m[usable], k=count)
    first = np.repeat(np.arange(len(usable)), count)
    distance, second = (np.asarray(one).ravel() for one in found)
    possible = first < second
    possible |= ~np.isin(second * len(usable) + first, first * len(usable) + second)
    possible &= (first != second) & (distance <= _SIGMAS * (spread[first] + spread[second]))
    first, second = usable[first[possible]], usable[second[possible]]
    apart = xyz_m[first] - xyz_m[second]
    both = covariance_m2[first] + covariance_m2[second]
    both = both + 1e-12 * np.einsum("nii->n", both)[:, None, None] * np.eye(3)
    size = np.einsum("ni,ni->n", apart, np.linalg.solve(both, apart[:, :, None])[:, :, 0])
    within = np.flatnonzero(size <= _LIMIT)
    order = within[np.argsort(size[within], kind="stable")]
    return [_Pair(float(size[k]), int(first[k]), int(second[k])) for k in order]


def _with_groups(network: Network, xyz_m: Array, group: Indices) -> tuple[Network, int]:
    """The network with each point replaced by the first of its group."""
    kept, number = np.unique(group, return_inverse=True)
    if len(kept) == len(group):
        return network, 0
    points, table, distances = network.points, network.image_points, network.distances
    weighted = np.asarray(np.isfinite(points.sigma_m).any(axis=1))
    start = np.where(weighted[:, None], points.xyz_m, xyz_m)
    return replace(
        network,
        points=replace(
            points,
            names=tuple(points.names[k] for k in kept),
            xyz_m=start[kept],
            sigma_m=points.sigma_m[kept],
            at_infinity=points.at_infinity[kept],
        ),
        image_points=ImagePoints(table.image, number[table.point], table.xy_mm, table.sigma_mm),
        distances=replace(
            distances, point_a=number[distances.point_a], point_b=number[distances.point_b]
        ),
    ), len(group) - len(kept)
