"""A point that was measured in one image, found in the others that show it.

The patch around the measurement is matched as tie points are. What is transferred is the place of
the patch: the error of the measurement is common to all images and moves the point on the ground.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.matching.block_matching import BlockMatching, matched_in, pixels_of
from processing.matching.patch_tracks import Picture
from processing.matching.plane_rectification import rectified
from processing.rig import VirtualImage

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class TransferredPoints:
    """Image (m,), point (m,) and pixels (m, 2) of what was found."""

    image: Indices
    point: Indices
    px: Array


def transfer_points(
    load: Callable[[int], Picture],
    image: VirtualImage,
    station_m: Array,
    rotation: Array,
    source: tuple[Indices, Array],
    xyz_m: Array,
    settings: BlockMatching,
    skip: frozenset[tuple[int, int]] = frozenset(),
) -> TransferredPoints:
    """Find points of one image each in all others.

    Args:
        load: an image's pixels, (h, w), NaN without data.
        image: their common geometry.
        station_m: (n, 3) projection centres.
        rotation: (n, 3, 3) from camera.
        source: image (p,) and pixels (p, 2) where each point was measured.
        xyz_m: (p, 3) where the points are.
        settings: windows, searches and limits; searches are those of the first match.
        skip: pairs of image and point that need no match.

    Returns:
        Pixels of the same places in other images, in the order of images and points.

    Source: docs/explanation/mathematics/matching.md#least-squares-matching.
    """
    which, points, found = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 2))]
    for k in np.unique(source[0]).tolist():
        own = np.flatnonzero(source[0] == k)
        px, ground = source[1][own], xyz_m[own]
        here, places = load(k), np.round(px).astype(np.int64)
        known = np.zeros(len(own), dtype=bool)
        for j in range(len(station_m)):
            wanted = np.array([j != k and (j, int(p)) not in skip for p in own])
            if not wanted.any() or not _may_show(image, station_m[j], rotation[j], ground[wanted]):
                continue
            poses = ((station_m[k], rotation[k]), (station_m[j], rotation[j]))
            seen = rectified(load(j), image, *poses, float(ground[:, 2].mean()))
            _, at = matched_in(
                here, seen, image, rotation[j], station_m[j], places, ground, known, settings
            )
            good = np.flatnonzero(np.isfinite(at[:, 0]) & wanted)
            # The rest of a pixel is the same in the rectified image.
            _, into, back = seen
            moved = back(into(at[good]) + px[good] - places[good])
            which.append(np.full(len(good), j, dtype=np.int64))
            points.append(own[good])
            found.append(moved)
    return TransferredPoints(np.concatenate(which), np.concatenate(points), np.concatenate(found))


def _may_show(image: VirtualImage, station_m: Array, rotation: Array, xyz_m: Array) -> bool:
    at = pixels_of(image, station_m, rotation, xyz_m)
    last = np.array([image.width_px - 1, image.height_px - 1])
    return bool(((at >= 0.0) & (at <= last)).all(axis=1).any())
