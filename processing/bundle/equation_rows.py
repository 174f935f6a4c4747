"""Whitened rows of observation equations, and how they are put together.

What the rows of each kind of observation are is in `image_rows` and `other_rows`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from processing.bundle.unknowns import ParameterLayout

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Equations:
    """m whitened rows: misclosure + v = design @ corrections.

    Attributes:
        misclosure: (m,) observed less computed.
        reduced: (m, columns), sparse.
        point_part: (m, 3) derivatives by the eliminated point's coordinates, zero where held.
        point: (m,) its position among the eliminated, -1 where there is none.
        sigma: (m,) standard deviation a row was divided by (robust weights are not in it).
        group: (m,) index into `groups`.
        groups: kinds of observations.
        source: (m,) row of the table the observation comes from (image points, ...).
        axis: (m,) coordinate of that row, 0 to 2.
    """

    misclosure: Array
    reduced: sparse.csr_array
    point_part: Array
    point: Indices
    sigma: Array
    group: Indices
    groups: tuple[str, ...]
    source: Indices
    axis: Indices


GROUPS = (
    "image x",
    "image y",
    "control plan",
    "control height",
    "GNSS plan",
    "GNSS height",
    "attitude",
    "distance",
    "prior",
    "jitter",
    "pattern",
)


class RowBuilder:
    """Rows of all observations, appended kind by kind."""

    def __init__(self, layout: ParameterLayout, derivatives: bool) -> None:
        self.layout = layout
        self.derivatives = derivatives
        self.count = 0
        self._entries: list[NDArray[np.int32]] = []
        self._columns: list[NDArray[np.int32]] = []
        self._values: list[Array] = []
        self._tables: tuple[list[Any], ...] = tuple([] for _ in range(7))

    def add(
        self,
        misclosure: Array,
        sigma: Array,
        group: Indices,
        source: Indices,
        entries: list[tuple[Indices, Array]],
        *,
        point: Indices | None = None,
        point_part: Array | None = None,
        weight: Array | None = None,
        axis: int = 0,
    ) -> None:
        """Append rows; an observation with an infinite sigma has none.

        Args:
            misclosure: observed less computed, shape (n,).
            sigma: standard deviations, shape (n,).
            group: index into `GROUPS`, shape (n,).
            source: row of the table the observation comes from, shape (n,).
            entries: columns, -1 where held, and derivatives by them, each of shape (n, k).
            point: position among the eliminated points, -1 where there is none, shape (n,).
            point_part: derivatives by that point, shape (n, 3).
            weight: factor on the weight, shape (n,); None: one.
            axis: coordinate of the row of the table.
        """
        taken = np.isfinite(sigma)
        n = int(taken.sum())
        sigma = sigma[taken]
        factor = 1.0 / sigma if weight is None else np.sqrt(weight[taken]) / sigma
        part = np.zeros((n, 3)) if point_part is None else point_part[taken] * factor[:, None]
        who = np.full(n, -1, dtype=np.int64) if point is None else point[taken]
        of_axis = np.full(n, axis, dtype=np.int64)
        tables = (
            misclosure[taken] * factor,
            sigma,
            group[taken],
            part,
            who,
            source[taken],
            of_axis,
        )
        for table, value in zip(self._tables, tables, strict=True):
            table.append(value)
        if self.derivatives:
            # Nothing of what is held is copied.
            free = [entry for entry in entries if entry[0].size and entry[0].max() >= 0]
            none = (np.zeros((len(taken), 0), dtype=np.int32), np.zeros((len(taken), 0)))
            columns = np.hstack([none[0], *(c.astype(np.int32) for c, _ in free)])[taken]
            values = np.hstack([none[1], *(v for _, v in free)])[taken] * factor[:, None]
            there = columns >= 0
            self._entries.append(there.sum(axis=1, dtype=np.int32))
            self._columns.append(columns[there])
            self._values.append(values[there])
        self.count += n

    def equations(self) -> Equations:
        """All rows.

        Returns:
            The rows in the order in which they were appended.
        """
        joined = [np.concatenate(part) for part in self._tables]
        shape = (self.count, self.layout.columns)
        if self._entries:
            begin = np.concatenate([[0], np.cumsum(np.concatenate(self._entries))])
            content = np.concatenate(self._values), np.concatenate(self._columns)
            reduced = sparse.csr_array((*content, begin.astype(np.int32)), shape=shape)
        else:
            reduced = sparse.csr_array(shape)
        misclosure, sigma, group, part, point, source, axis = joined
        return Equations(misclosure, reduced, part, point, sigma, group, GROUPS, source, axis)


def columns_where(table: Indices, index: Indices) -> Indices:
    """Columns of owners; -1 where a row has none.

    Args:
        table: columns of each owner, shape (n, k).
        index: owner of each row, -1 where there is none, shape (m,).

    Returns:
        Shape (m, k).
    """
    return np.where((index >= 0)[:, None], table[np.clip(index, 0, None)], -1)
