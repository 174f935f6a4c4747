"""Correlated errors of neighbouring tie points, which carry less information than independent ones.

A roof's sunny side or the edge of a field looks otherwise in green than in PAN, and so does ground
whose colours are not quite in one place: every point on it is off the same way. The effect
on the covariance of the unknowns is computed here from the residuals of one exposure; single points
and their weights are evaluated in `processing.mosaic.weights`.

Source: docs/explanation/mathematics/mosaicking.md#accuracy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.matching.tie_points import PAN_TO_COLOUR
from processing.mosaic.adjustment import ObservationBlock, normal_equations
from processing.mosaic.weights import CLASSES, TiePointGroup

Array = NDArray[np.float64]

_POINTS_PER_CLUSTER: Final = 30.0
_MIN_CLUSTERS: Final = 30
"""Fewer sums of residuals determine their variance to no better than a quarter."""
_REACH_PX: Final = 93.0
"""Correlation length of errors of P/C points, colour pixels: sums over cells of area a show
a / (a + reach^2) of what sums over whole sensors have. Measured on rendered exposures
(docs/explanation/matching.md)."""


def clustered_cofactor(
    groups: Sequence[TiePointGroup],
    blocks: Sequence[ObservationBlock],
    cofactor: Array,
    scale: Array,
    sigma0: float,
    *,
    pitch_mm: float,
) -> Array:
    """The cofactor of unknowns whose observations are not independent: Q + sum (k - 1) Q N_c Q.

    N_c are the normal equations of a class of points, k how many times larger than for independent
    points the variance of sums over neighbours is, one at least. Cells of a few points determine it
    from one exposure; unknowns are sums over whole sensors, and to these it is carried on.

    Args:
        groups: the points, with the residuals of the last adjustment.
        blocks: their equations, as that adjustment had them.
        cofactor: Q (u, u), that of independent observations.
        scale: (groups,) factor of its class on the sigmas of a group.
        sigma0: of that adjustment.
        pitch_mm: of the pixels; those of colour heads are as large.

    Returns:
        (u, u), Q itself where no class has correlated errors.
    """
    reach_mm = {PAN_TO_COLOUR: _REACH_PX * pitch_mm}
    result = cofactor
    for kind in CLASSES:
        mine = [i for i, group in enumerate(groups) if group.kind == kind]
        k = _variance_ratio(
            [groups[i] for i in mine],
            [blocks[i] for i in mine],
            cofactor,
            scale[mine],
            sigma0,
            reach_mm.get(kind, 0.0),
        )
        if k > 1.0:
            normal, _ = normal_equations([blocks[i] for i in mine], len(cofactor))
            result = result + (k - 1.0) * cofactor @ normal @ cofactor
    return result


def _variance_ratio(
    groups: Sequence[TiePointGroup],
    blocks: Sequence[ObservationBlock],
    cofactor: Array,
    scale: Array,
    sigma0: float,
    reach_mm: float,
) -> float:
    """Variance of the residuals' sums over whole sensors, against that of independent residuals.

    Found as that of sums over clusters, and carried on from their area.
    """
    found = expected = shown = 0.0
    clusters = 0
    for group, block, unit in zip(groups, blocks, scale, strict=True):
        used = group.factor > 0.0
        count = int(used.sum())
        if count < 2:
            continue
        cell, area_mm2 = _cells(group.corrected_b[used])
        # Neighbours side by side, so that the sums over a cluster are those of a run.
        order = np.argsort(cell, kind="stable")
        first = np.flatnonzero(np.diff(cell[order], prepend=-1))
        rows = np.flatnonzero(used)[order]
        amount = np.diff(first, append=count)
        sigma = group.sigma[rows] * unit
        q = cofactor[np.ix_(block.columns, block.columns)]
        design = block.design.reshape(len(block.columns), 2, -1)
        for axis in (0, 1):
            sums = np.add.reduceat(group.difference[rows, axis] / (sigma * sigma0), first)
            common = np.add.reduceat(design[:, axis, rows] / sigma, first, axis=1)
            # What the unknowns take of a sum is lost to it.
            left = amount - np.sum((q @ common) * common, axis=0)
            found += float(np.sum(sums**2))
            expected += float(np.sum(left))
            shown += float(np.sum(left)) * area_mm2 / (area_mm2 + reach_mm**2)
        clusters += 2 * len(amount)
    if clusters < _MIN_CLUSTERS or expected <= 0.0:
        return 1.0
    return 1.0 + (found - expected) / shown


def _cells(place_mm: Array) -> tuple[NDArray[np.int64], float]:
    """Number of the square cell each of the places (n, 2) lies in, and the area of a cell, mm².

    Some 30 places are to a cell.
    """
    low, high = place_mm.min(axis=0), place_mm.max(axis=0)
    width, height = np.maximum(high - low, 1e-9)
    side = math.sqrt(width * height * min(1.0, _POINTS_PER_CLUSTER / len(place_mm)))
    columns = max(1, round(width / side))
    rows = max(1, round(height / side))
    column = np.minimum(((place_mm[:, 0] - low[0]) / width * columns).astype(np.int64), columns - 1)
    row = np.minimum(((place_mm[:, 1] - low[1]) / height * rows).astype(np.int64), rows - 1)
    return np.asarray(row * columns + column), float(width * height / (columns * rows))
