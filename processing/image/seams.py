"""Seams: which sensor serves which part of the virtual image, and how it fades into the next.

Works on the coarse nodes of `processing.image.balance.node_means`; the pixels are fetched in
`processing.image.resampling`. Sensors are joined to rows and rows to the image, each time along the
path of least disagreement through the overlap (dynamic programming), so that four-fold corners need
no special case and a missing sensor leaves a hole and nothing worse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.balance import NOT_COVERED, UNUSABLE, covered_box
from processing.image.compiled_kernel import compiled_kernel
from processing.image.resampling import WEIGHT_STEP_PX, WEIGHT_UNIT

Array = NDArray[Any]

_STEP_COST: Final = 0.15
"""A detour of one node must save this much disagreement (in units of noise): straight seams."""
_EDGE_COST: Final = 3.0
_UNUSABLE_COST: Final = 30.0
_UNCOVERED_COST: Final = 0.1
"""Per node given to a part that does not cover it. Low, because such nodes are handed over after-
wards: a stretch of them bends the seam, a ragged border of one node does not."""
_NOISE_FLOOR_COUNTS: Final = 100.0


@dataclass(frozen=True)
class _JoinedSensors:
    """Sensors already joined, in the box of nodes from (row, column) on that holds them all: who
    owns each node, and the owner's signal there."""

    row: int
    column: int
    labels: Array
    signal: Array

    @property
    def end_row(self) -> int:
        return self.row + len(self.labels)

    @property
    def end_column(self) -> int:
        return self.column + int(self.labels.shape[1])


def seam_labels(centres: Array, means: Array, gains: Array, feather_px: int) -> Array:
    """The owner of every node.

    Nodes no frame covers have an owner too (the resampling finds nothing there); a node that any
    frame covers is never given to one that does not.

    Args:
        centres: (n, 2) target pixel (column, row) of each sensor's middle.
        means: (n, rows, columns) float32 from `node_means`.
        gains: (n,) applied to the means before they are compared.
        feather_px: seams keep half of it away from the borders of an overlap where there is room.

    Returns:
        Index of a frame, (rows, columns) int8.

    Raises:
        ValueError: no frames at all.

    Source: docs/explanation/mathematics/radiometry.md#seams.
    """
    if len(means) == 0:
        raise ValueError("no frame to compose an image from; give one at least")
    margin = math.ceil(0.5 * feather_px / WEIGHT_STEP_PX) + 1
    parts = []
    for row in sensor_rows(centres, means.shape[1:]):
        joined = _part(means, gains, row[0])
        for index in row[1:]:
            joined = _join(joined, _part(means, gains, index), margin, upright=True)
        parts.append(joined)
    joined_all = parts[0]
    for part in parts[1:]:
        joined_all = _join(joined_all, part, margin, upright=False)
    labels = np.zeros(means.shape[1:], np.int8)
    box = (
        slice(joined_all.row, joined_all.end_row),
        slice(joined_all.column, joined_all.end_column),
    )
    labels[box] = joined_all.labels
    orphaned = np.flatnonzero(joined_all.signal == np.float32(NOT_COVERED))
    i, j = np.divmod(orphaned, joined_all.signal.shape[1])
    i, j = i + joined_all.row, j + joined_all.column
    for index in range(len(means)):
        covers = means[index][i, j] != np.float32(NOT_COVERED)
        labels[i[covers], j[covers]] = index
    return labels


def sensor_rows(centres: Array, shape: Sequence[int]) -> list[list[int]]:
    """Sensors sorted into rows from above, each row from left to right.

    A new row begins where the next middle lies more than a fifth of the image lower.

    Args:
        centres: column and row of each sensor's middle, (n, 2), target pixels.
        shape: rows and columns of weight nodes.

    Returns:
        Indices of sensors, row by row.
    """
    order = np.argsort(centres[:, 1], kind="stable")
    rows: list[list[int]] = []
    gap = 0.2 * shape[0] * WEIGHT_STEP_PX
    last = -math.inf
    for index in order:
        if centres[index, 1] - last > gap:
            rows.append([])
        rows[-1].append(int(index))
        last = float(centres[index, 1])
    return [sorted(row, key=lambda k: float(centres[k, 0])) for row in rows]


def seam_weights(labels: Array, feather_px: int, out: Array) -> None:
    """Weights of every frame at every node, fading linearly over `feather_px` around the seams.

    Args:
        labels: (rows, columns) int8.
        feather_px: full width of the fade; less than one node step gives one node step.
        out: (n, rows, columns) uint8, `WEIGHT_UNIT` is all; overwritten.
    """
    length = max(feather_px / WEIGHT_STEP_PX, 1.0)
    reach = math.ceil((length - 1.0) / 2.0)
    offsets = np.arange(-reach, reach + 1)
    # A box of `length` nodes, its outer nodes counted by the part that lies inside.
    kernel = np.clip(0.5 * length + 0.5 - np.abs(offsets), 0.0, 1.0)
    _feather(labels, (kernel / kernel.sum()).astype(np.float32), out)


def _part(means: Array, gains: Array, index: int) -> _JoinedSensors:
    rows, columns = covered_box(means[index])
    there = means[index][rows, columns]
    signal = np.where(there >= 0.0, there * np.float32(gains[index]), there)
    labels = np.full(signal.shape, index, np.int8)
    return _JoinedSensors(rows.start, columns.start, labels, signal.astype(np.float32))


def _join(
    first: _JoinedSensors, second: _JoinedSensors, margin: int, *, upright: bool
) -> _JoinedSensors:
    """Join two parts, the second right of the first (`upright` seam) or below it."""
    if not first.labels.size or not second.labels.size:
        return first if first.labels.size else second
    if not upright:
        joined = _join(_transposed(first), _transposed(second), margin, upright=True)
        return _transposed(joined)
    row, end_row = min(first.row, second.row), max(first.end_row, second.end_row)
    column = min(first.column, second.column)
    end_column = max(first.end_column, second.end_column)
    low, high = _window(first, second, column, end_column)
    a, b = (_signal_in(part, row, end_row, low, high) for part in (first, second))
    in_a, in_b = a != np.float32(NOT_COVERED), b != np.float32(NOT_COVERED)
    cost = _path_cost(a, b, in_a, in_b, margin)
    path = low + _cheapest_path(cost, np.float32(_STEP_COST))
    shape = (end_row - row, end_column - column)
    labels, signal = np.zeros(shape, np.int8), np.full(shape, NOT_COVERED, np.float32)
    for part, begin, end in ((first, column, low), (second, high, end_column)):
        begin, end = max(begin, part.column), min(end, part.end_column)
        if begin < end:
            own = slice(begin - part.column, end - part.column)
            target = (
                slice(part.row - row, part.end_row - row),
                slice(begin - column, end - column),
            )
            signal[target] = part.signal[:, own]
            labels[target] = part.labels[:, own]
    left = np.arange(low, high)[None, :] < path[:, None]
    window = slice(low - column, high - column)
    signal[:, window] = np.where(left, a, b)
    of_a, of_b = (_labels_in(part, row, end_row, low, high) for part in (first, second))
    labels[:, window] = np.where(left, of_a, of_b)
    return _JoinedSensors(row, column, labels, signal)


def _transposed(part: _JoinedSensors) -> _JoinedSensors:
    """The part with rows and columns exchanged; views, not copies."""
    return _JoinedSensors(part.column, part.row, part.labels.T, part.signal.T)


def _window(
    first: _JoinedSensors, second: _JoinedSensors, column: int, end_column: int
) -> tuple[int, int]:
    """Columns between which the seam must run: from where b begins to where a ends."""
    columns_a = first.column + np.flatnonzero((first.signal != np.float32(NOT_COVERED)).any(axis=0))
    columns_b = second.column + np.flatnonzero(
        (second.signal != np.float32(NOT_COVERED)).any(axis=0)
    )
    low, high = int(columns_b[0]), int(columns_a[-1]) + 1
    if low >= high:
        low, high = high - 1, low + 1
    return max(low - 1, column), min(high + 1, end_column)


def _signal_in(part: _JoinedSensors, row: int, end_row: int, low: int, high: int) -> Array:
    """A part's signal in a window of nodes, `NOT_COVERED` beyond its box."""
    return _laid_out(part, part.signal, (row, end_row, low, high), NOT_COVERED)


def _labels_in(part: _JoinedSensors, row: int, end_row: int, low: int, high: int) -> Array:
    return _laid_out(part, part.labels, (row, end_row, low, high), int(part.labels.flat[0]))


def _laid_out(
    part: _JoinedSensors, values: Array, window: tuple[int, int, int, int], fill: float
) -> Array:
    row, end_row, low, high = window
    out = np.full((end_row - row, high - low), fill, values.dtype)
    begin, end = max(low, part.column), min(high, part.end_column)
    if begin < end:
        out[part.row - row : part.end_row - row, begin - low : end - low] = values[
            :, begin - part.column : end - part.column
        ]
    return out


def _path_cost(a: Array, b: Array, in_a: Array, in_b: Array, margin: int) -> Array:
    """Cost (rows, positions) of a seam at position k: columns < k are a's, the others b's."""
    both = in_a & in_b
    with np.errstate(invalid="ignore"):
        noise = np.sqrt(np.maximum(a + b, 0.0) * 8.0 + _NOISE_FLOOR_COUNTS)
    cost = np.where(both, np.abs(a - b) / noise, 0.0)
    cost[both & ((a == np.float32(UNUSABLE)) | (b == np.float32(UNUSABLE)))] = _UNUSABLE_COST
    # Near the border of the overlap, and beyond it, there is no room to fade.
    shared: Array = np.any(both, axis=1)
    cost[shared[:, None] & ~_eroded(both, margin)] += _EDGE_COST
    # A position that gives nodes to a part that does not cover them costs every such node.
    wrong_for_a = np.cumsum(in_b & ~in_a, axis=1)
    wrong_for_b = np.cumsum((in_a & ~in_b)[:, ::-1], axis=1)[:, ::-1]
    lost = np.zeros_like(cost)
    lost[:, 1:] += wrong_for_a[:, :-1]
    lost += wrong_for_b
    total: Array = (cost + _UNCOVERED_COST * lost).astype(np.float32)
    return np.ascontiguousarray(total)


def _eroded(mask: Array, margin: int) -> Array:
    inner = mask.copy()
    for k in range(1, margin + 1):
        inner[:, k:] &= mask[:, :-k]
        inner[:, :-k] &= mask[:, k:]
    return inner


@compiled_kernel()
def _cheapest_path(cost, step_cost):
    """One position per row, neighbours differing by one at most, of least total cost."""
    rows, positions = cost.shape
    total = cost[0].astype(np.float64)
    middle = (positions - 1) / 2.0
    predecessor = np.zeros((rows, positions), np.int8)
    for i in range(1, rows):
        start_cost = np.empty(positions, np.float64)
        for k in range(positions):
            best = total[k]
            move = 0
            if k > 0 and total[k - 1] + step_cost < best:
                best = total[k - 1] + step_cost
                move = -1
            if k + 1 < positions and total[k + 1] + step_cost < best:
                best = total[k + 1] + step_cost
                move = 1
            # Among equals the middle: 1e-3 is far below any real difference.
            start_cost[k] = best + cost[i, k] + 1e-3 * abs(k - middle)
            predecessor[i, k] = move
        total = start_cost
    path = np.zeros(rows, np.int64)
    path[rows - 1] = np.argmin(total)
    for i in range(rows - 1, 0, -1):
        path[i - 1] = path[i] + predecessor[i, path[i]]
    return path


@compiled_kernel(parallel=True)
def _feather(labels, kernel, out):
    rows, columns = labels.shape
    reach = kernel.shape[0] // 2
    for i in prange(rows):
        for s in range(out.shape[0]):
            for j in range(columns):
                out[s, i, j] = 0
        mixed = _mixed_along(labels, i, reach)
        shares = np.zeros(out.shape[0], np.float32)
        for j in range(columns):
            if not mixed[j]:
                out[labels[i, j], i, j] = WEIGHT_UNIT
                continue
            shares[:] = 0.0
            for dy in range(-reach, reach + 1):
                y = min(max(i + dy, 0), rows - 1)
                for dx in range(-reach, reach + 1):
                    x = min(max(j + dx, 0), columns - 1)
                    shares[labels[y, x]] += kernel[dy + reach] * kernel[dx + reach]
            for s in range(out.shape[0]):
                out[s, i, j] = np.uint8(np.float32(WEIGHT_UNIT) * shares[s] + np.float32(0.5))


@compiled_kernel()
def _mixed_along(labels, i, reach):
    """Where in a row of nodes several frames own nodes within reach; (columns,) uint8."""
    rows, columns = labels.shape
    own = labels[i]
    differs = np.zeros(columns, np.uint8)
    for y in range(max(i - reach, 0), min(i + reach + 1, rows)):
        other = labels[y]
        for j in range(columns):
            differs[j] |= np.uint8(other[j] != own[j])
    mixed = differs.copy()
    for k in range(1, reach + 1):
        for j in range(columns - k):
            mixed[j] |= differs[j + k]
        for j in range(k, columns):
            mixed[j] |= differs[j - k]
    for k in range(reach):
        # A change between two nodes is within reach of those on both sides.
        for j in range(1, columns - k):
            mixed[j + k] |= np.uint8(own[j] != own[j - 1])
        for j in range(1 + k, columns):
            mixed[j - 1 - k] |= np.uint8(own[j] != own[j - 1])
    return mixed
