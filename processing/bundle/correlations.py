"""High correlations between unknowns of an adjustment, across cameras and images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.block_band import BandCofactor
from processing.bundle.reduced_solution import Cofactor

Array = NDArray[np.float64]

CORRELATION_LIMIT: Final = 0.9
_ROWS_AT_ONCE: Final = 1024
_BLOCK_WIDE: Final = ("camera", "head rotation", "head offset", "GNSS shift", "GNSS drift")
"""Kinds of unknowns that many observations share: their correlations come first."""


@dataclass(frozen=True)
class Correlation:
    """Two unknowns by name, and their correlation."""

    first: str
    second: str
    value: float


@dataclass(frozen=True)
class CorrelationGroup:
    """High correlations of two kinds of unknowns.

    Attributes:
        first_kind, second_kind: such as `camera` and `station`.
        is_of_one: the two unknowns are of the same camera, head, line or exposure.
        count: how many.
        largest: the largest of them, by absolute value.
    """

    first_kind: str
    second_kind: str
    is_of_one: bool
    count: int
    largest: tuple[Correlation, ...]


def high_correlations(
    result: Adjustment, limit: float = CORRELATION_LIMIT, *, listed: int = 20
) -> tuple[CorrelationGroup, ...]:
    """Pairs of unknowns whose correlation is beyond a limit.

    Args:
        result: the adjustment; eliminated object points are not looked at, nor, in a large block,
            pairs of exposures without a common object point.
        limit: absolute value of a correlation.
        listed: largest number of named pairs of each group.

    Returns:
        Groups by the kinds of the two unknowns; those of interior orientation, heads and lines
        first, the others by their number.

    Source: docs/explanation/mathematics/bundle.md#correlations.
    """
    unknowns = result.layout.unknowns
    spread = np.sqrt(np.clip(result.cofactors.diagonal(), 1e-300, None))
    kinds = sorted({u.kind for u in unknowns})
    kind = np.array([kinds.index(u.kind) for u in unknowns], dtype=np.int64)
    owners = {name: k for k, name in enumerate(dict.fromkeys(u.owner for u in unknowns))}
    owner = np.array([owners[u.owner] for u in unknowns], dtype=np.int64)
    if not unknowns:
        return ()
    first, second, value = _beyond(result.cofactors, spread, limit)
    # A station and an attitude of the same name are of one exposure.
    is_of_one = owner[first] == owner[second]
    pair = np.sort(np.stack([kind[first], kind[second]], axis=1), axis=1)
    key = (pair[:, 0] * len(kinds) + pair[:, 1]) * 2 + is_of_one
    groups = []
    for one in np.unique(key):
        own = np.flatnonzero(key == one)
        own = own[np.argsort(-np.abs(value[own]), kind="stable")]
        names = (kinds[pair[own[0], 0]], kinds[pair[own[0], 1]])
        groups.append(
            CorrelationGroup(
                *names,
                bool(is_of_one[own[0]]),
                len(own),
                tuple(
                    Correlation(unknowns[first[k]].name, unknowns[second[k]].name, float(value[k]))
                    for k in own[:listed]
                ),
            )
        )
    wide = [any(k in _BLOCK_WIDE for k in (g.first_kind, g.second_kind)) for g in groups]
    order = sorted(range(len(groups)), key=lambda k: (not wide[k], -groups[k].count))
    return tuple(groups[k] for k in order)


def _beyond(
    cofactors: Cofactor, spread: Array, limit: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Pairs of columns, the first before the second, and their correlations."""
    if isinstance(cofactors, BandCofactor):
        first, second, value = cofactors.stored()
        correlation = value / spread[first] / spread[second]
        own = (np.abs(correlation) > limit) & (first < second)
        return first[own], second[own], correlation[own]
    found = []
    for low in range(0, len(cofactors), _ROWS_AT_ONCE):
        part = cofactors[low : low + _ROWS_AT_ONCE, low:]
        correlation = part / spread[low : low + _ROWS_AT_ONCE, None] / spread[low:]
        rows, columns = np.nonzero(np.triu(np.abs(correlation) > limit, 1))
        found.append((rows + low, columns + low, correlation[rows, columns]))
    rows, columns, value = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return rows, columns, value
