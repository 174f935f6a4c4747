"""Normal equations with the object points eliminated (Schur complement), and their solution.

Each point's three columns are first made orthonormal within the point (its own Cholesky factor), so
that eliminating it needs a product and no inverse. Columns that most rows touch (interior
orientation) are stored dense, all others sparse; the reduced matrix itself is dense.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from processing import ProcessingError
from processing.bundle.equations import Equations
from processing.bundle.network import NetworkError
from processing.bundle.unknowns import ParameterLayout

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MAX_COLUMNS = 15_000
"""Beyond this the reduced matrix takes more than 1.7 GiB."""

_DENSE_FILL = 0.04
_HELD_WEIGHT = 1e6
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
        matrix, right: (c, c), (c,): reduced normal equations.
        scale: (c,) square roots of the diagonal before elimination.
        point_factor: (p, 3, 3) inverse transposed Cholesky factor of each point: point rows times
            it are orthonormal.
        point_rows: (m, 3) those rows.
        coupling_sparse, coupling_dense: (3p, sparse columns), (3p, dense columns) products of
            `point_rows` with the columns, transposed.
        point_right: (3p,) right-hand side of the orthonormal point unknowns.
        sparse_columns, dense_columns: which columns are which.
        design_sparse, design_dense: the rows themselves, split.
        damping: share of the diagonal that was added to it.
        point_diagonal: (p, 3) that diagonal of the points.
    """

    matrix: Array
    right: Array
    scale: Array
    point_factor: Array
    point_rows: Array
    coupling_sparse: sparse.csr_array
    coupling_dense: Array
    point_right: Array
    sparse_columns: Indices
    dense_columns: Indices
    design_sparse: sparse.csr_array
    design_dense: Array
    damping: float
    point_diagonal: Array


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
    design = equations.reduced
    fill = np.bincount(design.indices, minlength=columns) / max(design.shape[0], 1)
    dense = np.flatnonzero(fill > _DENSE_FILL)
    thin = np.flatnonzero(fill <= _DENSE_FILL)
    by_column = design.tocsc()
    design_sparse = by_column[:, thin].tocsr()
    design_dense = by_column[:, dense].toarray()

    normals = point_normals(equations, layout)
    of_points = normals[:, range(3), range(3)].copy()
    normals[:, range(3), range(3)] += damping * of_points
    if held is not None:
        normals += _HELD_WEIGHT * held[:, :, None] * held[:, None, :]
    factor = np.linalg.inv(np.linalg.cholesky(normals))
    factor = np.swapaxes(factor, 1, 2)
    at = np.clip(equations.point, 0, None)
    if points:
        own = np.einsum("mi,mij->mj", equations.point_part, factor[at])
    else:
        own = np.zeros_like(equations.point_part)
    there = equations.point >= 0
    wide = (3 * equations.point[there, None] + np.arange(3)).ravel()
    begin = np.concatenate([[0], np.cumsum(3 * there)])
    orthonormal = sparse.csr_array((own[there].ravel(), wide, begin), shape=(len(at), 3 * points))
    coupling_sparse = (orthonormal.T @ design_sparse).tocsr()
    coupling_dense = np.asarray(orthonormal.T @ design_dense)
    point_right = np.asarray(orthonormal.T @ equations.misclosure)

    matrix = np.zeros((columns, columns))
    cross = np.asarray(design_sparse.T @ design_dense)
    own_sparse = (design_sparse.T @ design_sparse).toarray()
    own_dense = design_dense.T @ design_dense
    diagonal = np.zeros(columns)
    diagonal[thin], diagonal[dense] = own_sparse.diagonal(), own_dense.diagonal()
    own_sparse -= (coupling_sparse.T @ coupling_sparse).toarray()
    cross -= np.asarray(coupling_sparse.T @ coupling_dense)
    own_dense -= coupling_dense.T @ coupling_dense
    matrix[np.ix_(thin, thin)] = own_sparse
    matrix[np.ix_(thin, dense)] = cross
    matrix[np.ix_(dense, thin)] = cross.T
    matrix[np.ix_(dense, dense)] = own_dense
    matrix[range(columns), range(columns)] += damping * diagonal
    right = np.zeros(columns)
    right[thin] = design_sparse.T @ equations.misclosure - coupling_sparse.T @ point_right
    right[dense] = design_dense.T @ equations.misclosure - coupling_dense.T @ point_right
    return ReducedEquations(
        matrix=matrix,
        right=right,
        scale=np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)),
        point_factor=factor,
        point_rows=own,
        coupling_sparse=coupling_sparse,
        coupling_dense=coupling_dense,
        point_right=point_right,
        sparse_columns=thin,
        dense_columns=dense,
        design_sparse=design_sparse,
        design_dense=design_dense,
        damping=damping,
        point_diagonal=of_points,
    )


def refuse_large_block(columns: int) -> None:
    """Refuse a block whose reduced normal matrix would not fit into memory.

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


def constrained_matrix(reduced: ReducedEquations, constraints: Array) -> tuple[Array, Array]:
    """The scaled reduced matrix with constraints added, and the scaled constraint rows of norm 1.

    Adding C'C leaves the solution under C dx = 0 as it is and gives its directions information.

    Args:
        reduced: from `reduced_equations`.
        constraints: rows, shape (k, c); constraints @ dx = 0.

    Returns:
        Matrix, shape (c, c), of unknowns multiplied by `reduced.scale`, and rows, shape (k, c), of
        the same.
    """
    scaled = reduced.matrix / reduced.scale[:, None] / reduced.scale
    if not len(constraints):
        return scaled, constraints
    rows = constraints / reduced.scale
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return scaled + rows.T @ rows, rows


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
    """
    matrix, _ = constrained_matrix(reduced, constraints)
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
    back = reduced.point_right - (
        reduced.coupling_sparse @ dx[reduced.sparse_columns]
        + reduced.coupling_dense @ dx[reduced.dense_columns]
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
) -> Array:
    """Cofactors of the columns, constraints and eliminated points taken into account.

    Args:
        reduced: from `reduced_equations`.
        constraints: rows, shape (k, c); constraints @ dx = 0.
        directions: all that nothing determines, orthonormal in the scaled unknowns, shape (c, d);
            they have no variance. None: an error where there are any.

    Returns:
        Shape (c, c); times sigma0 squared it is the covariance.

    Raises:
        SingularError: directions without information.
    """
    if not len(reduced.right):
        return np.zeros((0, 0))
    matrix, rows = constrained_matrix(reduced, constraints)
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
    matrix: Array, reduced: ReducedEquations, directions: Array | None
) -> Callable[[Array], Array]:
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
