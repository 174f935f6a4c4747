"""Observation equations of everything but image points.

Control, antenna positions, measured attitudes, distances, and what is known beforehand of cameras,
heads, times and patterns.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.bundle.equation_rows import RowBuilder, columns_where
from processing.bundle.network import INTERIOR, Network
from processing.bundle.unknowns import ParameterLayout, ParameterValues
from processing.geometry.rotation import skew, vectors_from_rotations

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def other_rows(
    build: RowBuilder, network: Network, layout: ParameterLayout, state: ParameterValues
) -> None:
    """Append the rows.

    Args:
        build: what they are appended to.
        network: observations.
        layout: columns.
        state: current values.

    Source: docs/explanation/mathematics/bundle.md#other-observations.
    """
    _control_rows(build, network, layout, state)
    _gnss_rows(build, network, layout, state)
    _attitude_rows(build, network, layout, state)
    _distance_rows(build, network, layout, state)
    _prior_rows(build, network, layout, state)


def _control_rows(
    build: RowBuilder, network: Network, layout: ParameterLayout, state: ParameterValues
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
    build: RowBuilder, network: Network, layout: ParameterLayout, state: ParameterValues
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
            shift = columns_where(layout.shift, gnss.line)[:, axis][:, None]
            drift = columns_where(layout.drift, gnss.line)[:, axis][:, None]
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
    build: RowBuilder, network: Network, layout: ParameterLayout, state: ParameterValues
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
    build: RowBuilder, network: Network, layout: ParameterLayout, state: ParameterValues
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
    build: RowBuilder, network: Network, layout: ParameterLayout, state: ParameterValues
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
    build: RowBuilder, network: Network, layout: ParameterLayout, state: ParameterValues
) -> None:
    """Pseudo-observations of the images' own delays: zero."""
    rows = np.flatnonzero(layout.jitter >= 0)
    if not rows.size:
        return
    sigma = np.array([network.heads[h].timing.jitter_sigma_s for h in network.images.head[rows]])
    n = len(rows)
    entry = [(layout.jitter[rows][:, None], np.ones((n, 1)))]
    build.add(-state.jitter[rows], sigma, np.full(n, 9), rows, entry)


def _pattern_rows(build: RowBuilder, layout: ParameterLayout, state: ParameterValues) -> None:
    """Pseudo-observations of the amplitudes of patterns of stitching: zero, of variance one."""
    rows, which = np.nonzero(layout.pattern >= 0)
    if not rows.size:
        return
    entry = [(layout.pattern[rows, which][:, None], np.ones((len(rows), 1)))]
    build.add(-state.pattern[rows, which], np.ones(len(rows)), np.full(len(rows), 10), rows, entry)


def _add_prior(
    build: RowBuilder, misclosure: Array, sigma: Array, columns: Indices, values: Array | None
) -> None:
    if not len(misclosure):
        return
    n = len(misclosure)
    entry = np.ones((n, 1)) if values is None else values
    build.add(misclosure, sigma, np.full(n, 8), columns[:, 0], [(columns, entry)])
