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
    thin, dense = reduced.sparse_columns, reduced.dense_columns
    order = np.argsort(equations.point, kind="stable")
    begin = np.searchsorted(equations.point[order], np.arange(points + 1))
    for low, high, spread, coupling, coupling_dense in _parts(reduced, cofactor):
        in_thin, in_dense = spread[:, thin], spread[:, dense]
        for axis in range(3):
            own = coupling[axis::3].tocsr()
            for other in range(3):
                through[low:high, other, axis] = _row_products(own, in_thin[other::3])
        through[low:high] += np.einsum(
            "pic,pjc->pij",
            in_dense.reshape(high - low, 3, -1),
            coupling_dense.reshape(high - low, 3, -1),
        )
        rows = order[begin[low] : begin[high]]
        local = equations.point[rows] - low
        b = reduced.point_rows[rows]
        sparse_rows, dense_rows = reduced.design_sparse[rows], reduced.design_dense[rows]
        mixed = np.zeros((len(rows), 3))
        for axis in range(3):
            at = 3 * local + axis
            mixed[:, axis] = _row_products(sparse_rows, in_thin, at)
            mixed[:, axis] += np.einsum("md,md->m", dense_rows, in_dense[at])
        back = np.einsum("mij,mj->mi", through[equations.point[rows]], b)
        leverage[rows] += np.einsum("mi,mi->m", b, back - 2.0 * mixed)
        factor = reduced.point_factor[equations.point[rows]]
        influence[rows] = np.einsum("mij,mj->mi", factor, b + back - mixed)
    inner = through + np.eye(3)
    factor = reduced.point_factor
    cofactors = np.einsum("pij,pjk,plk->pil", factor, inner, factor)
    return np.asarray(cofactors), np.asarray(np.clip(leverage, 0.0, 1.0)), influence


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


def _parts(
    reduced: ReducedEquations, cofactor: Array
) -> Iterator[tuple[int, int, Array, sparse.csr_array, Array]]:
    """Points low..high, their coupling times the cofactors (3n, c), and the coupling itself."""
    points = len(reduced.point_factor)
    step = max(1, _PART_BYTES // (24 * max(len(cofactor), 1)))
    thin, dense = cofactor[reduced.sparse_columns], cofactor[reduced.dense_columns]
    for low in range(0, points, step):
        high = min(low + step, points)
        rows = slice(3 * low, 3 * high)
        coupling_s, coupling_d = reduced.coupling_sparse[rows], reduced.coupling_dense[rows]
        yield low, high, coupling_s @ thin + coupling_d @ dense, coupling_s, coupling_d


def _row_products(
    rows: sparse.csr_array, dense: Array, of: NDArray[np.int64] | None = None
) -> Array:
    """Scalar products of each sparse row with the dense row of its own number, or of `of`, (m,)."""
    row = np.repeat(np.arange(rows.shape[0]), np.diff(rows.indptr))
    at = row if of is None else of[row]
    products = np.asarray(rows.data * dense[at, rows.indices], dtype=np.float64)
    return np.bincount(row, weights=products, minlength=rows.shape[0]).astype(np.float64)
