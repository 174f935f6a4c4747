"""Bright discs on dark ground: detection, measurement by weighted means, and identification.

Which target a disc shows follows from where the nominal camera would see each: the holder's
settings have a common error of tens of pixels, so the shift of most pairs is removed first.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_AREA_LIMITS: Final = (0.6, 1.35)
_MAX_SIDE_RATIO: Final = 1.3
_VOTE_PX: Final = 8.0
_COARSE_PX: Final = 14.0
_FINE_PX: Final = 2.5
_MIN_PAIRS: Final = 8


def disc_positions(pixels: NDArray[Any]) -> Array:
    """Measure the middles of the discs of a frame.

    Args:
        pixels: grey values, (height, width).

    Returns:
        Column and row of each disc, (n, 2), px. Discs that touch each other, or that the border
        cuts, are left out; empty without contrast.
    """
    values = np.asarray(pixels, dtype=np.float32)
    ground = float(np.median(values))
    noise = 1.4826 * float(np.median(np.abs(values - ground)))
    top = float(np.percentile(values, 99.95))
    if top - ground < 20.0 * max(noise, 0.5):
        return np.zeros((0, 2))
    labels, count = ndimage.label(values > 0.5 * (ground + top))
    if count == 0:
        return np.zeros((0, 2))
    boxes = ndimage.find_objects(labels)
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    usual = float(np.median(areas))
    found = []
    for (rows, columns), area in zip(boxes, areas.tolist(), strict=True):
        high, wide = rows.stop - rows.start, columns.stop - columns.start
        round_ = max(high, wide) <= _MAX_SIDE_RATIO * min(high, wide)
        if round_ and _AREA_LIMITS[0] * usual <= area <= _AREA_LIMITS[1] * usual:
            middle = _middle(values, (rows, columns), ground)
            if middle is not None:
                found.append(middle)
    return np.array(found).reshape(-1, 2)


def _middle(values: NDArray[Any], box: tuple[slice, slice], ground: float) -> Array | None:
    """Weighted mean within a circle about itself, so that the window's place does not matter."""
    row = 0.5 * (box[0].start + box[0].stop - 1)
    column = 0.5 * (box[1].start + box[1].stop - 1)
    radius = 0.5 * max(box[0].stop - box[0].start, box[1].stop - box[1].start) + 3.0
    reach = int(np.ceil(radius)) + 2
    r, c = round(row), round(column)
    height, width = values.shape
    if r < reach or c < reach or r >= height - reach or c >= width - reach:
        return None
    part = values[r - reach : r + reach + 1, c - reach : c + reach + 1] - np.float32(ground)
    y, x = np.mgrid[r - reach : r + reach + 1, c - reach : c + reach + 1]
    for _ in range(4):
        # A circle whose border fades: whole pixels at a hard one would pull by their chance.
        weight = np.clip(radius + 0.5 - np.hypot(x - column, y - row), 0.0, 1.0) * part
        total = float(weight.sum())
        if total <= 0.0:
            return None
        moved = (float((weight * x).sum()) / total, float((weight * y).sum()) / total)
        step = abs(moved[0] - column) + abs(moved[1] - row)
        column, row = moved
        if step < 1e-4:
            break
    # Next to another disc the circle holds a part of that one.
    rim = part[np.abs(np.hypot(x - column, y - row) - radius) < 1.0]
    if float(np.max(rim)) > 0.25 * float(part.max()):
        return None
    return np.array([column, row])


def identify_targets(predicted: Array, found: Array, *, reach_px: float) -> tuple[Indices, Indices]:
    """Assign found positions to predicted ones.

    Args:
        predicted: where the nominal camera would see each target, (n, 2), px.
        found: measured positions, (m, 2), px.
        reach_px: how far the prediction may be off, in each coordinate.

    Returns:
        Indices into `predicted` and into `found` of the pairs, each position used once; empty where
        fewer than eight pairs agree.
    """
    none = np.zeros(0, np.int64)
    if len(predicted) < _MIN_PAIRS or len(found) < _MIN_PAIRS:
        return none, none
    difference = (found[None, :, :] - predicted[:, None, :]).reshape(-1, 2)
    near = difference[(np.abs(difference) < reach_px).all(axis=1)]
    bins = max(int(2 * reach_px / _VOTE_PX), 3)
    span = [[-reach_px, reach_px], [-reach_px, reach_px]]
    votes, across, down = np.histogram2d(near[:, 0], near[:, 1], bins=bins, range=span)
    votes = ndimage.uniform_filter(votes, 3, mode="constant")
    i, j = np.unravel_index(int(np.argmax(votes)), votes.shape)
    shift = np.array([across[i] + across[i + 1], down[j] + down[j + 1]]) / 2.0
    moved = predicted + shift
    a, b = _nearest(moved, found, _COARSE_PX)
    for limit in (_COARSE_PX, 2 * _FINE_PX, _FINE_PX):
        if len(a) < _MIN_PAIRS:
            return none, none
        design = np.column_stack([np.ones(len(a)), predicted[a]])
        weight = np.ones(len(a))
        for _ in range(5):
            solved, *_ = np.linalg.lstsq(
                design * weight[:, None], found[b] * weight[:, None], rcond=None
            )
            left = np.hypot(*(found[b] - design @ solved).T)
            weight = 1.0 / np.maximum(1.0, left / max(1.5 * float(np.median(left)), 0.05))
        moved = np.column_stack([np.ones(len(predicted)), predicted]) @ solved
        a, b = _nearest(moved, found, limit)
    return (a, b) if len(a) >= _MIN_PAIRS else (none, none)


def _nearest(a: Array, b: Array, limit: float) -> tuple[Indices, Indices]:
    """Mutually nearest pairs within a limit."""
    distance = np.hypot(*(a[:, None, :] - b[None, :, :]).transpose(2, 0, 1))
    to_b, to_a = np.argmin(distance, axis=1), np.argmin(distance, axis=0)
    index = np.arange(len(a))
    mutual = (to_a[to_b] == index) & (distance[index, to_b] < limit)
    return index[mutual], to_b[mutual].astype(np.int64)
