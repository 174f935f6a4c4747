"""Measurements against the projections of the points of the same files.

A free network of mirrored images is adjusted as well as the true one, into a mirrored scene: only
the other program's own orientations show which it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.exchange.block import Block, BlockError
from daemon.postflight.exchange.conventions import (
    WRITE_AXES,
    Convention,
    Explanation,
    of_measurements,
    of_points,
    of_poses,
)
from processing.geometry.forward_distortion import measured_px_from_rays

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_FAR: Final = 0.02
"""Median distance over the longer side of the image from which other origins and units are tried,
which a provisional principal point or principal distance resembles."""
_UNEXPLAINED: Final = 0.05
"""The same, from which a block is refused although no other convention explains it."""
_BETTER: Final = 0.2
_SCALE_BEYOND: Final = 1.2
_MIN_POINTS: Final = 20
_TRIED: Final = 20_000
"""Measurements that are projected, spread evenly over the block."""
_NOTED_SIGMAS: Final = 3.0
"""Median distance in standard deviations from which other axes, poses and columns are tried."""
_SHIFT_NOTED_PX: Final = 0.3
_SINGLE: Final = 20.0
"""Median distance of a single image, over that of all, from which it is not of the block."""
_SINGLE_MIN: Final = 10
_LISTED: Final = 5
_OUTSIDE_SHARE: Final = 0.01
_BORDER_PX: Final = 1.5


@dataclass(frozen=True)
class _Sample:
    """Measurements: indices of image and point (n,); px, principal point and size (n, 2)."""

    block: Block
    image: Indices
    point: Indices
    px: Array
    centre: Array
    size: Array


def refuse_other_convention(path: Path, block: Block, sigma_px: float) -> tuple[str, ...]:
    """Refuse measurements that fit the block's own points in another convention only.

    Args:
        path: of the files, for the message.
        block: as read.
        sigma_px: stated standard deviation of image coordinates.

    Returns:
        Sentences about measurements that fit hardly: distances of several standard deviations, a
        common shift, and some that lie outside of their image.

    Raises:
        BlockError: axes that are reversed or exchanged, another origin, unit, direction of poses
            or order of columns, points that are far from their measurements without such a reason,
            an image of another size, or single images with the orientation of another one.
    """
    sample = _sample_of(block)
    if len(sample.px) < _MIN_POINTS or not np.isfinite(block.points.xyz_m).all():
        return _outside(path, block)
    projected = _given(sample)
    side = float(sample.size.max())
    given = _median(sample.px, projected)
    is_far = given >= _FAR * side
    if not is_far:
        _refuse_single_images(path, sample, projected, max(given, sigma_px))
    if not is_far and given <= _NOTED_SIGMAS * sigma_px:
        return (*_shift_note(sample, projected, sigma_px), *_outside(path, block))
    limit = min(_BETTER * given, _UNEXPLAINED * side)
    finding = (
        "half of the measurements are of points behind their images"
        if math.isinf(given)
        else f"half of the measurements are {given:.1f} px or more from the projections of their "
        "points"
    )
    for explained in (_simple, _shifted) if is_far else (_simple,):
        why, then = explained(sample, projected)
        if then < limit:
            raise BlockError(f"{path}: {finding}: {why.what} ({then:.1f} px then); {why.cure}")
    for shift in (False, True) if is_far else ():
        scale, scaled = _scaled(sample, projected, shift=shift)
        is_other = scale > _SCALE_BEYOND or 0.0 < scale < 1.0 / _SCALE_BEYOND
        if is_other and scaled < limit:
            about = "and shifted" if shift else "about the principal point"
            raise BlockError(
                f"{path}: {finding}: multiplied by {scale:.4g} {about} they are {scaled:.1f} px "
                "away; they, or the principal distance, are of an image of another size, or in "
                "another unit"
            )
    if given >= _UNEXPLAINED * side:
        raise BlockError(
            f"{path}: {finding}, and neither reversed or exchanged axes nor another unit explain "
            "it; cameras, distortion, orientations, points and measurements are not of one "
            "adjustment, or angles have another order or unit: export them together"
        )
    hardly = (
        f"{finding}, and --image-sigma states {sigma_px:g} px: cameras, orientations and points "
        "are not adjusted to these measurements, or a sign of the distortion is another one"
    )
    return (hardly, *_outside(path, block))


def _sample_of(block: Block) -> _Sample:
    points = block.points
    rows = np.unique(np.linspace(0, len(points.image) - 1, _TRIED).astype(np.int64))
    rows = rows if len(points.image) else np.zeros(0, np.int64)
    image = points.image[rows]
    cameras = [block.cameras[one.camera] for one in block.images]
    centre = np.array([(c.model.cx_px, c.model.cy_px) for c in cameras])
    size = np.array([(c.width_px, c.height_px) for c in cameras], float)
    return _Sample(block, image, points.point[rows], points.px[rows], centre[image], size[image])


def _projected(sample: _Sample, rotation: Array, place: Array, xyz: Array) -> Array:
    """Pixels of the points in their images, NaN behind them."""
    found = np.full_like(sample.px, np.nan)
    for number in np.unique(sample.image):
        rows = np.flatnonzero(sample.image == number)
        ray = (xyz[sample.point[rows]] - place[number]) @ rotation[number]
        front = ray[:, 2] < 0.0
        seen = ray[front, :2] / -ray[front, 2:] * np.array([1.0, -1.0])
        model = sample.block.cameras[sample.block.images[number].camera].model
        found[rows[front]] = measured_px_from_rays(model, seen)
    return found


def _poses(sample: _Sample) -> tuple[Array, Array]:
    images = sample.block.images
    return np.array([one.rotation for one in images]), np.array([one.centre_m for one in images])


def _given(sample: _Sample) -> Array:
    return _projected(sample, *_poses(sample), sample.block.points.xyz_m)


def _simple(sample: _Sample, projected: Array) -> tuple[Explanation, float]:
    """The one other convention with which measurements are nearest, and their median distance."""
    rotation, place = _poses(sample)
    xyz = sample.block.points.xyz_m
    tried = [
        (one.why, _median(one.of(sample.px), projected))
        for one in of_measurements(sample.centre, sample.size)
    ]
    tried += [
        (why, _median(sample.px, _projected(sample, turns, places, xyz)))
        for why, turns, places in of_poses(rotation, place)
    ]
    tried += [
        (why, _median(sample.px, _projected(sample, rotation, place, other)))
        for why, other in of_points(xyz)
    ]
    return min(tried, key=lambda one: one[1])


def _shifted(sample: _Sample, projected: Array) -> tuple[Explanation, float]:
    """The same with another origin in addition."""
    same = Convention(Explanation("", WRITE_AXES), lambda px: px)
    best = Explanation("", ""), math.inf
    for one in (same, *of_measurements(sample.centre, sample.size)):
        px = one.of(sample.px)
        shift = _middle(projected - px)
        then = _median(px + shift, projected)
        if then < best[1]:
            origin = f"their origin, or the principal point, is {shift[0]:.0f}, {shift[1]:.0f} px"
            what = f"{one.why.what}, and " if one.why.what else ""
            best = Explanation(f"{what}{origin} away", one.why.cure), then
    return best


def _scaled(sample: _Sample, projected: Array, *, shift: bool) -> tuple[float, float]:
    """Factor of the measurements with which they are nearest, and their median distance."""
    there = np.isfinite(projected).all(axis=1)
    if there.sum() < _MIN_POINTS:
        return 1.0, math.inf
    measured, seen = (one[there] - sample.centre[there] for one in (sample.px, projected))
    if shift:
        measured, seen = measured - _middle(measured), seen - _middle(seen)
    scale = float((measured * seen).sum() / max((measured * measured).sum(), 1e-300))
    return scale, _median(scale * measured, seen)


def _refuse_single_images(path: Path, sample: _Sample, projected: Array, usual_px: float) -> None:
    """Refuse images that are far from their measurements where all others are near.

    Raises:
        BlockError: such images by name, with the image whose orientation fits each of them.
    """
    limit = max(_FAR * float(sample.size.max()), _SINGLE * usual_px)
    far = [
        int(number)
        for number in np.unique(sample.image)
        if (sample.image == number).sum() >= _SINGLE_MIN
        and _median_of(sample, projected, number) > limit
    ]
    if not far:
        return
    # Points intersected with their rays take neighbours along: the farthest are the cause.
    far.sort(key=lambda number: -_median_of(sample, projected, number))
    rotation, place = _poses(sample)
    names = [one.name for one in sample.block.images]
    sentences = []
    for number in far[:_LISTED]:
        own = f"{names[number]} ({_distance(_median_of(sample, projected, number))}"
        for other in far:
            turns, places = rotation.copy(), place.copy()
            turns[number], places[number] = rotation[other], place[other]
            then = _projected(sample, turns, places, sample.block.points.xyz_m)
            if _median_of(sample, then, number) < limit:
                own += f"; near with the orientation of {names[other]}"
                break
        sentences.append(f"{own})")
    more = ", ..." if len(far) > _LISTED else ""
    raise BlockError(
        f"{path}: measurements of {len(far)} of {len(names)} images are far from the projections "
        f"of their points, and those of the others near: {', '.join(sentences)}{more}. Their "
        "orientations or measurements are those of other images, or of another adjustment: export "
        "the block again, or leave these images out"
    )


def _median_of(sample: _Sample, projected: Array, number: int) -> float:
    own = sample.image == number
    return _median(sample.px[own], projected[own])


def _distance(px: float) -> str:
    return "points behind it" if math.isinf(px) else f"{px:.0f} px"


def _shift_note(sample: _Sample, projected: Array, sigma_px: float) -> tuple[str, ...]:
    shift = _middle(projected - sample.px)
    if np.abs(shift).max() < max(_SHIFT_NOTED_PX, 0.5 * sigma_px):
        return ()
    return (
        f"the projections of the points are {shift[0]:.2f} px right of and {shift[1]:.2f} px below "
        "their measurements (median); half a pixel or one pixel means that the file counts pixels "
        "from another origin",
    )


def _outside(path: Path, block: Block) -> tuple[str, ...]:
    """A sentence about measurements outside of their image; refuse more than a few.

    Raises:
        BlockError: more than 1 % lie outside.
    """
    points = block.points
    if not len(points.image):
        return ()
    cameras = [block.cameras[one.camera] for one in block.images]
    size = np.array([(c.width_px, c.height_px) for c in cameras], float)[points.image]

    def beyond(size: Array) -> Array:
        return np.asarray(
            ((points.px < -_BORDER_PX) | (points.px > size - 1.0 + _BORDER_PX)).any(axis=1)
        )

    outside = np.flatnonzero(beyond(size))
    if not len(outside):
        return ()
    first = block.images[int(points.image[outside[0]])]
    camera = block.cameras[first.camera]
    finding = (
        f"{len(outside)} of {len(points.image)} measurements lie outside of their image (the first "
        f"one in {first.name}, {camera.width_px} x {camera.height_px} px)"
    )
    if len(outside) <= _OUTSIDE_SHARE * len(points.image):
        return (finding,)
    exchanged = int(beyond(size[:, ::-1]).sum())
    why = (
        f"columns and rows of the camera are exchanged: {exchanged} lie outside then"
        if exchanged < _BETTER * len(outside)
        else "the size of the camera, or the origin or unit of the measurements, is another one"
    )
    raise BlockError(f"{path}: {finding}; {why}: correct the size, or export the block again")


def _middle(offset: Array) -> Array:
    there = np.isfinite(offset).all(axis=1)
    return np.median(offset[there], axis=0) if there.any() else np.zeros(2)


def _median(measured: Array, projected: Array) -> float:
    """Median distance; infinite where half of the points are behind their images."""
    distance = np.linalg.norm(measured - projected, axis=1)
    return float(np.median(np.where(np.isfinite(distance), distance, np.inf)))
