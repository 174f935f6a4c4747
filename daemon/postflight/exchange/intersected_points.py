"""Object points intersected from oriented images, and how far the rays miss each other.

Rays that miss each other, or meet behind the cameras, show orientations and measurements of
different conventions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.exchange.block import (
    VISION_FROM_CAMERA,
    BlockCamera,
    BlockError,
    BlockImage,
    BlockPoints,
)
from daemon.postflight.exchange.photogrammetry import CAMERAS_FILE
from processing.geometry.forward_distortion import measured_px_from_rays, rays_from_measured_px

Array = NDArray[np.float64]

MISFIT_SHARE: Final = 0.01
"""Median misfit of the intersected points above which orientations and measurements disagree, as
a share of the longer side."""


class OtherConventionError(BlockError):
    """Rays that do not meet, with the median misfit; infinite where none was computed."""

    def __init__(self, message: str, median_px: float) -> None:
        super().__init__(message)
        self.median_px = median_px


@dataclass(frozen=True)
class Measured:
    """One image: what names its camera (a name, or a focal length), and its points in mm."""

    camera: str
    points: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class _Ray:
    """One measurement: its image, its pixel, and x / z, y / z of its ray, y down."""

    image: int
    px: Array
    xy: Array


def intersected(
    folder: Path,
    cameras: Sequence[BlockCamera],
    images: Sequence[BlockImage],
    measured: Mapping[str, Measured],
) -> tuple[BlockPoints, float]:
    """Points seen in two images or more, from the rays of all, and the median misfit in px.

    Raises:
        BlockError: no point is measured in two images.
        OtherConventionError: rays that do not meet, or meet behind the cameras, or measurements
            outside of their image.
    """
    seen: dict[str, list[_Ray]] = {}
    for k, one in enumerate(measured.values()):
        camera = cameras[images[k].camera]
        pitch = camera.pitch_mm or 1.0
        middle = np.array([(camera.width_px - 1) / 2.0, (camera.height_px - 1) / 2.0])
        xy_mm = np.array(list(one.points.values())).reshape(-1, 2)
        pixels = middle + xy_mm * [1.0, -1.0] / pitch
        directions = rays_from_measured_px(camera.model, pixels)
        is_outside = (np.abs(pixels - middle) > middle + 1.0).any(axis=1)
        for row, point in enumerate(one.points):
            if is_outside[row] or not np.isfinite(directions[row]).all():
                raise OtherConventionError(
                    f"{folder}: point {point} of image {images[k].name} lies outside of the image "
                    f"({xy_mm[row, 0]:g}, {xy_mm[row, 1]:g} mm); are coordinates in mm from the "
                    f"middle of the image, and {CAMERAS_FILE} right?",
                    math.inf,
                )
            seen.setdefault(point, []).append(_Ray(k, pixels[row], directions[row]))
    names: list[str] = []
    xyz: list[Array] = []
    image: list[int] = []
    of: list[int] = []
    px: list[Array] = []
    misfits: list[float] = []
    behind = 0
    for point, rays in seen.items():
        if len(rays) < 2:
            continue
        place, misfit_px, in_front = _meeting(cameras, images, rays)
        behind += not in_front
        misfits += misfit_px
        image += [ray.image for ray in rays]
        of += [len(names)] * len(rays)
        px += [ray.px for ray in rays]
        names.append(point)
        xyz.append(place)
    if not names:
        raise BlockError(f"{folder}: no point is measured in two images; there is no block")
    median_px = float(np.median(misfits))
    limit_px = MISFIT_SHARE * max(max(c.width_px, c.height_px) for c in cameras)
    if not median_px < limit_px or 2 * behind > len(names):
        raise OtherConventionError(
            f"{folder}: the rays miss each other by {median_px:.0f} px (median), and {behind} of "
            f"{len(names)} points lie behind the cameras. Order or unit of the angles, the "
            "direction of y (up), or the coordinate system of the orientation is another one",
            math.inf if 2 * behind > len(names) else median_px,
        )
    return BlockPoints(
        np.array(xyz),
        tuple(names),
        np.array(image, dtype=np.int64),
        np.array(of, dtype=np.int64),
        np.array(px),
    ), median_px


def _meeting(
    cameras: Sequence[BlockCamera], images: Sequence[BlockImage], rays: Sequence[_Ray]
) -> tuple[Array, list[float], bool]:
    """Where rays meet best, how far in px each measurement is from it, and whether in front."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for ray in rays:
        image = images[ray.image]
        along = image.rotation @ VISION_FROM_CAMERA @ np.append(ray.xy, 1.0)
        along /= np.linalg.norm(along)
        across = np.eye(3) - np.outer(along, along)
        normal += across
        right += across @ image.centre_m
    try:
        place = np.linalg.solve(normal, right)
    except np.linalg.LinAlgError:
        return images[rays[0].image].centre_m, [math.inf], False
    misfits, in_front = [], True
    for ray in rays:
        image = images[ray.image]
        x, y, z = VISION_FROM_CAMERA @ image.rotation.T @ (place - image.centre_m)
        in_front = in_front and z > 0.0
        back = measured_px_from_rays(cameras[image.camera].model, np.array([[x / z, y / z]]))
        misfits.append(float(np.linalg.norm(back[0] - ray.px)))
    return np.asarray(place), misfits, bool(in_front)
