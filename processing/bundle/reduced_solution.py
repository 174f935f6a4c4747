"""Solution of reduced normal equations and its way back to the points; cofactors of the columns.

The factorisation is LAPACK's, or by blocks where the matrix is stored in blocks (`block_band`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from processing import ProcessingError
from processing.bundle.block_band import BandCofactor, BandFactor, BandMatrix
from processing.bundle.normal_equations import MIN_INFORMATION, Matrix, ReducedEquations

Array = NDArray[np.float64]

Cofactor = Array | BandCofactor

_SUBSPACE, _SUBSPACE_STEPS = 16, 6


class SingularError(ProcessingError, ValueError):
    """The reduced matrix has directions without information."""

    def __init__(self) -> None:
        super().__init__("the normal equations are singular")


@dataclass(frozen=True)
class GaussNewtonStep:
    """Corrections of columns (c,) and eliminated points (p, 3), and the predicted decrease.

    `predicted_decrease` is the predicted decrease of the weighted sum of squares.
    """

    dx: Array
    dpoints: Array
    predicted_decrease: float


def weak_directions(matrix: Matrix) -> Array:
    """Directions of a scaled matrix with less information than `MIN_INFORMATION`.

    Args:
        matrix: of `ReducedEquations`.

    Returns:
        Orthonormal, shape (c, n); at least the weakest.
    """
    if isinstance(matrix, BandMatrix):
        values, vectors = _weakest(matrix)
    else:
        values, vectors = linalg.eigh(matrix)
    return np.asarray(vectors[:, : max(1, int((values < MIN_INFORMATION).sum()))])


def null_directions(reduced: ReducedEquations, expected: Array) -> tuple[Array, bool]:
    """Directions without information.

    Args:
        reduced: from `reduced_equations`.
        expected: orthonormal directions in the scaled unknowns that have none, shape (c, d).

    Returns:
        All directions without information, shape (c, n), and whether they are the expected ones;
        only then no eigenvalues were needed.

    Raises:
        SingularError: a matrix in blocks has other directions without information.
    """
    matrix = reduced.matrix
    if isinstance(matrix, BandMatrix):
        if _held(matrix, expected).factor(MIN_INFORMATION) is None:
            raise SingularError
        return expected, True
    if len(matrix) and _cholesky(matrix + expected @ expected.T) is not None:
        return expected, True
    values, vectors = linalg.eigh(matrix)
    return np.asarray(vectors[:, values < MIN_INFORMATION]), False


def solve(reduced: ReducedEquations, *, directions: Array | None = None) -> GaussNewtonStep:
    """Solve the reduced equations and go back to the points.

    Args:
        reduced: from `reduced_equations`.
        directions: a free network: the shortest (scaled) correction, without these orthonormal
            directions, shape (c, d), and others that nothing determines; None: an error.

    Returns:
        Corrections of columns and points, and the predicted decrease of the sum of squares.

    Raises:
        SingularError: directions without information.
    """
    if len(reduced.right):
        right, rows = reduced.right / reduced.scale, reduced.constraints
        inverse = _inverse_action(reduced, directions)
        dx = inverse(right)
        if len(rows):
            spread = inverse(rows.T)
            dx = dx - spread @ np.linalg.lstsq(rows @ spread, rows @ dx, rcond=None)[0]
        dx = dx / reduced.scale
    else:
        dx = np.zeros(0)
    moved = reduced.design_sparse @ dx[reduced.sparse_columns]
    back = reduced.point_right - (
        reduced.orthonormal().T @ moved + reduced.coupling_dense @ dx[reduced.dense_columns]
    )
    dpoints = np.einsum("pij,pj->pi", reduced.point_factor, back.reshape(-1, 3))
    predicted_decrease = float(reduced.right @ dx + reduced.point_right @ reduced.point_right)
    if reduced.damping > 0.0:
        added = float((reduced.scale * dx) @ (reduced.scale * dx))
        added += float((reduced.point_diagonal * dpoints**2).sum())
        predicted_decrease += reduced.damping * added
    return GaussNewtonStep(dx, dpoints, predicted_decrease)


def cofactor_matrix(reduced: ReducedEquations, *, directions: Array | None = None) -> Cofactor:
    """Cofactors of the columns, constraints and eliminated points taken into account.

    Args:
        reduced: from `reduced_equations`.
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
    matrix, rows = reduced.matrix, reduced.constraints
    if isinstance(matrix, BandMatrix):
        return _band_cofactor(matrix, reduced, directions)
    if directions is not None:
        matrix = matrix + directions @ directions.T
    factor = _factor(matrix, reduced)
    inverse, info = linalg.lapack.dpotri(factor, lower=1)
    if info != 0:
        raise SingularError
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    if directions is not None:
        inverse -= directions @ directions.T
    if len(rows):
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
    matrix: BandMatrix, reduced: ReducedEquations, directions: Array | None
) -> BandCofactor:
    factor, rows = _band_factor(matrix, reduced, directions), reduced.constraints
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


def _band_factor(
    matrix: BandMatrix, reduced: ReducedEquations, directions: Array | None
) -> BandFactor:
    """Factor with the directions held, in a copy, or without any, in the place of the matrix."""
    if directions is None:
        factor = reduced.band_factor
    else:
        factor = _held(matrix, directions).factor(MIN_INFORMATION)
    if factor is None:
        raise SingularError
    return factor


def _held(matrix: BandMatrix, directions: Array) -> BandMatrix:
    """A copy with as many unknowns held as there are directions without information."""
    if not directions.shape[1]:
        return matrix.diagonal_added(np.zeros(len(directions)))
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
        raise SingularError
    return factor


def _cholesky(matrix: Array) -> Array | None:
    factor, info = linalg.lapack.dpotrf(matrix, lower=1, clean=1)
    if info != 0 or float(factor.diagonal().min(initial=1.0)) ** 2 < MIN_INFORMATION:
        return None
    return np.asarray(factor)


def _inverse_action(
    reduced: ReducedEquations, directions: Array | None
) -> Callable[[Array], Array]:
    matrix = reduced.matrix
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
    factor = _band_factor(matrix, reduced, directions)
    if directions is None:
        return factor.solve

    def across(right: Array) -> Array:
        right = right - directions @ (directions.T @ right)
        found = factor.solve(right)
        return np.asarray(found - directions @ (directions.T @ found))

    return across
