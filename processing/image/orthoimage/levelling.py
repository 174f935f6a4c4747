"""Radiometric levelling of a block: smooth fields of gain and haze for each image and band.

Where images show the same ground their signals shall agree; what light, haze, hot spot and
exposure do to an image is smooth over it. Haze adds to the signal of dark ground as much as to that
of bright ground, so it is subtracted before the gain. The logarithm of the gain and the haze are
bilinear on a few nodes of each image. The content of the ground cancels, for only the same ground
is compared.

Source: docs/explanation/mathematics/orthomosaic.md#levelling.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

NODES_ALONG: Final = 9
"""Nodes along the longer side of an image."""
HOLD: Final = 1e-3
"""Weight of a gain of one at a node; an overlap has the weight 1."""
STIFFNESS: Final = 0.02
"""Weight of equal gains at two neighbouring nodes."""
HAZE_HOLD: Final = 0.003
"""Weight of no haze at a node, haze in units of the mean signal."""
HAZE_STIFFNESS: Final = 10.0
"""Weight of equal haze at two neighbouring nodes."""
HAZE_MAX: Final = 0.5
"""Of the signal of a pixel; haze subtracts no more."""
OUTLIER_LOG: Final = 0.3
"""Overlaps that disagree by more after a first solution show moving things; they are left out."""
_TOLERANCE: Final = 1e-7
_ITERATIONS: Final = 3000
_ROUNDS: Final = 3


@dataclass(frozen=True)
class ImageLevels:
    """Signal of one image on the blocks of a common grid.

    Attributes:
        row, column: of its first block in the common grid.
        log_signal: (bands, rows, columns) float32, logarithm of the mean signal of each block; NaN
            where the image does not cover it whole.
    """

    row: int
    column: int
    log_signal: Array


@dataclass(frozen=True)
class GainField:
    """Gains of one image.

    Attributes:
        row, column: place of the first node in the common grid, in blocks; integers are the
            centres of blocks.
        step: blocks from node to node, along rows and columns.
        log_gain: (bands, r, c), at the nodes.
        haze: (bands, r, c), at the nodes, in units of the signal.
    """

    row: float
    column: float
    step: tuple[float, float]
    log_gain: Array
    haze: Array

    def levelled(self, signal: Array, rows: Array, columns: Array) -> Array:
        """Signal without haze, times the gain.

        Args:
            signal: (bands, h, w).
            rows: (h,), rows in the common grid, in blocks.
            columns: (w,).

        Returns:
            (bands, h, w) float32.

        Example:
            >>> one = np.ones((1, 2, 2))
            >>> field = GainField(0.0, 0.0, (2.0, 2.0), np.log(2.0) * one, 3.0 * one)
            >>> field.levelled(np.array([[[10.0, 4.0]]]), np.array([0.0]), np.array([0.0, 1.0]))
            array([[[14.,  4.]]], dtype=float32)
        """
        haze = self._on_grid(self.haze, rows, columns)
        clear = np.maximum(signal - haze, (1.0 - HAZE_MAX) * signal)
        return np.asarray(clear * self.at(rows, columns), dtype=np.float32)

    def _on_grid(self, nodes: Array, rows: Array, columns: Array) -> Array:
        first = _hats((rows - self.row) / self.step[0], nodes.shape[1])
        last = _hats((columns - self.column) / self.step[1], nodes.shape[2])
        return np.asarray(first @ nodes @ last.T)

    def at(self, rows: Array, columns: Array) -> Array:
        """Gains on a grid of places.

        Args:
            rows: (h,), rows in the common grid, in blocks.
            columns: (w,).

        Returns:
            (bands, h, w) float32.

        Example:
            >>> gains = np.log([[[1.0, 4.0], [1.0, 4.0]]])
            >>> field = GainField(0.0, 0.0, (2.0, 2.0), gains, np.zeros((1, 2, 2)))
            >>> field.at(np.array([1.0]), np.array([0.0, 1.0, 2.0]))
            array([[[1., 2., 4.]]], dtype=float32)
        """
        gains = np.exp(self._on_grid(self.log_gain, rows, columns))
        return np.asarray(gains, dtype=np.float32)


def _hats(at: Array, count: int) -> Array:
    """Bilinear weights of nodes, (n, count); constant beyond the outer nodes."""
    inside = np.clip(at, 0.0, count - 1.0)
    return np.maximum(1.0 - np.abs(inside[:, None] - np.arange(count)), 0.0)


def level_block(images: Sequence[ImageLevels], owner: Array) -> tuple[GainField, ...]:
    """Fields of gain and haze that make overlapping images agree.

    Args:
        images: their signal on the common grid.
        owner: (rows, columns) int, which image each block of the grid is taken from; -1: none. The
            other images of a block are compared with this one.

    Returns:
        A field for each image. The mean logarithm of all gains is near zero, the mean haze too:
        only differences of haze between images are known.
    """
    nodes = [_nodes_of(levels) for levels in images]
    starts = np.cumsum([0, *(n.log_gain[0].size for n in nodes)])
    bands = images[0].log_signal.shape[0] if images else 0
    pairs = _overlaps(images, owner, nodes, starts)
    held = _held(nodes, starts)
    solution = np.zeros((bands, 2 * starts[-1]))
    for band in range(bands):
        solution[band] = _solved(pairs, band, held)
    return tuple(
        GainField(
            node.row,
            node.column,
            node.step,
            *(
                solution[:, first + start : first + end].reshape(bands, *node.log_gain.shape[1:])
                for first in (0, starts[-1])
            ),
        )
        for node, start, end in zip(nodes, starts[:-1], starts[1:], strict=True)
    )


def levelled(levels: ImageLevels, field: GainField) -> Array:
    """Logarithm of the signal of an image after levelling.

    Args:
        levels: of the image.
        field: of the image.

    Returns:
        As `levels.log_signal`.
    """
    _, rows, columns = levels.log_signal.shape
    places = (levels.row + np.arange(rows), levels.column + np.arange(columns))
    return np.asarray(np.log(field.levelled(np.exp(levels.log_signal), *places)))


def _nodes_of(levels: ImageLevels) -> GainField:
    """Nodes over the blocks of an image; gains are one."""
    _, rows, columns = levels.log_signal.shape
    step = max(max(rows, columns) - 1, 1) / (NODES_ALONG - 1)
    counts = [max(math.ceil((n - 1) / step) + 1, 2) for n in (rows, columns)]
    steps = [max(n - 1, 1) / (k - 1) for n, k in zip((rows, columns), counts, strict=True)]
    zeros = np.zeros((1, counts[0], counts[1]))
    return GainField(levels.row, levels.column, (steps[0], steps[1]), zeros, zeros)


@dataclass(frozen=True)
class _Pairs:
    """Overlaps: weights of nodes of each side, sparse (n, nodes), and its signals (bands, n)."""

    owner: Any
    other: Any
    owner_signal: Array
    other_signal: Array


def _overlaps(
    images: Sequence[ImageLevels], owner: Array, nodes: Sequence[GainField], starts: Array
) -> _Pairs:
    """The signals of the owner of a block and of another image that shows it."""
    from scipy import sparse

    bands = images[0].log_signal.shape[0] if images else 0
    taken = np.full((bands, *owner.shape), np.nan, np.float32)
    for k, levels in enumerate(images):
        window = _window(levels)
        own = owner[window] == k
        taken[:, *window][:, own] = levels.log_signal[:, own]
    entries: tuple[list[tuple[Array, Array, Array]], ...] = ([], [])
    signals: tuple[list[Array], ...] = ([], [])
    count = 0
    for k, levels in enumerate(images):
        window = _window(levels)
        own = owner[window]
        there = taken[:, *window]
        difference = levels.log_signal - there
        used = (own >= 0) & (own != k) & np.isfinite(difference).all(axis=0)
        r, c = np.nonzero(used)
        if not len(r):
            continue
        equations = count + np.arange(len(r))
        count += len(r)
        signals[0].append(np.exp(there[:, r, c]))
        signals[1].append(np.exp(levels.log_signal[:, r, c]))
        rows, columns = levels.row + r, levels.column + c
        entries[1].append(_weights(nodes[k], starts[k], equations, rows, columns))
        for other in np.unique(own[r, c]):
            mine = own[r, c] == other
            entries[0].append(
                _weights(nodes[other], starts[other], equations[mine], rows[mine], columns[mine])
            )
    shape = (count, int(starts[-1]))
    if not count:
        empty, none = sparse.csr_array(shape), np.zeros((bands, 0))
        return _Pairs(empty, empty, none, none)
    sides = []
    for side in entries:
        i, j, w = (np.concatenate(part) for part in zip(*side, strict=True))
        sides.append(sparse.coo_array((w, (i, j)), shape=shape).tocsr())
    first, last = (np.concatenate(one, axis=1).astype(np.float64) for one in signals)
    return _Pairs(sides[0], sides[1], first, last)


def _window(levels: ImageLevels) -> tuple[slice, slice]:
    _, rows, columns = levels.log_signal.shape
    return (
        slice(levels.row, levels.row + rows),
        slice(levels.column, levels.column + columns),
    )


def _weights(
    node: GainField, start: int, equations: Array, rows: Array, columns: Array
) -> tuple[Array, Array, Array]:
    """Bilinear weights of the four nodes around each place."""
    _, height, width = node.log_gain.shape
    v, u = (rows - node.row) / node.step[0], (columns - node.column) / node.step[1]
    r = np.clip(np.floor(v), 0, height - 2).astype(np.int64)
    c = np.clip(np.floor(u), 0, width - 2).astype(np.int64)
    v, u = v - r, u - c
    at = start + r * width + c
    index = np.concatenate([at, at + 1, at + width, at + width + 1])
    weight = np.concatenate([(1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u])
    return np.tile(equations, 4), index, weight


def _held(nodes: Sequence[GainField], starts: Array) -> Any:
    """Normal matrix of gains of one, no haze, and equal values at neighbouring nodes."""
    from scipy import sparse

    pairs = []
    for node, start in zip(nodes, starts[:-1], strict=True):
        number = start + np.arange(node.log_gain.size).reshape(node.log_gain.shape[1:])
        pairs.append(np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()]))
        pairs.append(np.stack([number[:-1].ravel(), number[1:].ravel()]))
    a, b = np.concatenate(pairs, axis=1)
    n, k = int(starts[-1]), np.arange(len(a))
    one = np.ones(len(a))
    steps = sparse.coo_array(
        (np.concatenate([one, -one]), (np.concatenate([k, k]), np.concatenate([a, b]))),
        shape=(len(a), n),
    ).tocsr()
    one_each, smooth = sparse.eye_array(n, format="csr"), steps.T @ steps
    gain = HOLD * one_each + STIFFNESS * smooth
    haze = HAZE_HOLD * one_each + HAZE_STIFFNESS * smooth
    return sparse.block_diag((gain, haze), format="csr")


def _solved(pairs: _Pairs, band: int, held: Any) -> Array:
    """Gains and haze of one band, least squares by conjugate gradients.

    Linearized at the haze of the round before; after the first round without overlaps that
    disagree.
    """
    from scipy import sparse
    from scipy.sparse.linalg import cg

    nodes = held.shape[0] // 2
    owner, other = pairs.owner_signal[band], pairs.other_signal[band]
    solution = np.zeros(2 * nodes)
    if not len(owner):
        return solution
    unit = float(np.median(np.concatenate([owner, other])))
    weight = np.ones(len(owner))
    for _ in range(_ROUNDS):
        haze = solution[nodes:] * unit
        parts, observed = [], np.zeros(len(owner))
        for side, signal, sign in ((pairs.owner, owner, 1.0), (pairs.other, other, -1.0)):
            clear = np.maximum(signal - side @ haze, (1.0 - HAZE_MAX) * signal)
            parts.append(sparse.diags_array(-sign * unit / clear) @ side)
            observed -= sign * (np.log(clear) + (signal - clear) / clear)
        design = sparse.hstack([pairs.owner - pairs.other, parts[0] + parts[1]], format="csr")
        normal = held + design.T @ (sparse.diags_array(weight) @ design)
        inverse = sparse.diags_array(1.0 / normal.diagonal())
        right = design.T @ (weight * observed)
        solution, _ = cg(
            normal, right, x0=solution, rtol=_TOLERANCE, maxiter=_ITERATIONS, M=inverse
        )
        weight = (np.abs(design @ solution - observed) < OUTLIER_LOG).astype(np.float64)
    solution[nodes:] *= unit
    return np.asarray(solution)
