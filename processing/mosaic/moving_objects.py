"""What moving objects add to the accuracy of a mosaic whose tie points lie on them.

Heads see the same ground at different instants. Vehicles on a road move alike between two of them:
data snooping rejects points that moved far, and points that moved little are not recognised. How
many these are is computed here from the rejected ones of each pair of sensors.

Source: docs/explanation/mathematics/mosaicking.md#moving-objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.mosaic.adjustment import ObservationBlock
from processing.mosaic.weights import MosaicSettings, TiePointGroup, normalised_residuals

Array = NDArray[np.float64]

ONE_SIDED_SIGMAS: Final = 3.0
"""Of the difference between rejected points of both signs, were each sign as likely."""
ONE_SIDED_SHARE: Final = 0.05
"""Of the points of a pair, at least, that their difference is."""
SHELL: Final = 2.0
"""Rejected points up to so many limits away show how dense such points are within the limit."""
PARTLY_COVERED: Final = 1.5
"""A window that holds a small part of a vehicle shows a small part of its motion: small shifts are
more frequent than those at the limit. By rendered motorways."""


def one_sided_shifts(groups: Sequence[TiePointGroup], settings: MosaicSettings) -> list[Array]:
    """By how much points on moving objects that were not rejected shift the mean of each pair.

    Args:
        groups: points with differences and redundancies of an adjustment.
        settings: its `outlier_limit`.

    Returns:
        Standard deviation of the common shift of x and y, in standard deviations of a point, (2,)
        for each group; zero where as many points were rejected on either side.
    """
    limit = settings.outlier_limit
    shifts = []
    for w, group in zip(normalised_residuals(groups, soft=False), groups, strict=True):
        used = int(np.count_nonzero(group.factor > 0.0))
        sign = np.sign(w) * (np.abs(w) > limit)
        more = np.abs(np.sum(sign, axis=0))
        usual = ONE_SIDED_SIGMAS * np.sqrt(np.sum(np.abs(sign), axis=0))
        moves = (more > usual) & (more > ONE_SIDED_SHARE * len(w))
        near = np.abs(np.sum(sign * (np.abs(w) <= SHELL * limit), axis=0))
        # Points as dense within the limit as in the shell have a mean of half the limit.
        density = near / ((SHELL - 1.0) * limit)
        shift = PARTLY_COVERED * density * limit**2 / 2.0 / max(used, 1)
        shifts.append(np.where(moves, shift, 0.0))
    return shifts


def shifted_cofactor(
    groups: Sequence[TiePointGroup],
    blocks: Sequence[ObservationBlock],
    cofactor: Array,
    scale: Array,
    shifts: Sequence[Array],
) -> Array:
    """What common shifts of the points of a pair add to the cofactor of the unknowns.

    The share of points that moved changes over an overlap: next to the same shift of all points,
    one that grows along x and one that grows along y count, each as large (RMS) as the first.

    Args:
        groups: the points.
        blocks: their equations, as the last adjustment had them.
        cofactor: Q (u, u), that of independent observations.
        scale: (groups,) factor of its class on the sigmas of a group.
        shifts: from `one_sided_shifts`.

    Returns:
        (u, u), zeros without shifts.
    """
    result = np.zeros_like(cofactor)
    for group, block, unit, shift in zip(groups, blocks, scale, shifts, strict=True):
        if not shift.any():
            continue
        used = group.factor > 0.0
        place = group.corrected_a[used] - group.corrected_a[used].mean(axis=0)
        place /= np.maximum(place.std(axis=0), 1e-9)
        patterns = np.column_stack([np.ones(len(place)), place])
        design = block.design.reshape(len(block.columns), 2, -1)
        for axis in np.flatnonzero(shift > 0.0):
            common = (design[:, axis, used] / (group.sigma[used] * unit)) @ patterns
            moved = cofactor[:, block.columns] @ common * shift[axis]
            result += moved @ moved.T
    return result
