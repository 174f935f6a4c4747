"""What is known of an adjusted network: covariances of points, redundancy numbers, groups.

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
from processing.bundle.normal import Reduced

Array = NDArray[np.float64]

_PART_BYTES = 64_000_000


@dataclass(frozen=True)
class Group:
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


def point_cofactors(reduced: Reduced, cofactor: Array) -> Array:
    """Cofactors (p, 3, 3) of the eliminated points, m squared; zero where a coordinate is held
    is left to the caller."""
    points = len(reduced.point_factor)
    inner = np.broadcast_to(np.eye(3), (points, 3, 3)).copy()
    for first, last, spread, coupling_s, coupling_d in _parts(reduced, cofactor):
        n = last - first
        wide = np.zeros((3 * n, cofactor.shape[0]))
        wide[:, reduced.sparse_columns] = coupling_s.toarray()
        wide[:, reduced.dense_columns] = coupling_d
        inner[first:last] += np.einsum(
            "pic,pjc->pij", spread.reshape(n, 3, -1), wide.reshape(n, 3, -1)
        )
    return np.asarray(
        np.einsum("pij,pjk,plk->pil", reduced.point_factor, inner, reduced.point_factor)
    )


def leverages(equations: Equations, reduced: Reduced, cofactor: Array) -> Array:
    """How much of an observation's error stays in its adjusted value, (m,): 1 - redundancy number.

    A row (a, b) of columns a and orthonormal point part b has a leverage of
    b b' + (a - b W) Q (a - b W)', W being the point's coupling with the columns.
    """
    m = len(equations.misclosure)
    result = np.einsum("mi,mi->m", reduced.point_rows, reduced.point_rows)
    thin, dense = reduced.sparse_columns, reduced.dense_columns
    step = max(1, _PART_BYTES // (8 * max(len(cofactor), 1)))
    for first in range(0, m, step):
        rows = slice(first, min(first + step, m))
        own, own_dense = reduced.design_sparse[rows], reduced.design_dense[rows]
        carried = own @ cofactor[thin] + own_dense @ cofactor[dense]
        result[rows] += _row_products(own, carried[:, thin])
        result[rows] += np.einsum("md,md->m", own_dense, carried[:, dense])
    order = np.argsort(equations.point, kind="stable")
    begin = np.searchsorted(equations.point[order], np.arange(len(reduced.point_factor) + 1))
    for low, high, spread, coupling_s, coupling_d in _parts(reduced, cofactor):
        rows_of = order[begin[low] : begin[high]]
        if not len(rows_of):
            continue
        local = equations.point[rows_of] - low
        b = reduced.point_rows[rows_of]
        through = np.einsum("mi,mic->mc", b, spread.reshape(high - low, 3, -1)[local])
        own, own_dense = reduced.design_sparse[rows_of], reduced.design_dense[rows_of]
        mixed = _row_products(own, through[:, thin])
        mixed += np.einsum("md,md->m", own_dense, through[:, dense])
        wide_rows = (3 * local[:, None] + np.arange(3)).ravel()
        pick = sparse.coo_array(
            (b.ravel(), (np.repeat(np.arange(len(b)), 3), wide_rows)),
            shape=(len(b), 3 * (high - low)),
        ).tocsr()
        back = _row_products((pick @ coupling_s).tocsr(), through[:, thin])
        back += np.einsum("md,md->m", pick @ coupling_d, through[:, dense])
        result[rows_of] += back - 2.0 * mixed
    return np.asarray(np.clip(result, 0.0, 1.0))


def groups_of(
    equations: Equations, residual: Array, redundancy: Array, factors: Mapping[str, float]
) -> tuple[Group, ...]:
    """Residuals and variance components of each kind of observation.

    Args:
        equations: rows as last built (their sigmas include `factors`).
        residual: (m,) whitened residuals.
        redundancy: (m,) redundancy numbers.
        factors: variance factors the sigmas already hold, by group.
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
            Group(
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
    reduced: Reduced, cofactor: Array
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


def _row_products(rows: sparse.csr_array, dense: Array) -> Array:
    """Scalar products of sparse and dense rows alike, (m,)."""
    at = np.repeat(np.arange(rows.shape[0]), np.diff(rows.indptr))
    products = np.asarray(rows.data * dense[at, rows.indices], dtype=np.float64)
    return np.bincount(at, weights=products, minlength=rows.shape[0]).astype(np.float64)
