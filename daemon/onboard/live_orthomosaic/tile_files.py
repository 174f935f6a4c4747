"""Files of the live orthomosaic's tiles: signals for more computing, pictures for the page.

Signals are 16-bit words, 0 is no data. A picture is a WebP with transparency; it gets a new version
whenever it is published. Each file is replaced whole.
"""

from __future__ import annotations

import shutil
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.mission.store import durable
from daemon.onboard.live_orthomosaic.map_layout import TILES_FOLDER, TileId, tile_file, world_tile
from daemon.onboard.monitoring.maps.tiles import TILE_PX

Words = NDArray[np.uint16]

QUALITY: Final = 65
"""Of the pictures; 4 to 10 kB each."""
IN_MEMORY: Final = 96
"""Signals in memory, 131 kB each."""
IMAGES_IN_MEMORY: Final = 32
WORK_FOLDER: Final = "work"


@dataclass
class TileState:
    """What is known of a tile.

    Attributes:
        version: of the published picture; 0 before the first.
        changed: bound of the relative change since it was published.
        has_moved: it was displaced by half a pixel or more since then.
    """

    version: int = 0
    changed: float = 0.0
    has_moved: bool = False


class TileFiles:
    """Tiles below a folder.

    Args:
        folder: of the live orthomosaic; what an earlier process left is removed.
        version: of the last picture published by an earlier process.

    Attributes:
        work: folder of signals and reduced images.
    """

    def __init__(self, folder: Path, version: int = 0) -> None:
        self.folder = folder
        self.version = version
        self.states: dict[TileId, TileState] = {}
        self._signals: OrderedDict[TileId, Words] = OrderedDict()
        self._images: OrderedDict[int, Words] = OrderedDict()
        self.work = folder / WORK_FOLDER
        for path in (folder / TILES_FOLDER, self.work):
            shutil.rmtree(path, ignore_errors=True)
        durable.make_directories(self.work)

    def signal(self, tile: TileId) -> Words | None:
        """Pixels of a tile, None where there is none."""
        if tile not in self.states:
            return None
        if tile in self._signals:
            self._signals.move_to_end(tile)
            return self._signals[tile]
        return self._remember(tile, np.load(self._signal_file(tile)))

    def put(self, tile: TileId, signal: Words, *, has_moved: bool = False) -> bool:
        """Store the pixels of a tile and note by how much they changed.

        Returns:
            Whether anything changed.
        """
        before = self.signal(tile)
        change = relative_change(before, signal)
        if tile in self.states and not change:
            return False
        state = self.states.setdefault(tile, TileState())
        state.changed += change
        state.has_moved |= has_moved
        _replace(self._signal_file(tile), signal)
        self._remember(tile, signal)
        return True

    def put_image(self, number: int, pixels: Words) -> None:
        """Store a reduced image."""
        _replace(self._image_file(number), pixels)
        self._images[number] = pixels
        while len(self._images) > IMAGES_IN_MEMORY:
            self._images.popitem(last=False)

    def image(self, number: int) -> Words:
        """A reduced image."""
        if number not in self._images:
            self._images[number] = np.load(self._image_file(number))
            while len(self._images) > IMAGES_IN_MEMORY:
                self._images.popitem(last=False)
        self._images.move_to_end(number)
        return self._images[number]

    def picture(self, tile: TileId, table: NDArray[np.uint8]) -> bytes:
        """The picture of a tile.

        Args:
            table: (65536,), the 8-bit value of each word.
        """
        signal = self.signal(tile)
        if signal is None:
            raise ValueError(f"no tile {tile}")
        alpha = np.where(signal > 0, np.uint8(255), np.uint8(0))
        return encoded(table[signal], alpha)

    def publish(self, tile: TileId, picture: bytes) -> int:
        """Write the picture of a tile; its new version."""
        path = tile_file(self.folder, world_tile(tile))
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_bytes(picture)
        part.replace(path)
        self.version += 1
        self.states[tile] = TileState(self.version)
        return self.version

    def move_to(self, folder: Path) -> None:
        """Copy everything to another disk, and go on there.

        Raises:
            OSError: a disk refused; nothing changed.
        """
        for name in (TILES_FOLDER, WORK_FOLDER):
            shutil.rmtree(folder / name, ignore_errors=True)
            durable.make_directories(folder / name)
            if (self.folder / name).exists():
                shutil.copytree(self.folder / name, folder / name, dirs_exist_ok=True)
        self.folder, self.work = folder, folder / WORK_FOLDER

    def drop_work(self) -> None:
        """Remove signals and reduced images."""
        shutil.rmtree(self.work, ignore_errors=True)
        self._signals.clear()
        self._images.clear()

    def _remember(self, tile: TileId, signal: Words) -> Words:
        self._signals[tile] = signal
        self._signals.move_to_end(tile)
        while len(self._signals) > IN_MEMORY:
            self._signals.popitem(last=False)
        return signal

    def _signal_file(self, tile: TileId) -> Path:
        zoom, x, y = tile
        return self.work / f"{zoom}-{x}-{y}.npy"

    def _image_file(self, number: int) -> Path:
        return self.work / f"image-{number:06d}.npy"


def encoded(grey: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> bytes:
    """A WebP picture."""
    pixels = np.dstack([grey, grey, grey, alpha])
    _, data = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return bytes(data)


def relative_change(before: Words | None, after: Words) -> float:
    """Mean over the pixels with data of the relative difference; 1 for a pixel that is new.

    Args:
        before: (h, w) words, 0 is no data; None: there was no tile.
        after: (h, w).
    """
    if before is None:
        return 1.0 if after.any() else 0.0
    one, other = before.astype(np.float32), after.astype(np.float32)
    largest = np.maximum(one, other)
    known = largest > 0.0
    if not known.any():
        return 0.0
    return float((np.abs(one - other)[known] / largest[known]).mean())


def merged(children: list[Words | None]) -> Words:
    """A tile of the level above from its four children: north-west, north-east, south-west,
    south-east."""
    half = TILE_PX // 2
    result = np.zeros((TILE_PX, TILE_PX), np.uint16)
    for k, child in enumerate(children):
        if child is None:
            continue
        r, c = divmod(k, 2)
        parts = child.reshape(half, 2, half, 2).astype(np.float32)
        count = (parts > 0.0).sum(axis=(1, 3))
        mean = parts.sum(axis=(1, 3)) / np.maximum(count, 1)
        # A pixel of which a half has data has data: the border keeps its place.
        mean[count < 2] = 0.0
        result[r * half : (r + 1) * half, c * half : (c + 1) * half] = np.rint(mean)
    return result


def _replace(path: Path, pixels: Words) -> None:
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.save(file, pixels)
    part.replace(path)
