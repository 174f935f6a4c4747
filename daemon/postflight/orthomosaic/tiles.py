"""Tiles of an orthomosaic: computed one by one, stored until all are there.

A tile that is stored is not computed again, so that an interrupted run continues. The folder of the
tiles bears the hash of all inputs: with other inputs all tiles are computed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.store import durable
from daemon.postflight.orthomosaic.cells import BLOCK_CELLS, CELL_PX, CellSurvey
from daemon.postflight.orthomosaic.inputs import OrthoBlock
from daemon.postflight.orthomosaic.pixels import image_pixels
from processing.image.orthoimage.ground_grid import GroundGrid
from processing.image.orthoimage.ground_resampling import resample_to_ground, window_seen

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


def compute_tiles(
    block: OrthoBlock,
    survey: CellSurvey,
    plan: TilePlan,
    folder: Path,
    *,
    threads: int,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> int:
    """Compute the tiles that are not stored.

    Args:
        threads: tiles computed simultaneously; so many are in memory.
        progress: called with the count of tiles done and of all.

    Returns:
        How many were computed; the others were there.

    Raises:
        RasterError, OSError: an image cannot be read, or the disk refused. What is stored stays.
    """
    every = list(plan.tiles)
    missing = [tile for tile in every if not tile_file(folder, *tile[:2]).exists()]
    done = len(every) - len(missing)
    progress(done, len(every))

    def compute(tile: tuple[int, int, int, int]) -> None:
        _store(tile_file(folder, *tile[:2]), render_tile(block, survey, plan, tile))

    queue = iter(missing)
    with ThreadPoolExecutor(threads) as pool:
        running: set[Future[None]] = set()
        try:
            while True:
                while len(running) < threads and (tile := next(queue, None)) is not None:
                    running.add(pool.submit(compute, tile))
                if not running:
                    break
                finished, running = wait(running, return_when=FIRST_COMPLETED)
                for one in finished:
                    one.result()
                    done += 1
                    progress(done, len(every))
        finally:
            for one in running:
                one.cancel()
    return len(missing)


def render_tile(
    block: OrthoBlock, survey: CellSurvey, plan: TilePlan, tile: tuple[int, int, int, int]
) -> Array:
    """Pixels of one tile, each from the image its cell is taken from.

    Returns:
        (bands, rows, columns) uint16, 0 where no image has data.
    """
    column, row, width, height = tile
    grid = plan.grid.window(column, row, width, height)
    surface = block.surface(grid)
    first_row, first_column = plan.first_row + row, plan.first_column + column
    r = (first_row + np.arange(height)) // CELL_PX
    c = (first_column + np.arange(width)) // CELL_PX
    owner = survey.owner[np.ix_(r, c)]
    result = np.zeros((len(survey.bands), height, width), np.uint16)
    span = CELL_PX * BLOCK_CELLS
    rows = (first_row + np.arange(height) + 0.5) / span - 0.5
    columns = (first_column + np.arange(width) + 0.5) / span - 0.5
    for k in np.unique(owner[owner >= 0]):
        image = block.images[k]
        seen = window_seen(surface, image.pose)
        if seen is None:
            continue
        wanted = owner == k
        pixels = image_pixels(block, image, survey.bands, seen)
        found = resample_to_ground(pixels, image.pose.window(*seen), surface, wanted=wanted)
        filled = found > 0.0
        found = survey.gains[k].levelled(found, rows, columns)
        words = np.clip(np.rint(found), 1.0, _WORD_MAX).astype(np.uint16)
        words[~filled] = 0
        # Where one band has no data, none has: colours of a pixel belong together.
        words[:, ~filled.all(axis=0)] = 0
        result[:, wanted] = words[:, wanted]
    return result


def _store(path: Path, pixels: Array) -> None:
    with durable.new_file(path) as part, part.open("wb") as file:
        np.save(file, pixels)
        file.flush()
        os.fsync(file.fileno())
