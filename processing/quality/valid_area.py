"""Which parts of an image hold valid pixels, band by band, in a few numbers.

An image is divided into a grid of cells; what has no valid pixels is listed as boxes of cells. How
the boxes lie on the ground is not asked here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.quality.figures.image import ValidAreaFigures

Mask: TypeAlias = NDArray[np.bool_]
Box: TypeAlias = tuple[int, int, int, int]
"""First column, first row, last column + 1, last row + 1, in cells; row 0 is the top of the
image."""

CELLS: Final = 240
"""Along the longer side: a cell is 0.4 % of it."""
SAMPLES: Final = 4
"""Pixels looked at in each direction of a cell."""
SATURATION_WINDOW: Final = 5
"""Saturated cells count where they are the majority of so many cells squared: a white roof is no
gap, a saturated field is."""
BOXES_MAX: Final = 24
"""Of a band. A mask that needs more is described in cells twice, four times ... as large."""


@dataclass(frozen=True)
class ValidArea:
    """The gaps of an image by band; a band that is not listed is valid everywhere.

    `columns` and `rows` are the numbers of cells across and down the image.
    """

    columns: int
    rows: int
    gaps: Mapping[str, tuple[Box, ...]] = field(default_factory=dict)

    def mask(self, band: str) -> Mask:
        """Which cells of a band are valid.

        Args:
            band: name of the band.

        Returns:
            True for valid cells, (rows, columns).
        """
        valid = np.ones((self.rows, self.columns), np.bool_)
        for left, top, right, bottom in self.gaps.get(band, ()):
            valid[top:bottom, left:right] = False
        return valid

    def share(self, band: str) -> float:
        """The valid share of a band.

        Args:
            band: name of the band.

        Returns:
            0 to 1.
        """
        return float(self.mask(band).mean())


def grid_of(width_px: int, height_px: int) -> tuple[int, int]:
    """Grid of an image; cells are square but for rounding.

    Args:
        width_px: of the image.
        height_px: of the image.

    Returns:
        Columns and rows of cells, at most `CELLS`.
    """
    longer = max(width_px, height_px)
    return max(1, round(CELLS * width_px / longer)), max(1, round(CELLS * height_px / longer))


def gap_cells(raster: NDArray[Any], columns: int, rows: int, *, saturated_bit: int = 0) -> Mask:
    """Which cells of an image hold no valid pixels.

    A cell is valid where at least half of its pixels are; gaps narrower than half a cell are not
    seen. Sixteen pixels of a cell are looked at.

    Args:
        raster: (h, w) integers over the whole image; 0 is no data.
        columns: cells across the image.
        rows: cells down the image.
        saturated_bit: the bit of a value that marks saturation; 0 where none does.

    Returns:
        True for gaps, (rows, columns).
    """
    height, width = raster.shape
    down = ((np.arange(rows * SAMPLES) + 0.5) * height / (rows * SAMPLES)).astype(np.int64)
    across = ((np.arange(columns * SAMPLES) + 0.5) * width / (columns * SAMPLES)).astype(np.int64)
    there = np.zeros((rows, columns), np.int32)
    saturated = np.zeros((rows, columns), np.int32)
    _count_samples(raster, down, across, saturated_bit, there, saturated)
    half = SAMPLES * SAMPLES / 2.0
    gaps: Mask = there < half
    full = saturated >= half
    if full.any():
        gaps |= _smoothed(full)
    return gaps


def area_of(cells: Mapping[str, Mask]) -> ValidArea:
    """The area by the gap cells of every band, all on one grid.

    Args:
        cells: True for gaps, (rows, columns), by band.

    Returns:
        The area; bands without gaps are not listed.

    Raises:
        ValueError: there is no band at all.
    """
    if not cells:
        raise ValueError("no band, so there is no image to describe")
    rows, columns = next(iter(cells.values())).shape
    gaps = {band: boxes for band, one in cells.items() if (boxes := boxes_of(one))}
    return ValidArea(columns, rows, gaps)


def area_of_rasters(
    rasters: Mapping[str, NDArray[Any]],
    bands: Iterable[str],
    cells: tuple[int, int],
    *,
    saturated_bit: int,
) -> ValidArea:
    """The valid area of an image by its rasters; a band without one has no valid pixels.

    Args:
        rasters: by band, (h, w), 0 without data.
        bands: all that the image is to have.
        cells: columns and rows of the grid.
        saturated_bit: of a raster's words.

    Returns:
        The area.
    """
    columns, rows = cells
    nothing = np.ones((rows, columns), np.bool_)
    return area_of(
        {
            band: gap_cells(rasters[band], columns, rows, saturated_bit=saturated_bit)
            if band in rasters
            else nothing
            for band in bands
        }
    )


def boxes_of(gaps: Mask, most: int = BOXES_MAX) -> tuple[Box, ...]:
    """Boxes that cover the true cells of a grid and no others.

    Where more than `most` were needed, the grid is coarsened by twos, majority of cells.

    Args:
        gaps: True for gaps, (rows, columns).
        most: largest number of boxes.

    Returns:
        Left, top, right, bottom of each in cells, right and bottom exclusive.
    """
    scale, cells = 1, gaps
    rows, columns = gaps.shape
    while len(boxes := list(_boxes(cells))) > most:
        scale *= 2
        cells = _coarser(cells)
    return tuple(
        (left * scale, top * scale, min(right * scale, columns), min(bottom * scale, rows))
        for left, top, right, bottom in boxes
    )


def valid_area_figures(area: ValidArea) -> ValidAreaFigures:
    """The band with the smallest valid share, and that share.

    Args:
        area: of one image.

    Returns:
        Share and band; share 1 and no band where all are whole.
    """
    shares = {band: area.share(band) for band in area.gaps}
    worst = min(shares, key=lambda band: shares[band], default=None)
    return ValidAreaFigures(1.0 if worst is None else shares[worst], worst)


def as_json(area: ValidArea) -> dict[str, Any]:
    """The area as `quality.json` and telemetry hold it.

    Args:
        area: of one image.

    Returns:
        JSON-ready data.
    """
    gaps = {band: [list(box) for box in boxes] for band, boxes in area.gaps.items()}
    return {"columns": area.columns, "rows": area.rows, "gaps": gaps}


def from_json(content: object) -> ValidArea | None:
    """The area out of `quality.json`.

    Args:
        content: parsed JSON of any kind.

    Returns:
        The area; None where `content` holds none that can be used.
    """
    if not isinstance(content, Mapping):
        return None
    columns, rows, gaps = content.get("columns"), content.get("rows"), content.get("gaps")
    if not isinstance(columns, int) or not isinstance(rows, int) or not isinstance(gaps, Mapping):
        return None
    if not (0 < columns <= CELLS and 0 < rows <= CELLS):
        return None
    found: dict[str, tuple[Box, ...]] = {}
    for band, boxes in gaps.items():
        if not isinstance(band, str) or not isinstance(boxes, list | tuple):
            return None
        if not all(_is_box(box, columns, rows) for box in boxes):
            return None
        found[band] = tuple((box[0], box[1], box[2], box[3]) for box in boxes)
    return ValidArea(columns, rows, found)


def _is_box(box: object, columns: int, rows: int) -> bool:
    if not isinstance(box, list | tuple) or len(box) != 4:
        return False
    if not all(isinstance(value, int) for value in box):
        return False
    left, top, right, bottom = box
    return bool(0 <= left < right <= columns and 0 <= top < bottom <= rows)


@compiled_kernel()
def _count_samples(
    raster: NDArray[Any],
    down: NDArray[np.int64],
    across: NDArray[np.int64],
    saturated_bit: int,
    there: NDArray[np.int32],
    saturated: NDArray[np.int32],
) -> None:
    """Count the samples of each cell that hold data, and those that are saturated."""
    for i in range(len(down)):
        line = raster[down[i]]
        there_row = there[i // SAMPLES]
        saturated_row = saturated[i // SAMPLES]
        for j in range(len(across)):
            value = np.int64(line[across[j]])
            there_row[j // SAMPLES] += np.int32(value != 0)
            saturated_row[j // SAMPLES] += np.int32((value & saturated_bit) != 0)


def _smoothed(cells: Mask) -> Mask:
    """The majority of the window around each cell; outside the image is not saturated."""
    reach = SATURATION_WINDOW // 2
    padded = np.pad(cells.astype(np.int64), reach)
    windows = np.lib.stride_tricks.sliding_window_view(
        padded, (SATURATION_WINDOW, SATURATION_WINDOW)
    )
    majority: Mask = windows.sum(axis=(2, 3)) * 2 > SATURATION_WINDOW**2
    return majority


def _boxes(cells: Mask) -> list[Box]:
    """Runs along the rows, those of successive rows joined where they are the same."""
    boxes: list[Box] = []
    open_runs: dict[tuple[int, int], int] = {}
    for row, runs in enumerate([*_runs(cells), set()]):
        for (left, right), top in list(open_runs.items()):
            if (left, right) not in runs:
                boxes.append((left, top, right, row))
                del open_runs[left, right]
        for run in runs:
            open_runs.setdefault(run, row)
    return sorted(boxes, key=lambda box: (box[1], box[0]))


def _runs(cells: Mask) -> list[set[tuple[int, int]]]:
    """First and end column of each run of true cells, row by row."""
    runs: list[set[tuple[int, int]]] = [set() for _ in range(len(cells))]
    steps = np.diff(np.pad(cells.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, begins = np.nonzero(steps > 0)
    ends = np.nonzero(steps < 0)[1]
    for row, begin, end in zip(rows.tolist(), begins.tolist(), ends.tolist(), strict=True):
        runs[row].add((begin, end))
    return runs


def _coarser(cells: Mask) -> Mask:
    rows, columns = cells.shape
    padded = np.pad(cells.astype(np.float64), ((0, rows % 2), (0, columns % 2)), mode="edge")
    blocks = padded.reshape(-(-rows // 2), 2, -(-columns // 2), 2)
    return np.asarray(blocks.mean(axis=(1, 3)) >= 0.5)
