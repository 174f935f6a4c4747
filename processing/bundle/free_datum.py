"""Datum of a free network: motions that nothing determines, and inner constraints on some unknowns.

An adjusted free network may be shifted, rotated and scaled without a change of its residuals. The
datum chooses among these; covariances follow it by an S-transformation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing.bundle.network import Network, NetworkError
from processing.bundle.normal_equations import MIN_INFORMATION, ReducedEquations
from processing.bundle.reduced_solution import (
    Cofactor,
    with_product,
)
from processing.bundle.unknowns import ParameterLayout, ParameterValues
from processing.geometry.rotation import rotations_from_vectors

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
FreeDatum = Literal["unknowns", "points", "stations", "all", "dependent"]

_MAX_STEPS: Final = 50
_STEP_CONVERGED: Final = 1e-14
_SCALE_SHARE: Final = 1e-3
"""Of a motion of the block, in m, below which it does not change the scale."""


@dataclass(frozen=True)
class Motions:
    """Shifts, rotations and scale of the whole block that nothing determines.

    Attributes:
        combinations: (d, 7) in terms of three shifts m, three rotations rad and scale, about
            `centre`; orthogonal.
        centre: (3,) m.
        columns: (c, d) changes of the columns.
        points: (points, 3, d) changes of object points, m; zero at infinity.
    """

    combinations: Array
    centre: Array
    columns: Array
    points: Array


def motion_columns(layout: ParameterLayout, state: ParameterValues) -> tuple[Array, Array]:
    """Shifts, rotations and scale of the whole block as corrections of the columns.

    Args:
        layout: columns.
        state: values.

    Returns:
        Shape (7, c): shifts along X, Y, Z, rotations about them, scale; and the centre of the
        stations, shape (3,), about which the block turns.
    """
    motions = np.zeros((7, layout.columns))
    used = layout.station.min(axis=1) >= 0 if layout.station.size else np.zeros(0, dtype=bool)
    centre = state.station[used].mean(axis=0) if used.any() else np.zeros(3)

    def put(row: int, columns: NDArray[np.int64], values: Array) -> None:
        there = columns >= 0
        motions[row, columns[there]] = np.broadcast_to(values, columns.shape)[there]

    for axis in range(3):
        unit = np.eye(3)[axis]
        put(axis, layout.station, unit)
        put(axis, layout.retained_points, unit)
        put(3 + axis, layout.station, np.cross(unit, state.station - centre))
        put(3 + axis, layout.retained_points, np.cross(unit, state.points - centre))
        put(3 + axis, layout.attitude, np.einsum("nji,j->ni", state.attitude, unit))
    put(6, layout.station, state.station - centre)
    put(6, layout.retained_points, state.points - centre)
    put(6, layout.head_offset, state.head_offset)
    return motions, centre


def free_motions(
    layout: ParameterLayout, state: ParameterValues, reduced: ReducedEquations
) -> Motions:
    """Motions of the block that leave all observations as they are.

    Args:
        layout: columns.
        state: values at which the equations were reduced.
        reduced: reduced equations.

    Returns:
        As many as have less information than `MIN_INFORMATION`; combinations of the seven where a
        single control point, say, leaves three rotations about it.
    """
    motions, centre = motion_columns(layout, state)
    scaled = motions * reduced.scale
    length = np.linalg.norm(scaled, axis=1)
    own = length > 0.0
    unit = np.zeros((7, int(own.sum())))
    unit[own, np.arange(int(own.sum()))] = 1.0 / length[own]
    # Orthonormal directions in the scaled space, as combinations of the seven.
    basis, triangle = np.linalg.qr((unit.T @ scaled).T)
    values, vectors = np.linalg.eigh(basis.T @ (reduced.matrix @ basis))
    null = vectors[:, values < MIN_INFORMATION]
    combinations = (unit @ np.linalg.solve(triangle, null)).T
    ground = state.points - centre
    by_point = np.zeros((len(ground), 3, 7))
    by_point[:, :, :3] = np.eye(3)
    for axis in range(3):
        by_point[:, :, 3 + axis] = np.cross(np.eye(3)[axis], ground)
    by_point[:, :, 6] = ground
    return Motions(
        combinations,
        centre,
        (combinations @ motions).T,
        np.einsum("pik,dk->pid", by_point, combinations),
    )


def scaled_directions(motions: Motions, reduced: ReducedEquations) -> Array:
    """Orthonormal directions of the motions in the unknowns multiplied by their scale.

    Args:
        motions: from `free_motions`.
        reduced: reduced equations.

    Returns:
        Shape (c, d).
    """
    return np.asarray(np.linalg.qr(motions.columns * reduced.scale[:, None])[0])


@dataclass(frozen=True)
class DatumFigures:
    """Cofactors in a datum; shapes as in `Adjustment`."""

    cofactor: Cofactor
    point_cofactor: Array
    influence: Array


def state_in_datum(
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    motions: Motions,
    datum: FreeDatum,
    chosen: tuple[str, ...] = (),
) -> ParameterValues:
    """Move a free network to another datum.

    Of chosen object points and stations: the sum of squares of the differences between their
    adjusted and starting coordinates is smallest (inner constraints). `dependent`: one exposure
    keeps its starting position and attitude, and another one coordinate.

    Args:
        network: starting values.
        layout: columns.
        state: in any datum.
        motions: what is free.
        datum: object points, stations, or both; or `dependent`.
        chosen: names as of `in_datum`.

    Returns:
        The same network, moved.

    Raises:
        NetworkError: a name that is not there.

    Source: Meissl (1962); docs/explanation/mathematics/bundle.md#rank-and-free-networks.
    """
    if datum == "dependent":
        return dependent_datum(network, layout, motions, chosen).applied(network, state)
    points, stations = _members(network, layout, datum, chosen)
    return _best_fit(network, state, motions, points, stations)


def in_datum(
    network: Network,
    layout: ParameterLayout,
    figures: DatumFigures,
    reduced: ReducedEquations,
    row_point: NDArray[np.int64],
    motions: Motions,
    datum: FreeDatum,
    chosen: tuple[str, ...] = (),
) -> DatumFigures:
    """Transform cofactors of a free network to another datum.

    Of chosen object points and stations the trace of their covariance is smallest (inner
    constraints). `dependent`: one exposure and a coordinate of another have no variance.

    Args:
        network: starting values.
        layout: columns.
        figures: in any datum.
        reduced: reduced equations of the adjustment, at the values of `state_in_datum`.
        row_point: eliminated point of each row, -1 where there is none, shape (m,).
        motions: what is free.
        datum: object points, stations, or both; or `dependent`.
        chosen: names of those that define it; all of them if empty. Of `dependent` the exposure
            that is held, and the one that keeps a coordinate; the first, and that of the largest
            coordinate relative to it, where they are not given.

    Returns:
        The same in the datum.

    Raises:
        NetworkError: a name that is not there, or coordinates that do not fix the motions.

    Source: Meissl (1962); docs/explanation/mathematics/bundle.md#rank-and-free-networks.
    """
    if datum == "dependent":
        points = np.zeros(0, dtype=np.int64)
        taken = dependent_datum(network, layout, motions, chosen).columns(layout)
    else:
        points, stations = _members(network, layout, datum, chosen)
        taken = layout.station[stations].ravel()
    g_points, g_columns = motions.points[points], motions.columns[taken]
    normal = np.einsum("pid,pie->de", g_points, g_points) + g_columns.T @ g_columns
    d = len(normal)
    scale = np.sqrt(np.clip(np.diag(normal), 1e-300, None))
    values = np.linalg.eigvalsh(normal / scale[:, None] / scale)
    if not len(values) or values[0] < 1e-12:
        raise NetworkError(
            [f"the {datum} of the datum do not fix {d} free motions of the block: choose more"]
        )
    inverse = np.linalg.inv(normal)
    # t = by_columns x + sum of by_point p over the eliminated points of the datum.
    by_columns = np.zeros((d, layout.columns))
    by_columns[:, taken] = inverse @ g_columns.T
    of_retained = layout.retained_points[points]
    by_retained = np.einsum("de,pie->pid", inverse, g_points)[of_retained >= 0]
    by_columns[:, of_retained[of_retained >= 0]] += by_retained.T
    own = layout.eliminated[points] >= 0
    where = layout.eliminated[points[own]]
    factor = reduced.point_factor
    by_point = np.zeros((len(factor), d, 3))
    by_point[where] = np.einsum("de,pie,pij->pdj", inverse, g_points[own], factor[where])
    flat = by_point.transpose(1, 0, 2).reshape(d, -1)
    through = np.zeros((d, layout.columns))
    through[:, reduced.sparse_columns] = (reduced.coupling_sparse.T @ flat.T).T
    through[:, reduced.dense_columns] = flat @ reduced.coupling_dense
    by_reduced = by_columns - through
    with_t = figures.cofactor @ by_reduced.T
    of_t = by_reduced @ with_t + np.einsum("pdj,pej->de", by_point, by_point)
    coupled = reduced.coupling_sparse @ with_t[reduced.sparse_columns]
    coupled = coupled + reduced.coupling_dense @ with_t[reduced.dense_columns]
    point_with_t = np.einsum(
        "pij,pjd->pid", factor, by_point.transpose(0, 2, 1) - coupled.reshape(-1, 3, d)
    )
    columns = motions.columns
    cofactor = with_product(
        figures.cofactor,
        np.hstack([-with_t, -columns, columns @ of_t]),
        np.hstack([columns, with_t, columns]),
    )
    point_cofactor = figures.point_cofactor.copy()
    eliminated = layout.eliminated_points
    g = motions.points[eliminated]
    cross = np.einsum("pid,pjd->pij", point_with_t, g)
    point_cofactor[eliminated] += np.einsum("pid,de,pje->pij", g, of_t, g) - cross
    point_cofactor[eliminated] -= cross.transpose(0, 2, 1)
    retained = (layout.retained_points >= 0).all(axis=1)
    at = layout.retained_points[retained]
    point_cofactor[retained] = cofactor[at[:, :, None], at[:, None, :]]
    there = row_point >= 0
    of = row_point[there]
    row_t = (reduced.design_sparse @ with_t[reduced.sparse_columns])[there]
    row_t = row_t + reduced.design_dense[there] @ with_t[reduced.dense_columns]
    b = reduced.point_rows[there]
    inside = by_point.transpose(0, 2, 1) - coupled.reshape(-1, 3, d)
    row_t = row_t + np.einsum("mj,mjd->md", b, inside[of])
    influence = figures.influence.copy()
    influence[there] -= np.einsum("mid,md->mi", g[of], row_t)
    return DatumFigures(cofactor, point_cofactor, influence)


@dataclass(frozen=True)
class DependentDatum:
    """Dependent relative orientation: a held exposure, and a coordinate of another for the scale.

    Attributes:
        station, attitude: of the held exposure.
        base: station that keeps a coordinate; -1 where the scale is determined.
        axis: that coordinate.
    """

    station: int
    attitude: int
    base: int
    axis: int

    def columns(self, layout: ParameterLayout) -> NDArray[np.int64]:
        """Columns that the datum holds.

        Args:
            layout: columns.

        Returns:
            Six or seven of them.
        """
        held = [*layout.station[self.station], *layout.attitude[self.attitude]]
        if self.base >= 0:
            held.append(layout.station[self.base, self.axis])
        return np.array(held, dtype=np.int64)

    def applied(self, network: Network, state: ParameterValues) -> ParameterValues:
        """The whole block moved so that what is held has its starting values.

        Args:
            network: starting values.
            state: adjusted values in any datum.

        Returns:
            Adjusted values in this datum.
        """
        given, rotation = network.stations.position_m, network.attitudes.rotation[self.attitude]
        turned = rotation @ state.attitude[self.attitude].T
        centre = state.station[self.station]
        scale = 1.0
        if self.base >= 0:
            now = (turned @ (state.station[self.base] - centre))[self.axis]
            scale = float((given[self.base] - given[self.station])[self.axis] / now)
        infinite = network.points.at_infinity[:, None]

        def place(xyz: Array) -> Array:
            return np.asarray(given[self.station] + scale * (xyz - centre) @ turned.T)

        return replace(
            state,
            station=place(state.station),
            attitude=turned @ state.attitude,
            head_offset=scale * state.head_offset,
            points=np.where(infinite, state.points @ turned.T, place(state.points)),
        )


def dependent_datum(
    network: Network, layout: ParameterLayout, motions: Motions, chosen: tuple[str, ...] = ()
) -> DependentDatum:
    """The exposure and the coordinate that a dependent datum holds.

    Args:
        network: starting values.
        layout: columns.
        motions: what is free.
        chosen: names of the held exposure and of the one that keeps a coordinate; where they are
            not given the first free exposure, and that with the largest coordinate relative to it.

    Returns:
        The datum.

    Raises:
        NetworkError: names that are no free exposures, or observations that fix part of the
            position and orientation.

    Source: the option `depend` of the Damped Bundle Adjustment Toolbox.
    """
    names = network.stations.names
    free = np.asarray((layout.station >= 0).all(axis=1))
    at = {name: k for k, name in enumerate(names) if free[k]}
    foreign = [name for name in chosen if name not in at]
    if foreign or len(chosen) > 2 or len(set(chosen)) < len(chosen):
        raise NetworkError(
            [
                f"the dependent datum names {', '.join(chosen[:5])}; the names of one or two free "
                "exposures are right"
            ]
        )
    size = float(np.sqrt(np.mean((network.stations.position_m - motions.centre) ** 2)))
    moved = np.abs(motions.combinations) * np.array([1.0, 1.0, 1.0, size, size, size, size])
    has_scale = bool((moved[:, 6] > _SCALE_SHARE * moved.sum(axis=1)).any())
    station = at[chosen[0]] if chosen else int(np.flatnonzero(free)[0]) if free.any() else -1
    of_image = np.flatnonzero(network.images.station == station)
    attitude = int(network.images.attitude[of_image[0]]) if len(of_image) else -1
    held = attitude >= 0 and bool((layout.attitude[attitude] >= 0).all())
    if not held or len(motions.combinations) != 6 + has_scale:
        raise NetworkError(
            [
                "a dependent datum needs a block of which nothing fixes position and orientation, "
                "and an exposure with an attitude of its own; free_datum = stations fits others"
            ]
        )
    if not has_scale:
        return DependentDatum(station, attitude, -1, 0)
    offset = network.stations.position_m - network.stations.position_m[station]
    offset[~free] = 0.0
    if len(chosen) == 2:
        base = at[chosen[1]]
        return DependentDatum(station, attitude, base, int(np.argmax(np.abs(offset[base]))))
    largest = offset if (offset > 0.0).any() else np.abs(offset)
    return DependentDatum(station, attitude, *divmod(int(np.argmax(largest)), 3))


def _members(
    network: Network, layout: ParameterLayout, datum: FreeDatum, chosen: tuple[str, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Object points and stations of the datum, by index."""
    adjusted = (layout.eliminated >= 0) | (layout.retained_points >= 0).all(axis=1)
    adjusted &= ~layout.locked.any(axis=1) & ~network.points.at_infinity
    free = (layout.station >= 0).all(axis=1)
    names = set(chosen)
    taken_points, taken_stations = np.zeros_like(adjusted), np.zeros_like(free)
    if datum in ("points", "all"):
        taken_points = adjusted & _named(network.points.names, names)
    if datum in ("stations", "all"):
        taken_stations = free & _named(network.stations.names, names)
    known = {
        "points": {*network.points.names},
        "stations": {*network.stations.names},
    }
    missing = sorted(names - known["points"] - known["stations"])
    if missing:
        raise NetworkError([f"the datum names {', '.join(missing[:5])}, which are not there"])
    other = sorted(names - known[datum]) if datum in known else []
    if other:
        raise NetworkError(
            [
                f"the datum is of {datum} and names {', '.join(other[:5])}, which are none; "
                "free_datum = all takes points and stations"
            ]
        )
    return np.flatnonzero(taken_points), np.flatnonzero(taken_stations)


def _named(names: tuple[str, ...], chosen: set[str]) -> Flags:
    if not chosen:
        return np.ones(len(names), dtype=bool)
    return np.array([name in chosen for name in names], dtype=bool)


def _best_fit(
    network: Network,
    state: ParameterValues,
    motions: Motions,
    points: NDArray[np.int64],
    stations: NDArray[np.int64],
) -> ParameterValues:
    """The state moved so that the coordinates of the datum fit their starting values best."""
    target = np.concatenate([network.points.xyz_m[points], network.stations.position_m[stations]])
    for _ in range(_MAX_STEPS):
        now = np.concatenate([state.points[points], state.station[stations]])
        about = now - motions.centre
        by_motion = np.zeros((len(now), 3, 7))
        by_motion[:, :, :3] = np.eye(3)
        for axis in range(3):
            by_motion[:, :, 3 + axis] = np.cross(np.eye(3)[axis], about)
        by_motion[:, :, 6] = about
        design = np.einsum("pik,dk->pid", by_motion, motions.combinations).reshape(3 * len(now), -1)
        step = np.linalg.lstsq(design, (target - now).ravel(), rcond=None)[0]
        seven = step @ motions.combinations
        state = _moved(network, state, motions.centre, seven)
        size = max(float(np.abs(about).max(initial=1.0)), 1.0)
        if np.abs(design @ step).max(initial=0.0) <= _STEP_CONVERGED * size:
            break
    return state


def _moved(
    network: Network, state: ParameterValues, centre: Array, seven: Array
) -> ParameterValues:
    rotation = rotations_from_vectors(seven[3:6][None])[0]
    scale = float(np.exp(seven[6]))

    def place(xyz: Array) -> Array:
        return np.asarray(centre + seven[:3] + scale * (xyz - centre) @ rotation.T)

    infinite = network.points.at_infinity[:, None]
    return replace(
        state,
        station=place(state.station),
        attitude=rotation @ state.attitude,
        head_offset=scale * state.head_offset,
        points=np.where(infinite, state.points @ rotation.T, place(state.points)),
    )
