"""Reduced matrix of a large block in blocks near the diagonal, its factor, and its inverse.

The inverse is computed where the matrix itself has entries (Takahashi's equations, by blocks);
other elements follow from solutions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from processing.bundle.block_order import BlockOrder

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class BandMatrix:
    """Symmetric matrix; the lower triangle by block rows, then the rows of the border.

    Attributes:
        order: places of the columns.
        values: block rows (block before, own block), and the border (all places), one after the
            other.
    """

    order: BlockOrder
    values: Array

    def blocks(self, k: int) -> tuple[Array, Array]:
        """Views of the part below the block before, and of the diagonal block.

        Args:
            k: block.

        Returns:
            Shapes (n, columns of the block before; none for the first) and (n, n).
        """
        order = self.order
        rows = int(order.begin[k + 1] - order.begin[k])
        part = self.values[order.block_offset[k] : order.block_offset[k + 1]].reshape(rows, -1)
        return part[:, :-rows], part[:, -rows:]

    def border(self) -> Array:
        """View of the border.

        Returns:
            Shape (b, c).
        """
        columns = len(self.order.columns)
        return self.values[self.order.block_offset[-2] :].reshape(-1, columns)

    def mirrored(self) -> None:
        """Copy the lower triangle of diagonal blocks to the upper one."""
        local = self.order.local
        for part in [self.blocks(k)[1] for k in range(self.order.blocks)] + [
            self.border()[:, local:]
        ]:
            part[:] = np.tril(part) + np.tril(part, -1).T

    def add_to_diagonal(self, values: Array) -> None:
        """Add values to the diagonal, in place.

        Args:
            values: by column, shape (c,).
        """
        order = self.order
        self.values[order.row_offset + np.arange(len(order.columns))] += values[order.columns]

    def diagonal_added(self, values: Array) -> BandMatrix:
        """The matrix with values added to its diagonal.

        Args:
            values: by column, shape (c,).

        Returns:
            A new matrix.
        """
        result = BandMatrix(self.order, self.values.copy())
        result.add_to_diagonal(values)
        return result

    def scale(self, factor: Array) -> None:
        """Multiply rows and columns, in place.

        Args:
            factor: by column, shape (c,).
        """
        by_place, begin = factor[self.order.columns], self.order.begin
        for k in range(self.order.blocks):
            rows = by_place[begin[k] : begin[k + 1], None]
            before, own = self.blocks(k)
            before *= rows * by_place[begin[max(k - 1, 0)] : begin[k]]
            own *= rows * by_place[begin[k] : begin[k + 1]]
        border = self.border()
        border *= by_place[self.order.local :, None] * by_place

    def add_border_rows(self, rows: Array) -> None:
        """Add the products of rows whose entries are in the border, in place.

        Args:
            rows: shape (k, c).
        """
        part = rows[:, self.order.columns[self.order.local :]]
        corner = self.border()[:, self.order.local :]
        corner += part.T @ part

    def __matmul__(self, right: Array) -> Array:
        order = self.order
        x = right[order.columns]
        y = np.zeros_like(x)
        begin, local = order.begin, order.local
        for k in range(order.blocks):
            rows = slice(begin[k], begin[k + 1])
            earlier = slice(begin[max(k - 1, 0)], begin[k])
            before, own = self.blocks(k)
            y[rows] += own @ x[rows] + before @ x[earlier]
            y[earlier] += before.T @ x[rows]
        border = self.border()
        y[local:] += border @ x
        y[:local] += border[:, :local].T @ x[local:]
        result = np.empty_like(y)
        result[order.columns] = y
        return result

    def factor(self, least: float) -> BandFactor | None:
        """Cholesky factor by blocks, in the place of the matrix.

        Args:
            least: a squared pivot below it is a direction without information.

        Returns:
            None where there is such a direction.
        """
        begin, local = self.order.begin, self.order.local
        border = self.border()
        corner = border[:, local:]
        above = np.zeros((0, 0))
        for k in range(self.order.blocks):
            before, own = self.blocks(k)
            part = border[:, begin[k] : begin[k + 1]]
            if k:
                before[:] = linalg.solve_triangular(above, before.T, lower=True).T
                own -= before @ before.T
                part -= border[:, begin[k - 1] : begin[k]] @ before.T
            found = _lower(own, least)
            if found is None:
                return None
            own[:] = above = found
            part[:] = linalg.solve_triangular(above, part.T, lower=True).T
            corner -= part @ part.T
        if len(corner):
            last = _lower(corner, least)
            if last is None:
                return None
            corner[:] = last
        return BandFactor(self)


def _lower(matrix: Array, least: float) -> Array | None:
    factor, info = linalg.lapack.dpotrf(matrix, lower=1, clean=1)
    if info != 0 or float(factor.diagonal().min(initial=1.0)) ** 2 < least:
        return None
    return np.asarray(factor)


@dataclass(frozen=True)
class BandFactor:
    """Lower Cholesky factor of a `BandMatrix`, in the same places."""

    lower: BandMatrix

    def solve(self, right: Array) -> Array:
        """Solve with the matrix.

        Args:
            right: by column, shape (c,) or (c, k).

        Returns:
            The same shape.
        """
        order, lower = self.lower.order, self.lower
        x = right[order.columns]
        begin, local, border = order.begin, order.local, lower.border()
        for k in range(order.blocks):
            rows, earlier = slice(begin[k], begin[k + 1]), slice(begin[max(k - 1, 0)], begin[k])
            before, own = lower.blocks(k)
            x[rows] = linalg.solve_triangular(own, x[rows] - before @ x[earlier], lower=True)
        if len(border):
            corner = border[:, local:]
            rest = x[local:] - border[:, :local] @ x[:local]
            last = linalg.solve_triangular(corner, rest, lower=True)
            x[local:] = linalg.solve_triangular(corner, last, lower=True, trans=1)
            x[:local] -= border[:, :local].T @ x[local:]
        for k in reversed(range(order.blocks)):
            rows, earlier = slice(begin[k], begin[k + 1]), slice(begin[max(k - 1, 0)], begin[k])
            before, own = lower.blocks(k)
            x[rows] = linalg.solve_triangular(own, x[rows], lower=True, trans=1)
            x[earlier] -= before.T @ x[rows]
        result = np.empty_like(x)
        result[order.columns] = x
        return result

    def inverse(self, scale: Array) -> BandCofactor:
        """Inverse of the matrix at the pairs of its order, and of the border with everything.

        Args:
            scale: by which rows and columns of the inverse are divided, shape (c,).

        Returns:
            The inverse.

        Source: Takahashi et al. (1973), by blocks.
        """
        order, lower = self.lower.order, self.lower
        begin, local, border = order.begin, order.local, lower.border()
        pattern = order.pattern
        data = np.zeros(len(pattern.indices))
        row = np.repeat(np.arange(local), np.diff(pattern.indptr))
        z_border = np.zeros_like(border)
        corner = np.zeros((0, 0))
        if len(border):
            corner = linalg.cho_solve((border[:, local:], True), np.eye(len(border)))
            z_border[:, local:] = corner
        following = np.zeros((0, 0))
        for k in reversed(range(order.blocks)):
            own = lower.blocks(k)[1]
            low, high = int(begin[k]), int(begin[k + 1])
            size = len(following)
            below = lower.blocks(k + 1)[0] if size else np.zeros((0, high - low))
            through = np.vstack([below, border[:, low:high]])
            through = linalg.solve_triangular(own, through.T, lower=True, trans=1).T
            next_border = z_border[:, high : high + size]
            around = np.block([[following, next_border.T], [next_border, corner]])
            across = -around @ through
            following = linalg.cho_solve((own, True), np.eye(high - low)) - through.T @ across
            z_border[:, low:high] = across[size:]
            for first, last, z in ((low, high, following), (high, high + size, across)):
                at = slice(pattern.indptr[first], pattern.indptr[last])
                inside = (pattern.indices[at] >= low) & (pattern.indices[at] < high)
                entries = np.flatnonzero(inside) + at.start
                data[entries] = z[row[entries] - first, pattern.indices[entries] - low]
        by_place = scale[order.columns]
        data /= by_place[row] * by_place[pattern.indices]
        found = sparse.csr_array((data, pattern.indices, pattern.indptr), shape=pattern.shape)
        z_border /= by_place[local:, None] * by_place
        symmetric = (found + sparse.tril(found, -1).T).tocsr()
        return BandCofactor(order, self, scale, symmetric, z_border)


@dataclass(frozen=True)
class BandCofactor:
    """Cofactors of the columns of a large block, of which most elements are not stored.

    It is indexed by pairs of columns like a matrix, for instance by `np.ix_`. Elements between
    exposures without a common object point take a solution each.

    Attributes:
        order, factor, scale: of the reduced equations.
        pairs: stored elements of places before the border.
        border: (b, c) those of the border.
        left, right: (c, k) by column; their product is added.
    """

    order: BlockOrder
    factor: BandFactor
    scale: Array
    pairs: sparse.csr_array
    border: Array
    left: Array | None = None
    right: Array | None = None

    __array_ufunc__ = None

    @property
    def shape(self) -> tuple[int, int]:
        """(c, c)."""
        return (len(self.order.columns), len(self.order.columns))

    def __len__(self) -> int:
        return len(self.order.columns)

    def diagonal(self) -> Array:
        """Cofactors of single columns.

        Returns:
            Shape (c,).
        """
        result = np.empty(len(self))
        local = self.order.local
        result[self.order.columns[:local]] = self.pairs.diagonal()
        result[self.order.columns[local:]] = self.border[:, local:].diagonal()
        if self.left is not None and self.right is not None:
            result += np.einsum("ck,ck->c", self.left, self.right)
        return result

    def window(self, columns: Indices) -> Array:
        """Stored cofactors between columns; zero where none is.

        Args:
            columns: shape (k,).

        Returns:
            Shape (k, k).
        """
        place, n = self.order.place[columns], self.order.local
        inner, outer = np.flatnonzero(place < n), np.flatnonzero(place >= n)
        result = np.zeros((len(columns), len(columns)))
        result[np.ix_(inner, inner)] = self.pairs[place[inner]][:, place[inner]].toarray()
        if len(outer):
            rows = self.border[place[outer] - n][:, place]
            result[outer] = rows
            result[:, outer] = rows.T
        return self._corrected(result, columns)

    def stored(self) -> tuple[Indices, Indices, Array]:
        """Stored elements, each pair of columns in both orders.

        Returns:
            First columns, second columns and cofactors, shape (k,).
        """
        columns, local = self.order.columns, self.order.local
        pairs = self.pairs.tocoo()
        outer = np.repeat(columns[local:], len(columns))
        every = np.tile(columns, len(self.border))
        value = np.concatenate([pairs.data, self.border.ravel(), self.border[:, :local].ravel()])
        first = np.concatenate(
            [columns[pairs.row], outer, np.tile(columns[:local], len(self.border))]
        )
        second = np.concatenate([columns[pairs.col], every, np.repeat(columns[local:], local)])
        if self.left is not None and self.right is not None:
            value += np.einsum("nk,nk->n", self.left[first], self.right[second])
        return first, second, value

    def __getitem__(self, key: Any) -> Any:
        rows, columns = np.asarray(key[0]), np.asarray(key[1])
        used = np.unique(np.concatenate([rows.ravel(), columns.ravel()]))
        if self._holds(used):
            block = self.window(used)
        else:
            unit = np.zeros((len(self), len(used)))
            unit[used, np.arange(len(used))] = 1.0
            block = (self @ unit)[used]
        return block[np.searchsorted(used, rows), np.searchsorted(used, columns)]

    def __matmul__(self, right: Array) -> Array:
        by = self.scale if right.ndim == 1 else self.scale[:, None]
        result = self.factor.solve(right / by) / by
        if self.left is not None and self.right is not None:
            result = result + self.left @ (self.right.T @ right)
        return np.asarray(result)

    def __rmatmul__(self, left: Array) -> Array:
        return (self @ left.T).T

    def added(self, left: Array, right: Array) -> BandCofactor:
        """The cofactors with a product of few columns added.

        Args:
            left: shape (c, k).
            right: shape (c, k); left @ right.T is symmetric.

        Returns:
            The sum.
        """
        if self.left is None or self.right is None:
            return replace(self, left=left, right=right)
        return replace(
            self, left=np.hstack([self.left, left]), right=np.hstack([self.right, right])
        )

    def _corrected(self, window: Array, columns: Indices) -> Array:
        if self.left is None or self.right is None:
            return window
        return np.asarray(window + self.left[columns] @ self.right[columns].T)

    def _holds(self, columns: Indices) -> bool:
        place = self.order.place[columns]
        place = place[place < self.order.local]
        return self._stored[place][:, place].nnz == len(place) ** 2

    @cached_property
    def _stored(self) -> sparse.csr_array:
        ones = np.ones(len(self.pairs.indices), dtype=np.int8)
        return sparse.csr_array((ones, self.pairs.indices, self.pairs.indptr), self.pairs.shape)
