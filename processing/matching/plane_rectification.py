"""One exposure as seen from another, by the plane of the ground, so that a shift is left to find.

Images that differ by a shift and quarter turns are turned only: resampling costs accuracy.

Source: docs/explanation/mathematics/matching.md#across-exposures.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.geometry.projective import apply_projective
from processing.rig import VirtualImage

Array = NDArray[np.float64]
Picture = NDArray[np.float32]
Carry = Callable[[Array], Array]

_SAME_SHAPE: Final = 2e-3
"""Rotation, stretch or shear between two images below which a shift fits: 0.02 px at the edge of a
window. A turn by 2 degrees that is left in it moves a match by 0.07 px."""


def quarter_rotations(rotation: Array, other: Array) -> int:
    """Quarter turns, counter-clockwise, that align another image with the first.

    Args:
        rotation: (3, 3) from camera, of the first image.
        other: (3, 3) from camera, of the other.

    Returns:
        0 to 3, for `np.rot90` of the other image.
    """
    between = rotation.T @ other
    return round(math.atan2(between[1, 0], between[0, 0]) / (math.pi / 2.0)) % 4


def rotated_px(px: Array, width: int, height: int, quarters: int) -> Array:
    """Pixels of an image in that image turned by `np.rot90(image, quarters)`.

    Args:
        px: column and row before the turn, (n, 2).
        width: columns before the turn.
        height: rows before the turn.
        quarters: quarter turns, counter-clockwise, 0 to 3.

    Returns:
        Column and row after the turn, (n, 2).
    """
    column, row = px[:, 0], px[:, 1]
    rotated = {
        0: (column, row),
        1: (row, width - 1 - column),
        2: (width - 1 - column, height - 1 - row),
        3: (height - 1 - row, column),
    }[quarters]
    return np.stack(rotated, axis=1)


def _plane_homography(
    image: VirtualImage, here: tuple[Array, Array], there: tuple[Array, Array], ground_m: float
) -> Array:
    """There from here, (3, 3) on pixels, of level ground at a height; poses are place, rotation."""
    pitch, middle = image.pitch_mm, ((image.width_px - 1) / 2.0, (image.height_px - 1) / 2.0)
    right, up = -middle[0] * pitch, middle[1] * pitch
    ray_from_px = np.array([[pitch, 0.0, right], [0.0, -pitch, up], [0.0, 0.0, -image.f_mm]])
    # A ray d from S meets the ground at S + d (g - S_z) / d_z; d_z times that, less T d_z:
    seen = np.outer(here[0] - there[0], [0.0, 0.0, 1.0]) + (ground_m - here[0][2]) * np.eye(3)
    px_from_ray = np.linalg.inv(ray_from_px)
    return np.asarray(px_from_ray @ there[1].T @ seen @ here[1] @ ray_from_px)


def _shape_beyond_quarters(image: VirtualImage, homography: Array, quarters: int) -> float:
    """Largest element by which a homography differs locally from quarter turns, at the corners."""
    turn = np.linalg.matrix_power(np.array([[0.0, 1.0], [-1.0, 0.0]]), quarters)
    corners = [
        (x, y, 1.0) for x in (0.0, image.width_px - 1.0) for y in (0.0, image.height_px - 1.0)
    ]
    at = np.array(corners) @ homography.T
    with np.errstate(all="ignore"):
        local = homography[:2, :2] - at[:, :2, None] / at[:, 2, None, None] * homography[2, :2]
        return float(np.abs(turn @ (local / at[:, 2, None, None]) - np.eye(2)).max())


def rectified(
    there: Picture,
    image: VirtualImage,
    own: tuple[Array, Array],
    other: tuple[Array, Array],
    ground_m: float,
) -> tuple[Picture, Carry, Carry]:
    """Another image so that about a shift is left to find, and pixels' way into it and back.

    Args:
        there: (h, w), NaN without data.
        image: geometry of both.
        own: place and rotation of the first image.
        other: those of the other.
        ground_m: height of the ground.

    Returns:
        The image, and functions of pixels (n, 2) from the other image into it and back.
    """
    height, width = there.shape
    quarters = quarter_rotations(own[1], other[1])
    from_here = _plane_homography(image, own, other, ground_m)
    if not _shape_beyond_quarters(image, from_here, quarters) <= _SAME_SHAPE:
        to_here = np.asarray(np.linalg.inv(from_here))
        seen = cv2.warpPerspective(
            there, from_here, (width, height), flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT, borderValue=math.nan,
        )  # fmt: skip
        return (
            np.asarray(seen, np.float32),
            partial(apply_projective, to_here),
            partial(apply_projective, from_here),
        )
    rotated = np.ascontiguousarray(np.rot90(there, quarters))
    return (
        rotated,
        lambda px: rotated_px(px, width, height, quarters),
        lambda px: rotated_px(px, rotated.shape[1], rotated.shape[0], (4 - quarters) % 4),
    )
