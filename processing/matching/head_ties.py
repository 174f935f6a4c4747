"""Tie points between two heads of one instant, and the rotation between them.

Features are matched where both heads should see the same ground; distant ground is taken for
infinitely far, so that their directions differ by a rotation alone.

Source: docs/explanation/mathematics/virtual-camera.md#proposed-image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.geometry.lens import ideal_from_measured
from processing.geometry.placement import layer_mm_from_raw
from processing.geometry.rotation import rotation_matrix
from processing.rig import Cone

Array = NDArray[np.float64]

MIN_TIES: Final = 20
_FEATURES: Final = 6000
_RATIO: Final = 0.8
_SEARCH_RAD: Final = math.radians(4.0)
_INLIER_PX: Final = 2.0
_TRIALS: Final = 400


@dataclass(frozen=True)
class HeadRotation:
    """Rotation first_from_second, (3, 3), from `ties` directions that fit to `rms_px`."""

    rotation: Array
    ties: int
    rms_px: float


def directions(cone: Cone, px: Array) -> Array:
    """Unit directions of pixels in the axes of a head.

    Args:
        cone: with one sensor.
        px: column and row, shape (n, 2).

    Returns:
        Shape (n, 3).
    """
    ideal = ideal_from_measured(cone.lens, layer_mm_from_raw(cone.sensors[0], px))
    ray = np.column_stack([ideal, np.full(len(ideal), -cone.lens.f_mm)])
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def rotation_between(
    cones: tuple[Cone, Cone], pictures: Sequence[tuple[NDArray[np.uint8], NDArray[np.uint8]]]
) -> HeadRotation | None:
    """Estimate the rotation between two heads from pictures of some instants.

    Args:
        cones: both heads, their rotations about right (4 degrees).
        pictures: of both heads, 8-bit grey, one pair for each instant.

    Returns:
        The rotation; None where fewer than `MIN_TIES` directions agree.
    """
    nominal = rotation_matrix(*cones[0].rotation_rad).T @ rotation_matrix(*cones[1].rotation_rad)
    pairs = [_matched(cones, pair, nominal) for pair in pictures]
    first = np.concatenate([a for a, _ in pairs]) if pairs else np.zeros((0, 3))
    second = np.concatenate([b for _, b in pairs]) if pairs else np.zeros((0, 3))
    pixel_rad = cones[0].sensors[0].pitch_mm / cones[0].lens.f_mm
    limit = _INLIER_PX * pixel_rad
    if len(first) < MIN_TIES:
        return None
    random = np.random.default_rng(1)
    best = np.zeros(len(first), bool)
    for _ in range(_TRIALS):
        chosen = random.choice(len(first), 2, replace=False)
        good = _apart(first, second, _fitted(first[chosen], second[chosen])) < limit
        if good.sum() > best.sum():
            best = good
    for _ in range(5):
        if best.sum() < MIN_TIES:
            return None
        rotation = _fitted(first[best], second[best])
        best = _apart(first, second, rotation) < limit
    if best.sum() < MIN_TIES:
        return None
    off = _apart(first[best], second[best], rotation)
    rms = float(np.sqrt(np.mean(off**2))) / pixel_rad
    return HeadRotation(rotation, int(best.sum()), rms)


def _matched(
    cones: tuple[Cone, Cone], pair: tuple[NDArray[np.uint8], NDArray[np.uint8]], nominal: Array
) -> tuple[Array, Array]:
    finder = cv2.SIFT.create(nfeatures=_FEATURES)
    seen = []
    for cone, picture in zip(cones, pair, strict=True):
        keys, features = finder.detectAndCompute(picture, None)
        px = np.array([key.pt for key in keys], np.float64).reshape(-1, 2)
        seen.append((directions(cone, px), features))
    (first, a), (second, b) = seen
    if a is None or b is None or min(len(a), len(b)) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3))
    nearest = cv2.BFMatcher().knnMatch(b, a, k=2)
    links = [
        (m[0].trainIdx, m[0].queryIdx)
        for m in nearest
        if len(m) == 2 and m[0].distance < _RATIO * m[1].distance
    ]
    i, j = np.array(links, np.int64).reshape(-1, 2).T
    near = _apart(first[i], second[j], nominal) < _SEARCH_RAD
    return first[i][near], second[j][near]


def _fitted(first: Array, second: Array) -> Array:
    """Rotation first_from_second that fits directions best (Kabsch)."""
    u, _, v = np.linalg.svd(first.T @ second)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v)


def _apart(first: Array, second: Array, rotation: Array) -> Array:
    return np.asarray(np.linalg.norm(first - second @ rotation.T, axis=1))
