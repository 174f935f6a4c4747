"""Tie points across exposures: features of one image found in every other that overlaps it.

Prediction by direct georeferencing, and by a height model until an earlier match of the same point
gave its height;
correlation and least squares as in `processing.matching.patches`, which find a shift. Images that
differ by more than that and quarter turns (crab, tilts, oblique views) are first brought to where
the other stood and looked, by the plane of the ground. Views from too far apart are not matched.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.initial_values import intersect
from processing.geometry.terrain_rays import HeightModel, on_terrain
from processing.matching.patches import INTERPOLATION, MARGIN_PX, match_patches, select_features
from processing.matching.plane_rectification import Carry, Picture, rectified
from processing.rig import VirtualImage

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_SIMILAR_VIEW_COSINE: Final = math.cos(math.radians(35.0))
"""Views farther apart show other sides of objects on the ground."""


@dataclass(frozen=True)
class BlockMatching:
    """How to match.

    Attributes:
        cells: columns and rows of the grid with one feature each.
        window_px: side of the patches, odd.
        first_search_px: around the prediction while the height of the ground is a plane's.
        search_px: once a point's height is known from an earlier match.
        min_correlation, min_peak_margin, max_sigma_px: what a match must reach.
    """

    cells: tuple[int, int] = (20, 14)
    window_px: int = 19
    first_search_px: int = 24
    search_px: int = 8
    min_correlation: float = 0.9
    min_peak_margin: float = 0.1
    max_sigma_px: float = 0.1


@dataclass(frozen=True)
class BlockTiePoints:
    """Image points: image (n,), point (n,), pixels (n, 2); points are numbered from zero.

    `tried` and `matched` count patches by pair of images.
    """

    image: Indices
    point: Indices
    px: Array
    points: int
    tried: dict[tuple[int, int], int]
    matched: dict[tuple[int, int], int]


@dataclass(frozen=True)
class ImageMatches:
    """Features of one image found in later ones.

    `own` (n, 2) are their pixels; `places` by later image j: which of the features (m,), and where
    they are in it (m, 2). `tried` counts patches by later image.
    """

    own: Array
    places: dict[int, tuple[Indices, Array]]
    tried: dict[int, int]


def match_block(
    load: Callable[[int], Picture],
    image: VirtualImage,
    station_m: Array,
    rotation: Array,
    ground_m: float,
    settings: BlockMatching | None = None,
    *,
    heights: HeightModel | None = None,
    progress: Callable[[int], None] = lambda _done: None,
) -> BlockTiePoints:
    """Match all overlapping images of a block.

    Args:
        load: an image's pixels, (h, w) float32, NaN without data.
        image: their common geometry.
        station_m: (n, 3) projection centres, any Cartesian frame with z up.
        rotation: (n, 3, 3) from camera.
        ground_m: height of the ground there, to begin with.
        settings: grid, windows, searches and limits; None takes the defaults.
        heights: of the ground in that frame, where they are known; elsewhere `ground_m` holds.
        progress: called with the number of images that are done.

    Returns:
        Image points that at least two images share, and counts by pair of images (k, j), k < j.

    Source: docs/explanation/mathematics/matching.md#least-squares-matching.
    """
    settings = settings or BlockMatching()
    found = []
    for k in range(len(station_m)):
        found.append(match_image(k, load, image, station_m, rotation, ground_m, settings, heights))
        progress(k + 1)
    return joined_matches(found)


def match_image(
    k: int,
    load: Callable[[int], Picture],
    image: VirtualImage,
    station_m: Array,
    rotation: Array,
    ground_m: float,
    settings: BlockMatching,
    heights: HeightModel | None = None,
) -> ImageMatches:
    """Match one image with all later ones that overlap it; no other image's matches are needed.

    Args:
        k: index of the image.
        load: an image's pixels, (h, w) float32, NaN without data.
        image: their common geometry.
        station_m: (n, 3) projection centres, any Cartesian frame with z up.
        rotation: (n, 3, 3) from camera.
        ground_m: height of the ground there, to begin with.
        settings: grid, windows, searches and limits.
        heights: of the ground in that frame, where they are known.

    Returns:
        Its features, and where later images show them.

    Source: docs/explanation/mathematics/matching.md#least-squares-matching.
    """
    here = load(k)
    chosen = select_features(here, _cells(image, settings), settings.window_px // 2, 2, False)
    pixels = np.round(chosen[chosen[:, 2] > 0.0][:, :2]).astype(np.int64)
    others = _overlapping(image, station_m, rotation, ground_m, k)
    own = pixels.astype(np.float64)
    found = ImageMatches(own, {}, {})
    if not len(pixels) or not others:
        return found
    rays = rays_of(image, rotation[k], own)
    ground = _on_ground(station_m[k], rays, ground_m, heights)
    plane_m = float(np.median(ground[:, 2]))
    known = np.zeros(len(pixels), dtype=bool)
    for j in others:
        poses = ((station_m[k], rotation[k]), (station_m[j], rotation[j]))
        found.tried[j], at = matched_in(
            here, rectified(load(j), image, *poses, plane_m), image, rotation[j],
            station_m[j], pixels, ground, known, settings,
        )  # fmt: skip
        rows = np.flatnonzero(np.isfinite(at[:, 0]))
        found.places[j] = rows, at[rows]
        if not len(rows):
            continue
        new = rows[~known[rows]]
        ground[new] = _intersected(
            (station_m[k], rays[new]),
            (station_m[j], rays_of(image, rotation[j], at[new])),
            ground[new],
        )
        known[new] = True
    return found


def _on_ground(
    station_m: Array, rays: Array, ground_m: float, heights: HeightModel | None
) -> Array:
    """Where rays (n, 3) meet the height model, else level ground, (n, 3)."""
    level = station_m + rays * ((ground_m - station_m[2]) / rays[:, 2:])
    if heights is None:
        return np.asarray(level)
    found = on_terrain(station_m, rays, heights, earth_radius_m=None)
    return np.where(np.isfinite(found), found, level)


def joined_matches(found: Sequence[ImageMatches]) -> BlockTiePoints:
    """Tie points of a block from the matches of its images.

    Args:
        found: of every image, in order.

    Returns:
        Image points that at least two images share, numbered by image and feature.
    """
    which, points, px = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 2))]
    count = 0
    for k, one in enumerate(found):
        seen = np.zeros(len(one.own), dtype=bool)
        for rows, _ in one.places.values():
            seen[rows] = True
        number = np.where(seen, count + np.cumsum(seen) - 1, -1)
        count += int(seen.sum())
        for j, own, at in [
            (k, np.flatnonzero(seen), one.own[seen]),
            *((j, rows, at) for j, (rows, at) in one.places.items()),
        ]:
            which.append(np.full(len(own), j, dtype=np.int64))
            points.append(number[own])
            px.append(at)
    return BlockTiePoints(
        np.concatenate(which),
        np.concatenate(points),
        np.concatenate(px),
        count,
        {(k, j): tried for k, one in enumerate(found) for j, tried in one.tried.items()},
        {(k, j): len(rows) for k, one in enumerate(found) for j, (rows, _) in one.places.items()},
    )


def image_mm(image: VirtualImage, px: Array) -> Array:
    """Image coordinates of pixels.

    Args:
        image: size and pixel pitch.
        px: column and row, (n, 2), zero in the middle of the upper left pixel.

    Returns:
        x right and y up of the image's middle, (n, 2), mm.

    Source: docs/explanation/mathematics/coordinates.md#pixels-and-millimetres.
    """
    return np.stack(
        [
            (px[:, 0] - (image.width_px - 1) / 2.0) * image.pitch_mm,
            ((image.height_px - 1) / 2.0 - px[:, 1]) * image.pitch_mm,
        ],
        axis=1,
    )


def rays_of(image: VirtualImage, rotation: Array, px: Array) -> Array:
    """Rays of pixels.

    Args:
        image: size, pixel pitch and principal distance.
        rotation: (3, 3) from camera.
        px: column and row, (n, 2).

    Returns:
        Directions, shape (n, 3), object axes.
    """
    xy = image_mm(image, px)
    return np.asarray(np.column_stack([xy, np.full(len(xy), -image.f_mm)]) @ rotation.T)


def pixels_of(image: VirtualImage, station_m: Array, rotation: Array, xyz_m: Array) -> Array:
    """Pixels where an image sees points.

    Args:
        image: size, pixel pitch and principal distance.
        station_m: (3,) projection centre.
        rotation: (3, 3) from camera.
        xyz_m: (n, 3) points.

    Returns:
        Column and row, shape (n, 2), NaN where a point is behind the image.
    """
    seen = (xyz_m - station_m) @ rotation
    with np.errstate(all="ignore"):
        xy = -image.f_mm * seen[:, :2] / seen[:, 2:]
    xy[seen[:, 2] >= 0.0] = np.nan
    return np.stack(
        [
            xy[:, 0] / image.pitch_mm + (image.width_px - 1) / 2.0,
            (image.height_px - 1) / 2.0 - xy[:, 1] / image.pitch_mm,
        ],
        axis=1,
    )


def matched_in(
    here: Picture,
    rectified_image: tuple[Picture, Carry, Carry],
    image: VirtualImage,
    rotation: Array,
    station_m: Array,
    places: Indices,
    ground: Array,
    known: NDArray[np.bool_],
    settings: BlockMatching,
) -> tuple[int, Array]:
    """Find places of one image in another.

    Args:
        here: the first image.
        rectified_image: the other, as `rectified` makes it.
        image: geometry of both.
        rotation: (3, 3) of the other.
        station_m: (3,) of the other.
        places: (n, 2) pixels of the first.
        ground: (n, 3) where they are on the ground, about.
        known: (n,) that is from a match.
        settings: searches and limits.

    Returns:
        Number of places searched, and where they are in the other image (n, 2), NaN if not found.
    """
    rotated, into, back = rectified_image
    seen = pixels_of(image, station_m, rotation, ground)
    predicted = into(seen)
    margin_px = settings.window_px // 2 + MARGIN_PX + 2
    last = np.array([rotated.shape[1] - 1, rotated.shape[0] - 1])
    inside = ((predicted > margin_px) & (predicted < last - margin_px)).all(axis=1)
    own = np.array([image.width_px - 1, image.height_px - 1])
    inside &= ((seen > margin_px) & (seen < own - margin_px)).all(axis=1)
    limits = np.array([0, last[0], 0, last[1]], dtype=np.int64)
    at = np.full((len(places), 2), np.nan)
    for rows, search in (
        (np.flatnonzero(inside & known), settings.search_px),
        (np.flatnonzero(inside & ~known), settings.first_search_px),
    ):
        if not len(rows):
            continue
        result = match_patches(
            here, rotated, places[rows], np.round(predicted[rows]).astype(np.int64), limits, 1,
            settings.window_px // 2, search, False, INTERPOLATION,
        )  # fmt: skip
        good = (
            (result[:, 7] > 0.0)
            & (result[:, 4] <= settings.max_sigma_px)
            & (result[:, 5] >= settings.min_correlation)
            & (result[:, 6] >= settings.min_peak_margin)
        )
        # Both places moved by a part of a pixel; what counts is where the chosen pixel is.
        moved = result[good, 2:4] - (result[good, :2] - places[rows[good]])
        at[rows[good]] = back(moved)
    return int(inside.sum()), at


def _overlapping(
    image: VirtualImage, station_m: Array, rotation: Array, ground_m: float, k: int
) -> list[int]:
    """Later images that see part of what image k does from about its side, the nearest first."""
    c, r = np.meshgrid(
        np.linspace(0, image.width_px - 1, 9), np.linspace(0, image.height_px - 1, 9)
    )
    rays = rays_of(image, rotation[k], np.stack([c.ravel(), r.ravel()], axis=1))
    level = station_m[k] + rays * ((ground_m - station_m[k, 2]) / rays[:, 2:])
    last = np.array([image.width_px - 1, image.height_px - 1])
    found = []
    for j in range(k + 1, len(station_m)):
        if rotation[j][:, 2] @ rotation[k][:, 2] < _SIMILAR_VIEW_COSINE:
            continue
        at = pixels_of(image, station_m[j], rotation[j], level)
        if ((at >= 0.0) & (at <= last)).all(axis=1).any():
            found.append((float(np.linalg.norm(station_m[j] - station_m[k])), j))
    return [j for _, j in sorted(found)]


def _intersected(a: tuple[Array, Array], b: tuple[Array, Array], otherwise: Array) -> Array:
    n = len(otherwise)
    stations = np.concatenate([np.broadcast_to(a[0], (n, 3)), np.broadcast_to(b[0], (n, 3))])
    point = np.concatenate([np.arange(n), np.arange(n)])
    found, _ = intersect(n, point, stations, np.concatenate([a[1], b[1]]))
    return np.where(np.isfinite(found), found, otherwise)


def _cells(image: VirtualImage, settings: BlockMatching) -> NDArray[Any]:
    margin_px = settings.window_px // 2 + MARGIN_PX + 4
    columns = np.linspace(margin_px, image.width_px - margin_px, settings.cells[0] + 1).astype(
        np.int64
    )
    rows = np.linspace(margin_px, image.height_px - margin_px, settings.cells[1] + 1).astype(
        np.int64
    )
    return np.array(
        [
            (columns[c], columns[c + 1] - 1, rows[r], rows[r + 1] - 1)
            for r in range(settings.cells[1])
            for c in range(settings.cells[0])
        ]
    )


def match_counts_by_line(block: BlockTiePoints, line: Sequence[str]) -> tuple[int, int]:
    """Count matches that join images of one line, and of different lines.

    Args:
        block: what was matched.
        line: name of the flight line of each image.

    Returns:
        Matches within lines, and between lines.
    """
    along = sum(n for (a, b), n in block.matched.items() if line[a] == line[b])
    return along, sum(block.matched.values()) - along
