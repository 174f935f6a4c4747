"""Tiles of Level-2 images at full resolution, read by windows from the uncompressed rasters.

A tile of reduction r covers 256 r x 256 r pixels. Rows are read in blocks, so that memory stays
below a few megabytes whatever the size of the image. Nothing is read without a request.
"""

from __future__ import annotations

import math
import os
import re
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.store.level0 import tiff_errors
from daemon.onboard.monitoring.maps.pictures import encode
from daemon.onboard.monitoring.maps.tiles import TILE_PX, Tile

REDUCTIONS: Final = (1, 2, 4, 8, 16)
OUTPUT_ROWS: Final = 16
"""Rows of a tile that are computed at a time."""
FULL_SCALE: Final = 32_768
"""Counts of Level-2 at the full scale of the converter: 2^(15 - bits) counts to the DN."""
NEAR_FULL: Final = 0.95
SIDE_MAX_PX: Final = 200_000
SHARP_BLOCK_PX: Final = 32
CONTRAST_MIN: Final = 12.0
"""RMS difference of pixels two apart, in counts, below which there is no texture to measure."""
SHARP_LIMITS: Final = (0.5, 0.75)
DERIVED: Final = ("saturation", "sharpness")
LAYERS_MAX: Final = 24
_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,40}")
Words = NDArray[np.uint16]


class ImageTileError(DaemonError):
    """An image that cannot be read; the message names file and finding."""


@dataclass(frozen=True)
class RasterLayout:
    """Where the planes of a raster lie in its file, and how its values are shown."""

    path: Path
    offset: int
    planes: int
    height: int
    width: int
    byte_order: str
    low: float
    high: float

    @property
    def dtype(self) -> np.dtype[np.uint16]:
        return np.dtype(f"{self.byte_order}u2")


class ImageTiles:
    """Tiles of the exposures of a mission; the shapes of the last images are cached."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[Path, int, int], RasterLayout] = OrderedDict()

    def about(self, folder: Path) -> dict[str, Any]:
        """Layers of an exposure and the size of its image.

        Args:
            folder: products of the exposure.

        Returns:
            `layers` with name, width and height in pixels; `reductions`; `tile_px`.

        Raises:
            ImageTileError: there is no image.
        """
        names = _names(folder)
        if not names:
            raise ImageTileError("there is no image of full resolution (yet)")
        layers = []
        for name in names:
            found = self._raster(folder / f"{name}.tif")
            layers.append({"name": name, "width_px": found.width, "height_px": found.height})
        return {
            "layers": layers,
            "derived": list(DERIVED),
            "reductions": list(REDUCTIONS),
            "tile_px": TILE_PX,
            "near_full_scale": NEAR_FULL,
            "sharpness": {"low": SHARP_LIMITS[0], "high": SHARP_LIMITS[1]},
        }

    def tile(
        self, folder: Path, layer: str, reduction: int, x: int, y: int, of: str | None = None
    ) -> Tile | None:
        """A tile in the pixel grid of the first layer, counted from its upper left corner.

        Args:
            folder: products of the exposure.
            layer: one of `about`, or a derived one.
            reduction: side of the square of pixels that becomes one.
            x: column of the tile.
            y: row of the tile.
            of: the layer that a derived one is computed from (default: the first one).

        Returns:
            The tile; None beyond the image.

        Raises:
            ImageTileError: no such layer, or a damaged file.
        """
        names = _names(folder)
        wanted = (of or names[0]) if layer in DERIVED and names else layer
        if wanted not in names or reduction not in REDUCTIONS:
            raise ImageTileError(f"there is no layer {wanted!r}; there are {', '.join(names)}")
        base = self._raster(folder / f"{names[0]}.tif")
        side_px = TILE_PX * reduction
        x0, y0 = x * side_px, y * side_px
        if x0 >= base.width or y0 >= base.height:
            return None
        raster = self._raster(folder / f"{wanted}.tif")
        try:
            descriptor = os.open(raster.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        except OSError as error:
            raise ImageTileError(f"{raster.path.name}: {error.strerror}") from error
        try:
            if layer == "saturation":
                return _saturation(descriptor, raster, base, reduction, x0, y0)
            if layer == "sharpness":
                return _sharpness(descriptor, raster, base, reduction, x0, y0)
            if (raster.height, raster.width) != (base.height, base.width):
                return _scaled(descriptor, raster, base, reduction, x0, y0)
            return _plain(descriptor, raster, reduction, x0, y0)
        finally:
            os.close(descriptor)

    def _raster(self, path: Path) -> RasterLayout:
        try:
            status = path.stat()
        except OSError as error:
            raise ImageTileError(f"{path.name}: {error.strerror}") from error
        key = path, status.st_mtime_ns, status.st_size
        known = self._known.get(key)
        if known is None:
            known = read_raster(path)
            self._known[key] = known
            while len(self._known) > 2 * LAYERS_MAX:
                self._known.popitem(last=False)
        return known


def read_raster(path: Path) -> RasterLayout:
    """The layout of an uncompressed 16-bit TIFF.

    Args:
        path: the file.

    Returns:
        Where its planes are.

    Raises:
        ImageTileError: it is compressed, of another type, truncated or no TIFF.
    """
    from tifffile import TiffFile

    faults: tuple[type[Exception], ...] = (OSError, *tiff_errors())
    try:
        with TiffFile(path) as tiff:
            page = tiff.pages.first
            shape = page.shape if len(page.shape) == 3 else (1, *page.shape)
            offset, nbytes = page.dataoffsets[0], sum(page.databytecounts)
            byte_order = tiff.byteorder
            is_plain = page.compression == 1 and page.dtype == np.uint16 and page.is_contiguous
    except faults as error:
        raise ImageTileError(f"{path.name}: is no TIFF that can be read ({error})") from error
    planes, height, width = shape if len(shape) == 3 else (0, 0, 0)
    is_sized = 0 < height <= SIDE_MAX_PX and 0 < width <= SIDE_MAX_PX and 0 < planes <= 16
    if not is_plain or not is_sized or nbytes < planes * height * width * 2:
        raise ImageTileError(f"{path.name}: is no uncompressed image of 16 bits")
    if path.stat().st_size < offset + planes * height * width * 2:
        raise ImageTileError(f"{path.name}: is truncated; process the exposure again")
    plain = RasterLayout(path, offset, planes, height, width, byte_order, 0.0, 1.0)
    low, high = _stretch(plain)
    return RasterLayout(path, offset, planes, height, width, byte_order, low, high)


def _names(folder: Path) -> list[str]:
    """Layers in the folder, the panchromatic image first."""
    try:
        names = [one.stem for one in folder.iterdir() if one.suffix == ".tif"]
    except OSError:
        return []
    valid = sorted(name for name in names if _NAME.fullmatch(name) and name not in DERIVED)
    return sorted(valid, key=lambda name: (name != "pan", name != "rgbn", name))[:LAYERS_MAX]


def _stretch(raster: RasterLayout) -> tuple[float, float]:
    """Counts shown as black and white, from 64 rows."""
    descriptor = os.open(raster.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        rows = np.linspace(0, raster.height - 1, 64).astype(int)
        step = max(1, raster.width // 512)
        samples = [
            _rows(descriptor, raster, plane, int(row), 1, 0, raster.width)[0, ::step]
            for plane in range(min(raster.planes, 3))
            for row in rows
        ]
    finally:
        os.close(descriptor)
    known = np.concatenate(samples)
    known = known[known > 0]
    if not len(known):
        return 0.0, 1.0
    low, high = np.percentile(known, (0.5, 99.5))
    return float(low), float(max(high, low + 1.0))


def _rows(
    descriptor: int, raster: RasterLayout, plane: int, row: int, count: int, column: int, width: int
) -> Words:
    """A window of a plane, row by row."""
    out = np.zeros((count, width), np.uint16)
    line_nbytes = raster.width * 2
    begin = raster.offset + (plane * raster.height + row) * line_nbytes + column * 2
    for index in range(count):
        data = os.pread(descriptor, width * 2, begin + index * line_nbytes)
        if len(data) != width * 2:
            raise ImageTileError(f"{raster.path.name}: is truncated; process the exposure again")
        out[index] = np.frombuffer(data, raster.dtype)
    return out


def _blocks(
    descriptor: int,
    raster: RasterLayout,
    plane: int,
    reduction: int,
    x0: int,
    y0: int,
    *,
    side: int = TILE_PX,
) -> Iterator[tuple[int, Words]]:
    """Row of the tile and pixels (rows, r, columns, r) of a few rows of it; whole squares only.

    The tile has `side` squares a side, fewer at the end of the image.
    """
    columns = min(side, -(-(raster.width - x0) // reduction))
    rows = min(side, -(-(raster.height - y0) // reduction))
    width = min(columns * reduction, raster.width - x0)
    for first in range(0, rows, OUTPUT_ROWS):
        count = min(OUTPUT_ROWS, rows - first)
        begin = y0 + first * reduction
        height = min(count * reduction, raster.height - begin)
        window = _rows(descriptor, raster, plane, begin, height, x0, width)
        padded = np.zeros((count * reduction, columns * reduction), np.uint16)
        padded[:height, :width] = window
        yield first, padded.reshape(count, reduction, columns, reduction)


def _mean(
    descriptor: int,
    raster: RasterLayout,
    plane: int,
    reduction: int,
    x0: int,
    y0: int,
    *,
    side: int = TILE_PX,
) -> Any:
    """Mean of the known pixels of each square, 0 where none is known, shape (side, side)."""
    tile = np.zeros((side, side), np.float32)
    for first, block in _blocks(descriptor, raster, plane, reduction, x0, y0, side=side):
        known = (block > 0).sum(axis=(1, 3))
        total = block.sum(axis=(1, 3), dtype=np.float32)
        tile[first : first + len(block), : block.shape[2]] = total / np.maximum(known, 1)
    return tile


def _shown(values: NDArray[np.float32], raster: RasterLayout) -> NDArray[np.uint8]:
    scaled = np.clip((values - raster.low) / (raster.high - raster.low), 0.0, 1.0)
    grey: NDArray[np.uint8] = (255.0 * scaled ** np.float32(1 / 2.2) + 0.5).astype(np.uint8)
    return grey


def _plain(descriptor: int, raster: RasterLayout, reduction: int, x0: int, y0: int) -> Tile:
    planes = range(3) if raster.planes >= 3 else range(1)
    values = np.dstack([_mean(descriptor, raster, p, reduction, x0, y0) for p in planes])
    return _encoded(values, raster)


@dataclass(frozen=True)
class _Window:
    """Squares of a layer that a tile of the grid of the first layer covers.

    `matrix` maps pixels of the tile to squares; there are `side` squares a side from (left, top).
    """

    reduction: int
    left: int
    top: int
    side: int
    matrix: NDArray[np.float64]


def _window(
    raster: RasterLayout, base: RasterLayout, reduction: int, x0: int, y0: int, square: int = 0
) -> _Window:
    """The window of a tile; `square` is the side of the squares in pixels, 0 for those that fit."""
    scale = base.width / raster.width
    ratio = reduction / scale
    fitting = next((one for one in REDUCTIONS if one >= ratio), REDUCTIONS[-1])
    size = square or fitting
    left = max(0, int(x0 / scale / size) - 1) * size
    top = max(0, int(y0 / scale / size) - 1) * size
    step = ratio / size
    begin = np.array([x0, y0]) / scale / size - np.array([left, top]) / size + step / 2 - 0.5
    matrix = np.array([[step, 0.0, begin[0]], [0.0, step, begin[1]]])
    return _Window(size, left, top, math.ceil(TILE_PX * step) + 4, matrix)


def _warped(values: NDArray[Any], window: _Window, flags: int) -> Any:
    import cv2

    size = (TILE_PX, TILE_PX)
    return cv2.warpAffine(values, window.matrix, size, flags=flags | cv2.WARP_INVERSE_MAP)


def _scaled(
    descriptor: int, raster: RasterLayout, base: RasterLayout, reduction: int, x0: int, y0: int
) -> Tile:
    """A layer of another resolution, brought to the grid of the first one."""
    import cv2

    window = _window(raster, base, reduction, x0, y0)
    at = (window.reduction, window.left, window.top)
    planes = range(3) if raster.planes >= 3 else range(1)
    squares = np.dstack([_mean(descriptor, raster, p, *at, side=window.side) for p in planes])
    values = _warped(squares, window, cv2.INTER_LINEAR)
    return _encoded(values if values.ndim == 3 else values[..., None], raster)


def _encoded(values: NDArray[np.float32], raster: RasterLayout) -> Tile:
    alpha = (values.max(axis=2) > 0).astype(np.uint8) * 255
    return encode(_shown(values, raster), alpha)


def _saturation(
    descriptor: int, raster: RasterLayout, base: RasterLayout, reduction: int, x0: int, y0: int
) -> Tile:
    """Red where a pixel of the square is near the full scale of the converter, in any plane."""
    import cv2

    window = _window(raster, base, reduction, x0, y0)
    at = (window.reduction, window.left, window.top)
    is_full = np.zeros((window.side, window.side), np.uint8)
    for plane in range(raster.planes):
        for first, block in _blocks(descriptor, raster, plane, *at, side=window.side):
            full = block.max(axis=(1, 3)) >= NEAR_FULL * FULL_SCALE
            is_full[first : first + len(block), : block.shape[2]] |= full
    alpha = _warped(is_full * np.uint8(254), window, cv2.INTER_NEAREST)
    red = np.zeros((TILE_PX, TILE_PX, 3), np.uint8)
    red[..., 0] = 255
    return encode(red, alpha, lossless=True)


def _sharpness(
    descriptor: int, raster: RasterLayout, base: RasterLayout, reduction: int, x0: int, y0: int
) -> Tile:
    """Ratio of differences one and two pixels apart, by blocks of 32 pixels; blank without texture.

    White noise and the sharpest edges give 0.7 to 1, a blur over two pixels and more gives 0.5.
    """
    import cv2

    window = _window(raster, base, reduction, x0, y0, SHARP_BLOCK_PX)
    columns = min(window.side, (raster.width - window.left) // SHARP_BLOCK_PX)
    rows = min(window.side, (raster.height - window.top) // SHARP_BLOCK_PX)
    over = np.zeros((window.side, window.side, 4), np.uint8)
    for row in range(max(rows, 0) if columns > 0 else 0):
        begin = window.top + row * SHARP_BLOCK_PX
        width = columns * SHARP_BLOCK_PX
        pixels = _rows(descriptor, raster, 0, begin, SHARP_BLOCK_PX, window.left, width)
        ratio = sharpness_of(pixels)
        share = (ratio - SHARP_LIMITS[0]) / (SHARP_LIMITS[1] - SHARP_LIMITS[0])
        share = np.clip(np.nan_to_num(share), 0.0, 1.0)
        over[row, :columns, 0] = 255 * np.minimum(1.0, 2 - 2 * share)
        over[row, :columns, 1] = 200 * np.minimum(1.0, 2 * share)
        over[row, :columns, 3] = np.where(np.isfinite(ratio), 110, 0)
    full = _warped(over, window, cv2.INTER_NEAREST)
    return encode(full[..., :3], full[..., 3], lossless=True)


def sharpness_of(pixels: Words) -> NDArray[np.float64]:
    """Sharpness of the blocks of a strip of pixels.

    Args:
        pixels: shape (32, 32 n), counts; 0 is no data.

    Returns:
        Shape (n,): RMS difference of neighbours over that of pixels two apart; NaN without texture
        or without data.
    """
    values = pixels.astype(np.float64).reshape(SHARP_BLOCK_PX, -1, SHARP_BLOCK_PX)
    near = ((values[:, :, 1:] - values[:, :, :-1]) ** 2).mean(axis=(0, 2))
    near += ((values[1:] - values[:-1]) ** 2).mean(axis=(0, 2))
    far = ((values[:, :, 2:] - values[:, :, :-2]) ** 2).mean(axis=(0, 2))
    far += ((values[2:] - values[:-2]) ** 2).mean(axis=(0, 2))
    has_texture = (far > 2 * CONTRAST_MIN**2) & (values > 0).all(axis=(0, 2))
    return np.where(has_texture, np.sqrt(near / np.maximum(far, 1e-9)), np.nan)
