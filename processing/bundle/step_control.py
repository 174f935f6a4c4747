"""Steps of an adjustment that always lower the sum of squares: Levenberg-Marquardt damping.

Without trouble a step is that of Gauss-Newton. The depth of an object point whose rays are nearly
parallel changes by its reciprocal, in which collinearity is almost linear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.equation_rows import Equations
from processing.bundle.image_rows import BehindCameraError
from processing.bundle.network import Network
from processing.bundle.reduced_solution import GaussNewtonStep
from processing.bundle.unknowns import ParameterLayout, ParameterValues, apply_corrections
from processing.geometry.rotation import rotations_from_vectors, skew

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

RECIPROCAL_BELOW: Final = 1e-2
"""Smallest over largest eigenvalue of a point's normal matrix: rays about 12 degrees apart."""

_FARTHEST: Final = 1e5
"""Largest depth over the distances of the projection centres: rays 0.001 degrees apart."""

_FIRST_DAMPING: Final = 1e-4
_MIN_DAMPING: Final = 1e-7
MAX_DAMPING: Final = 1e8
_GOOD: Final = 0.6
_POOR: Final = 0.2
_MAX_DEPTH_RATIO: Final = 10.0
_MAX_TRIALS: Final = 4
_ROTATION_MIN: Final = 3
_MAX_OWN_SHARE: Final = 0.1
_SUFFICIENT: Final = 1e-4
_NEGLIGIBLE: Final = 1e-7


@dataclass
class Damping:
    """Share of the diagonal that is added to the normal matrix; zero is Gauss-Newton."""

    value: float = 0.0

    def raise_(self) -> bool:
        """Damp more.

        Returns:
            False at the limit, where no step lowers the sum of squares.
        """
        self.value = max(10.0 * self.value, _FIRST_DAMPING)
        return self.value <= MAX_DAMPING

    def adapt(self, actual: float, predicted: float) -> None:
        """Damp less after a step that did what was predicted, and more after a poor one.

        Args:
            actual: decrease of the sum of squares.
            predicted: by the linear model.
        """
        if self.value == 0.0:
            return
        if actual > _GOOD * predicted:
            self.value /= 30.0
        elif actual < _POOR * predicted:
            self.value *= 3.0
        if self.value < _MIN_DAMPING:
            self.value = 0.0


@dataclass(frozen=True)
class Rays:
    """The projection centres that see each eliminated point.

    Attributes:
        stations, attitudes, heads, points: station, attitude, head (-1: none) and eliminated point
            of each image point.
        count: (p,) image points of each.
        free: (p,) points at finite distance whose place follows from rays alone, without a given
            coordinate.
    """

    stations: NDArray[np.int64]
    attitudes: NDArray[np.int64]
    heads: NDArray[np.int64]
    points: NDArray[np.int64]
    count: Array
    free: Flags

    def centres(self, state: ParameterValues) -> tuple[Array, Array]:
        """Mean projection centre of each point, and the root mean square distance from it.

        Args:
            state: current values.

        Returns:
            Shapes (p, 3) and (p,), m.
        """
        of = np.maximum(self.count, 1.0)
        place = state.station[self.stations]
        # Heads of one exposure see from different places, too.
        mounted = self.heads >= 0
        if mounted.any():
            offset = state.head_offset[self.heads[mounted]]
            rotation = state.attitude[self.attitudes[mounted]]
            place[mounted] += np.einsum("nij,nj->ni", rotation, offset)
        mean = self._sums(place) / of[:, None]
        off = place - mean[self.points]
        return mean, np.sqrt(self._sums(off**2).sum(axis=1) / of)

    def _sums(self, values: Array) -> Array:
        return np.stack(
            [
                np.bincount(self.points, weights=values[:, axis], minlength=len(self.count))
                for axis in range(values.shape[1])
            ],
            axis=1,
        )


def rays_of(network: Network, layout: ParameterLayout) -> Rays:
    """Projection centres by eliminated point.

    Args:
        network: observations.
        layout: eliminated points.

    Returns:
        See `Rays`.
    """
    table = network.image_points
    point = layout.eliminated[table.point]
    own = point >= 0
    points = layout.eliminated_points
    image = table.image[own]
    return Rays(
        network.images.station[image],
        network.images.attitude[image],
        network.images.head[image],
        point[own],
        np.bincount(point[own], minlength=len(points)).astype(np.float64),
        np.isnan(network.points.sigma_m[points]).all(axis=1) & ~network.points.at_infinity[points],
    )


def weakest_share(normals: Array) -> Array:
    """Information in the weakest direction of each point over that in all.

    Args:
        normals: normal matrices, shape (p, 3, 3).

    Returns:
        Shape (p,): determinant over the sum of principal minors and the trace, between a third of
        the smallest over the sum of eigenvalues and that ratio itself.

    Example:
        >>> weakest_share(np.diag([1.0, 1.0, 2e-6])[None]).round(9)
        array([1.e-06])
    """
    a, b, c = normals[:, 0, 0], normals[:, 1, 1], normals[:, 2, 2]
    d, e, f = normals[:, 0, 1], normals[:, 0, 2], normals[:, 1, 2]
    minors = (a * b - d * d) + (a * c - e * e) + (b * c - f * f)
    determinant = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    whole = np.maximum(minors * (a + b + c), 1e-300)
    return np.asarray(np.maximum(determinant, 0.0) / whole)


def held_depths(
    rows: Equations, layout: ParameterLayout, state: ParameterValues, rays: Rays, normals: Array
) -> Array:
    """Hold the depth of points whose rays do not meet in front of the cameras.

    They are as far as `_FARTHEST` allows, and their own rows would move them farther.

    Args:
        rows: at the state.
        layout: eliminated points.
        state: current values.
        rays: projection centres by point.
        normals: normal matrices of the points, shape (p, 3, 3).

    Returns:
        Rows to be added to the points' normal matrices, shape (p, 3); zero for all others.
    """
    held = np.zeros((len(normals), 3))
    mean, base = rays.centres(state)
    away = state.points[layout.eliminated_points] - mean
    depth = np.linalg.norm(away, axis=1)
    far = np.flatnonzero(rays.free & (depth > 0.5 * _FARTHEST * base) & (rays.count > 0))
    if not len(far):
        return held
    right = np.zeros((len(normals), 3))
    own = rows.point >= 0
    who, part = rows.point[own], rows.point_part[own] * rows.misclosure[own, None]
    for axis in range(3):
        right[:, axis] = np.bincount(who, weights=part[:, axis], minlength=len(right))
    unit = away[far] / depth[far, None]
    size = np.einsum("pii->p", normals[far])
    # Sideways a point is determined; the sign of its own step along the ray is all that counts.
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    sideways = np.einsum("pij,pjk,pkl->pil", across, normals[far], across)
    sideways += size[:, None, None] * unit[:, :, None] * unit[:, None, :]
    step = np.linalg.solve(sideways, np.einsum("pij,pj->pi", across, right[far])[:, :, None])
    left = right[far] - np.einsum("pij,pj->pi", normals[far], step[:, :, 0])
    outward = np.einsum("pi,pi->p", unit, left) >= 0.0
    held[far[outward]] = (unit * np.sqrt(size)[:, None])[outward]
    return held


def corrected_state(
    state: ParameterValues,
    layout: ParameterLayout,
    step: GaussNewtonStep,
    rays: Rays,
    reciprocal: Flags,
    share: Array,
    *,
    rotates: bool = True,
) -> ParameterValues:
    """The state after a step.

    Args:
        state: before it; not changed.
        layout: columns of the step.
        step: corrections.
        rays: projection centres by point.
        reciprocal: (p,) points whose depth changes by its reciprocal.
        share: of the correction of each eliminated point, shape (p,).
        rotates: stations and points rotate together as the step states to first order.

    Returns:
        The state; a depth changes by a factor of ten at most and never its sign.

    Source: docs/explanation/mathematics/bundle.md#points-of-nearly-parallel-rays.
    """
    dpoints = share[:, None] * step.dpoints
    result = apply_corrections(state, layout, step.dx, dpoints)
    _change_depths(state, result, layout, dpoints, rays, reciprocal)
    if rotates:
        _rotate_as_whole(state, result, layout, rays, rays.free & ~reciprocal)
    return result


def _rotate_as_whole(
    state: ParameterValues, result: ParameterValues, layout: ParameterLayout, rays: Rays, own: Flags
) -> None:
    """Rotate where the linear step moves along tangents: what stations and points share.

    A block that its images hold together and that hardly anything fixes in space turns as a whole.
    Moved along tangents it loses its shape, and only short steps would lower the sum of squares.

    Args:
        state: before the step.
        result: after it, each coordinate moved by its correction; changed.
        layout: which coordinates are unknown.
        rays: points at finite distance, which are rotated.
        own: (p,) points that show the rotation.
    """
    if not (layout.station >= 0).all() or own.sum() < _ROTATION_MIN:
        return
    points, shown = layout.eliminated_points[rays.free], layout.eliminated_points[own]
    before = np.concatenate([state.station, state.points[shown]])
    after = np.concatenate([result.station, result.points[shown]])
    centre, centre_after = before.mean(axis=0), after.mean(axis=0)
    away, moved = before - centre, after - before - (centre_after - centre)
    inertia = (away * away).sum() * np.eye(3) - away.T @ away
    vector = (np.linalg.pinv(inertia) @ np.cross(away, moved).sum(axis=0))[None]
    rotation, tangent = rotations_from_vectors(vector)[0], skew(vector)[0]
    for values, old, rows in (
        (result.station, state.station, np.arange(len(state.station))),
        (result.points, state.points, points),
    ):
        unturned = values[rows] - centre_after - (old[rows] - centre) @ tangent.T
        values[rows] = centre_after + unturned @ rotation.T


def _change_depths(
    state: ParameterValues,
    result: ParameterValues,
    layout: ParameterLayout,
    dpoints: Array,
    rays: Rays,
    own: Flags,
) -> None:
    """Change the depths of points of nearly parallel rays, `own`, by their reciprocals."""
    if not own.any():
        return
    points = layout.eliminated_points[own]
    before, after, base = rays.centres(state)[0][own], *rays.centres(result)
    after, base = after[own], base[own]
    ray = state.points[points] - before
    depth = np.linalg.norm(ray, axis=1)
    unit = ray / depth[:, None]
    moved = dpoints[own] - (after - before)
    along = np.einsum("pi,pi->p", unit, moved)
    across = moved - along[:, None] * unit
    ratio = 1.0 / np.clip(1.0 - along / depth, 1.0 / _MAX_DEPTH_RATIO, _MAX_DEPTH_RATIO)
    ratio = np.minimum(ratio, np.maximum(_FARTHEST * base / depth, 1.0 / _MAX_DEPTH_RATIO))
    result.points[points] = after + ratio[:, None] * (ray + across)


def lowering_step(
    rows_of: Callable[[ParameterValues], Equations],
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    step: GaussNewtonStep,
    rays: Rays,
    reciprocal: Flags,
    before: Equations,
) -> tuple[ParameterValues, float] | None:
    """Take a step if it lowers the sum of squares, with shorter corrections of single points.

    Args:
        rows_of: misclosures at a state.
        network: observations.
        layout: columns.
        state: before the step.
        step: corrections.
        rays: projection centres by point.
        reciprocal: (p,) points whose depth changes by its reciprocal.
        before: rows at the state.

    Returns:
        The state and its sum of squares; None where it does not fall enough.
    """
    share = np.ones(len(step.dpoints))
    objective = float(before.misclosure @ before.misclosure)
    of_point = squares_by_point(before, len(share))
    for _ in range(_MAX_TRIALS):
        after = corrected_state(
            state, layout, step, rays, reciprocal, share, rotates=not network.constraints
        )
        try:
            rows = rows_of(after)
        except BehindCameraError as error:
            who = layout.eliminated[network.image_points.point[error.image_points]]
            behind = np.unique(who[who >= 0])
            if not len(behind) or len(behind) > _MAX_OWN_SHARE * len(share):
                return None
            share[behind] *= 0.5
            continue
        value = float(rows.misclosure @ rows.misclosure)
        enough = _SUFFICIENT * step.predicted_decrease
        if value <= objective - enough or step.predicted_decrease < _NEGLIGIBLE * objective:
            return after, value
        # A point that a few rays fix badly must not shorten the step of all others.
        worse = squares_by_point(rows, len(share)) > of_point + 0.5 * (value - objective)
        if not 0 < worse.sum() <= _MAX_OWN_SHARE * len(share):
            return None
        share[worse] *= 0.25
    return None


def squares_by_point(rows: Equations, count: int) -> Array:
    """Sum of squares of the rows of each eliminated point.

    Args:
        rows: whitened rows.
        count: number of eliminated points.

    Returns:
        Shape (count,).
    """
    there = rows.point >= 0
    squares = rows.misclosure[there] ** 2
    return np.bincount(rows.point[there], weights=squares, minlength=count).astype(np.float64)


def points_in_front(network: Network, state: ParameterValues) -> ParameterValues:
    """Put points that are behind a camera into the middle of their rays, in front of the cameras.

    Rays that diverge by errors of orientations meet behind the cameras.

    Args:
        network: observations.
        state: starting values; not changed.

    Returns:
        Such points at the median distance of those that two or more images see in front; the state
        itself where there are none.
    """
    table, images = network.image_points, network.images
    rotation, place = state.attitude[images.attitude], state.station[images.station]
    mounted = np.flatnonzero(images.head >= 0)
    if len(mounted):
        head = images.head[mounted]
        place = place.copy()
        place[mounted] += np.einsum("nij,nj->ni", rotation[mounted], state.head_offset[head])
        rotation = rotation.copy()
        rotation[mounted] = rotation[mounted] @ state.head_rotation[head]
    ray = state.points[table.point] - place[table.image]
    along = np.einsum("nji,nj->ni", rotation[table.image], ray)[:, 2]
    free = ~(network.points.sigma_m == 0.0).any(axis=1) & ~network.points.at_infinity
    behind = np.zeros(len(free), dtype=bool)
    behind[table.point[along >= 0.0]] = True
    behind &= free & ~(np.nan_to_num(network.points.sigma_m) > 0.0).any(axis=1)
    good = ~behind[table.point] & (along < 0.0)
    if not behind.any() or not good.any():
        return state
    rows = np.flatnonzero(behind[table.point])
    f_mm = np.array([camera.f_mm for camera in network.cameras])
    about = np.array([(camera.xp_mm, camera.yp_mm) for camera in network.cameras])
    camera = images.camera[table.image[rows]]
    seen = np.column_stack([table.xy_mm[rows] - about[camera], -f_mm[camera]])
    unit = np.einsum("nij,nj->ni", rotation[table.image[rows]], seen)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    centre, direction = np.zeros((len(free), 3)), np.zeros((len(free), 3))
    np.add.at(centre, table.point[rows], place[table.image[rows]])
    np.add.at(direction, table.point[rows], unit)
    count = np.bincount(table.point[rows], minlength=len(free))[behind, None]
    length = np.linalg.norm(direction[behind], axis=1, keepdims=True)
    depth = float(np.median(np.linalg.norm(ray[good], axis=1)))
    points = state.points.copy()
    points[behind] = centre[behind] / count + depth * direction[behind] / np.maximum(length, 1e-9)
    return replace(state, points=points)
