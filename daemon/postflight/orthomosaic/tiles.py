"""Tiles of an orthomosaic: computed one by one, stored until all are there.

A tile that is stored is not computed again, so that an interrupted run continues. Next to it is the
hash of its bytes: one that was damaged meanwhile is computed again. The folder of the tiles bears
the hash of all inputs: with other inputs all tiles are computed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.store import durable
from daemon.postflight.orthomosaic.cells import BLOCK_CELLS, CELL_PX, CellSurvey
from daemon.postflight.orthomosaic.inputs import OrthoBlock
from daemon.postflight.orthomosaic.pixels import reduced_pixels, reduction_of
from processing.image.orthoimage.ground_grid import GroundGrid
from processing.image.orthoimage.ground_resampling import resample_to_ground, window_seen
from processing.image.orthoimage.levelling import GainField

Array = NDArray[Any]

TILE_PX: Final = 1024
_WORD_MAX: Final = 65535.0


@dataclass(frozen=True)
class TilePlan:
    """Part of the block's grid that has data, cut into tiles.

    `first_column`, `first_row` are its first pixel in the block's grid, multiples of a cell.
    """

    first_column: int
    first_row: int
    grid: GroundGrid

    @property
    def tiles(self) -> Iterator[tuple[int, int, int, int]]:
        """First column, first row, columns and rows of each tile."""
        for row in range(0, self.grid.height_px, TILE_PX):
            for column in range(0, self.grid.width_px, TILE_PX):
                width = min(TILE_PX, self.grid.width_px - column)
                yield column, row, width, min(TILE_PX, self.grid.height_px - row)


def plan_tiles(block: OrthoBlock, survey: CellSurvey) -> TilePlan:
    """The part of the grid that some image covers."""
    rows, columns = np.nonzero(survey.owner >= 0)
    row, column = int(rows.min()) * CELL_PX, int(columns.min()) * CELL_PX
    height = min((int(rows.max()) + 1) * CELL_PX, block.grid.height_px) - row
    width = min((int(columns.max()) + 1) * CELL_PX, block.grid.width_px) - column
    return TilePlan(column, row, block.grid.window(column, row, width, height))


def tile_file(folder: Path, column: int, row: int) -> Path:
    """Where a tile is stored."""
    return folder / f"{row:06d}-{column:06d}.npy"


@dataclass(frozen=True)
class TileJob:
    """One tile, and the part of seams and gains that it is made with; it can be pickled.

    `column`, `row` are its first pixel in the plan, `first_column`, `first_row` in the block's
    grid. `owner` are images of its cells, `gains` those of these images.
    """

    column: int
    row: int
    first_column: int
    first_row: int
    grid: GroundGrid
    owner: Array
    gains: Mapping[int, GainField]


def missing_tiles(survey: CellSurvey, plan: TilePlan, folder: Path) -> list[TileJob]:
    """The tiles that are not stored, or not as they were stored.

    Args:
        survey: seams and gains of the block.
        plan: part of the grid that has data.
        folder: of the tiles.
    """
    jobs = []
    for column, row, width, height in plan.tiles:
        if _is_whole(tile_file(folder, column, row)):
            continue
        first_row, first_column = plan.first_row + row, plan.first_column + column
        rows = slice(first_row // CELL_PX, (first_row + height - 1) // CELL_PX + 1)
        columns = slice(first_column // CELL_PX, (first_column + width - 1) // CELL_PX + 1)
        owner = np.ascontiguousarray(survey.owner[rows, columns])
        grid = plan.grid.window(column, row, width, height)
        gains = {int(k): survey.gains[k] for k in np.unique(owner[owner >= 0])}
        jobs.append(TileJob(column, row, first_column, first_row, grid, owner, gains))
    return jobs


def store_tile(block: OrthoBlock, bands: Sequence[str], job: TileJob, folder: Path) -> None:
    """Compute a tile and store it.

    Args:
        block: of the tile.
        bands: of the tile.
        job: which one.
        folder: of the tiles.

    Raises:
        RasterError, OSError: an image cannot be read, or the disk refused.
    """
    _store(tile_file(folder, job.column, job.row), render_tile(block, bands, job))


def render_tile(block: OrthoBlock, bands: Sequence[str], job: TileJob) -> Array:
    """Pixels of one tile, each from the image its cell is taken from.

    Args:
        block: of the tile.
        bands: of the tile.
        job: which one.

    Returns:
        (bands, rows, columns) uint16, 0 where no image has data.
    """
    width, height = job.grid.width_px, job.grid.height_px
    surface = block.surface(job.grid)
    y, x = job.first_row + np.arange(height), job.first_column + np.arange(width)
    cells = np.ix_(y // CELL_PX - y[0] // CELL_PX, x // CELL_PX - x[0] // CELL_PX)
    owner = job.owner[cells]
    result = np.zeros((len(bands), height, width), np.uint16)
    span = CELL_PX * BLOCK_CELLS
    rows, columns = (y + 0.5) / span - 0.5, (x + 0.5) / span - 0.5
    for k, gain in job.gains.items():
        image = block.images[k]
        factor = reduction_of(block, image, job.grid.gsd_m)
        pose = image.pose.reduced(factor)
        visible = window_seen(surface, pose)
        if visible is None:
            continue
        wanted = owner == k
        pixels = reduced_pixels(block, image, bands, factor, visible)
        found = resample_to_ground(pixels, pose.window(*visible), surface, wanted=wanted)
        filled = found > 0.0
        found = gain.levelled(found, rows, columns)
        words = np.clip(np.rint(found), 1.0, _WORD_MAX).astype(np.uint16)
        words[~filled] = 0
        # Where one band has no data, none has: colours of a pixel belong together.
        words[:, ~filled.all(axis=0)] = 0
        result[:, wanted] = words[:, wanted]
    return result


def stored_nbytes(folder: Path) -> int:
    """Bytes of the tiles in a folder."""
    return sum(path.stat().st_size for path in folder.glob("*.npy"))


def _store(path: Path, pixels: Array) -> None:
    """The tile, then its hash: without one it is computed again."""
    with durable.new_file(path) as part:
        with part.open("wb") as file:
            np.save(file, pixels)
        digest = _sha256(part)
    with durable.new_file(_hash_file(path)) as part:
        part.write_text(digest, encoding="ascii")


def _is_whole(path: Path) -> bool:
    try:
        return _hash_file(path).read_bytes() == _sha256(path).encode("ascii")
    except FileNotFoundError:
        return False


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _hash_file(path: Path) -> Path:
    return path.with_suffix(".sha256")
