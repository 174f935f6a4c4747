"""Survey of a block in cells: what every image shows of each, which image is nearest to it, gains.

A cell is a block of ground pixels. Every cell is taken from one image, so that seams follow the
borders of cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.orthomosaic.ground_reach import ground_reach_m
from daemon.postflight.orthomosaic.inputs import OrthoBlock, OrthoImage
from daemon.postflight.orthomosaic.pixels import reduced_pixels, reduction_of
from daemon.postflight.orthomosaic.triangulated import OrthomosaicError
from processing.image.orthoimage.ground_grid import GroundGrid
from processing.image.orthoimage.ground_resampling import resample_to_ground
from processing.image.orthoimage.levelling import GainField, ImageLevels, level_block, levelled

Array = NDArray[Any]

CELL_PX: Final = 16
CELLS_MIN: Final = 8
"""Cells along the shorter side of an image: fewer are no survey of it."""
BLOCK_CELLS: Final = 4
"""Cells along a block whose mean signal is levelled."""
SEAM_MAX: Final = 0.5
"""Seam steps beyond this show moving things; they do not count in the figures."""


@dataclass(frozen=True)
class CellSurvey:
    """Seams and gains of a block.

    Attributes:
        owner: (rows, columns) int32, index of the image each cell is taken from, -1 where none
            covers it whole.
        gains: of each image, by bands as in `bands`.
        bands: "pan" first.
        seam_rms: relative step across seams, RMS, by band, before and after levelling.
    """

    owner: Array
    gains: tuple[GainField, ...]
    bands: tuple[str, ...]
    seam_rms: dict[str, tuple[float | None, float | None]]


def cell_grid(grid: GroundGrid) -> GroundGrid:
    """Grid of the cells of a grid."""
    return grid.coarser(CELL_PX)


@dataclass(frozen=True)
class ImageCells:
    """What one image shows of the cells of a grid.

    `place` is its first row and column, multiples of `BLOCK_CELLS`; `covered` (rows, columns)
    marks the cells it covers whole; `levels` is its signal.
    """

    place: tuple[int, int]
    covered: NDArray[np.bool_]
    levels: ImageLevels


def refuse_coarse_grid(block: OrthoBlock) -> None:
    """Refuse ground pixels so large that an image would hold too few cells.

    Args:
        block: images and grid.

    Raises:
        OrthomosaicError: they are.
    """
    cells = min(
        min(image.pose.width_px, image.pose.height_px)
        // reduction_of(block, image, CELL_PX * block.grid.gsd_m)
        for image in block.images
    )
    if cells < CELLS_MIN:
        largest_m = block.grid.gsd_m * cells / CELLS_MIN if cells else None
        example = f", such as {largest_m:.2g}" if largest_m else ""
        raise OrthomosaicError(
            f"an image is {cells} cells of {CELL_PX} ground pixels of {block.grid.gsd_m:g} m; it "
            f"must be {CELLS_MIN} at least. Give a smaller --gsd, in metres{example}"
        )


def cells_of(block: OrthoBlock, image: OrthoImage, bands: Sequence[str]) -> ImageCells:
    """Look at an image once: which cells it covers, and with what signal.

    Args:
        block: of the image.
        image: that is looked at.
        bands: "pan", and colour bands that every image has.

    Raises:
        RasterError, OSError: it cannot be read.
    """
    place, cells = _signal_of(block, image, bands, cell_grid(block.grid))
    return ImageCells(place, np.asarray(cells[0] > 0.0), _levels(place, cells))


def survey(
    block: OrthoBlock, bands: Sequence[str], seen: Sequence[ImageCells], *, level: bool = True
) -> CellSurvey:
    """Take every cell from the image nearest to it, and level the images.

    Args:
        block: images, poses and grid.
        bands: "pan", and colour bands that every image has.
        seen: cells of every image, in order.
        level: whether gains are computed; else they are one.
    """
    grid = cell_grid(block.grid)
    owner = np.full((grid.height_px, grid.width_px), -1, np.int32)
    nearest = np.full(owner.shape, np.inf, np.float32)
    found = [one.levels for one in seen]
    for k, one in enumerate(seen):
        row, column = one.place
        height, width = one.covered.shape
        part = np.s_[row : row + height, column : column + width]
        distance = _nadir_distance(block.images[k], grid.window(column, row, width, height))
        mine = one.covered & (distance < nearest[part])
        owner[part][mine] = k
        nearest[part][mine] = distance[mine]
    blocks = owner[BLOCK_CELLS // 2 :: BLOCK_CELLS, BLOCK_CELLS // 2 :: BLOCK_CELLS]
    shape = tuple(-(-n // BLOCK_CELLS) for n in owner.shape)
    taken = np.full(shape, -1, np.int32)
    taken[: blocks.shape[0], : blocks.shape[1]] = blocks
    gains = level_block(found, taken)
    if not level:
        gains = tuple(_flat(one) for one in gains)
    before = _seam_steps(found, [one.log_signal for one in found], taken)
    after = _seam_steps(
        found, [levelled(one, gain) for one, gain in zip(found, gains, strict=True)], taken
    )
    steps = {name: (before[k], after[k]) for k, name in enumerate(bands)}
    return CellSurvey(owner, gains, tuple(bands), steps)


def _signal_of(
    block: OrthoBlock, image: OrthoImage, bands: Sequence[str], grid: GroundGrid
) -> tuple[tuple[int, int], Array]:
    """First row and column, a multiple of `BLOCK_CELLS`, and means of cells (bands, h, w)."""
    pose = image.pose
    reach = ground_reach_m(pose, image.nadir_m, image.height_m, block.ground.surface)
    row = int((grid.north_m - image.nadir_m[1] - reach) / grid.gsd_m)
    column = int((image.nadir_m[0] - reach - grid.east_m) / grid.gsd_m)
    side = int(2 * reach / grid.gsd_m) + BLOCK_CELLS
    row, column = (max(n, 0) // BLOCK_CELLS * BLOCK_CELLS for n in (row, column))
    height, width = (max(min(side, n), 1) for n in (grid.height_px - row, grid.width_px - column))
    part = grid.window(column, row, width, height)
    factor = reduction_of(block, image, grid.gsd_m)
    cells = resample_to_ground(
        reduced_pixels(block, image, bands, factor), pose.reduced(factor), block.surface(part),
        interpolation="bilinear",
    )  # fmt: skip
    # The reduced image has data where all its pixels have; a cell reaches half of one further.
    whole = _shrunk(np.asarray((cells > 0.0).all(axis=0)))
    cells[:, ~whole] = 0.0
    return _cropped((row, column), cells)


def _shrunk(mask: Array) -> Array:
    """Without the outermost cells."""
    padded = np.pad(mask, 1)
    return np.asarray(
        padded[1:-1, 1:-1] & padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2]
        & padded[1:-1, 2:]
    )  # fmt: skip


def _cropped(place: tuple[int, int], cells: Array) -> tuple[tuple[int, int], Array]:
    """The part with data, beginning at a multiple of `BLOCK_CELLS`."""
    rows, columns = np.nonzero(cells[0])
    if not len(rows):
        return place, cells[:, :BLOCK_CELLS, :BLOCK_CELLS]
    r, c = (int(n.min()) // BLOCK_CELLS * BLOCK_CELLS for n in (rows, columns))
    cut = cells[:, r : int(rows.max()) + 1, c : int(columns.max()) + 1]
    return (place[0] + r, place[1] + c), np.ascontiguousarray(cut)


def _nadir_distance(image: OrthoImage, grid: GroundGrid) -> Array:
    """Distance of cells from below the camera, (h, w), m."""
    east, north = image.nadir_m
    d = np.hypot((grid.rows_m - north)[:, None], (grid.columns_m - east)[None, :])
    return np.asarray(d, dtype=np.float32)


def _levels(place: tuple[int, int], cells: Array) -> ImageLevels:
    """Means of blocks of cells that an image covers whole."""
    bands, height, width = cells.shape
    rows, columns = -(-height // BLOCK_CELLS), -(-width // BLOCK_CELLS)
    padded = np.zeros((bands, rows * BLOCK_CELLS, columns * BLOCK_CELLS), np.float32)
    padded[:, :height, :width] = cells
    parts = padded.reshape(bands, rows, BLOCK_CELLS, columns, BLOCK_CELLS)
    whole = (parts > 0.0).all(axis=(0, 2, 4))
    means = np.log(np.maximum(parts.mean(axis=(2, 4)), 1e-3))
    means[:, ~whole] = np.nan
    return ImageLevels(place[0] // BLOCK_CELLS, place[1] // BLOCK_CELLS, means)


def _flat(gain: GainField) -> GainField:
    none = np.zeros_like(gain.log_gain)
    return GainField(gain.row, gain.column, gain.step, none, none)


def _seam_steps(
    images: Sequence[ImageLevels], signals: Sequence[Array], owner: Array
) -> list[float | None]:
    """RMS difference of both images of a seam in the blocks along it, relative, by band."""
    bands = images[0].log_signal.shape[0]
    squares, count = np.zeros(bands), 0
    taken = np.full((bands, *owner.shape), np.nan, np.float32)
    for k, (one, signal) in enumerate(zip(images, signals, strict=True)):
        rows, columns = signal.shape[1:]
        part = np.s_[one.row : one.row + rows, one.column : one.column + columns]
        mine = owner[part] == k
        taken[:, *part][:, mine] = signal[:, mine]
    for k, (one, signal) in enumerate(zip(images, signals, strict=True)):
        rows, columns = signal.shape[1:]
        part = np.s_[one.row : one.row + rows, one.column : one.column + columns]
        own = owner[part]
        next_to = np.zeros(own.shape, bool)
        next_to[1:] |= own[:-1] == k
        next_to[:-1] |= own[1:] == k
        next_to[:, 1:] |= own[:, :-1] == k
        next_to[:, :-1] |= own[:, 1:] == k
        step = np.expm1(signal - taken[:, *part])
        used = next_to & (own >= 0) & (own != k) & (np.abs(step) < SEAM_MAX).all(axis=0)
        squares += (step[:, used] ** 2).sum(axis=1)
        count += int(used.sum())
    return [float(v) for v in np.sqrt(squares / count)] if count else [None] * bands
