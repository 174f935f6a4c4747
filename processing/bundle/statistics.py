"""Statistics of an adjusted network: covariances of points, redundancy numbers, groups.

Everything is exact, from the reduced equations and their inverse; nothing of the size of all
unknowns squared is ever formed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from processing.bundle.block_band import BandCofactor
from processing.bundle.eliminated_products import add_spread
from processing.bundle.equation_rows import Equations
from processing.bundle.normal_equations import ReducedEquations
from processing.bundle.reduced_solution import Cofactor

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_PART_BYTES = 64_000_000
_PART_ROWS = 100_000
_WINDOW_COLUMNS = 6_000


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
    equations: Equations, reduced: ReducedEquations, cofactor: Cofactor
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
    dense, design = reduced.dense_columns, reduced.design_dense
    points = len(reduced.point_factor)
    among_dense = cofactors_between(cofactor, dense)
    leverage = np.einsum("mi,mi->m", reduced.point_rows, reduced.point_rows)
    leverage += np.einsum("md,md->m", design @ among_dense, design)
    influence = np.zeros((len(equations.point), 3))
    through = np.zeros((points, 3, 3))
    for part in _parts(equations, reduced, cofactor):
        add_spread(
            part.rows,
            part.begin,
            equations.point,
            reduced.design_sparse.indptr,
            reduced.design_sparse.indices,
            reduced.design_sparse.data,
            design,
            reduced.point_rows,
            reduced.coupling_dense.reshape(points, 3, len(dense)),
            (reduced.coupling_dense @ among_dense).reshape(points, 3, len(dense)),
            reduced.point_factor,
            part.window,
            part.at_sparse,
            part.at_dense,
            leverage,
            influence,
            through,
        )
    inner = through + np.eye(3)
    factor = reduced.point_factor
    cofactors = np.einsum("pij,pjk,plk->pil", factor, inner, factor)
    return np.asarray(cofactors), np.asarray(np.clip(leverage, 0.0, 1.0)), influence


def cofactors_between(cofactor: Cofactor, columns: Indices) -> Array:
    """Cofactors between columns; of a large block only those of exposures with common points.

    Args:
        cofactor: of the columns.
        columns: shape (k,).

    Returns:
        Shape (k, k).
    """
    if isinstance(cofactor, BandCofactor):
        return cofactor.window(columns)
    return np.asarray(cofactor[np.ix_(columns, columns)])


class _Part(NamedTuple):
    """Rows by point (single ones without), first of each, and cofactors of their columns."""

    rows: Indices
    begin: Indices
    window: Array
    at_sparse: Indices
    at_dense: Indices


def _parts(equations: Equations, reduced: ReducedEquations, cofactor: Cofactor) -> Iterator[_Part]:
    """All rows at once where all cofactors are there; else such as are near each other."""
    thin, dense = reduced.sparse_columns, reduced.dense_columns
    points, rows = len(reduced.point_factor), len(equations.point)
    loose = equations.point < 0
    group = np.where(loose, points + np.arange(rows), equations.point)
    if not isinstance(cofactor, BandCofactor):
        order = np.argsort(group, kind="stable")
        yield _Part(order, _begin(group[order]), cofactor, thin, dense)
        return
    place = _first_places(reduced.design_sparse, cofactor.order.place[thin])
    nearest = np.full(points + rows, len(cofactor), dtype=np.int64)
    np.minimum.at(nearest, group, place)
    order = np.lexsort((group, nearest[group]))
    begin = _begin(group[order])
    for low, high in _group_ranges(begin):
        own = order[begin[low] : begin[high]]
        taken = reduced.design_sparse[own].indices
        columns = np.concatenate([thin[np.unique(taken)], dense])
        at = np.full(len(cofactor), -1, dtype=np.int64)
        at[columns] = np.arange(len(columns))
        yield _Part(
            own,
            begin[low : high + 1] - begin[low],
            cofactor.window(columns),
            at[thin],
            at[dense],
        )


def _begin(group: Indices) -> Indices:
    """First of each run of equal numbers, and the end."""
    return np.concatenate([np.flatnonzero(np.diff(group, prepend=-1)), [len(group)]])


def _first_places(design: sparse.csr_array, place: Indices) -> Indices:
    """Smallest place of the columns of each row; beyond the last where it has none."""
    result = np.full(design.shape[0], len(place), dtype=np.int64)
    filled = np.flatnonzero(np.diff(design.indptr))
    if len(filled):
        result[filled] = np.minimum.reduceat(place[design.indices], design.indptr[filled])
    return result


def _group_ranges(begin: Indices) -> Iterator[tuple[int, int]]:
    """Ranges of groups of about `_PART_ROWS` rows; row `begin[k]` is the first of group k."""
    low, groups = 0, len(begin) - 1
    while low < groups:
        high = int(np.searchsorted(begin, begin[low] + _PART_ROWS, side="right")) - 1
        high = min(max(high, low + 1), groups)
        yield low, high
        low = high


def observation_cofactors(
    equations: Equations, rows: Indices, reduced: ReducedEquations, cofactor: Cofactor
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
    columns, near = equations.reduced.shape[1], np.arange(count)
    if isinstance(cofactor, BandCofactor):
        columns = min(columns, _WINDOW_COLUMNS)
        place = _first_places(equations.reduced, cofactor.order.place)
        near = np.argsort(place[rows[:, 0]], kind="stable")
    step = max(1, _PART_BYTES // (8 * width * max(columns, 1)))
    for low in range(0, count, step):
        chosen = near[low : low + step]
        flat = rows[chosen].ravel()
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
        used = np.unique(own.indices)
        own = sparse.hstack([own[:, used], sparse.csr_array(own_dense)], format="csr")
        spread = own @ cofactors_between(cofactor, np.concatenate([thin[used], dense]))
        for i in range(width):
            for j in range(width):
                result[chosen, i, j] = _row_products(own[i::width], spread[j::width]) + np.einsum(
                    "mi,mi->m", part[i::width], part[j::width]
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
