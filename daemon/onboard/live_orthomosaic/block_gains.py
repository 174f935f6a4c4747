"""Gains of the images of the live orthomosaic: one on arrival, smooth fields at the end of a line.

Both make an image agree with the others where they show the same ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.onboard.live_orthomosaic.placed_image import CELL_PX, PlacedImage
from processing.image.orthoimage.levelling import GainField, ImageLevels, level_block, levelled

Array = NDArray[np.float64]

CELLS_MAX: Final = 4_000_000
"""Of the area in which images are levelled at once; earlier images keep their gains."""
OVERLAP_MIN: Final = 6
"""Cells."""


def gain_on_arrival(levels: ImageLevels, others: Sequence[PlacedImage]) -> float | None:
    """Logarithm of the gain that makes an image agree with those placed before.

    Args:
        levels: of the new image.
        others: images that may overlap.

    Returns:
        The median of all overlaps; None where there is none.
    """
    differences = []
    for other in others:
        mine, theirs = _common(levels, other.levels)
        if mine is None or theirs is None:
            continue
        difference = levelled(other.levels, other.gain)[0][theirs] - levels.log_signal[0][mine]
        differences.append(difference[np.isfinite(difference)])
    known = np.concatenate(differences) if differences else np.zeros(0)
    return float(np.median(known)) if len(known) >= OVERLAP_MIN else None


def _common(
    one: ImageLevels, other: ImageLevels
) -> tuple[tuple[slice, slice], tuple[slice, slice]] | tuple[None, None]:
    """The part that two images share, in the cells of each."""
    parts: list[tuple[slice, slice]] = []
    starts = ((one.row, other.row), (one.column, other.column))
    for axis, (a, b) in enumerate(starts):
        low = max(a, b)
        high = min(a + one.log_signal.shape[1 + axis], b + other.log_signal.shape[1 + axis])
        if high <= low:
            return None, None
        parts.append((slice(low - a, high - a), slice(low - b, high - b)))
    return (parts[0][0], parts[1][0]), (parts[0][1], parts[1][1])


def owners_of(images: Sequence[PlacedImage], rows: slice, columns: slice) -> NDArray[np.int32]:
    """For each cell the image that was taken nearest above it.

    Args:
        images: that may cover the cells.
        rows, columns: of the cells.

    Returns:
        Index in `images`, -1 where none covers the cell.
    """
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    owner = np.full(shape, -1, np.int32)
    nearest = np.full(shape, np.inf)
    for k, image in enumerate(images):
        own = image.covered
        top, left = max(rows.start, own[0].start), max(columns.start, own[1].start)
        end, right = min(rows.stop, own[0].stop), min(columns.stop, own[1].stop)
        if end <= top or right <= left:
            continue
        part = np.s_[top - rows.start : end - rows.start, left - columns.start :
                     right - columns.start]  # fmt: skip
        covers = np.isfinite(
            image.levels.log_signal[0][
                top - own[0].start : end - own[0].start, left - own[1].start : right - own[1].start
            ]
        )
        column, row = _nadir_cells(image)
        distance = np.hypot(
            (np.arange(top, end) - row)[:, None], (np.arange(left, right) - column)[None]
        )
        mine = covers & (distance < nearest[part])
        owner[part][mine] = k
        nearest[part][mine] = distance[mine]
    return owner


def _nadir_cells(image: PlacedImage) -> tuple[float, float]:
    column, row = image.nadir_px / CELL_PX - 0.5
    return float(column), float(row)


def level_images(images: Sequence[PlacedImage]) -> list[PlacedImage]:
    """Level the latest images at once.

    Gains are relative. Those of images that were levelled before keep their mean, so that the map
    does not change its brightness from line to line.

    Args:
        images: in the order in which they came.

    Returns:
        The images whose gain was computed; theirs is changed in place.
    """
    chosen: list[PlacedImage] = []
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for image in reversed(images):
        if not np.isfinite(image.levels.log_signal).any():
            continue
        rows, columns = image.covered
        first = np.minimum(low, [rows.start, columns.start])
        last = np.maximum(high, [rows.stop, columns.stop])
        if float(np.prod(last - first)) > CELLS_MAX:
            break
        low, high = first, last
        chosen.append(image)
    if len(chosen) < 2:
        return []
    chosen.reverse()
    row, column = int(low[0]), int(low[1])
    owner = owners_of(chosen, slice(row, int(high[0])), slice(column, int(high[1])))
    local = [
        ImageLevels(i.levels.row - row, i.levels.column - column, i.levels.log_signal)
        for i in chosen
    ]
    fields = level_block(local, owner)
    before = [i for i, image in enumerate(chosen) if image.is_levelled]
    shift = (
        float(np.mean([_mean(chosen[i].gain) - _mean(fields[i]) for i in before]))
        if before
        else 0.0
    )
    for image, field in zip(chosen, fields, strict=True):
        image.gain = replace(
            field, row=field.row + row, column=field.column + column,
            log_gain=field.log_gain + shift,
        )  # fmt: skip
        image.is_levelled = True
    return chosen


def _mean(gain: GainField) -> float:
    return float(gain.log_gain.mean())
