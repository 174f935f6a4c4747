"""Normal equations with the object points eliminated (Schur complement), and their solution.

Each point's three columns are first made orthonormal within the point (its own Cholesky factor), so
that eliminating it needs a product and no inverse. Columns that most rows touch (interior
orientation) are stored dense, all others sparse. The reduced matrix is dense, of a large block in
blocks near its diagonal (`block_order`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from processing import ProcessingError
from processing.bundle.block_band import BandCofactor, BandFactor, BandMatrix
from processing.bundle.eliminated_products import add_products
from processing.bundle.equations import Equations
from processing.bundle.network import NetworkError
from processing.bundle.unknowns import ParameterLayout

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

Matrix = Array | BandMatrix
Cofactor = Array | BandCofactor

MAX_COLUMNS = 150_000
"""Beyond this even the equations of the object points do not fit into 16 GiB."""

_DENSE_FILL = 0.04
_HELD_WEIGHT = 1e6
_SUBSPACE, _SUBSPACE_STEPS = 16, 6
MIN_INFORMATION = 1e-11
"""Of the reduced matrix over the diagonal it had before points were eliminated; a datum defect
leaves 1e-14."""


class SingularError(ProcessingError, ValueError):
    """The reduced matrix has directions without information; `reduced` is for the diagnosis."""

    def __init__(self, reduced: ReducedEquations) -> None:
        self.reduced = reduced
        super().__init__("the normal equations are singular")


@dataclass(frozen=True)
class ReducedEquations:
    """Normal equations of the columns after elimination of the points.

    Attributes:
        matrix, right: (c, c), (c,): reduced normal equations; in the blocks of `layout.order`.
        scale: (c,) square roots of the diagonal before elimination.
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
    def coupling_sparse(self) -> sparse.csr_array:
        """Products of `point_rows` with the sparse columns, (3p, sparse columns)."""
        rows = _orthonormal_rows(self.point_rows, self.row_point, len(self.point_factor))
        return sparse.csr_array(rows.T @ self.design_sparse)


@dataclass(frozen=True)
class GaussNewtonStep:
    """Corrections of columns (c,) and eliminated points (p, 3), and the predicted decrease.

    `predicted_decrease` is the predicted decrease of the weighted sum of squares.
    """

    dx: Array
    dpoints: Array
    predicted_decrease: float


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
            matrix = matrix.diagonal_added(damping * diagonal)
    right = np.zeros(columns)
    right[thin] = across[:, -1]
    right[dense] = design_dense.T @ equations.misclosure - coupling_dense.T @ point_right
    return ReducedEquations(
        matrix=matrix,
        right=right,
        scale=np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)),
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


def constrained_matrix(reduced: ReducedEquations, constraints: Array) -> tuple[Matrix, Array]:
    """The scaled reduced matrix with constraints added, and the scaled constraint rows of norm 1.

    Adding C'C leaves the solution under C dx = 0 as it is and gives its directions information.

    Args:
        reduced: from `reduced_equations`.
        constraints: rows, shape (k, c); constraints @ dx = 0.

    Returns:
        Matrix, shape (c, c), of unknowns multiplied by `reduced.scale`, and rows, shape (k, c), of
        the same.
    """
    matrix = reduced.matrix
    if isinstance(matrix, BandMatrix):
        scaled: Matrix = matrix.scaled(1.0 / reduced.scale)
    else:
        scaled = matrix / reduced.scale[:, None] / reduced.scale
    if not len(constraints):
        return scaled, constraints
    rows = constraints / reduced.scale
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    if isinstance(scaled, BandMatrix):
        return scaled.with_border_rows(rows), rows
    return scaled + rows.T @ rows, rows


def weak_directions(matrix: Matrix) -> Array:
    """Directions of a scaled matrix with less information than `MIN_INFORMATION`.

    Args:
        matrix: from `constrained_matrix`.

    Returns:
        Orthonormal, shape (c, n); at least the weakest.
    """
    if isinstance(matrix, BandMatrix):
        values, vectors = _weakest(matrix)
    else:
        values, vectors = linalg.eigh(matrix)
    return np.asarray(vectors[:, : max(1, int((values < MIN_INFORMATION).sum()))])


def null_directions(
    reduced: ReducedEquations, constraints: Array, expected: Array
) -> tuple[Array, bool]:
    """Directions without information.

    Args:
        reduced: from `reduced_equations`.
        constraints: rows, shape (k, c).
        expected: orthonormal directions in the scaled unknowns that have none, shape (c, d).

    Returns:
        All directions without information, shape (c, n), and whether they are the expected ones;
        only then no eigenvalues were needed.

    Raises:
        SingularError: a matrix in blocks has other directions without information.
    """
    matrix, _ = constrained_matrix(reduced, constraints)
    if isinstance(matrix, BandMatrix):
        if _held(matrix, expected).factor(MIN_INFORMATION) is None:
            raise SingularError(reduced)
        return expected, True
    if len(matrix) and _cholesky(matrix + expected @ expected.T) is not None:
        return expected, True
    values, vectors = linalg.eigh(matrix)
    return np.asarray(vectors[:, values < MIN_INFORMATION]), False


def solve(
    reduced: ReducedEquations, constraints: Array, *, directions: Array | None = None
) -> GaussNewtonStep:
    """Solve the reduced equations and go back to the points.

    Args:
        reduced: from `reduced_equations`.
        constraints: rows, shape (k, c); constraints @ dx = 0.
        directions: a free network: the shortest (scaled) correction, without these orthonormal
            directions, shape (c, d), and others that nothing determines; None: an error.

    Returns:
        Corrections of columns and points, and the predicted decrease of the sum of squares.

    Raises:
        SingularError: directions without information.
    """
    if len(reduced.right):
        matrix, rows = constrained_matrix(reduced, constraints)
        right = reduced.right / reduced.scale
        inverse = _inverse_action(matrix, reduced, directions)
        dx = inverse(right)
        if len(constraints):
            spread = inverse(rows.T)
            dx = dx - spread @ np.linalg.lstsq(rows @ spread, rows @ dx, rcond=None)[0]
        dx = dx / reduced.scale
    else:
        dx = np.zeros(0)
    moved = reduced.design_sparse @ dx[reduced.sparse_columns]
    orthonormal = _orthonormal_rows(
        reduced.point_rows, reduced.row_point, len(reduced.point_factor)
    )
    back = reduced.point_right - (
        orthonormal.T @ moved + reduced.coupling_dense @ dx[reduced.dense_columns]
    )
    dpoints = np.einsum("pij,pj->pi", reduced.point_factor, back.reshape(-1, 3))
    predicted_decrease = float(reduced.right @ dx + reduced.point_right @ reduced.point_right)
    if reduced.damping > 0.0:
        added = float((reduced.scale * dx) @ (reduced.scale * dx))
        added += float((reduced.point_diagonal * dpoints**2).sum())
        predicted_decrease += reduced.damping * added
    return GaussNewtonStep(dx, dpoints, predicted_decrease)


def cofactor_matrix(
    reduced: ReducedEquations, constraints: Array, *, directions: Array | None = None
) -> Cofactor:
    """Cofactors of the columns, constraints and eliminated points taken into account.

    Args:
        reduced: from `reduced_equations`.
        constraints: rows, shape (k, c); constraints @ dx = 0.
        directions: all that nothing determines, orthonormal in the scaled unknowns, shape (c, d);
            they have no variance. None: an error where there are any.

    Returns:
        Shape (c, c); times sigma0 squared it is the covariance. Of a matrix in blocks, what is
        stored of it.

    Raises:
        SingularError: directions without information.
    """
    if not len(reduced.right):
        return np.zeros((0, 0))
    matrix, rows = constrained_matrix(reduced, constraints)
    if isinstance(matrix, BandMatrix):
        return _band_cofactor(matrix, reduced, rows, directions)
    if directions is not None:
        matrix = matrix + directions @ directions.T
    factor = _factor(matrix, reduced)
    inverse, info = linalg.lapack.dpotri(factor, lower=1)
    if info != 0:
        raise SingularError(reduced)
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    if directions is not None:
        inverse -= directions @ directions.T
    if len(constraints):
        spread = inverse @ rows.T
        inverse -= spread @ np.linalg.pinv(rows @ spread) @ spread.T
    return np.asarray(inverse / reduced.scale[:, None] / reduced.scale)


def with_product(cofactor: Cofactor, left: Array, right: Array) -> Cofactor:
    """Cofactors with a product of few columns added.

    Args:
        cofactor: shape (c, c).
        left: shape (c, k).
        right: shape (c, k); left @ right.T is symmetric.

    Returns:
        The sum.
    """
    if isinstance(cofactor, BandCofactor):
        return cofactor.added(left, right)
    return np.asarray(cofactor + left @ right.T)


def _band_cofactor(
    matrix: BandMatrix, reduced: ReducedEquations, rows: Array, directions: Array | None
) -> BandCofactor:
    if directions is not None:
        matrix = _held(matrix, directions)
    factor = matrix.factor(MIN_INFORMATION)
    if factor is None:
        raise SingularError(reduced)
    result = factor.inverse(reduced.scale)
    if directions is not None:
        # P Z P with P = 1 - G G', in scaled unknowns; then back to columns.
        spread = factor.solve(directions)
        middle = directions.T @ spread
        left = np.hstack([-directions, -spread, directions @ middle])
        right = np.hstack([spread, directions, directions])
        result = result.added(left / reduced.scale[:, None], right / reduced.scale[:, None])
    if len(rows):
        of_columns = (rows * reduced.scale).T
        spread = result @ of_columns
        result = result.added(-spread @ np.linalg.pinv(of_columns.T @ spread), spread)
    return result


def _held(matrix: BandMatrix, directions: Array) -> BandMatrix:
    """The matrix with as many unknowns held as there are directions without information."""
    if not directions.shape[1]:
        return matrix
    _, _, pivots = linalg.qr(directions.T, pivoting=True, mode="economic")
    hold = np.zeros(len(directions))
    hold[pivots[: directions.shape[1]]] = 1.0
    return matrix.diagonal_added(hold)


def _weakest(matrix: BandMatrix) -> tuple[Array, Array]:
    """The smallest eigenvalues and their vectors, by subspace iteration."""
    columns = len(matrix.order.columns)
    factor = matrix.diagonal_added(np.full(columns, 10.0 * MIN_INFORMATION)).factor(0.0)
    basis = np.random.default_rng(1).normal(size=(columns, min(_SUBSPACE, columns)))
    if factor is None:
        raise ProcessingError("the reduced matrix has negative eigenvalues")
    for _ in range(_SUBSPACE_STEPS):
        basis = np.linalg.qr(factor.solve(basis))[0]
    values, vectors = np.linalg.eigh(basis.T @ (matrix @ basis))
    return values, basis @ vectors


def _factor(matrix: Array, reduced: ReducedEquations) -> Array:
    """Lower Cholesky factor, refused where a pivot shows a direction without information."""
    factor = _cholesky(matrix)
    if factor is None:
        raise SingularError(reduced)
    return factor


def _cholesky(matrix: Array) -> Array | None:
    factor, info = linalg.lapack.dpotrf(matrix, lower=1, clean=1)
    if info != 0 or float(factor.diagonal().min(initial=1.0)) ** 2 < MIN_INFORMATION:
        return None
    return np.asarray(factor)


def _inverse_action(
    matrix: Matrix, reduced: ReducedEquations, directions: Array | None
) -> Callable[[Array], Array]:
    if isinstance(matrix, BandMatrix):
        return _band_action(matrix, reduced, directions)
    if directions is None:
        factor = _factor(matrix, reduced)
        return lambda right: np.asarray(linalg.cho_solve((factor, True), right, check_finite=False))
    # In the directions, the matrix is zero: one there leaves the solution across them as it is.
    bordered = _cholesky(matrix + directions @ directions.T)
    if bordered is not None:

        def across(right: Array) -> Array:
            found = linalg.cho_solve((bordered, True), right, check_finite=False)
            return np.asarray(found - directions @ (directions.T @ found))

        return across
    values, vectors = linalg.eigh(matrix)
    known = values > MIN_INFORMATION
    eigenvectors, weights = vectors[:, known], 1.0 / values[known]
    return lambda right: np.asarray(eigenvectors @ ((weights * (eigenvectors.T @ right).T).T))


def _band_action(
    matrix: BandMatrix, reduced: ReducedEquations, directions: Array | None
) -> Callable[[Array], Array]:
    if directions is not None:
        matrix = _held(matrix, directions)
    factor: BandFactor | None = matrix.factor(MIN_INFORMATION)
    if factor is None:
        raise SingularError(reduced)
    if directions is None:
        return factor.solve

    def across(right: Array) -> Array:
        right = right - directions @ (directions.T @ right)
        found = factor.solve(right)
        return np.asarray(found - directions @ (directions.T @ found))

    return across
