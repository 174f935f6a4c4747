"""Observation equations of a network: misclosures and analytic derivatives, whitened.

Every row is divided by its standard deviation, so that normal equations are plain products. Rows
hold entries of columns (`reduced`) and of at most one eliminated object point (`point_part`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from processing import ProcessingError
from processing.bundle.camera_model import (
    ideal_mm,
    interior_derivatives,
    measured_by_ideal,
    principal_distance_mm,
    term_derivatives,
)
from processing.bundle.curvature_refraction import corrected_rays
from processing.bundle.exposure_motion import RowMotion, row_motion, time_columns
from processing.bundle.network import INTERIOR, Network
from processing.bundle.unknowns import ParameterLayout, ParameterValues
from processing.geometry.rotation import skew, vectors_from_rotations

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


_ROWS_AT_ONCE = 50_000


class BehindCameraError(ProcessingError, ValueError):
    """Object points are behind the camera that saw them: starting values are far off."""

    def __init__(self, image_points: Indices) -> None:
        self.image_points = image_points
        super().__init__(f"{len(image_points)} image points see an object point behind the camera")


@dataclass(frozen=True)
class Equations:
    """m whitened rows: misclosure + v = design @ corrections.

    Attributes:
        misclosure: (m,) observed less computed.
        reduced: (m, columns), sparse.
        point_part: (m, 3) derivatives by the eliminated point's coordinates, zero where held.
        point: (m,) its position among the eliminated, -1 where there is none.
        sigma: (m,) standard deviation a row was divided by (robust weights are not in it).
        group: (m,) index into `groups`.
        groups: kinds of observations.
        source: (m,) row of the table the observation comes from (image points, ...).
        axis: (m,) coordinate of that row, 0 to 2.
    """

    misclosure: Array
    reduced: sparse.csr_array
    point_part: Array
    point: Indices
    sigma: Array
    group: Indices
    groups: tuple[str, ...]
    source: Indices
    axis: Indices


GROUPS = (
    "image x",
    "image y",
    "control plan",
    "control height",
    "GNSS plan",
    "GNSS height",
    "attitude",
    "distance",
    "prior",
    "jitter",
    "pattern",
)


def equations(
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    weight: Array,
    *,
    derivatives: bool = True,
) -> Equations:
    """All rows at the current state.

    Args:
        network: observations.
        layout: columns.
        state: current values.
        weight: factor on the weight of each image point, shape (image points,); zero leaves it
            out.
        derivatives: without them `reduced` and `point_part` are zero.

    Returns:
        Whitened rows, image points first.

    Raises:
        BehindCameraError: an object point is not in front of a camera that saw it.

    Source: docs/explanation/mathematics/bundle.md#collinearity and #other-observations.
    """
    build = _Builder(layout, derivatives)
    _image_rows(build, network, layout, state, weight)
    _control_rows(build, network, layout, state)
    _gnss_rows(build, network, layout, state)
    _attitude_rows(build, network, layout, state)
    _distance_rows(build, network, layout, state)
    _prior_rows(build, network, layout, state)
    return build.equations()


class _Builder:
    def __init__(self, layout: ParameterLayout, derivatives: bool) -> None:
        self.layout = layout
        self.derivatives = derivatives
        self.count = 0
        self._entries: list[NDArray[np.int32]] = []
        self._columns: list[NDArray[np.int32]] = []
        self._values: list[Array] = []
        self._tables: tuple[list[Any], ...] = tuple([] for _ in range(7))

    def add(
        self,
        misclosure: Array,
        sigma: Array,
        group: Indices,
        source: Indices,
        entries: list[tuple[Indices, Array]],
        *,
        point: Indices | None = None,
        point_part: Array | None = None,
        weight: Array | None = None,
        axis: int = 0,
    ) -> None:
        """Append rows (n,); entries are (columns (n, k), values (n, k)).

        An observation with an infinite sigma has no row.
        """
        taken = np.isfinite(sigma)
        n = int(taken.sum())
        sigma = sigma[taken]
        factor = 1.0 / sigma if weight is None else np.sqrt(weight[taken]) / sigma
        part = np.zeros((n, 3)) if point_part is None else point_part[taken] * factor[:, None]
        who = np.full(n, -1, dtype=np.int64) if point is None else point[taken]
        of_axis = np.full(n, axis, dtype=np.int64)
        tables = (
            misclosure[taken] * factor,
            sigma,
            group[taken],
            part,
            who,
            source[taken],
            of_axis,
        )
        for table, value in zip(self._tables, tables, strict=True):
            table.append(value)
        if self.derivatives:
            # Nothing of what is held is copied.
            free = [entry for entry in entries if entry[0].size and entry[0].max() >= 0]
            none = (np.zeros((len(taken), 0), dtype=np.int32), np.zeros((len(taken), 0)))
            columns = np.hstack([none[0], *(c.astype(np.int32) for c, _ in free)])[taken]
            values = np.hstack([none[1], *(v for _, v in free)])[taken] * factor[:, None]
            there = columns >= 0
            self._entries.append(there.sum(axis=1, dtype=np.int32))
            self._columns.append(columns[there])
            self._values.append(values[there])
        self.count += n

    def equations(self) -> Equations:
        joined = [np.concatenate(part) for part in self._tables]
        shape = (self.count, self.layout.columns)
        if self._entries:
            begin = np.concatenate([[0], np.cumsum(np.concatenate(self._entries))])
            content = np.concatenate(self._values), np.concatenate(self._columns)
            reduced = sparse.csr_array((*content, begin.astype(np.int32)), shape=shape)
        else:
            reduced = sparse.csr_array(shape)
        misclosure, sigma, group, part, point, source, axis = joined
        return Equations(misclosure, reduced, part, point, sigma, group, GROUPS, source, axis)


def _image_rows(
    build: _Builder,
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    weight: Array,
) -> None:
    measured, images = network.image_points, network.images
    part = layout.eliminated[measured.point]
    takes_part = (part >= 0) | (layout.retained_points[measured.point] >= 0).any(axis=1)
    takes_part |= layout.locked[measured.point].all(axis=1)
    behind: list[Indices] = []
    for index in range(len(network.cameras)):
        of_camera = np.flatnonzero(
            (images.camera[measured.image] == index) & (weight > 0.0) & takes_part
        )
        # In parts: what is computed on the way is larger than the rows.
        for low in range(0, len(of_camera), _ROWS_AT_ONCE):
            rows = of_camera[low : low + _ROWS_AT_ONCE]
            behind.append(_camera_rows(build, network, layout, state, weight, index, rows))
    if any(len(part) for part in behind):
        raise BehindCameraError(np.concatenate(behind))


def _camera_rows(
    build: _Builder,
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    weight: Array,
    index: int,
    rows: Indices,
) -> Indices:
    """Rows of image points of one camera; those whose object point is behind it, and then none."""
    measured, images, camera = network.image_points, network.images, network.cameras[index]
    part = layout.eliminated[measured.point]
    image, point = measured.image[rows], measured.point[rows]
    station, attitude, head = images.station[image], images.attitude[image], images.head[image]
    object_from_rig = state.attitude[attitude]
    place = state.station[station]
    motion = row_motion(network, state, image, measured.xy_mm[rows, 1])
    if motion is not None:
        place = place + motion.shift_m
    scale = np.where(network.points.at_infinity[point], 0.0, 1.0)
    ray = state.points[point] - scale[:, None] * place
    is_straight = network.rays.is_straight
    if not is_straight:
        ray, ray_by_point, ray_by_station = corrected_rays(ray, place[:, 2], network.rays)
    in_rig = at_exposure = np.einsum("nji,nj->ni", object_from_rig, ray)
    if motion is not None:
        in_rig = np.einsum("nji,nj->ni", motion.rotation, at_exposure)
    rig_from_camera = np.broadcast_to(np.eye(3), (len(rows), 3, 3)).copy()
    offset = np.zeros((len(rows), 3))
    mounted = head >= 0
    rig_from_camera[mounted] = state.head_rotation[head[mounted]]
    offset[mounted] = state.head_offset[head[mounted]]
    seen = np.einsum("nji,nj->ni", rig_from_camera, in_rig - scale[:, None] * offset)
    if (seen[:, 2] >= 0.0).any():
        return np.asarray(rows[seen[:, 2] >= 0.0])
    interior = state.interior[index]
    c = principal_distance_mm(camera, interior)
    projected = -c * seen[:, :2] / seen[:, 2:]
    measured_mm = measured.xy_mm[rows]
    misclosure = ideal_mm(camera, interior, state.terms[index], measured_mm) - projected
    patterns = _pattern_design(network, image, measured_mm) if network.patterns else None
    if patterns is not None:
        misclosure = misclosure - np.einsum("nak,nk->na", patterns, state.pattern[image])
    to_measured = measured_by_ideal(camera, interior, measured_mm)
    if to_measured is not None:
        misclosure = np.einsum("nij,nj->ni", to_measured, misclosure)
    entries: list[tuple[Indices, Array]] = []
    by_point = np.zeros((len(rows), 2, 3))
    if build.derivatives:
        by_seen = np.zeros((len(rows), 2, 3))
        by_seen[:, 0, 0] = by_seen[:, 1, 1] = -c / seen[:, 2]
        by_seen[:, :, 2] = -projected / seen[:, 2:]
        by_rig = np.einsum("nij,nkj->nik", by_seen, rig_from_camera)
        by_exposure = by_rig
        if motion is not None:
            by_exposure = np.einsum("nij,nkj->nik", by_rig, motion.rotation)
        by_point = np.einsum("nij,nkj->nik", by_exposure, object_from_rig)
        by_station = -by_point * scale[:, None, None]
        if not is_straight:
            by_point, by_station = by_point @ ray_by_point, by_point @ ray_by_station
        blocks = [
            (layout.station[station], by_station),
            (layout.attitude[attitude], by_exposure @ skew(at_exposure)),
            (layout.retained_points[point], by_point),
        ]
        if (layout.interior[index] >= 0).any():
            by_interior = -interior_derivatives(camera, interior, state.terms[index], measured_mm)
            if camera.model == "centred":
                by_interior[:, :, 2] = -projected / c
            elif camera.model != "australis":
                by_interior[:, :, 2] -= projected / c
            columns = np.broadcast_to(layout.interior[index], (len(rows), 10))
            blocks.append((columns, by_interior))
        if camera.terms:
            columns = np.broadcast_to(layout.terms[index], (len(rows), len(camera.terms)))
            by_term = -term_derivatives(camera, interior, state.terms[index], measured_mm)
            blocks += _active(columns, by_term)
        if patterns is not None:
            blocks.append((layout.pattern[image], patterns))
        if mounted.any():
            blocks += [
                (_where(layout.head_rotation, head), by_seen @ skew(seen)),
                (_where(layout.head_offset, head), -by_rig * scale[:, None, None]),
            ]
        if motion is not None:
            by_time = _by_time(motion, in_rig, by_rig, by_station)
            blocks += time_columns(layout, network, image, by_time, motion.by_readout)
        blocks = [(columns, values.reshape(len(rows), 2, -1)) for columns, values in blocks]
        if to_measured is not None:
            blocks = [(columns, to_measured @ values) for columns, values in blocks]
            by_point = to_measured @ by_point
        entries = blocks
    locked = layout.locked[point]
    for axis in range(2):
        build.add(
            misclosure[:, axis],
            measured.sigma_mm[rows, axis],
            np.full(len(rows), axis),
            rows,
            [(columns, values[:, axis]) for columns, values in entries],
            point=part[rows],
            point_part=np.where(locked | (part[rows] < 0)[:, None], 0.0, by_point[:, axis]),
            weight=weight[rows],
            axis=axis,
        )
    return rows[:0]


def _pattern_design(network: Network, image: Indices, xy_mm: Array) -> Array:
    """Displacements of image points by amplitudes of one, (n, 2, k)."""
    most = max((own.count for own in network.patterns if own is not None), default=0)
    result = np.zeros((len(image), 2, most))
    for k in np.unique(image):
        own = network.patterns[k]
        if own is not None and own.count:
            rows = image == k
            result[rows, :, : own.count] = own.at(xy_mm[rows])
    return result


def _by_time(motion: RowMotion, in_rig: Array, by_rig: Array, by_station: Array) -> Array:
    """d(projected) / d(instant of the row), (n, 2), mm/s."""
    turned = np.cross(in_rig, motion.rate_rad_per_s)
    by_rotation = np.einsum("nij,nj->ni", by_rig, turned)
    return np.asarray(by_rotation + np.einsum("nij,nj->ni", by_station, motion.velocity_mps))


def _active(columns: Indices, by_term: Array) -> list[tuple[Indices, Array]]:
    """Terms act on parts of the image: columns of -1 where an entry is zero."""
    active = (by_term != 0.0).any(axis=1)
    return [(np.where(active, columns, -1), by_term)]


def _where(table: Indices, index: Indices) -> Indices:
    return np.where((index >= 0)[:, None], table[np.clip(index, 0, None)], -1)


def _control_rows(
    build: _Builder, network: Network, layout: ParameterLayout, state: ParameterValues
) -> None:
    sigma = network.points.sigma_m
    part = layout.eliminated
    for axis in range(3):
        known = np.isfinite(sigma[:, axis]) & (sigma[:, axis] > 0.0)
        rows = np.flatnonzero(known & ((part >= 0) | (layout.retained_points[:, axis] >= 0)))
        if not rows.size:
            continue
        unit = np.zeros((len(rows), 3))
        unit[part[rows] >= 0, axis] = 1.0
        build.add(
            network.points.xyz_m[rows, axis] - state.points[rows, axis],
            sigma[rows, axis],
            np.full(len(rows), 2 if axis < 2 else 3),
            rows,
            [(layout.retained_points[rows, axis][:, None], np.ones((len(rows), 1)))],
            point=part[rows],
            point_part=unit,
            axis=axis,
        )


def _gnss_rows(
    build: _Builder, network: Network, layout: ParameterLayout, state: ParameterValues
) -> None:
    gnss = network.gnss
    n = len(gnss.station)
    if not n:
        return
    rows = np.arange(n)
    lever = np.einsum("nij,nj->ni", state.attitude[gnss.attitude], gnss.lever_m)
    since = _seconds_from_mean(network)
    on_line = gnss.line >= 0
    computed = state.station[gnss.station] + lever
    if len(gnss.lines):
        line = np.clip(gnss.line, 0, None)
        bias = state.shift[line] + state.drift[line] * since[:, None]
        computed = computed + np.where(on_line[:, None], bias, 0.0)
    rotated = -np.einsum("nij,njk->nik", state.attitude[gnss.attitude], skew(gnss.lever_m))
    for axis in range(3):
        entries = [
            (layout.station[gnss.station, axis][:, None], np.ones((n, 1))),
            (
                np.where(
                    (gnss.lever_m != 0.0).any(axis=1)[:, None], layout.attitude[gnss.attitude], -1
                ),
                rotated[:, axis],
            ),
        ]
        if len(gnss.lines):
            shift = _where(layout.shift, gnss.line)[:, axis][:, None]
            drift = _where(layout.drift, gnss.line)[:, axis][:, None]
            entries += [(shift, np.ones((n, 1))), (drift, since[:, None])]
        build.add(
            gnss.position_m[:, axis] - computed[:, axis],
            gnss.sigma_m[:, axis],
            np.full(n, 4 if axis < 2 else 5),
            rows,
            entries,
            axis=axis,
        )


def _seconds_from_mean(network: Network) -> Array:
    """Seconds since the mean time of each line's positions, so shift and drift are uncorrelated."""
    gnss = network.gnss
    since = np.zeros(len(gnss.station))
    for line in range(len(gnss.lines)):
        rows = gnss.line == line
        if rows.any():
            since[rows] = gnss.time_s[rows] - gnss.time_s[rows].mean()
    return since


def _attitude_rows(
    build: _Builder, network: Network, layout: ParameterLayout, state: ParameterValues
) -> None:
    measured_attitudes = network.measured_attitudes
    n = len(measured_attitudes.attitude)
    if not n:
        return
    own = state.attitude[measured_attitudes.attitude]
    misclosure = vectors_from_rotations(np.einsum("nji,njk->nik", own, measured_attitudes.rotation))
    d_rotation = _rotation_jacobian(misclosure)
    for axis in range(3):
        build.add(
            misclosure[:, axis],
            measured_attitudes.sigma_rad[:, axis],
            np.full(n, 6),
            np.arange(n),
            [(layout.attitude[measured_attitudes.attitude], d_rotation[:, axis])],
            axis=axis,
        )


def _rotation_jacobian(misclosure: Array) -> Array:
    """-d(log(exp(-d) exp(m))) / dd at d = 0, (n, 3, 3): one but for half the misclosure m."""
    k = skew(misclosure)
    return np.asarray(np.eye(3) - 0.5 * k + np.einsum("nij,njk->nik", k, k) / 12.0)


def _distance_rows(
    build: _Builder, network: Network, layout: ParameterLayout, state: ParameterValues
) -> None:
    distances = network.distances
    n = len(distances.point_a)
    if not n:
        return
    separation = state.points[distances.point_b] - state.points[distances.point_a]
    length = np.linalg.norm(separation, axis=1)
    direction = separation / length[:, None]
    # A distance has no row where an object point that it ends at is left out.
    there = np.asarray((layout.retained_points >= 0).any(axis=1) | layout.locked.all(axis=1))
    usable = there[distances.point_a] & there[distances.point_b]
    build.add(
        distances.distance_m - length,
        np.where(usable, distances.sigma_m, np.inf),
        np.full(n, 7),
        np.arange(n),
        [
            (layout.retained_points[distances.point_b], direction),
            (layout.retained_points[distances.point_a], -direction),
        ],
    )


def _prior_rows(
    build: _Builder, network: Network, layout: ParameterLayout, state: ParameterValues
) -> None:
    """Pseudo-observations of interior orientation, terms and heads."""
    for index, camera in enumerate(network.cameras):
        given = np.concatenate([camera.interior, [t.value for t in camera.terms]])
        now = np.concatenate([state.interior[index], state.terms[index]])
        at = np.concatenate([layout.interior[index], layout.terms[index]])
        names = [*INTERIOR, *(t.name for t in camera.terms)]
        sigma = np.array([camera.sigma.get(name, np.nan) for name in names])
        rows = np.flatnonzero(np.isfinite(sigma) & (at >= 0))
        _add_prior(build, (given - now)[rows], sigma[rows], at[rows][:, None], None)
    for index, head in enumerate(network.heads):
        if head.rotation_free and head.rotation_sigma_rad is not None:
            rotated = vectors_from_rotations((state.head_rotation[index].T @ head.rotation)[None])
            columns = np.tile(layout.head_rotation[index], (3, 1))
            sigma = np.full(3, head.rotation_sigma_rad)
            _add_prior(build, rotated[0], sigma, columns, _rotation_jacobian(rotated)[0])
        if head.offset_free and head.offset_sigma_m is not None:
            moved = head.offset_m - state.head_offset[index]
            sigma = np.full(3, head.offset_sigma_m)
            _add_prior(build, moved, sigma, layout.head_offset[index][:, None], None)
        timing = head.timing
        for difference, spread, column in (
            (timing.delay_s - state.head_delay[index], timing.delay_sigma_s, layout.head_delay),
            (timing.readout_s - state.readout[index], timing.readout_sigma_s, layout.readout),
        ):
            if column[index] >= 0 and spread is not None:
                at_head = column[index : index + 1, None]
                _add_prior(build, np.array([difference]), np.array([spread]), at_head, None)
    _jitter_rows(build, network, layout, state)
    _pattern_rows(build, layout, state)


def _jitter_rows(
    build: _Builder, network: Network, layout: ParameterLayout, state: ParameterValues
) -> None:
    """Pseudo-observations of the images' own delays: zero."""
    rows = np.flatnonzero(layout.jitter >= 0)
    if not rows.size:
        return
    sigma = np.array([network.heads[h].timing.jitter_sigma_s for h in network.images.head[rows]])
    n = len(rows)
    entry = [(layout.jitter[rows][:, None], np.ones((n, 1)))]
    build.add(-state.jitter[rows], sigma, np.full(n, 9), rows, entry)


def _pattern_rows(build: _Builder, layout: ParameterLayout, state: ParameterValues) -> None:
    """Pseudo-observations of the amplitudes of patterns of stitching: zero, of variance one."""
    rows, which = np.nonzero(layout.pattern >= 0)
    if not rows.size:
        return
    entry = [(layout.pattern[rows, which][:, None], np.ones((len(rows), 1)))]
    build.add(-state.pattern[rows, which], np.ones(len(rows)), np.full(len(rows), 10), rows, entry)


def _add_prior(
    build: _Builder, misclosure: Array, sigma: Array, columns: Indices, values: Array | None
) -> None:
    if not len(misclosure):
        return
    n = len(misclosure)
    entry = np.ones((n, 1)) if values is None else values
    build.add(misclosure, sigma, np.full(n, 8), columns[:, 0], [(columns, entry)])
