"""Where the files of a live orthomosaic are, below a mission's `export`."""

from __future__ import annotations

from pathlib import Path
from typing import Final

FOLDER: Final = "live-orthomosaic"
STATE_FILE: Final = "orthomosaic.json"
TILES_FOLDER: Final = "tiles"

TileId = tuple[int, int, int]
"""Level, column, row."""


def tile_file(folder: Path, tile: TileId) -> Path:
    """Where the picture of a tile is.

    Args:
        folder: of the live orthomosaic.
        tile: level, column and row.
    """
    zoom, x, y = tile
    return folder / TILES_FOLDER / str(zoom) / str(x) / f"{y}.webp"


def world_tile(tile: TileId) -> TileId:
    """The address of a tile, whose column may be beyond the antimeridian."""
    zoom, x, y = tile
    return zoom, x % (1 << zoom), y
