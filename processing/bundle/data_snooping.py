"""Data snooping: which observations an adjustment contradicts, of every kind, and which fit again.

An observation is tested by its residual over the residual's own standard deviation. The coordinates
of an image point are left out together, those of control points, GNSS positions and attitudes one
by one. Several are left out in one round: those that no neighbour surpasses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.critical_values import MIN_REDUNDANCY
from processing.bundle.equation_rows import Equations
from processing.bundle.equations import equations
from processing.bundle.image_rows import BehindCameraError
from processing.bundle.network import Network
from processing.bundle.normal_equations import ReducedEquations
from processing.bundle.reduced_solution import Cofactor
from processing.bundle.statistics import observation_cofactors
from processing.bundle.unknowns import ParameterLayout, ParameterValues

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

_OF_LARGEST: Final = 0.5
_AMBIGUOUS: Final = 9.0
"""Difference of squared sizes below which two image points of an object point explain its
contradiction alike: three standard deviations."""

_EQUAL_DECIMALS: Final = 4

_AXES: Final = ("X", "Y", "Z")
_ROTATIONS: Final = ("about x", "about y", "about z")


@dataclass(frozen=True)
class Excluded:
    """Observations that data snooping left out.

    Attributes:
        image: (image points,).
        control: (points, 3).
        gnss: (GNSS positions, 3).
        attitude: (measured attitudes, 3).
        distance: (distances, 1).
    """

    image: Flags
    control: Flags
    gnss: Flags
    attitude: Flags
    distance: Flags

    @property
    def count(self) -> int:
        """Image points, and coordinates of the other observations."""
        return sum(int(table.sum()) for table in self._tables())

    @property
    def others(self) -> int:
        """Coordinates of observations other than image points."""
        return self.count - int(self.image.sum())

    def joined(self, other: Excluded) -> Excluded:
        """What either leaves out.

        Args:
            other: of the same network.

        Returns:
            The union.
        """
        return Excluded(*(a | b for a, b in zip(self._tables(), other._tables(), strict=True)))

    def without(self, other: Excluded) -> Excluded:
        """What this leaves out and the other does not.

        Args:
            other: of the same network.

        Returns:
            The difference.
        """
        return Excluded(*(a & ~b for a, b in zip(self._tables(), other._tables(), strict=True)))

    def applied(self, network: Network) -> Network:
        """The network with an infinite sigma for what is left out; image points have weights.

        Args:
            network: observations.

        Returns:
            A network whose infinite sigmas have no row in `equations`.
        """
        if not self.others:
            return network
        attitudes, distances = network.measured_attitudes, network.distances

        def off(sigma: Array, flags: Flags) -> Array:
            return np.where(flags, np.inf, sigma)

        return replace(
            network,
            points=replace(network.points, sigma_m=off(network.points.sigma_m, self.control)),
            gnss=replace(network.gnss, sigma_m=off(network.gnss.sigma_m, self.gnss)),
            measured_attitudes=replace(
                attitudes, sigma_rad=off(attitudes.sigma_rad, self.attitude)
            ),
            distances=replace(distances, sigma_m=off(distances.sigma_m, self.distance[:, 0])),
        )

    def rows(self, of: Equations) -> Flags:
        """Rows that belong to observations left out.

        Args:
            of: rows of the whole network.

        Returns:
            Shape (m,).
        """
        found = np.zeros(len(of.group), dtype=bool)
        image = of.group < 2
        found[image] = self.image[of.source[image]]
        for table, groups in zip(self._tables()[1:], _GROUPS_OF, strict=True):
            own = np.isin(of.group, groups)
            found[own] = table[of.source[own], of.axis[own]]
        return found

    def _tables(self) -> tuple[Flags, ...]:
        return (self.image, self.control, self.gnss, self.attitude, self.distance)


_GROUPS_OF: Final = ((2, 3), (4, 5), (6,), (7,))


def nothing_excluded(network: Network) -> Excluded:
    """Every observation takes part.

    Args:
        network: its tables give the shapes.

    Returns:
        Flags that are all False.
    """

    def none(*shape: int) -> Flags:
        return np.zeros(shape, dtype=bool)

    return Excluded(
        none(len(network.image_points.image)),
        none(len(network.points.names), 3),
        none(len(network.gnss.station), 3),
        none(len(network.measured_attitudes.attitude), 3),
        none(len(network.distances.point_a), 1),
    )


def contradicted(
    network: Network,
    rows: Equations,
    reduced: ReducedEquations,
    cofactor: Cofactor,
    standardised: Array,
    redundancy_number: Array,
    sigma0: float,
    limit: float,
) -> tuple[Excluded, int]:
    """Observations to leave out next, and how many are beyond the limit.

    One blunder enlarges its neighbours' residuals. An image point is left out if it is the largest
    of its object point, more than half the largest of its image, and not surpassed by another kind
    of observation of that image; with it those of its object point that explain the contradiction
    alike (three rays in a strip, an error along the base). Another observation is left out if
    nothing of its images and object points surpasses it. The largest of all always is.

    Args:
        network: what was adjusted.
        rows: the observations as adjusted.
        reduced: their reduced equations.
        cofactor: of the columns, shape (c, c).
        standardised: residuals over their own a posteriori standard deviations, shape (m,).
        redundancy_number: shape (m,).
        sigma0: a posteriori standard deviation of unit weight.
        limit: in those standard deviations.

    Returns:
        What is to be left out, and the number of observations beyond the limit.

    Source: docs/explanation/mathematics/bundle.md#data-snooping.
    """
    table, images = network.image_points, network.images
    testable = redundancy_number > MIN_REDUNDANCY
    single = np.where(testable, np.abs(standardised), 0.0)
    size = np.zeros(len(table.image))
    of_images = rows.group < 2
    np.maximum.at(size, rows.source[of_images], single[of_images])
    beyond = size > limit
    near = np.flatnonzero(beyond)
    size[near] = np.maximum(
        size[near], _joint_sizes(rows, reduced, cofactor, near, len(size), sigma0)
    )
    other = np.flatnonzero((rows.group >= 2) & (rows.group < 8))
    largest = _Largest(network, rows, other, single[other])
    of_point = largest.of_point.copy()
    np.maximum.at(of_point, table.point, size)
    in_image = np.zeros(len(images.names))
    np.maximum.at(in_image, table.image, size)
    worst = nothing_excluded(network)
    worst.image[:] = (
        beyond
        & (size >= of_point[table.point])
        & (size > _OF_LARGEST * in_image[table.image])
        & (size >= largest.of_image[table.image])
    )
    # Where it cannot be decided which of them is wrong, none may stay: it would move its point.
    chosen_points = np.zeros(len(network.points.names), dtype=bool)
    chosen_points[table.point[worst.image]] = True
    alike = size**2 > of_point[table.point] ** 2 - _AMBIGUOUS
    worst.image[:] |= beyond & alike & chosen_points[table.point]
    around = largest.surroundings(np.maximum(in_image, largest.of_image), of_point)
    beyond_other = single[other] > limit
    chosen = other[beyond_other & (single[other] >= around)]
    chosen = _largest_of_lines(network, rows, chosen, single, redundancy_number)
    for flags, groups in zip(worst._tables()[1:], _GROUPS_OF, strict=True):
        own = chosen[np.isin(rows.group[chosen], groups)]
        flags[rows.source[own], rows.axis[own]] = True
    return worst, int(beyond.sum()) + int(beyond_other.sum())


def fitting_again(
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    excluded: Excluded,
    reduced: ReducedEquations,
    cofactor: Cofactor,
    sigma0: float,
    limit: float,
) -> Excluded:
    """Observations left out that agree with the adjustment of the others.

    Args:
        network: with all observations.
        layout: as adjusted.
        state: as adjusted.
        excluded: what was left out.
        reduced: reduced equations of the adjustment.
        cofactor: of the columns, shape (c, c).
        sigma0: a posteriori standard deviation of unit weight.
        limit: in standard deviations of the difference between observed and predicted.

    Returns:
        Those whose differences are all below the limit.
    """
    weight = np.where(excluded.image, 1.0, 0.0)
    behind = np.zeros(len(weight), dtype=bool)
    try:
        rows = equations(network, layout, state, weight)
    except BehindCameraError as error:
        behind[error.image_points] = True
        rows = equations(network, layout, state, np.where(behind, 0.0, weight))
    own = np.flatnonzero(excluded.rows(rows))
    spread = 1.0 + observation_cofactors(rows, own[:, None], reduced, cofactor)[:, 0, 0]
    fits = np.abs(rows.misclosure[own]) < limit * sigma0 * np.sqrt(spread)
    found = nothing_excluded(network)
    poor = np.zeros(len(weight), dtype=bool)
    of_images = rows.group[own] < 2
    found.image[rows.source[own[of_images]]] = True
    poor[rows.source[own[of_images & ~fits]]] = True
    found.image[poor] = False
    for flags, groups in zip(found._tables()[1:], _GROUPS_OF, strict=True):
        good = own[fits & np.isin(rows.group[own], groups)]
        flags[rows.source[good], rows.axis[good]] = True
    return found


def names_of(network: Network, excluded: Excluded) -> tuple[str, ...]:
    """Names of observations other than image points that were left out.

    Args:
        network: its tables.
        excluded: what was left out.

    Returns:
        A name for each, such as "control point P7 X".
    """
    tables = zip(excluded._tables()[1:], _GROUPS_OF, strict=True)
    return tuple(
        observation_name(network, groups[0], k, axis)
        for flags, groups in tables
        for k, axis in _where(flags)
    )


def observation_name(network: Network, group: int, source: int, axis: int) -> str:
    """Name of an observation in messages.

    Args:
        network: its tables.
        group: index of the kind of observation in `equations.GROUPS`.
        source: row of its table.
        axis: its coordinate, 0 to 2.

    Returns:
        Such as "control point P7 X".
    """
    points = network.points.names
    if group < 2:
        table = network.image_points
        image = network.images.names[table.image[source]]
        return f"{'xy'[axis]} of {points[table.point[source]]} in {image}"
    if group in _GROUPS_OF[0]:
        return f"control point {points[source]} {_AXES[axis]}"
    if group in _GROUPS_OF[1]:
        station = network.stations.names[network.gnss.station[source]]
        return f"GNSS position of {station} {_AXES[axis]}"
    if group in _GROUPS_OF[2]:
        attitude = network.measured_attitudes.attitude[source]
        return f"attitude of {network.attitudes.names[attitude]} {_ROTATIONS[axis]}"
    distances = network.distances
    ends = (points[distances.point_a[source]], points[distances.point_b[source]])
    return f"distance {ends[0]} to {ends[1]}"


def _where(flags: Flags) -> list[tuple[int, int]]:
    return [(int(k), int(axis)) for k, axis in np.argwhere(flags)]


def _largest_of_lines(
    network: Network, rows: Equations, chosen: Indices, size: Array, redundancy_number: Array
) -> Indices:
    """Without GNSS positions that another of their line surpasses: they share shift and drift.

    With one redundant position the tests of a line are equal; the best controlled goes.
    """
    line = np.full(len(chosen), -1, dtype=np.int64)
    own = np.isin(rows.group[chosen], _GROUPS_OF[1])
    line[own] = network.gnss.line[rows.source[chosen[own]]]
    with_share = np.round(size[chosen], _EQUAL_DECIMALS), redundancy_number[chosen]
    first = np.lexsort((-with_share[1], -with_share[0], line))
    _, begin = np.unique(line[first], return_index=True)
    largest = np.isin(np.arange(len(chosen)), first[begin])
    return chosen[(line < 0) | largest]


class _Largest:
    """The largest test of observations other than image points, by object point and by image."""

    def __init__(self, network: Network, rows: Equations, other: Indices, size: Array) -> None:
        self._network, self._group = network, rows.group[other]
        self._source = rows.source[other]
        self._size = size
        table, images = network.image_points, network.images
        self.of_point = np.zeros(len(network.points.names))
        self.of_image = np.zeros(len(images.names))
        control, gnss, attitude, distance = (np.isin(self._group, g) for g in _GROUPS_OF)
        np.maximum.at(self.of_point, self._source[control], size[control])
        np.maximum.at(self.of_image, table.image, self.of_point[table.point])
        for ends in (network.distances.point_a, network.distances.point_b):
            np.maximum.at(self.of_point, ends[self._source[distance]], size[distance])
        station = np.zeros(len(network.stations.names))
        np.maximum.at(station, network.gnss.station[self._source[gnss]], size[gnss])
        rotation = np.zeros(len(network.attitudes.names))
        of = network.measured_attitudes.attitude[self._source[attitude]]
        np.maximum.at(rotation, of, size[attitude])
        for index, value in ((images.station, station), (images.attitude, rotation)):
            self.of_image = np.maximum(self.of_image, value[index])

    def surroundings(self, of_image: Array, of_point: Array) -> Array:
        """The largest of the images and object points of each observation, (other,)."""
        network = self._network
        table, images = network.image_points, network.images
        point = of_point.copy()
        seen = np.zeros(len(of_point))
        np.maximum.at(seen, table.point, of_image[table.image])
        station = np.zeros(len(network.stations.names))
        np.maximum.at(station, images.station, of_image)
        rotation = np.zeros(len(network.attitudes.names))
        np.maximum.at(rotation, images.attitude, of_image)
        control, gnss, attitude, distance = (np.isin(self._group, g) for g in _GROUPS_OF)
        result = np.zeros(len(self._group))
        result[control] = np.maximum(point, seen)[self._source[control]]
        result[gnss] = station[network.gnss.station[self._source[gnss]]]
        of = network.measured_attitudes.attitude[self._source[attitude]]
        result[attitude] = rotation[of]
        ends = (network.distances.point_a, network.distances.point_b)
        result[distance] = np.maximum(*(point[end[self._source[distance]]] for end in ends))
        return result


def _joint_sizes(
    rows: Equations,
    reduced: ReducedEquations,
    cofactor: Cofactor,
    chosen: Indices,
    count: int,
    sigma0: float,
) -> Array:
    """Root of v' Qvv^-1 v over sigma0 of both coordinates of image points, (chosen,).

    Its square is what the sum of squares falls by without the point. Directions that the other
    observations do not control are left out of the inverse.
    """
    if not len(chosen):
        return np.zeros(0)
    row = np.zeros((count, 2), dtype=np.int64)
    for axis in range(2):
        own = np.flatnonzero(rows.group == axis)
        row[rows.source[own], axis] = own
    pairs = row[chosen]
    of_residuals = np.eye(2) - observation_cofactors(rows, pairs, reduced, cofactor)
    values, vectors = np.linalg.eigh(of_residuals)
    along = np.einsum("kij,ki->kj", vectors, rows.misclosure[pairs])
    squares = np.where(values > MIN_REDUNDANCY, along**2 / np.maximum(values, 1e-12), 0.0)
    return np.asarray(np.sqrt(squares.sum(axis=1)) / sigma0)
