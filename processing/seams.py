"""Seams: which sensor serves which part of the virtual image, and how it fades into the next.

Works on the coarse nodes of `processing.balance.node_means`; the pixels are fetched in
`processing.resampling`. Sensors are joined to rows and rows to the image, each time along the path
of least disagreement through the overlap (dynamic programming), so that four-fold corners need no
special case and a missing sensor leaves a hole and nothing worse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from processing.balance import NOT_COVERED, UNUSABLE
from processing.resampling import WEIGHT_STEP_PX, WEIGHT_UNIT

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
class _Part:
    """Sensors already joined: who owns each node and the owner's signal there."""

    labels: Array
    signal: Array


def seam_labels(centres: Array, means: Array, gains: Array, feather_px: int) -> Array:
    """The owner of every node: index of a frame, (rows, columns) int8.

    Nodes no frame covers have an owner too (the resampling finds nothing there); a node that any
    frame covers is never given to one that does not.

    Args:
        centres: (n, 2) target pixel (column, row) of each sensor's middle.
        means: (n, rows, columns) float32 from `node_means`.
        gains: (n,) applied to the means before they are compared.
        feather_px: seams keep half of it away from the borders of an overlap where there is room.

    Raises:
        ValueError: no frames at all.
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
    whole = parts[0]
    for part in parts[1:]:
        whole = _join(whole, part, margin, upright=False)
    labels = whole.labels
    orphaned = whole.signal == np.float32(NOT_COVERED)
    if orphaned.any():
        for index in range(len(means)):
            labels[orphaned & (means[index] != np.float32(NOT_COVERED))] = index
    return labels


def sensor_rows(centres: Array, shape: Sequence[int]) -> list[list[int]]:
    """Sensors sorted into rows from above, each row from left to right.

    A new row begins where the next middle lies more than a fifth of the image lower.
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


def _part(means: Array, gains: Array, index: int) -> _Part:
    signal = np.where(means[index] >= 0.0, means[index] * np.float32(gains[index]), means[index])
    return _Part(np.full(signal.shape, index, np.int8), signal.astype(np.float32))


def _join(first: _Part, second: _Part, margin: int, *, upright: bool) -> _Part:
    """Join two parts, the second right of the first (`upright` seam) or below it."""
    if not upright:
        joined = _join(_transposed(first), _transposed(second), margin, upright=True)
        return _transposed(joined)
    a, b = first.signal, second.signal
    in_a, in_b = a != np.float32(NOT_COVERED), b != np.float32(NOT_COVERED)
    low, high = _window(in_a, in_b)
    window = slice(low, high)
    cost = _path_cost(a[:, window], b[:, window], in_a[:, window], in_b[:, window], margin)
    path = low + _cheapest_path(cost, np.float32(_STEP_COST))
    left = np.arange(a.shape[1])[None, :] < path[:, None]
    return _Part(
        np.where(left, first.labels, second.labels),
        np.where(left, a, b),
    )


def _transposed(part: _Part) -> _Part:
    return _Part(np.ascontiguousarray(part.labels.T), np.ascontiguousarray(part.signal.T))


def _window(in_a: Array, in_b: Array) -> tuple[int, int]:
    """Columns between which the seam must run: from where b begins to where a ends."""
    columns_a = np.flatnonzero(in_a.any(axis=0))
    columns_b = np.flatnonzero(in_b.any(axis=0))
    width = in_a.shape[1]
    if len(columns_a) == 0 or len(columns_b) == 0:
        whole = width if len(columns_a) else 0
        return (width - 1, width) if whole else (0, 1)
    low, high = int(columns_b[0]), int(columns_a[-1]) + 1
    if low >= high:
        low, high = high - 1, low + 1
    return max(low - 1, 0), min(high + 1, width)


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


@njit(cache=True, nogil=True)
def _cheapest_path(cost, step_cost):  # type: ignore[no-untyped-def]
    """One position per row, neighbours differing by one at most, of least total cost."""
    rows, positions = cost.shape
    total = cost[0].astype(np.float64)
    middle = (positions - 1) / 2.0
    come_from = np.zeros((rows, positions), np.int8)
    for i in range(1, rows):
        fresh = np.empty(positions, np.float64)
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
            fresh[k] = best + cost[i, k] + 1e-3 * abs(k - middle)
            come_from[i, k] = move
        total = fresh
    path = np.zeros(rows, np.int64)
    path[rows - 1] = np.argmin(total)
    for i in range(rows - 1, 0, -1):
        path[i - 1] = path[i] + come_from[i, path[i]]
    return path


@njit(cache=True, parallel=True, nogil=True)
def _feather(labels, kernel, out):  # type: ignore[no-untyped-def]
    rows, columns = labels.shape
    reach = kernel.shape[0] // 2
    for i in prange(rows):
        for s in range(out.shape[0]):
            for j in range(columns):
                out[s, i, j] = 0
        shares = np.zeros(out.shape[0], np.float32)
        for j in range(columns):
            own = labels[i, j]
            alone = True
            for y in range(max(i - reach, 0), min(i + reach + 1, rows)):
                for x in range(max(j - reach, 0), min(j + reach + 1, columns)):
                    alone &= labels[y, x] == own
            if alone:
                out[own, i, j] = WEIGHT_UNIT
                continue
            shares[:] = 0.0
            for dy in range(-reach, reach + 1):
                y = min(max(i + dy, 0), rows - 1)
                for dx in range(-reach, reach + 1):
                    x = min(max(j + dx, 0), columns - 1)
                    shares[labels[y, x]] += kernel[dy + reach] * kernel[dx + reach]
            for s in range(out.shape[0]):
                out[s, i, j] = np.uint8(np.float32(WEIGHT_UNIT) * shares[s] + np.float32(0.5))
