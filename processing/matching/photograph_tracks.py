"""Tracks of features through photographs of which no orientation is known.

Features of every image are compared with those of candidate images; what a fundamental matrix
explains is joined to tracks. Which images are compared is the caller's choice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Pairs = Mapping[tuple[int, int], Indices]

MATCHES_MIN: Final = 25
"""Pairs of images with fewer consistent matches are taken as unrelated."""
_RATIO: Final = 0.8
_CONTRAST_MIN: Final = 0.0067
"""A sixth of the usual limit: fields and sand are faint."""
_EPIPOLAR_PX: Final = 4.0
_CONFIDENCE: Final = 0.9999
_TRIALS: Final = 10_000
_FEATURES_MIN: Final = 8
_CELLS: Final = (12, 9)
_TRACKS_IN_CELL: Final = 2


@dataclass(frozen=True)
class ImageFeatures:
    """Places (n, 2) px, zero in the middle of the upper left pixel, and descriptors (n, 128)."""

    px: Array
    descriptors: NDArray[np.float32]


@dataclass(frozen=True)
class Tracks:
    """Image points: image (n,), point (n,), px (n, 2); points are numbered from zero."""

    image: Indices
    point: Indices
    px: Array
    points: int


def features_of(
    grey: NDArray[np.uint8], *, side_max_px: int = 2400, features_max: int = 7000
) -> ImageFeatures:
    """Features of one image by SIFT, the largest ones.

    Args:
        grey: (h, w).
        side_max_px: larger images are reduced to this size of their longer side.
        features_max: number of features at most.

    Returns:
        Places in pixels of the full image, and root-normalised descriptors.

    Source: Lowe (2004); Arandjelovic and Zisserman (2012) for the normalisation.
    """
    height, width = grey.shape
    scale = min(1.0, side_max_px / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale < 1.0 else grey
    # Without precise upscaling the doubled image, and with it all places, is shifted.
    detector = cv2.SIFT.create(contrastThreshold=_CONTRAST_MIN, enable_precise_upscale=True)
    # Large features are found again more often than small ones.
    found = sorted(detector.detect(small), key=lambda k: (-k.size, -k.response))
    kept, descriptors = detector.compute(small, found[:features_max])
    if descriptors is None or not kept:
        return ImageFeatures(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    ratio = np.array([width / size[0], height / size[1]])
    px = (np.array([k.pt for k in kept], dtype=np.float64) + 0.5) * ratio - 0.5
    # One feature a place: a second orientation of it would join tracks with themselves.
    _, first = np.unique(np.round(px, 3), axis=0, return_index=True)
    total = np.abs(descriptors).sum(axis=1, keepdims=True)
    rooted = np.sqrt(descriptors / np.maximum(total, 1e-12))
    return ImageFeatures(px[first], np.ascontiguousarray(rooted[first], np.float32))


def match_photographs(
    features: Sequence[ImageFeatures],
    candidates: Sequence[tuple[int, int]],
    *,
    progress: Callable[[int], None] = lambda _done: None,
) -> dict[tuple[int, int], Indices]:
    """Consistent matches of candidate pairs.

    Args:
        features: of every image.
        candidates: pairs of images (a, b), a < b.
        progress: called with the number of pairs that are done.

    Returns:
        By pair, indices (m, 2) of features in a and b; pairs with fewer than `MATCHES_MIN` are
        left out.
    """
    found = {}
    for done, (a, b) in enumerate(candidates, start=1):
        pairs = _consistent(features[a].px, features[b].px, _alike(features[a], features[b]))
        if len(pairs) >= MATCHES_MIN:
            found[a, b] = pairs
        progress(done)
    return found


def _alike(a: ImageFeatures, b: ImageFeatures) -> Indices:
    """Mutually nearest descriptors that are clearly nearer than the second nearest, (m, 2)."""
    if min(len(a.px), len(b.px)) < _FEATURES_MIN:
        return np.zeros((0, 2), np.int64)
    likeness = a.descriptors @ b.descriptors.T
    rows = np.arange(len(a.px))
    best = likeness.argmax(axis=1)
    back = likeness.argmax(axis=0)
    top = likeness[rows, best].copy()
    likeness[rows, best] = -1.0
    second = likeness.max(axis=1)
    # Descriptors have length 1: squared distances are 2 - 2 likeness.
    clear = (1.0 - top) < _RATIO**2 * (1.0 - second)
    keep = clear & (back[best] == rows)
    return np.stack([rows[keep], best[keep]], axis=1).astype(np.int64)


def _consistent(a_px: Array, b_px: Array, pairs: Indices) -> Indices:
    """Matches that one fundamental matrix explains."""
    if len(pairs) < MATCHES_MIN:
        return pairs[:0]
    try:
        _, inside = cv2.findFundamentalMat(
            a_px[pairs[:, 0]], b_px[pairs[:, 1]], cv2.USAC_MAGSAC, _EPIPOLAR_PX, _CONFIDENCE,
            _TRIALS,
        )  # fmt: skip
    except cv2.error:
        # Matches that no model explains end in an assertion (`!model.empty()`) in OpenCV 5.0.
        return pairs[:0]
    return pairs[:0] if inside is None else pairs[inside.ravel() > 0]


def join_tracks(features: Sequence[ImageFeatures], pairs: Pairs) -> Tracks:
    """Join matches to tracks; those that meet an image twice are left out as ambiguous.

    Args:
        features: of every image.
        pairs: matches of pairs of images, as `match_photographs` returns them.

    Returns:
        Image points of all tracks, by point.
    """
    start = np.concatenate([[0], np.cumsum([len(one.px) for one in features])]).astype(np.int64)
    root = _joined(int(start[-1]), start, pairs)
    of_image = np.repeat(np.arange(len(features)), np.diff(start))
    used = np.zeros(len(root), bool)
    for (a, b), rows in pairs.items():
        used[start[a] + rows[:, 0]] = True
        used[start[b] + rows[:, 1]] = True
    nodes = np.flatnonzero(used)
    _, track = np.unique(root[nodes], return_inverse=True)
    image = of_image[nodes]
    # A track that meets an image twice has two nodes with one key.
    key = track * len(features) + image
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    good = np.ones(int(track.max(initial=-1)) + 1, bool)
    good[track[first[count > 1]]] = False
    keep = good[track]
    _, point = np.unique(track[keep], return_inverse=True)
    order = np.lexsort((image[keep], point))
    px = np.concatenate([one.px for one in features]) if len(features) else np.zeros((0, 2))
    points = int(point.max(initial=-1)) + 1
    return Tracks(image[keep][order], point[order], px[nodes[keep]][order], points)


def spread_tracks(
    image: Indices, point: Indices, px: Array, size_px: Indices | tuple[int, int]
) -> NDArray[np.bool_]:
    """Object points so that every part of every image keeps its longest tracks.

    Args:
        image: of each image point, shape (m,).
        point: of each, shape (m,).
        px: places, shape (m, 2).
        size_px: columns and rows of all images, or of each image point, shape (m, 2).

    Returns:
        Image points to be kept, shape (m,); whole tracks.
    """
    length = np.bincount(point)
    cell = np.minimum(
        (px * _CELLS / np.array(size_px)).astype(np.int64), np.array(_CELLS) - 1
    ).clip(0)
    key = (image * _CELLS[0] + cell[:, 0]) * _CELLS[1] + cell[:, 1]
    order = np.lexsort((point, -length[point], key))
    first = np.searchsorted(key[order], key[order])
    best = order[np.arange(len(order)) - first < _TRACKS_IN_CELL]
    kept = np.zeros(len(length), bool)
    kept[point[best]] = True
    return np.asarray(kept[point])


def _joined(count: int, start: Indices, pairs: Pairs) -> Indices:
    """The smallest node that each node is joined with."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = [
        np.stack([start[a] + rows[:, 0], start[b] + rows[:, 1]]) for (a, b), rows in pairs.items()
    ]
    edges = np.concatenate(ends, axis=1) if ends else np.zeros((2, 0), np.int64)
    graph = coo_array((np.ones(edges.shape[1]), (edges[0], edges[1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)
