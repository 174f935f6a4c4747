"""Surveyed points that were measured in one image, also in the others that show them."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from daemon.postflight.triangulation.matching_work import image_loader
from daemon.postflight.triangulation.measured_points import MeasuredPoints
from daemon.postflight.triangulation.triangulation import ImageBlock
from processing.matching.block_matching import BlockMatching
from processing.matching.point_transfer import transfer_points

TRANSFER_SIGMA_PX: Final = 0.05
"""Standard deviation of a transferred coordinate against the patch that was measured."""


def transferred(
    block: ImageBlock, points: MeasuredPoints, settings: BlockMatching
) -> MeasuredPoints:
    """The points with measurements in all images that show them.

    The error of the first measurement is common to all of its transfers: it moves the point on the
    ground, and so enlarges the standard deviation of its survey in plan.
    """
    if not len(points.point):
        return points
    measured, first = np.unique(points.point, return_index=True)
    source, px = points.image[first], points.px[first]
    given = frozenset(
        (int(image), int(np.searchsorted(measured, point)))
        for image, point in zip(points.image, points.point, strict=True)
    )
    found = transfer_points(
        image_loader(block, settings), block.image, block.station_m, block.rotation, (source, px),
        points.xyz_m[measured], settings, given,
    )  # fmt: skip
    has_transfers = np.isin(np.arange(len(measured)), found.point)
    sigma_px = points.sigma_px.copy()
    moved_m = points.sigma_px[first] * block.gsd_m
    sigma_m = points.sigma_m.copy()
    sigma_px[first[has_transfers]] = TRANSFER_SIGMA_PX
    own = measured[has_transfers]
    sigma_m[own, :2] = np.hypot(sigma_m[own, :2], moved_m[has_transfers][:, None])
    return replace(
        points,
        sigma_m=sigma_m,
        image=np.concatenate([points.image, found.image]),
        point=np.concatenate([points.point, measured[found.point]]),
        px=np.concatenate([points.px, found.px]),
        sigma_px=np.concatenate([sigma_px, np.full(len(found.px), TRANSFER_SIGMA_PX)]),
    )
