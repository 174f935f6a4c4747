"""Measurements that count twice: one image under two names, one object point under two."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.adjustment.csv_tables import CsvTable
from processing.bundle.network import ImagePoints

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MIN_OF_IMAGES: Final = 4
"""Points with equal coordinates in two images from which these are one image."""

_MIN_OF_POINTS: Final = 2
"""Images with equal coordinates of two points from which these are one point."""

_MAX_LISTED: Final = 5
_SHARE: Final = 0.5
"""Of the common points of two images, or the common images of two points, that are equal."""


def check_repeated_images(
    table: CsvTable, points: ImagePoints, at_infinity: NDArray[np.bool_]
) -> None:
    """Report images that are measured under two names.

    Coordinates are compared to the last bit: no second measurement of the same image is equal in
    several points. Points at infinity are at equal places in all images of one attitude.

    Args:
        table: of image points; problems are added to it.
        points: its rows, in order.
        at_infinity: of the object points, shape (p,).
    """
    finite = np.flatnonzero(~at_infinity[points.point])
    names = table.text("image")
    for first, second, count, common in _pairs(
        points.image, points.point, points.xy_mm, finite, _MIN_OF_IMAGES
    ):
        table.add_problem(
            table.lines[second],
            f"image {names[second]} has the coordinates of image {names[first]} in {count} of "
            f"{common} common points; it would count twice: leave one out",
        )


def repeated_points(table: CsvTable, points: ImagePoints) -> list[str]:
    """Name object points with equal coordinates in several images.

    Programs that match features may find one place twice, with two orientations of the feature;
    such points are no reason to refuse a block.

    Args:
        table: of image points.
        points: its rows, in order.

    Returns:
        A sentence, or nothing.
    """
    names = table.text("point")
    rows = np.arange(len(points.point))
    found = _pairs(points.point, points.image, points.xy_mm, rows, _MIN_OF_POINTS)
    if not found:
        return []
    named = [
        f"{names[second]} as {names[first]} in {count} images (line {table.lines[second]})"
        for first, second, count, _ in found[:_MAX_LISTED]
    ]
    more = ", ..." if len(found) > _MAX_LISTED else ""
    return [
        f"{table.file}: {len(found)} object points have the coordinates of another one, and count "
        f"twice: {', '.join(named)}{more}; leave one of the two out"
    ]


def _pairs(
    own: Indices, group: Indices, xy_mm: Array, rows: Indices, at_least: int
) -> list[tuple[int, int, int, int]]:
    """Two of a kind that are equal: a row of each, how many are equal, and how many common.

    Args:
        own: images or points, shape (n,).
        group: within which coordinates are compared: points or images, shape (n,).
        xy_mm: shape (n, 2).
        rows: that are compared.
        at_least: equal rows of a pair.
    """
    pairs = rows[_equal_rows(group[rows], xy_mm[rows])]
    counts: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for a, b in pairs.tolist():
        counts.setdefault((int(own[a]), int(own[b])), []).append((a, b))
    candidates = {pair for pair, equal in counts.items() if len(equal) >= at_least}
    if not candidates:
        return []
    order = np.argsort(own, kind="stable")
    begin = np.searchsorted(own[order], np.arange(int(own.max()) + 2))
    found, repeated = [], set()
    for pair, equal in counts.items():
        if pair not in candidates or pair[1] in repeated:
            continue
        first, second = (group[order[begin[k] : begin[k + 1]]] for k in pair)
        common = len(np.intersect1d(first, second))
        if len(equal) >= _SHARE * common:
            repeated.add(pair[1])
            found.append((*equal[0], len(equal), common))
    return found


def _equal_rows(group: Indices, xy_mm: Array) -> Indices:
    """Rows of one group with equal coordinates: the first of each, and every other, (k, 2)."""
    bits = np.ascontiguousarray(xy_mm + 0.0).view(np.uint64).reshape(-1, 2)
    key = group.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    key ^= bits[:, 0] * np.uint64(0xC2B2AE3D27D4EB4F)
    key ^= bits[:, 1] * np.uint64(0x165667B19E3779F9)
    order = np.argsort(key, kind="stable")
    begins = np.flatnonzero(np.diff(key[order]) == 0)
    found: list[tuple[int, int]] = []
    run: dict[tuple[int, int, int], int] = {}
    for at in np.union1d(begins, begins + 1).tolist():
        row = int(order[at])
        exact = (int(group[row]), int(bits[row, 0]), int(bits[row, 1]))
        if (first := run.setdefault(exact, row)) != row:
            found.append((first, row))
    return np.array(found, dtype=np.int64).reshape(-1, 2)
