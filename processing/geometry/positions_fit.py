"""The similarity that brings a block without scale to known positions of its images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError

Array = NDArray[np.float64]

WIDTH_MIN: Final = 0.02
"""Spread of positions across their main direction, over that along it."""
_ROUNDS: Final = 4
_OUTLIER: Final = 4.0
_MUCH_BETTER: Final = 0.5
"""Median residual without a minority, over that with all, below which the minority is wrong."""
_MAJORITY_FROM: Final = 5
_TRIPLES: Final = 300
_TRIPLE_WIDTH: Final = 0.1


class NotPlacedError(ProcessingError, ValueError):
    """Positions that leave the place of a block open; the message states why."""


@dataclass(frozen=True)
class PositionsFit:
    """x' = scale rotation x + shift. `residual_m` (n, 3), `used` (n,) without outliers."""

    scale: float
    rotation: Array
    shift: Array
    residual_m: Array
    used: NDArray[np.bool_]

    def applied(self, xyz: Array) -> Array:
        """Bring points into the frame of the known positions.

        Args:
            xyz: shape (n, 3), without scale.

        Returns:
            Shape (n, 3), m.
        """
        return np.asarray(self.scale * xyz @ self.rotation.T + self.shift)


def fit_positions(model: Array, known: Array) -> PositionsFit:
    """Least squares of a similarity without the positions that contradict the others.

    If the majority of the positions fit much better without the others, as where some are of
    another day or place, these are left out from the beginning.

    Args:
        model: positions without scale, shape (n, 3).
        known: the same in metres, shape (n, 3).

    Returns:
        The similarity; positions beyond four times the median residual are left out.

    Raises:
        NotPlacedError: fewer than three positions, or all on one line.

    Source: Umeyama (1991); Rousseeuw (1984), least median of squares.

    Example:
        >>> model = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> fit_positions(model, 10.0 * model + 5.0).scale.__round__(6)
        10.0
    """
    if len(model) < 3:
        raise NotPlacedError(f"{len(model)} images with a position; three are needed")
    fit = _without_outliers(model, known, np.ones(len(model), bool))
    majority = _majority(model, known)
    if majority is None:
        return fit
    try:
        other = _without_outliers(model, known, majority)
    except NotPlacedError:
        return fit
    return other if _typical(other) < _MUCH_BETTER * _typical(fit) else fit


def _typical(fit: PositionsFit) -> float:
    return float(np.median(np.linalg.norm(fit.residual_m, axis=1)))


def _without_outliers(model: Array, known: Array, used: NDArray[np.bool_]) -> PositionsFit:
    for _ in range(_ROUNDS):
        spread = np.linalg.svd(known[used] - known[used].mean(axis=0), compute_uv=False)
        if spread[1] < WIDTH_MIN * spread[0]:
            raise NotPlacedError(
                "the positions lie on one line, about which the block can turn; fly a second line"
            )
        fit = _similarity(model, known, used)
        size = np.linalg.norm(fit.residual_m, axis=1)
        inside = size <= max(_OUTLIER * float(np.median(size)), 1e-9)
        if inside.sum() < 3 or (inside == used).all():
            break
        used = inside
    return fit


def _majority(model: Array, known: Array) -> NDArray[np.bool_] | None:
    """The half of the positions that one similarity of three of them fits best.

    None of fewer than five positions, or where all triples are on lines.
    """
    n = len(model)
    if n < _MAJORITY_FROM:
        return None
    if math.comb(n, 3) <= _TRIPLES:
        triples = [list(triple) for triple in combinations(range(n), 3)]
    else:
        random = np.random.default_rng(n)
        triples = [random.choice(n, 3, replace=False).tolist() for _ in range(_TRIPLES)]
    best, found = math.inf, None
    for triple in triples:
        spread = np.linalg.svd(known[triple] - known[triple].mean(axis=0), compute_uv=False)
        if spread[1] < _TRIPLE_WIDTH * spread[0]:
            continue
        used = np.zeros(n, bool)
        used[triple] = True
        size = np.linalg.norm(_similarity(model, known, used).residual_m, axis=1)
        half = np.partition(size, n // 2)[n // 2]
        if half < best:
            best, found = float(half), size <= half
    return found


def _similarity(model: Array, known: Array, used: NDArray[np.bool_]) -> PositionsFit:
    from_m, to_m = model[used].mean(axis=0), known[used].mean(axis=0)
    a, b = model[used] - from_m, known[used] - to_m
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ sign @ vt
    scale = float((s * np.diag(sign)).sum() / (a**2).sum())
    shift = to_m - scale * rotation @ from_m
    return PositionsFit(scale, rotation, shift, scale * model @ rotation.T + shift - known, used)
