"""Standard deviations of matched image coordinates, as the residuals of a block show them.

Shared by the last adjustment in flight and the triangulation after landing, so that both give the
same tie points the same weights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.gauss_newton import Progress
from processing.bundle.initial_values import completed
from processing.bundle.network import ImagePoints, Network

TIE_SIGMA_PX: Final = 0.03
"""Of a matched image coordinate, to begin with."""
REJECT_BEYOND: Final = 4.0
"""Standardised residual beyond which an observation of a flown block is left out."""


def block_settings(reject_beyond: float = REJECT_BEYOND) -> AdjustmentSettings:
    """How a flown block is adjusted once its weights are known.

    Args:
        reject_beyond: standardised residual beyond which an observation is left out.

    Returns:
        Settings for `processing.bundle.adjust.adjust`.
    """
    return AdjustmentSettings(robust=True, reject_beyond=reject_beyond)


def weighted_by_residuals(
    network: Network,
    settings: AdjustmentSettings,
    matched: NDArray[np.bool_],
    progress: Progress | None = None,
) -> Network:
    """Give matched image coordinates the standard deviations that their residuals have.

    The block is adjusted with matched points only, without control. Other image points keep the
    sigma they were given, and would otherwise be scaled with coordinates many times better.

    Args:
        network: the block.
        settings: of its adjustment.
        matched: (m,) image points that were matched.
        progress: as of `adjust`.

    Returns:
        The network with other standard deviations of the matched image points.

    Raises:
        NetworkError, RankDefectError: as `processing.bundle.adjust.adjust`.
    """
    table = network.image_points
    alone = replace(
        network,
        image_points=ImagePoints(
            table.image[matched],
            table.point[matched],
            table.xy_mm[matched],
            table.sigma_mm[matched],
        ),
        points=replace(network.points, sigma_m=np.full_like(network.points.sigma_m, np.nan)),
    )
    with_components = replace(settings, reject_beyond=None, variance_components=True)
    found = adjust(completed(alone), with_components, progress=progress)
    factor = [found.factors.get(name, 1.0) for name in ("image x", "image y")]
    scale = np.where(matched[:, None], np.sqrt(factor), 1.0)
    return replace(network, image_points=replace(table, sigma_mm=table.sigma_mm * scale))
