"""Compiled sums over rows whose object points are eliminated: the costliest part of an adjustment.

`add_products` forms the reduced matrix; `add_spread` leads its inverse back to points and rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@compiled_kernel()
def add_products(
    rows: Indices,
    begin: Indices,
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    data: Array,
    own: Array,
    dense: Array,
    right: Array,
    place: Indices,
    row_offset: Indices,
    values: Array,
    across: Array,
) -> None:
    """Add A'A - W'W of sparse columns to a lower triangle, with W the coupling of each point.

    Args:
        rows: rows in the order of their points, shape (m,); those before `begin[0]` have none.
        begin: first of the rows of each point, and the end, shape (p + 1,).
        indptr: first entry of each row of the sparse columns, and the end.
        indices: sparse columns of the entries.
        data: their values.
        own: orthonormal point part of each row, shape (m, 3).
        dense: coupling of points with the columns that are not sparse, shape (p, 3, d).
        right: right-hand side of the points, shape (p, 3).
        place: place of each sparse column, shape (n,).
        row_offset: index into `values` of each place's row, less the place of the column.
        values: lower triangle; changed.
        across: products of sparse columns with the others and the right-hand side, shape
            (n, d + 1); changed.
    """
    width = dense.shape[2]
    local = np.full(len(place), -1, dtype=np.int64)
    used = np.empty(len(place), dtype=np.int64)
    at_place = np.empty(len(place), dtype=np.int64)
    coupling = np.empty((len(place), 3))
    for k in range(begin[0]):
        _add_row(rows[k], indptr, indices, data, place, row_offset, values)
    for point in range(len(begin) - 1):
        count = 0
        for k in range(begin[point], begin[point + 1]):
            row = rows[k]
            _add_row(row, indptr, indices, data, place, row_offset, values)
            b0, b1, b2 = own[row, 0], own[row, 1], own[row, 2]
            for entry in range(indptr[row], indptr[row + 1]):
                column = indices[entry]
                at = local[column]
                if at < 0:
                    at = count
                    local[column] = at
                    used[at] = column
                    at_place[at] = place[column]
                    coupling[at, 0] = coupling[at, 1] = coupling[at, 2] = 0.0
                    count += 1
                value = data[entry]
                coupling[at, 0] += b0 * value
                coupling[at, 1] += b1 * value
                coupling[at, 2] += b2 * value
        for i in range(count):
            column = used[i]
            local[column] = -1
            c0, c1, c2 = coupling[i, 0], coupling[i, 1], coupling[i, 2]
            for j in range(width):
                across[column, j] -= (
                    c0 * dense[point, 0, j] + c1 * dense[point, 1, j] + c2 * dense[point, 2, j]
                )
            across[column, width] -= (
                c0 * right[point, 0] + c1 * right[point, 1] + c2 * right[point, 2]
            )
            own_place = at_place[i]
            for j in range(i + 1):
                other = at_place[j]
                product = c0 * coupling[j, 0] + c1 * coupling[j, 1] + c2 * coupling[j, 2]
                if other <= own_place:
                    values[row_offset[own_place] + other] -= product
                else:
                    values[row_offset[other] + own_place] -= product


@compiled_kernel()
def add_spread(
    rows: Indices,
    begin: Indices,
    point: Indices,
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    data: Array,
    design: Array,
    own: Array,
    coupling: Array,
    coupling_spread: Array,
    factor: Array,
    window: Array,
    at_sparse: Indices,
    at_dense: Indices,
    leverage: Array,
    influence: Array,
    through: Array,
) -> None:
    """Add what passes through the columns, for groups of rows of one point or of none.

    Args:
        rows: rows by group.
        begin: first of each group, and the end.
        point: point of each row, -1 where there is none.
        indptr: first entry of each row of the sparse columns, and the end.
        indices: sparse columns of the entries.
        data: their values.
        design: dense columns of the rows, shape (m, d).
        own: orthonormal point part of the rows, shape (m, 3).
        coupling: of the points with the dense columns, shape (p, 3, d).
        coupling_spread: that times the cofactors of the dense columns, shape (p, 3, d).
        factor: of the points, shape (p, 3, 3).
        window: cofactors between columns.
        at_sparse: index into `window` of each sparse column.
        at_dense: of each dense column.
        leverage: of the rows, without what is to be added, shape (m,); changed.
        influence: change of each row's object point, shape (m, 3); changed.
        through: cofactors of the points' orthonormal unknowns by the columns, shape (p, 3, 3);
            changed.
    """
    d = len(at_dense)
    local = np.full(len(at_sparse), -1, dtype=np.int64)
    used = np.empty(len(at_sparse), dtype=np.int64)
    at = np.empty(len(at_sparse), dtype=np.int64)
    coupled = np.empty((len(at_sparse), 3))
    spread = np.empty((len(at_sparse), 3))
    spread_dense = np.empty((d, 3))
    for group in range(len(begin) - 1):
        who = point[rows[begin[group]]]
        for k in range(begin[group], begin[group + 1]):
            row = rows[k]
            total = 0.0
            for e in range(indptr[row], indptr[row + 1]):
                i = at_sparse[indices[e]]
                part = 0.0
                for f in range(indptr[row], indptr[row + 1]):
                    part += window[i, at_sparse[indices[f]]] * data[f]
                for j in range(d):
                    part += 2.0 * window[i, at_dense[j]] * design[row, j]
                total += part * data[e]
            leverage[row] += total
        if who < 0:
            continue
        count = 0
        for k in range(begin[group], begin[group + 1]):
            row = rows[k]
            for e in range(indptr[row], indptr[row + 1]):
                c = local[indices[e]]
                if c < 0:
                    c = count
                    local[indices[e]] = c
                    used[c] = indices[e]
                    at[c] = at_sparse[indices[e]]
                    coupled[c] = 0.0
                    count += 1
                for a in range(3):
                    coupled[c, a] += own[row, a] * data[e]
        for i in range(count):
            s0, s1, s2 = 0.0, 0.0, 0.0
            for j in range(count):
                q = window[at[i], at[j]]
                s0 += q * coupled[j, 0]
                s1 += q * coupled[j, 1]
                s2 += q * coupled[j, 2]
            for j in range(d):
                q = window[at[i], at_dense[j]]
                s0 += q * coupling[who, 0, j]
                s1 += q * coupling[who, 1, j]
                s2 += q * coupling[who, 2, j]
            spread[i, 0], spread[i, 1], spread[i, 2] = s0, s1, s2
        for j in range(d):
            for a in range(3):
                spread_dense[j, a] = coupling_spread[who, a, j]
            for i in range(count):
                q = window[at[i], at_dense[j]]
                for a in range(3):
                    spread_dense[j, a] += q * coupled[i, a]
        for a in range(3):
            for b in range(3):
                value = 0.0
                for i in range(count):
                    value += spread[i, a] * coupled[i, b]
                for j in range(d):
                    value += spread_dense[j, a] * coupling[who, b, j]
                through[who, a, b] = value
        for k in range(begin[group], begin[group + 1]):
            row = rows[k]
            change = np.zeros(3)
            for a in range(3):
                mixed, back = 0.0, 0.0
                for e in range(indptr[row], indptr[row + 1]):
                    mixed += data[e] * spread[local[indices[e]], a]
                for j in range(d):
                    mixed += design[row, j] * spread_dense[j, a]
                for b in range(3):
                    back += through[who, a, b] * own[row, b]
                leverage[row] += own[row, a] * (back - 2.0 * mixed)
                change[a] = own[row, a] + back - mixed
            for a in range(3):
                value = 0.0
                for b in range(3):
                    value += factor[who, a, b] * change[b]
                influence[row, a] = value
        for i in range(count):
            local[used[i]] = -1


@compiled_kernel(inline="always")
def _add_row(
    row: int,
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    data: Array,
    place: Indices,
    row_offset: Indices,
    values: Array,
) -> None:
    for first in range(indptr[row], indptr[row + 1]):
        i = place[indices[first]]
        for second in range(indptr[row], first + 1):
            j = place[indices[second]]
            product = data[first] * data[second]
            if j <= i:
                values[row_offset[i] + j] += product
            else:
                values[row_offset[j] + i] += product
