"""Measurements against the projections of the points of the same files.

A free network of mirrored images is adjusted as well as the true one, into a mirrored scene: only
the other program's own orientations show which it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.exchange.block import Block, BlockError
from processing.geometry.forward_distortion import measured_px_from_rays

Array = NDArray[np.float64]

_FAR: Final = 0.02
"""Median distance over the longer side of the image from which another convention is tried."""

_BETTER: Final = 0.2
_SCALE_BEYOND: Final = 1.2
_MIN_POINTS: Final = 20


def refuse_other_convention(path: Path, block: Block) -> None:
    """Refuse measurements that fit the block's own points in another convention only.

    Args:
        path: of the files, for the message.
        block: as read.

    Raises:
        BlockError: rows that count upwards, or measurements in an image of another size.
    """
    points = block.points
    if len(points.image) < _MIN_POINTS or not np.isfinite(points.xyz_m).all():
        return
    measured, projected = np.empty_like(points.px), np.full_like(points.px, np.nan)
    side = max(max(camera.width_px, camera.height_px) for camera in block.cameras)
    for number in np.unique(points.image):
        image, rows = block.images[number], np.flatnonzero(points.image == number)
        camera = block.cameras[image.camera]
        ray = (points.xyz_m[points.point[rows]] - image.centre_m) @ image.rotation
        centre = np.array([camera.model.cx_px, camera.model.cy_px])
        measured[rows] = points.px[rows] - centre
        front = ray[:, 2] < 0.0
        seen = ray[front, :2] / -ray[front, 2:] * np.array([1.0, -1.0])
        projected[rows[front]] = measured_px_from_rays(camera.model, seen) - centre
    there = np.isfinite(projected).all(axis=1)
    if there.sum() < _MIN_POINTS:
        return
    measured, projected = measured[there], projected[there]
    given = _median(measured, projected)
    if given < _FAR * side:
        return
    beginning = (
        f"{path}: half of the measurements are {given:.0f} px or more from the projections of "
        "their points: "
    )
    mirrored = _median(measured * np.array([1.0, -1.0]), projected)
    if mirrored < _BETTER * given:
        raise BlockError(
            f"{beginning}their y is reversed ({mirrored:.1f} px with y reversed); write them with "
            "the y axis of the format"
        )
    scale = float((measured * projected).sum() / (measured * measured).sum())
    scaled = _median(scale * measured, projected)
    is_other = scale > _SCALE_BEYOND or 0.0 < scale < 1.0 / _SCALE_BEYOND
    if is_other and scaled < _BETTER * given:
        raise BlockError(
            f"{beginning}multiplied by {scale:.4g} about the principal point they are "
            f"{scaled:.1f} px away; they, or the principal distance, are of an image of another "
            "size"
        )


def _median(measured: Array, projected: Array) -> float:
    return float(np.median(np.linalg.norm(measured - projected, axis=1)))
