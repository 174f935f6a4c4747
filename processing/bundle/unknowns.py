"""Unknowns of a network: names, columns, current values, and how corrections are applied.

The unknowns of most object points are eliminated and have no column; those that distances tie to
each other keep theirs. Everything held has column -1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.bundle.block_order import LOCAL_KINDS, BlockOrder, block_order
from processing.bundle.network import INTERIOR, LinearConstraint, Network, NetworkError
from processing.geometry.rotation import rotations_from_vectors

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Unknown(NamedTuple):
    """One column: kind, owner and component of an unknown."""

    kind: str
    owner: str
    component: str

    @property
    def name(self) -> str:
        """Name in constraints and messages: kind, owner, component."""
        return f"{self.kind} {self.owner} {self.component}"


@dataclass(frozen=True)
class ParameterLayout:
    """Columns of the unknowns; -1 is held.

    Attributes:
        station, attitude: (n, 3).
        head_rotation, head_offset: (heads, 3).
        head_delay, readout: (heads,).
        jitter: (images,).
        pattern: (images, k) amplitudes of patterns of stitching, k that of the image with most.
        interior: (cameras, 10).
        terms: (t,) per camera.
        shift, drift: (lines, 3).
        retained_points: (points, 3), points with columns of their own.
        eliminated: (points,) position among the eliminated points, -1 for others.
        locked: (points, 3) coordinates that are held.
        unknowns: what each column is.
        constraints: (c, columns) rows; corrections summed over all iterations obey them.
        order: places of the columns of a large block; None: the reduced matrix is dense.
    """

    station: Indices
    attitude: Indices
    head_rotation: Indices
    head_offset: Indices
    head_delay: Indices
    readout: Indices
    jitter: Indices
    pattern: Indices
    interior: Indices
    terms: tuple[Indices, ...]
    shift: Indices
    drift: Indices
    retained_points: Indices
    eliminated: Indices
    locked: NDArray[np.bool_]
    unknowns: tuple[Unknown, ...]
    constraints: Array
    order: BlockOrder | None = None

    @property
    def columns(self) -> int:
        """Number of columns."""
        return len(self.unknowns)

    @property
    def eliminated_points(self) -> Indices:
        """Object points in the order of their elimination."""
        return np.flatnonzero(self.eliminated >= 0)


@dataclass(frozen=True)
class ParameterValues:
    """Current values of everything that may be unknown; shapes as in the network."""

    station: Array
    attitude: Array
    head_rotation: Array
    head_offset: Array
    head_delay: Array
    readout: Array
    jitter: Array
    pattern: Array
    interior: Array
    terms: tuple[Array, ...]
    shift: Array
    drift: Array
    points: Array


def initial_values(network: Network) -> ParameterValues:
    """The values the network was given with.

    Args:
        network: starting values.

    Returns:
        Copies of them; shifts and drifts of lines, jitter and amplitudes of patterns are
        zero.
    """
    heads = network.heads
    lines = len(network.gnss.lines)
    return ParameterValues(
        station=network.stations.position_m.copy(),
        attitude=network.attitudes.rotation.copy(),
        head_rotation=np.array([h.rotation for h in heads]).reshape(-1, 3, 3),
        head_offset=np.array([h.offset_m for h in heads]).reshape(-1, 3),
        head_delay=np.array([h.timing.delay_s for h in heads], dtype=np.float64),
        readout=np.array([h.timing.readout_s for h in heads], dtype=np.float64),
        jitter=np.zeros(len(network.images.names)),
        pattern=np.zeros((len(network.images.names), _pattern_count(network))),
        interior=np.array([c.interior for c in network.cameras], dtype=np.float64),
        terms=tuple(np.array([t.value for t in c.terms]) for c in network.cameras),
        shift=np.zeros((lines, 3)),
        drift=np.zeros((lines, 3)),
        points=network.points.xyz_m.copy(),
    )


def layout_of(
    network: Network, left_out: NDArray[np.bool_], retained: Sequence[str] = ()
) -> ParameterLayout:
    """Assign a column to every unknown.

    Args:
        network: what is estimated and what is held.
        left_out: object points that are not adjusted, shape (points,).
        retained: names of object points that have columns although no distance ties them.

    Returns:
        Columns of stations, attitudes, heads, images, cameras, lines and tied points, in this
        order.

    Raises:
        NetworkError: a constraint or a name of a retained point that is not there.
    """
    columns: list[Unknown] = []

    def take(free: bool, kind: str, owner: str, components: tuple[str, ...]) -> list[int]:
        if not free:
            return [-1] * len(components)
        first = len(columns)
        columns.extend(Unknown(kind, owner, component) for component in components)
        return list(range(first, first + len(components)))

    xyz = ("X", "Y", "Z")
    used_stations, used_attitudes = _used(network)
    station = [
        take(not held and used, "station", name, xyz)
        for name, held, used in zip(
            network.stations.names, network.stations.fixed, used_stations, strict=True
        )
    ]
    attitude = [
        take(not held and used, "attitude", name, ("about x", "about y", "about z"))
        for name, held, used in zip(
            network.attitudes.names, network.attitudes.fixed, used_attitudes, strict=True
        )
    ]
    head_rotation = [
        take(h.rotation_free, "head rotation", h.name, ("about x", "about y", "about z"))
        for h in network.heads
    ]
    head_offset = [take(h.offset_free, "head offset", h.name, xyz) for h in network.heads]
    timings = [(h.name, h.timing) for h in network.heads]
    delay = [take(t.delay_free, "head", name, ("delay",)) for name, t in timings]
    readout = [take(t.readout_free, "head", name, ("readout time",)) for name, t in timings]
    has_points = np.zeros(len(network.images.names), dtype=bool)
    has_points[network.image_points.image] = True
    jitter = [
        take(
            bool(used) and head >= 0 and timings[head][1].jitter_sigma_s is not None,
            "image",
            name,
            ("jitter",),
        )
        for name, head, used in zip(
            network.images.names, network.images.head, has_points, strict=True
        )
    ]
    most = _pattern_count(network)
    pattern = []
    for k, name in enumerate(network.images.names):
        own = network.patterns[k] if network.patterns and has_points[k] else None
        count = 0 if own is None else own.count
        named = tuple(f"pattern {number + 1}" for number in range(count))
        pattern.append(take(True, "image", name, named) + [-1] * (most - count))
    interior, terms = [], []
    for camera in network.cameras:
        interior.append(
            [take(name in camera.free, "camera", camera.name, (name,))[0] for name in INTERIOR]
        )
        terms.append(
            np.array(
                [take(True, "camera", camera.name, (t.name,))[0] for t in camera.terms],
                dtype=np.int64,
            )
        )
    lines = network.gnss.lines
    shift = [take(network.gnss.drift != "none", "GNSS shift", line, xyz) for line in lines]
    drift = [take(network.gnss.drift == "linear", "GNSS drift", line, xyz) for line in lines]
    locked = network.points.sigma_m == 0.0
    retained_points = np.full((len(network.points.names), 3), -1, dtype=np.int64)
    ends = np.stack([network.distances.point_a, network.distances.point_b], axis=1)
    tied = np.union1d(ends[~left_out[ends].any(axis=1)], _retained(network, left_out, retained))
    for point in tied:
        for axis in range(3):
            if not locked[point, axis]:
                retained_points[point, axis] = len(columns)
                columns.append(Unknown("point", network.points.names[point], xyz[axis]))
    eliminated = np.full(len(locked), -1, dtype=np.int64)
    free = ~left_out
    free[tied] = False
    eliminated[free] = np.arange(int(free.sum()))
    return ParameterLayout(
        station=_table(station, 3),
        attitude=_table(attitude, 3),
        head_rotation=_table(head_rotation, 3),
        head_offset=_table(head_offset, 3),
        head_delay=_table(delay, 1)[:, 0],
        readout=_table(readout, 1)[:, 0],
        jitter=_table(jitter, 1)[:, 0],
        pattern=np.array(pattern, dtype=np.int64).reshape(len(network.images.names), most),
        interior=_table(interior, 10),
        terms=tuple(terms),
        shift=_table(shift, 3),
        drift=_table(drift, 3),
        retained_points=retained_points,
        eliminated=eliminated,
        locked=locked,
        unknowns=tuple(columns),
        constraints=_constraints(network, columns),
    )


def in_blocks(network: Network, layout: ParameterLayout) -> ParameterLayout:
    """The layout with an order in which the reduced matrix has blocks near its diagonal.

    Args:
        network: which image sees which object point.
        layout: columns.

    Returns:
        The same columns, with `order`.

    Raises:
        NetworkError: there is no such order that fits into memory.
    """
    local = np.array([u.kind in LOCAL_KINDS for u in layout.unknowns], dtype=bool)
    tied = ~local | (layout.constraints != 0.0).any(axis=0)
    of_images = np.column_stack([layout.jitter, layout.pattern])
    order = block_order(network, layout.station, layout.attitude, of_images, layout.columns, tied)
    return replace(layout, order=order)


def apply_corrections(
    state: ParameterValues, layout: ParameterLayout, dx: Array, dpoints: Array
) -> ParameterValues:
    """The state with corrections applied.

    Args:
        state: current values; it is not changed.
        layout: columns of the corrections.
        dx: corrections of the columns, shape (columns,); rotations as vectors about the camera's
            or rig's own axes, rad.
        dpoints: corrections of the eliminated points, shape (p, 3), m.

    Returns:
        The corrected values.
    """

    def part(columns: Indices) -> Array:
        return (
            np.where(columns >= 0, dx[np.clip(columns, 0, None)], 0.0)
            if dx.size
            else (np.zeros(columns.shape))
        )

    points = state.points + part(layout.retained_points)
    points[layout.eliminated_points] += dpoints
    return replace(
        state,
        station=state.station + part(layout.station),
        attitude=state.attitude @ rotations_from_vectors(part(layout.attitude)),
        head_rotation=state.head_rotation @ rotations_from_vectors(part(layout.head_rotation)),
        head_offset=state.head_offset + part(layout.head_offset),
        head_delay=state.head_delay + part(layout.head_delay),
        readout=state.readout + part(layout.readout),
        jitter=state.jitter + part(layout.jitter),
        pattern=state.pattern + part(layout.pattern),
        interior=state.interior + part(layout.interior),
        terms=tuple(v + part(c) for v, c in zip(state.terms, layout.terms, strict=True)),
        shift=state.shift + part(layout.shift),
        drift=state.drift + part(layout.drift),
        points=points,
    )


def _used(network: Network) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Stations and attitudes that some observation touches."""
    seen = np.unique(network.image_points.image)
    station = np.zeros(len(network.stations.names), dtype=bool)
    attitude = np.zeros(len(network.attitudes.names), dtype=bool)
    station[network.images.station[seen]] = True
    attitude[network.images.attitude[seen]] = True
    station[network.gnss.station] = True
    attitude[network.measured_attitudes.attitude] = True
    return station, attitude


def _pattern_count(network: Network) -> int:
    return max((own.count for own in network.patterns if own is not None), default=0)


def _retained(network: Network, left_out: NDArray[np.bool_], names: Sequence[str]) -> Indices:
    """Object points of those names that are adjusted."""
    if not names:
        return np.zeros(0, dtype=np.int64)
    at = {name: k for k, name in enumerate(network.points.names)}
    foreign = [n for n in names if n not in at or network.points.at_infinity[at[n]]]
    if foreign:
        raise NetworkError(
            [f"covariances of {', '.join(foreign[:5])}: no object points at finite distance"]
        )
    found = np.array(sorted({at[name] for name in names}), dtype=np.int64)
    return found[~left_out[found]]


def _table(rows: list[list[int]], width: int) -> Indices:
    return np.array(rows, dtype=np.int64).reshape(-1, width)


def _constraints(network: Network, columns: list[Unknown]) -> Array:
    at = {unknown.name: index for index, unknown in enumerate(columns)}
    wanted = list(network.constraints)
    for camera in network.cameras:
        wanted += [
            LinearConstraint({f"camera {camera.name} {name}": 1.0 for name in gauge})
            for gauge in camera.gauges
        ]
    rows = np.zeros((len(wanted), len(columns)))
    for row, constraint in zip(rows, wanted, strict=True):
        for name, coefficient in constraint.coefficients.items():
            if name not in at:
                raise NetworkError(
                    [f"a constraint names {name!r}, which is not an unknown of this network"]
                )
            row[at[name]] = coefficient
    return rows
