"""Pairs of images whose matches contradict the positions of their exposures.

Ground that repeats itself (rows of plants, roofs of one kind, a mosaic of the same pictures) gives
matches of images that do not overlap. One fundamental matrix explains them, so they are found here:
over ground that is about flat, matches and positions together determine the height and the heading
of every exposure, and a wrong pair disagrees with the others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import layer_mm_from_raw
from processing.geometry.rotation import rotation_matrix
from processing.rig import Cone

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]
Pairs = Mapping[tuple[int, int], Indices]

SHIFT_MAX: Final = (0.12, 0.25)
"""Deviation of where an image lies in another, as the tangent of an angle, that is always accepted,
and that never is. Between them: six times the median of all."""
TURN_MAX: Final = 0.3
"""Largest deviation of the turn and the scale between two images, relative."""
_INLIER_TANGENT: Final = 0.03
_INLIERS_MIN: Final = 0.5
_STEEP: Final = 0.2
_TILT_SIGMA: Final = 0.1
_TURN_SIGMA: Final = 0.03
_SHIFT_SIGMA: Final = 0.05
_KNOWN_SHARE: Final = 0.1
_ROUNDS: Final = 20
_RIDGE: Final = 1e-9
"""Keeps exposures that no pair meets."""
_LEAST_RESIDUAL: Final = 0.1
_CONTRADICTING_MAX: Final = 0.5


@dataclass(frozen=True)
class _Fit:
    """How an image lies in another: ground of b in the axes of a is `turn` times it plus `shift`.

    As complex numbers, right and forward over the height above ground.
    """

    a: int
    b: int
    turn: complex
    shift: complex
    weight: int


def contradicting_pairs(
    cones: Sequence[Cone],
    head: Indices,
    exposure: Indices,
    position_m: Array,
    px: Sequence[Array],
    pairs: Pairs,
) -> set[tuple[int, int]]:
    """Find pairs of images that cannot lie where their matches put them.

    Args:
        cones: heads, one sensor each, by their index.
        head: (images,) index of the cone of each image.
        exposure: (images,) index of its exposure.
        position_m: (exposures, 3), east, north, up.
        px: image points of each image, (n, 2) columns and rows.
        pairs: matches (m, 2) by images (a, b).

    Returns:
        Pairs whose matches are wrong. None if more than half of all contradict: then it is not
        known which are right, positions or matches.

    Source: docs/explanation/mathematics/lens.md#calibration-from-a-flight.
    """
    ground = [_ground_of(cones[h], p) for h, p in zip(head, px, strict=True)]
    fits = [f for (a, b), rows in pairs.items() if (f := _fit(a, b, ground, rows)) is not None]
    if not fits:
        return set()
    shift_away, turn_away = _residuals(fits, exposure, position_m[:, 0] + 1j * position_m[:, 1])
    limit = float(np.clip(6.0 * np.median(shift_away), *SHIFT_MAX))
    wrong = (shift_away > limit) | (turn_away > TURN_MAX)
    if wrong.mean() > _CONTRADICTING_MAX:
        return set()
    return {(fits[k].a, fits[k].b) for k in np.flatnonzero(wrong)}


def _ground_of(cone: Cone, px: Array) -> Complex:
    """Where rays meet the ground below, over the height: right, forward; NaN near the horizon."""
    xy_mm = layer_mm_from_raw(cone.sensors[0], px)
    ray = np.column_stack([xy_mm, np.full(len(xy_mm), -cone.lens.f_mm)])
    ray = ray @ rotation_matrix(*cone.rotation_rad).T
    down = -ray[:, 2] / np.linalg.norm(ray, axis=1)
    with np.errstate(all="ignore"):
        found = (ray[:, 0] + 1j * ray[:, 1]) / -ray[:, 2]
    return np.where(down > _STEEP, found, np.nan + 0j)


def _fit(a: int, b: int, ground: Sequence[Complex], rows: Indices) -> _Fit | None:
    """The turn, scale and shift that most matches of a pair agree on; None if most do not."""
    in_a, in_b = ground[a][rows[:, 0]], ground[b][rows[:, 1]]
    seen = np.isfinite(in_a) & np.isfinite(in_b)
    if seen.sum() < max(3, _INLIERS_MIN * len(rows)):
        return None
    source, target = (np.column_stack([v.real, v.imag])[seen] for v in (in_b, in_a))
    matrix, inside = cv2.estimateAffinePartial2D(
        source, target, method=cv2.RANSAC, ransacReprojThreshold=_INLIER_TANGENT
    )
    if matrix is None or inside.sum() < _INLIERS_MIN * seen.sum():
        return None
    turn = complex(matrix[0, 0], matrix[1, 0])
    return _Fit(a, b, turn, complex(matrix[0, 2], matrix[1, 2]), int(inside.sum()))


def _residuals(fits: Sequence[_Fit], exposure: Indices, place: Complex) -> tuple[Array, Array]:
    """How far pairs are from all others together: in shift, and in turn, relative.

    Turns determine v, the inverse of height times heading of each exposure, but for a common
    factor; shifts determine that factor and the tilts o: v_a = turn v_b and
    shift = (place_b - place_a) v_a + o_a - turn o_b. Zero where an exposure is not known.
    """
    a, b = (exposure[[getattr(f, end) for f in fits]] for end in "ab")
    turn, shift = (np.array([getattr(f, name) for f in fits]) for name in ("turn", "shift"))
    weight = np.sqrt([float(f.weight) for f in fits])
    inverse = _turned(place, a, b, turn, weight)
    size = np.abs(inverse)
    known = np.minimum(size[a], size[b]) > _KNOWN_SHARE * np.median(size)
    with np.errstate(all="ignore"):
        turn_away = np.abs(inverse[a] - turn * inverse[b]) / size[a]
    base = np.where(known, (place[b] - place[a]) * inverse[a], 0.0)
    fitting = weight * (known & (turn_away < TURN_MAX))
    shift_away = np.abs(_shifted(len(place), a, b, turn, shift, fitting, base))
    return np.where(known, shift_away, 0.0), np.where(known, turn_away, 0.0)


def _turned(place: Complex, a: Indices, b: Indices, turn: Complex, weight: Array) -> Complex:
    """Inverse heights times headings, of unit length together, by least absolute residuals.

    They begin with the nearest exposures, which overlap: least squares of all would begin between
    what is right and what pictures that recur turned agree on.
    """
    count, rows = len(place), np.flatnonzero(a != b)
    found = np.zeros(count, np.complex128)
    if not len(rows):
        return found
    found = _along_nearest(place, a[rows], b[rows], turn[rows], weight[rows])
    design = np.zeros((len(rows), count), np.complex128)
    design[np.arange(len(rows)), a[rows]] = 1.0
    design[np.arange(len(rows)), b[rows]] = -turn[rows]
    for _ in range(_ROUNDS):
        size = np.maximum(np.abs(found[a[rows]]), _KNOWN_SHARE / math.sqrt(count))
        own = weight[rows] / np.maximum(np.abs(design @ found) / size, _TURN_SIGMA)
        normal = (design.conj().T * own) @ design
        met = np.flatnonzero(normal.diagonal().real > 0.0)
        found[met] = np.linalg.eigh(normal[np.ix_(met, met)])[1][:, 0]
    return found


def _along_nearest(place: Complex, a: Indices, b: Indices, turn: Complex, weight: Array) -> Complex:
    """Turns carried from exposure to exposure along the pairs that lie closest together."""
    found = np.zeros(len(place), np.complex128)
    parent = np.arange(len(place))
    order = np.lexsort([-weight, np.abs(place[a] - place[b])])
    members = {k: [k] for k in range(len(place))}
    found[np.unique([a, b])] = 1.0
    for k in order:
        into, other = parent[a[k]], parent[b[k]]
        if into == other:
            continue
        # v_a = turn v_b: what hangs on b is turned and scaled to what hangs on a.
        moved = members.pop(other)
        found[moved] *= found[a[k]] / (turn[k] * found[b[k]])
        parent[moved] = into
        members[into] += moved
    return found / max(float(np.linalg.norm(found)), _RIDGE)


def _shifted(
    count: int,
    a: Indices,
    b: Indices,
    turn: Complex,
    shift: Complex,
    weight: Array,
    base: Complex,
) -> Complex:
    """Residuals of shifts after a common factor and the tilts, by least absolute residuals."""
    rows, every, common = np.arange(len(a)), np.arange(count), count + 1
    by_shift = np.zeros((len(a), count + 2), np.complex128)
    by_shift[rows, a] += 1.0
    by_shift[rows, b] -= turn
    by_shift[rows, count] = base
    by_tilt = np.zeros((count, count + 2), np.complex128)
    by_tilt[every, every] = 1.0
    by_tilt[every, common] = -1.0
    sigma = np.repeat([_SHIFT_SIGMA, _TILT_SIGMA], [len(a), count])
    design = np.concatenate([by_shift, by_tilt]) / sigma[:, None]
    observed = np.concatenate([shift, np.zeros(count)]) / sigma
    # A tilt that grows along a line acts as the distance flown: it must weigh as all pairs do.
    of_tilt = np.bincount(a, weight, count) + np.bincount(b, weight, count) + 1.0
    all_weights = np.concatenate([weight, of_tilt])
    residual = observed
    for _ in range(_ROUNDS):
        weighted = design.conj().T * (all_weights / np.maximum(np.abs(residual), _LEAST_RESIDUAL))
        normal = weighted @ design
        normal[np.diag_indices_from(normal)] += _RIDGE * np.trace(normal).real / len(normal)
        residual = observed - design @ np.linalg.solve(normal, weighted @ observed)
    return np.asarray(residual[: len(a)] * _SHIFT_SIGMA)
