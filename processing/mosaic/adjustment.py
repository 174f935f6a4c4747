"""Least squares with linear constraints between the unknowns, and its statistics.

Blocks of observations that touch few unknowns each are accumulated into dense normal equations;
what an observation or an unknown means is the caller's.

Source: docs/explanation/mathematics/mosaicking.md#datum-by-inner-constraints; Förstner and Wrobel
(2016), estimation with constraints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Eigenvalues of a datum defect are not quite zero: residuals shrink a little with the scale.
_RANK_TOLERANCE = 1e-7

_PART = 2048


@dataclass(frozen=True)
class ObservationBlock:
    """m observation equations dp @ design = misclosure + v that touch the unknowns `columns` (k).

    `design` is (k, m), a row of derivatives for each unknown (the usual matrix transposed, so that
    rows lie together in memory); `misclosure` (m,) observed minus computed; `weight` (m,)
    1 / sigma squared.
    """

    columns: NDArray[np.int64]
    design: Array
    misclosure: Array
    weight: Array


@dataclass(frozen=True)
class ConstrainedSolution:
    """Corrections dp and what is known of them.

    `cofactor` is the (u, u) inverse belonging to unit weight. `rank` is that of the normal matrix
    without constraints, `constrained_rank` with them. `undetermined` holds as columns (u, d) the
    directions that neither observations nor constraints fix well enough.
    """

    dp: Array
    cofactor: Array
    rank: int
    constrained_rank: int
    undetermined: Array


def normal_equations(blocks: Sequence[ObservationBlock], unknowns: int) -> tuple[Array, Array]:
    """Normal equations of all blocks.

    Args:
        blocks: observation equations.
        unknowns: number u of all unknowns.

    Returns:
        Normal matrix (u, u) and right-hand side (u,).

    Example:
        One unknown, observed as 2 and 4 with weights 3 and 1: N = 4, right-hand side 10.

        >>> block = ObservationBlock(
        ...     np.array([0]), np.ones((1, 2)), np.array([2.0, 4.0]), np.array([3.0, 1.0])
        ... )
        >>> normal_equations([block], 1)
        (array([[4.]]), array([10.]))
    """
    normal = np.zeros((unknowns, unknowns))
    right = np.zeros(unknowns)
    for block in blocks:
        at = np.ix_(block.columns, block.columns)
        for part in _parts(block):
            root = np.sqrt(block.weight[part])
            design = block.design[:, part] * root
            normal[at] += design @ design.T
            right[block.columns] += design @ (root * block.misclosure[part])
    return normal, right


def solve(
    normal: Array,
    right: Array,
    constraints: Array,
    misclosure: Array,
    *,
    fixed_at: Array,
    min_information: float,
) -> ConstrainedSolution:
    """Solve the normal equations, bordered with constraints @ dp = misclosure.

    Unknowns must have one scale. Directions with less information (eigenvalue of the normal matrix,
    constraints included) than `min_information` count as undetermined: these alone get a
    pseudo-observation of that information that draws them to `fixed_at` (as a correction dp).

    Args:
        normal: (u, u).
        right: (u,).
        constraints: (c, u), linearly independent rows.
        misclosure: (c,).
        fixed_at: (u,).
        min_information: in units of the normal matrix.

    Returns:
        Corrections, cofactor, ranks and undetermined directions.

    Raises:
        ValueError: constraints that depend on each other.

    Source: docs/explanation/mathematics/mosaicking.md#datum-by-inner-constraints and
        #undetermined-directions.

    Example:
        Two unknowns whose difference was observed as 2; the datum is that their sum is zero.

        >>> block = ObservationBlock(
        ...     np.array([0, 1]), np.array([[1.0], [-1.0]]), np.array([2.0]), np.array([1.0])
        ... )
        >>> normal, right = normal_equations([block], 2)
        >>> found = solve(
        ...     normal, right, np.ones((1, 2)), np.zeros(1), fixed_at=np.zeros(2),
        ...     min_information=1e-6
        ... )
        >>> found.dp.round(6), found.rank, found.constrained_rank
        (array([ 1., -1.]), 1, 2)
    """
    unknowns, conditions = len(right), len(constraints)
    rows = constraints / np.linalg.norm(constraints, axis=1, keepdims=True)
    if conditions and np.linalg.matrix_rank(rows) < conditions:
        raise ValueError("constraints depend on each other; give each condition once")
    eigenvalues = np.linalg.eigvalsh(normal)
    top = max(float(eigenvalues[-1]), np.finfo(float).tiny)
    strength = max(top, min_information)
    fixed_values, directions = np.linalg.eigh(normal + strength * (rows.T @ rows))
    free = directions[:, fixed_values < min_information]
    held = normal + min_information * (free @ free.T)
    # Balanced against the border, so that the inversion stays well conditioned.
    border = rows * np.sqrt(strength)
    bordered = np.zeros((unknowns + conditions, unknowns + conditions))
    bordered[:unknowns, :unknowns] = held
    bordered[:unknowns, unknowns:] = border.T
    bordered[unknowns:, :unknowns] = border
    target = np.zeros(unknowns + conditions)
    target[:unknowns] = right + min_information * (free @ (free.T @ fixed_at))
    if conditions:
        target[unknowns:] = misclosure / np.linalg.norm(constraints, axis=1) * np.sqrt(strength)
    inverse = np.linalg.inv(bordered)
    cofactor = inverse[:unknowns, :unknowns]
    return ConstrainedSolution(
        dp=(inverse @ target)[:unknowns],
        cofactor=0.5 * (cofactor + cofactor.T),
        rank=int(np.sum(eigenvalues > _RANK_TOLERANCE * top)),
        constrained_rank=int(np.sum(fixed_values > _RANK_TOLERANCE * strength)),
        undetermined=free,
    )


def redundancy_numbers(block: ObservationBlock, cofactor: Array) -> Array:
    """r_i = 1 - p_i a_i Q a_i' of each observation of a block, weightless ones too (r_i = 1).

    Args:
        block: m observation equations.
        cofactor: Q, (u, u), of unit weight.

    Returns:
        (m,), 0 to 1.

    Example:
        A mean of four observations: each keeps 3/4 of its own error.

        >>> block = ObservationBlock(np.array([0]), np.ones((1, 4)), np.zeros(4), np.ones(4))
        >>> redundancy_numbers(block, np.array([[0.25]]))
        array([0.75, 0.75, 0.75, 0.75])
    """
    q = cofactor[np.ix_(block.columns, block.columns)]
    numbers = np.empty(len(block.weight))
    for part in _parts(block):
        design = block.design[:, part]
        numbers[part] = np.sum((q @ design) * design, axis=0)
    numbers *= -block.weight
    numbers += 1.0
    return np.asarray(np.clip(numbers, 0.0, 1.0, out=numbers))


def _parts(block: ObservationBlock) -> Iterator[slice]:
    """Observations so many at a time that their derivatives stay in the cache."""
    for first in range(0, len(block.weight), _PART):
        yield slice(first, first + _PART)
