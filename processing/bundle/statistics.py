"""Statistics of an adjusted network: covariances of points, redundancy numbers, groups.

Everything is exact, from the reduced equations and their inverse; nothing of the size of all
unknowns squared is ever formed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from processing.bundle.equations import Equations
from processing.bundle.normal_equations import ReducedEquations

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_PART_BYTES = 64_000_000
_PART_ROWS = 200_000


@dataclass(frozen=True)
class ObservationGroup:
    """One kind of observation.

    `factor` is its variance component: the a posteriori over the a priori sigma, squared, NaN
    where the group has no redundancy. `rms` is of the residuals in the unit of the observation.
    """

    name: str
    count: int
    redundancy: float
    factor: float
    rms: float
    worst: float


def spread_of(
    equations: Equations, reduced: ReducedEquations, cofactor: Array
) -> tuple[Array, Array, Array]:
    """Cofactors of the eliminated points, and how errors of observations pass into unknowns.

    Args:
        equations: the rows.
        reduced: what they were reduced to.
        cofactor: (c, c) of the columns.

    Returns:
        (p, 3, 3) m squared, of held coordinates without meaning; (m,) leverages, which are one
        less the redundancy numbers; and (m, 3) m, the change of the row's own object point by a
        change of the observation by its sigma. A row (a, b) of columns a and orthonormal point
        part b has the leverage b b' + (a - b W) Q (a - b W)', W being the point's coupling with the
        columns.
    """
    leverage = np.einsum("mi,mi->m", reduced.point_rows, reduced.point_rows)
    leverage += _own_products(reduced, cofactor)
    points = len(reduced.point_factor)
    influence = np.zeros((len(equations.point), 3))
    through = np.zeros((points, 3, 3))
    order = np.argsort(equations.point, kind="stable")
    begin = np.searchsorted(equations.point[order], np.arange(points + 1))
    for low, high in _point_ranges(begin):
        rows = order[begin[low] : begin[high]]
        local = equations.point[rows] - low
        part, mixed = _through_columns(reduced, cofactor, rows, local, low, high)
        through[low:high] = part
        b = reduced.point_rows[rows]
        back = np.einsum("mij,mj->mi", part[local], b)
        leverage[rows] += np.einsum("mi,mi->m", b, back - 2.0 * mixed)
        factor = reduced.point_factor[equations.point[rows]]
        influence[rows] = np.einsum("mij,mj->mi", factor, b + back - mixed)
    inner = through + np.eye(3)
    factor = reduced.point_factor
    cofactors = np.einsum("pij,pjk,plk->pil", factor, inner, factor)
    return np.asarray(cofactors), np.asarray(np.clip(leverage, 0.0, 1.0)), influence


def _point_ranges(begin: Indices) -> Iterator[tuple[int, int]]:
    """Ranges of points of about `_PART_ROWS` rows; row `begin[k]` is the first of point k."""
    low, points = 0, len(begin) - 1
    while low < points:
        high = int(np.searchsorted(begin, begin[low] + _PART_ROWS, side="right")) - 1
        high = min(max(high, low + 1), points)
        yield low, high
        low = high


def _through_columns(
    reduced: ReducedEquations, cofactor: Array, rows: Indices, local: Indices, low: int, high: int
) -> tuple[Array, Array]:
    """W Q W' of the points low..high (n, 3, 3), and W Q a' of their rows (m, 3).

    Only cofactors between a point's own columns are needed: those of the images that see it, and
    dense ones.
    """
    thin, dense = reduced.sparse_columns, reduced.dense_columns
    n, design, b = high - low, reduced.design_sparse[rows], reduced.point_rows[rows]
    row = np.repeat(np.arange(len(rows)), np.diff(design.indptr))
    width = max(len(thin), 1)
    keys, place = np.unique(local[row] * width + design.indices, return_inverse=True)
    coupling = np.stack(
        [
            np.bincount(place, weights=b[row, axis] * design.data, minlength=len(keys))
            for axis in range(3)
        ],
        axis=1,
    ).astype(np.float64)
    columns = thin[keys % width]
    first = np.searchsorted(keys // width, np.arange(n + 1))
    count = np.diff(first)
    of_dense = reduced.coupling_dense[3 * low : 3 * high].reshape(n, 3, -1)
    among_dense = cofactor[np.ix_(dense, dense)]
    spread, spread_dense = np.zeros((len(keys), 3)), np.zeros((n, 3, len(dense)))
    through = np.zeros((n, 3, 3))
    for size in np.unique(count):
        of_size = np.flatnonzero(count == size)
        step = max(1, _PART_BYTES // (8 * max(int(size), 1) * (int(size) + len(dense) + 1)))
        for begin in range(0, len(of_size), step):
            own = of_size[begin : begin + step]
            at = first[own][:, None] + np.arange(size)
            c, d, its = coupling[at].transpose(0, 2, 1), of_dense[own], columns[at]
            across = cofactor[its[:, :, None], dense]
            s = c @ cofactor[its[:, :, None], its[:, None, :]] + d @ across.transpose(0, 2, 1)
            s_dense = c @ across + d @ among_dense
            spread[at], spread_dense[own] = s.transpose(0, 2, 1), s_dense
            through[own] = s @ c.transpose(0, 2, 1) + s_dense @ d.transpose(0, 2, 1)
    mixed = np.stack(
        [
            np.bincount(row, weights=design.data * spread[place, axis], minlength=len(rows))
            for axis in range(3)
        ],
        axis=1,
    ).astype(np.float64)
    if len(dense):
        mixed += np.einsum("md,mid->mi", reduced.design_dense[rows], spread_dense[local])
    return through, mixed


def _own_products(reduced: ReducedEquations, cofactor: Array) -> Array:
    """a Q a' of every row's columns a, (m,): rows with as many sparse entries go together."""
    thin, dense = reduced.sparse_columns, reduced.dense_columns
    rows, among_dense = reduced.design_sparse, cofactor[np.ix_(dense, dense)]
    result = np.einsum("md,md->m", reduced.design_dense @ among_dense, reduced.design_dense)
    entries = np.diff(rows.indptr)
    for count in np.unique(entries):
        if count == 0:
            continue
        of_count = np.flatnonzero(entries == count)
        step = max(1, _PART_BYTES // (8 * int(count) * (int(count) + len(dense))))
        for first in range(0, len(of_count), step):
            own = of_count[first : first + step]
            at = rows.indptr[own][:, None] + np.arange(count)
            columns, values = thin[rows.indices[at]], rows.data[at]
            between = cofactor[columns[:, :, None], columns[:, None, :]]
            result[own] += np.einsum("mi,mij,mj->m", values, between, values)
            if len(dense):
                across = cofactor[columns[:, :, None], dense]
                result[own] += 2.0 * np.einsum(
                    "mi,mid,md->m", values, across, reduced.design_dense[own]
                )
    return np.asarray(result)


def observation_cofactors(
    equations: Equations, rows: Indices, reduced: ReducedEquations, cofactor: Array
) -> Array:
    """Cofactors of adjusted or predicted observations.

    Args:
        equations: rows of the same columns and points as the reduced ones; they need not have
            taken part.
        rows: k groups of n rows, shape (k, n).
        reduced: reduced equations of the adjustment.
        cofactor: of the columns, shape (c, c).

    Returns:
        Shape (k, n, n), whitened by the sigmas of the rows.
    """
    count, width = rows.shape
    result = np.zeros((count, width, width))
    thin, dense = reduced.sparse_columns, reduced.dense_columns
    points = 3 * len(reduced.point_factor)
    step = max(1, _PART_BYTES // (8 * width * max(len(cofactor), 1)))
    for low in range(0, count, step):
        flat = rows[low : low + step].ravel()
        part, at = np.zeros((len(flat), 3)), np.clip(equations.point[flat], 0, None)
        if points:
            part = np.einsum("mi,mij->mj", equations.point_part[flat], reduced.point_factor[at])
        where = (np.repeat(np.arange(len(flat)), 3), (3 * at[:, None] + np.arange(3)).ravel())
        through = sparse.coo_array(
            (part.ravel(), where), shape=(len(flat), max(points, 3))
        ).tocsr()[:, :points]
        design = equations.reduced[flat]
        own = (design[:, thin] - through @ reduced.coupling_sparse).tocsr()
        own_dense = design[:, dense].toarray() - through @ reduced.coupling_dense
        spread = own @ cofactor[thin] + own_dense @ cofactor[dense]
        for i in range(width):
            for j in range(width):
                result[low : low + step, i, j] = (
                    _row_products(own[i::width], spread[j::width][:, thin])
                    + np.einsum("md,md->m", own_dense[i::width], spread[j::width][:, dense])
                    + np.einsum("mi,mi->m", part[i::width], part[j::width])
                )
    return result


def groups_of(
    equations: Equations, residual: Array, redundancy: Array, factors: Mapping[str, float]
) -> tuple[ObservationGroup, ...]:
    """Residuals and variance components of each kind of observation.

    Args:
        equations: rows as last built (their sigmas include `factors`).
        residual: whitened residuals, shape (m,).
        redundancy: redundancy numbers, shape (m,).
        factors: variance factors the sigmas already hold, by group.

    Returns:
        Statistics of the kinds that have rows, in the order of `equations.groups`.

    Source: docs/explanation/mathematics/bundle.md#adjustment.

    Example:
        Two distances of sigma 0.01 m, one redundant: v'v / r = 0.5^2 + 0.5^2 over 1.

        >>> rows = Equations(
        ...     np.zeros(2), sparse.csr_array((2, 1)), np.zeros((2, 3)), np.array([-1, -1]),
        ...     np.full(2, 0.01), np.array([0, 0]), ("distance",), np.array([0, 1]),
        ...     np.array([0, 0]),
        ... )
        >>> (group,) = groups_of(rows, np.array([0.5, -0.5]), np.array([0.5, 0.5]), {})
        >>> group.factor, group.rms, group.worst
        (0.5, 0.005, 0.005)
    """
    found = []
    for index, name in enumerate(equations.groups):
        rows = equations.group == index
        if not rows.any():
            continue
        share = float(redundancy[rows].sum())
        squares = float(residual[rows] @ residual[rows])
        natural = residual[rows] * equations.sigma[rows]
        found.append(
            ObservationGroup(
                name=name,
                count=int(rows.sum()),
                redundancy=share,
                factor=squares / share * factors.get(name, 1.0) if share > 1e-6 else float("nan"),
                rms=float(np.sqrt(np.mean(natural**2))),
                worst=float(np.abs(natural).max()),
            )
        )
    return tuple(found)


def _row_products(rows: sparse.csr_array, dense: Array) -> Array:
    """Scalar products of each sparse row with the dense row of its own number, (m,)."""
    row = np.repeat(np.arange(rows.shape[0]), np.diff(rows.indptr))
    products = np.asarray(rows.data * dense[row, rows.indices], dtype=np.float64)
    return np.bincount(row, weights=products, minlength=rows.shape[0]).astype(np.float64)
