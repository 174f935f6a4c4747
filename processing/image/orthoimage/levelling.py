"""Radiometric levelling of a block: one smooth gain field for each image and band.

Where images show the same ground their signals shall agree; what light, haze, hot spot and
exposure do to an image is smooth over it. The logarithm of the gain is bilinear on a few nodes of
each image. The content of the ground cancels, for only the same ground is compared.

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
OUTLIER_LOG: Final = 0.3
"""Overlaps that disagree by more after a first solution show moving things; they are left out."""
_TOLERANCE: Final = 1e-7
_ITERATIONS: Final = 3000


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
    """

    row: float
    column: float
    step: tuple[float, float]
    log_gain: Array

    def at(self, rows: Array, columns: Array) -> Array:
        """Gains on a grid of places.

        Args:
            rows: (h,), rows in the common grid, in blocks.
            columns: (w,).

        Returns:
            (bands, h, w) float32.

        Example:
            >>> field = GainField(0.0, 0.0, (2.0, 2.0), np.log([[[1.0, 4.0], [1.0, 4.0]]]))
            >>> field.at(np.array([1.0]), np.array([0.0, 1.0, 2.0]))
            array([[[1., 2., 4.]]], dtype=float32)
        """
        first = _hats((rows - self.row) / self.step[0], self.log_gain.shape[1])
        last = _hats((columns - self.column) / self.step[1], self.log_gain.shape[2])
        return np.asarray(np.exp(first @ self.log_gain @ last.T), dtype=np.float32)


def _hats(at: Array, count: int) -> Array:
    """Bilinear weights of nodes, (n, count); constant beyond the outer nodes."""
    inside = np.clip(at, 0.0, count - 1.0)
    return np.maximum(1.0 - np.abs(inside[:, None] - np.arange(count)), 0.0)


def level_block(images: Sequence[ImageLevels], owner: Array) -> tuple[GainField, ...]:
    """Gain fields that make overlapping images agree.

    Args:
        images: their signal on the common grid.
        owner: (rows, columns) int, which image each block of the grid is taken from; -1: none. The
            other images of a block are compared with this one.

    Returns:
        A field for each image. The mean logarithm of all gains is near zero.
    """
    nodes = [_nodes_of(levels) for levels in images]
    starts = np.cumsum([0, *(n.log_gain[0].size for n in nodes)])
    bands = images[0].log_signal.shape[0] if images else 0
    design, observed = _overlaps(images, owner, nodes, starts)
    held = _held(nodes, starts)
    solution = np.zeros((bands, starts[-1]))
    for band in range(bands):
        solution[band] = _solved(design, observed[band], held)
    return tuple(
        GainField(
            node.row,
            node.column,
            node.step,
            solution[:, start:end].reshape(bands, *node.log_gain.shape[1:]),
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
    gains = field.at(levels.row + np.arange(rows), levels.column + np.arange(columns))
    return np.asarray(levels.log_signal + np.log(gains))


def _nodes_of(levels: ImageLevels) -> GainField:
    """Nodes over the blocks of an image; gains are one."""
    _, rows, columns = levels.log_signal.shape
    step = max(max(rows, columns) - 1, 1) / (NODES_ALONG - 1)
    counts = [max(math.ceil((n - 1) / step) + 1, 2) for n in (rows, columns)]
    steps = [max(n - 1, 1) / (k - 1) for n, k in zip((rows, columns), counts, strict=True)]
    return GainField(
        levels.row, levels.column, (steps[0], steps[1]), np.zeros((1, counts[0], counts[1]))
    )


def _overlaps(
    images: Sequence[ImageLevels], owner: Array, nodes: Sequence[GainField], starts: Array
) -> tuple[Any, Array]:
    """Equations gain of the owner less gain of another image = difference of their signals."""
    from scipy import sparse

    bands = images[0].log_signal.shape[0]
    taken = np.full((bands, *owner.shape), np.nan, np.float32)
    for k, levels in enumerate(images):
        window = _window(levels)
        own = owner[window] == k
        taken[:, *window][:, own] = levels.log_signal[:, own]
    entries: list[tuple[Array, Array, Array]] = []
    observed: list[Array] = []
    count = 0
    for k, levels in enumerate(images):
        window = _window(levels)
        own = owner[window]
        difference = levels.log_signal - taken[:, *window]
        used = (own >= 0) & (own != k) & np.isfinite(difference).all(axis=0)
        r, c = np.nonzero(used)
        if not len(r):
            continue
        equations = count + np.arange(len(r))
        count += len(r)
        observed.append(difference[:, r, c])
        rows, columns = levels.row + r, levels.column + c
        entries.append(_weights(nodes[k], starts[k], equations, rows, columns, -1.0))
        for other in np.unique(own[r, c]):
            mine = own[r, c] == other
            entries.append(
                _weights(
                    nodes[other], starts[other], equations[mine], rows[mine], columns[mine], 1.0
                )
            )
    if not count:
        return sparse.csr_array((0, int(starts[-1]))), np.zeros((bands, 0))
    i, j, w = (np.concatenate(part) for part in zip(*entries, strict=True))
    shape = (count, int(starts[-1]))
    return sparse.coo_array((w, (i, j)), shape=shape).tocsr(), np.concatenate(observed, axis=1)


def _window(levels: ImageLevels) -> tuple[slice, slice]:
    _, rows, columns = levels.log_signal.shape
    return (
        slice(levels.row, levels.row + rows),
        slice(levels.column, levels.column + columns),
    )


def _weights(
    node: GainField, start: int, equations: Array, rows: Array, columns: Array, sign: float
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
    return np.tile(equations, 4), index, sign * weight


def _held(nodes: Sequence[GainField], starts: Array) -> Any:
    """Normal matrix of gains of one, and of equal gains at neighbouring nodes."""
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
    return HOLD * sparse.eye_array(n, format="csr") + STIFFNESS * (steps.T @ steps)


def _solved(design: Any, observed: Array, held: Any) -> Array:
    """Least squares by conjugate gradients, once more without overlaps that disagree."""
    from scipy import sparse
    from scipy.sparse.linalg import cg

    solution = np.zeros(held.shape[0])
    weight = np.ones(len(observed))
    for _ in range(2):
        normal = held + design.T @ (sparse.diags_array(weight) @ design)
        inverse = sparse.diags_array(1.0 / normal.diagonal())
        right = design.T @ (weight * observed)
        solution, _ = cg(
            normal, right, x0=solution, rtol=_TOLERANCE, maxiter=_ITERATIONS, M=inverse
        )
        weight = (np.abs(design @ solution - observed) < OUTLIER_LOG).astype(np.float64)
    return np.asarray(solution)
