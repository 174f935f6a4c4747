"""Order of the columns of a large block, in which its reduced matrix has blocks near the diagonal.

Exposures are ordered along a direction of the block, across its lines where these are long. What
all exposures share (interior orientation, heads, lines) comes last, as a border.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from processing.bundle.network import Network, NetworkError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LOCAL_KINDS: Final = ("station", "attitude", "image")
"""Kinds of unknowns of one exposure; all others belong to the border."""

MAX_VALUES: Final = 800_000_000
"""Of a reduced matrix in blocks: 6 GiB, and as much for its factor."""

_DIRECTIONS: Final = 12
_LEAST: Final = 64
"""Columns of a block at least: smaller ones would not be multiplied efficiently."""


@dataclass(frozen=True)
class BlockOrder:
    """Places of columns: blocks that are tied to the next block only, then the border.

    Attributes:
        columns: (c,) the column at each place.
        begin: (k + 1,) first place of each block; the last is the first of the border.
        pattern: (n, n) pairs of places before the border that one object point, image or antenna
            position ties, lower triangle with diagonal.
    """

    columns: Indices
    begin: Indices
    pattern: sparse.csr_array

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.begin) - 1

    @property
    def local(self) -> int:
        """Number of places before the border."""
        return int(self.begin[-1])

    @cached_property
    def place(self) -> Indices:
        """Place of each column, (c,)."""
        place = np.empty_like(self.columns)
        place[self.columns] = np.arange(len(place))
        return place

    @cached_property
    def block_offset(self) -> Indices:
        """Where the values of each block row begin, (k + 2,): then the border, then the end."""
        size = np.diff(self.begin)
        before = np.concatenate([[0], size[:-1]])
        border = (len(self.columns) - self.local) * len(self.columns)
        return np.concatenate([[0], np.cumsum(np.append(size * (before + size), border))])

    @cached_property
    def row_offset(self) -> Indices:
        """Index of the value of places (i, j), j not after i, less j: shape (c,)."""
        offset = np.empty(len(self.columns), dtype=np.int64)
        for k in range(self.blocks):
            low, high = self.begin[k], self.begin[k + 1]
            first = self.begin[max(k - 1, 0)]
            rows = np.arange(high - low)
            offset[low:high] = self.block_offset[k] + rows * (high - first) - first
        border = np.arange(len(self.columns) - self.local)
        offset[self.local :] = self.block_offset[-2] + border * len(self.columns)
        return offset


def block_order(
    network: Network,
    station_columns: Indices,
    attitude_columns: Indices,
    image_columns: Indices,
    columns: int,
    tied: NDArray[np.bool_],
) -> BlockOrder:
    """Choose an order of the columns.

    Args:
        network: which image sees which object point; positions of the stations.
        station_columns: columns of stations, shape (n, 3), -1 where held.
        attitude_columns: of attitudes.
        image_columns: columns of single images, shape (images, k).
        columns: number of columns c.
        tied: columns of the border in addition to those that are of no exposure, shape (c,).

    Returns:
        That of the direction, or of the reverse Cuthill-McKee order, with the least work.

    Raises:
        NetworkError: image points tie exposures all over the block to each other, so that no order
            has blocks that fit into memory.

    Source: Cuthill and McKee (1969); docs/explanation/mathematics/bundle.md#large-blocks.
    """
    incidence, position = _incidence(
        network, station_columns, attitude_columns, image_columns, columns
    )
    used = np.diff(incidence.indptr) > 0
    local = np.flatnonzero(used & ~tied)
    border = np.setdiff1d(np.arange(columns), local)
    incidence = incidence[local]
    graph = (incidence @ _common_points(network, incidence.shape[1]) @ incidence.T).tocsr()
    graph.data = np.ones(len(graph.data), dtype=np.int8)
    weight = 1.0 / np.maximum(np.diff(incidence.indptr), 1)
    place = (incidence @ position) * weight[:, None]
    angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    candidates = [
        np.argsort(place[:, 0] * np.cos(a) + place[:, 1] * np.sin(a), kind="stable") for a in angles
    ]
    turned = sparse.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True)
    candidates.append(turned.astype(np.int64))
    with_begin = [(order, _begin(graph, order)) for order in candidates]
    order, begin = min(with_begin, key=lambda one: float((np.diff(one[1]) ** 3.0).sum()))
    size = np.diff(begin)
    values = int((size * (size + np.append(0, size[:-1]))).sum()) + len(border) * columns
    if values > MAX_VALUES:
        raise NetworkError(
            [
                f"the reduced matrix of {columns} unknowns needs {values * 8 / 2**30:.0f} GiB, for "
                f"object points tie {int(size.max())} of them to each other: look for points with "
                "images far apart, or split the block"
            ]
        )
    pattern = sparse.tril(graph[order][:, order], format="csr")
    pattern.sort_indices()
    return BlockOrder(np.concatenate([local[order], border]), begin, pattern)


def _incidence(
    network: Network, station: Indices, attitude: Indices, image: Indices, columns: int
) -> tuple[sparse.csr_array, Array]:
    """Which columns take part in images, antenna positions and measured attitudes; their places."""
    images, gnss, measured = network.images, network.gnss, network.measured_attitudes
    of_attitude = np.zeros(len(attitude), dtype=np.int64)
    of_attitude[images.attitude] = images.station
    tables = [
        np.hstack([station[images.station], attitude[images.attitude], image]),
        np.hstack([station[gnss.station], attitude[gnss.attitude]]),
        attitude[measured.attitude],
    ]
    stations = np.concatenate([images.station, gnss.station, of_attitude[measured.attitude]])
    rows, who = [], []
    first = 0
    for table in tables:
        index = np.broadcast_to(first + np.arange(len(table))[:, None], table.shape)
        rows.append(table[table >= 0])
        who.append(index[table >= 0])
        first += len(table)
    at = (np.concatenate(rows), np.concatenate(who))
    ones = np.ones(len(at[0]), dtype=np.int32)
    found = sparse.coo_array((ones, at), shape=(columns, first)).tocsr()
    found.data[:] = 1
    return found, network.stations.position_m[stations]


def _common_points(network: Network, count: int) -> sparse.csr_array:
    """Pairs of images with a common object point, and each of `count` with itself."""
    table = network.image_points
    shape = (len(network.points.names), count)
    ones = np.ones(len(table.image), dtype=np.int32)
    seen = sparse.coo_array((ones, (table.point, table.image)), shape=shape).tocsr()
    return (seen.T @ seen + sparse.eye_array(count, dtype=np.int32)).tocsr()


def _begin(graph: sparse.csr_array, order: Indices) -> Indices:
    """First places of blocks each of which is tied to the next one only."""
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    reach = np.maximum.reduceat(place[graph.indices], graph.indptr[:-1])[order]
    reach = np.maximum.accumulate(reach) + 1
    begin, following = [0], max(int(reach[0]), _LEAST) if len(reach) else 0
    while following < len(order):
        begin.append(following)
        following = max(int(reach[following - 1]), following + _LEAST)
    return np.array([*begin, len(order)], dtype=np.int64)
