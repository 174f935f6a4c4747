"""Normal equations with the object points eliminated (Schur complement).

Each point's three columns are first made orthonormal within the point (its own Cholesky factor), so
that eliminating it needs a product and no inverse. Columns that most rows touch (interior
orientation) are stored dense, all others sparse. The reduced matrix is dense, of a large block in
blocks near its diagonal (`block_order`). Its solution is in `reduced_solution`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from processing.bundle.block_band import BandFactor, BandMatrix
from processing.bundle.eliminated_products import add_products
from processing.bundle.equation_rows import Equations
from processing.bundle.network import NetworkError
from processing.bundle.unknowns import ParameterLayout

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

Matrix = Array | BandMatrix

MAX_COLUMNS = 150_000
"""Beyond this even the equations of the object points do not fit into 16 GiB."""

MIN_INFORMATION = 1e-11
"""Of the reduced matrix over the diagonal it had before points were eliminated; a datum defect
leaves 1e-14."""

_DENSE_FILL = 0.04
_HELD_WEIGHT = 1e6


@dataclass(frozen=True)
class ReducedEquations:
    """Normal equations of the columns after elimination of the points.

    Attributes:
        matrix: (c, c) reduced normal matrix of the unknowns multiplied by `scale`, with C'C of
            the constraint rows added: that leaves the solution under C dx = 0 as it is and gives
            its directions information. In the blocks of `layout.order`; `band_factor` overwrites
            it.
        right: (c,) right-hand side of the unknowns as they are.
        scale: (c,) square roots of the diagonal before elimination.
        constraints: (k, c) rows of norm 1 of the scaled unknowns.
        point_factor: (p, 3, 3) inverse transposed Cholesky factor of each point: point rows times
            it are orthonormal.
        point_rows: (m, 3) those rows.
        row_point: (m,) point of each row, -1 where there is none.
        coupling_dense: (3p, dense columns) products of `point_rows` with the columns, transposed.
        point_right: (3p,) right-hand side of the orthonormal point unknowns.
        sparse_columns, dense_columns: which columns are which.
        design_sparse, design_dense: the rows themselves, split.
        damping: share of the diagonal that was added to it.
        point_diagonal: (p, 3) that diagonal of the points.
    """

    matrix: Matrix
    right: Array
    scale: Array
    constraints: Array
    point_factor: Array
    point_rows: Array
    row_point: Indices
    coupling_dense: Array
    point_right: Array
    sparse_columns: Indices
    dense_columns: Indices
    design_sparse: sparse.csr_array
    design_dense: Array
    damping: float
    point_diagonal: Array

    @cached_property
    def band_factor(self) -> BandFactor | None:
        """Factor of a matrix in blocks, in its place; None: directions without information.

        The matrix of a large block takes gigabytes and is not stored twice.
        """
        assert isinstance(self.matrix, BandMatrix)
        return self.matrix.factor(MIN_INFORMATION)

    @cached_property
    def coupling_sparse(self) -> sparse.csr_array:
        """Products of `point_rows` with the sparse columns, (3p, sparse columns)."""
        return sparse.csr_array(self.orthonormal().T @ self.design_sparse)

    def orthonormal(self) -> sparse.csr_array:
        """`point_rows` as a sparse matrix.

        Returns:
            Shape (m, 3p).
        """
        return _orthonormal_rows(self.point_rows, self.row_point, len(self.point_factor))


def point_normals(equations: Equations, layout: ParameterLayout) -> Array:
    """Normal matrices of the eliminated points alone.

    Args:
        equations: the rows.
        layout: their columns and points.

    Returns:
        Shape (p, 3, 3), in the order of `layout.eliminated_points`; one is added to the diagonal
        where a coordinate is held.
    """
    points = len(layout.eliminated_points)
    result = np.zeros((points, 3, 3))
    rows = equations.point >= 0
    who, part = equations.point[rows], equations.point_part[rows]
    for i in range(3):
        for j in range(i, 3):
            total = np.bincount(who, weights=part[:, i] * part[:, j], minlength=points)
            result[:, i, j] = result[:, j, i] = total
    held = layout.locked[layout.eliminated_points]
    result[:, range(3), range(3)] += np.where(held, 1.0, 0.0)
    return result


def reduced_equations(
    equations: Equations,
    layout: ParameterLayout,
    damping: float = 0.0,
    held: Array | None = None,
) -> ReducedEquations:
    """Eliminate the points.

    Args:
        equations: the rows.
        layout: their columns and points.
        damping: share of the diagonal that is added to it (Levenberg-Marquardt).
        held: directions in which points do not move, times the root of their information, shape
            (p, 3), zero where there is none; None: all zero.

    Returns:
        Normal equations of the columns, with what leads back to the points.

    Raises:
        NetworkError: more columns than `MAX_COLUMNS`.
        LinAlgError: a point that its rays do not fix.
    """
    columns, points = layout.columns, len(layout.eliminated_points)
    refuse_large_block(columns)
    thin, dense, design_sparse, design_dense = _split(equations.reduced, layout)
    normals = point_normals(equations, layout)
    of_points = normals[:, range(3), range(3)].copy()
    normals[:, range(3), range(3)] += damping * of_points
    if held is not None:
        normals += _HELD_WEIGHT * held[:, :, None] * held[:, None, :]
    factor = np.linalg.inv(np.linalg.cholesky(normals))
    factor = np.swapaxes(factor, 1, 2)
    if points:
        at = np.clip(equations.point, 0, None)
        own = np.einsum("mi,mij->mj", equations.point_part, factor[at])
    else:
        own = np.zeros_like(equations.point_part)
    orthonormal = _orthonormal_rows(own, equations.point, points)
    coupling_dense = np.asarray(orthonormal.T @ design_dense)
    point_right = np.asarray(orthonormal.T @ equations.misclosure)

    # Products of sparse columns with dense ones and with the misclosures.
    across = np.empty((len(thin), len(dense) + 1))
    across[:, :-1] = design_sparse.T @ design_dense
    across[:, -1] = design_sparse.T @ equations.misclosure
    order = layout.order
    if order is None:
        place, row_offset = np.arange(columns), columns * np.arange(columns)
        values = np.zeros(columns**2)
    else:
        place, row_offset = order.place, order.row_offset
        values = np.zeros(int(order.block_offset[-1]))
    rows = np.argsort(equations.point, kind="stable")
    add_products(
        rows,
        np.searchsorted(equations.point[rows], np.arange(points + 1)),
        design_sparse.indptr,
        design_sparse.indices,
        design_sparse.data,
        own,
        coupling_dense.reshape(points, 3, len(dense)),
        point_right.reshape(points, 3),
        place[thin],
        row_offset,
        values,
        across,
    )
    own_dense = design_dense.T @ design_dense
    diagonal = np.zeros(columns)
    diagonal[thin] = np.bincount(
        design_sparse.indices, weights=design_sparse.data**2, minlength=len(thin)
    )
    diagonal[dense] = own_dense.diagonal()
    own_dense -= coupling_dense.T @ coupling_dense
    matrix: Matrix
    if order is None:
        matrix = values.reshape(columns, columns)
        matrix += np.tril(matrix, -1).T
        matrix[np.ix_(thin, dense)] = across[:, :-1]
        matrix[np.ix_(dense, thin)] = across[:, :-1].T
        matrix[np.ix_(dense, dense)] = own_dense
        matrix[range(columns), range(columns)] += damping * diagonal
    else:
        matrix = BandMatrix(order, values)
        matrix.mirrored()
        border, of_thin, of_dense = matrix.border(), place[thin], place[dense]
        border[np.ix_(of_dense - order.local, of_thin)] += across[:, :-1].T
        tied = np.flatnonzero(of_thin >= order.local)
        border[np.ix_(of_thin[tied] - order.local, of_dense)] += across[tied, :-1]
        border[np.ix_(of_dense - order.local, of_dense)] += own_dense
        if damping > 0.0:
            matrix.add_to_diagonal(damping * diagonal)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    constraints = layout.constraints / scale
    constraints /= np.linalg.norm(constraints, axis=1, keepdims=True)
    if isinstance(matrix, BandMatrix):
        matrix.scale(1.0 / scale)
        matrix.add_border_rows(constraints)
    else:
        matrix /= scale[:, None]
        matrix /= scale
        if len(constraints):
            matrix += constraints.T @ constraints
    right = np.zeros(columns)
    right[thin] = across[:, -1]
    right[dense] = design_dense.T @ equations.misclosure - coupling_dense.T @ point_right
    return ReducedEquations(
        matrix=matrix,
        right=right,
        scale=scale,
        constraints=constraints,
        point_factor=factor,
        point_rows=own,
        row_point=equations.point,
        coupling_dense=coupling_dense,
        point_right=point_right,
        sparse_columns=thin,
        dense_columns=dense,
        design_sparse=design_sparse,
        design_dense=design_dense,
        damping=damping,
        point_diagonal=of_points,
    )


def _split(
    design: sparse.csr_array, layout: ParameterLayout
) -> tuple[Indices, Indices, sparse.csr_array, Array]:
    """Sparse and dense columns, and the rows split by them."""
    rows, columns = design.shape
    fill = np.bincount(design.indices, minlength=columns) / max(rows, 1)
    is_dense = fill > _DENSE_FILL
    if layout.order is not None:
        is_dense &= layout.order.place >= layout.order.local
    thin, dense = np.flatnonzero(~is_dense), np.flatnonzero(is_dense)
    number = np.empty(columns, dtype=np.int32)
    number[thin], number[dense] = np.arange(len(thin)), np.arange(len(dense))
    of_dense = is_dense[design.indices]
    begin = np.concatenate([[0], np.cumsum(~of_dense)])[design.indptr].astype(np.int32)
    at = number[design.indices]
    design_sparse = sparse.csr_array(
        (design.data[~of_dense], at[~of_dense], begin), shape=(rows, len(thin))
    )
    design_dense = np.zeros((rows, len(dense)))
    row = np.repeat(np.arange(rows), np.diff(design.indptr) - np.diff(begin))
    design_dense[row, at[of_dense]] = design.data[of_dense]
    return thin, dense, design_sparse, design_dense


def _orthonormal_rows(own: Array, point: Indices, points: int) -> sparse.csr_array:
    """Point parts of rows as a sparse matrix, (m, 3p)."""
    there = point >= 0
    wide = (3 * point[there, None] + np.arange(3)).ravel()
    begin = np.concatenate([[0], np.cumsum(3 * there)])
    return sparse.csr_array((own[there].ravel(), wide, begin), shape=(len(point), 3 * points))


def refuse_large_block(columns: int) -> None:
    """Refuse a block that would not fit into memory.

    Args:
        columns: unknowns in addition to the object points; six of an exposure that is free.

    Raises:
        NetworkError: more than `MAX_COLUMNS`.
    """
    if columns > MAX_COLUMNS:
        raise NetworkError(
            [
                f"{columns} unknowns in addition to the object points; at most {MAX_COLUMNS} are "
                f"adjusted at once, about {MAX_COLUMNS // 6} exposures: split the block"
            ]
        )
