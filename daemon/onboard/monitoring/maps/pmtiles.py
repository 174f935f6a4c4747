"""PMTiles: a map as one file with directories of tiles, raster or vector.

Only what one tile needs is read. Directories and tiles have limits, since a file comes from
anywhere; what is compressed other than by gzip is refused.

Source: PMTiles specification, version 3.
"""

from __future__ import annotations

import bisect
import json
import os
import struct
import zlib
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.mission.foreign_files import ForeignFileError, open_regular_file
from daemon.onboard.monitoring.maps.tiles import (
    MVT,
    TILE_MAX_BYTES,
    ZOOM_MAX,
    BaseMapError,
    MapDescription,
    Tile,
    checked_bounds,
    media_type_of,
)

FILE_MAX_BYTES: Final = 1 << 42
HEADER_BYTES: Final = 127
DIRECTORY_MAX_BYTES: Final = 16_000_000
ENTRIES_MAX: Final = 400_000
METADATA_MAX_BYTES: Final = 1_000_000
DEPTH_MAX: Final = 4
DIRECTORIES_CACHED: Final = 16
NONE, GZIP = 1, 2
_TYPES: Final = {1: "vector", 2: "raster", 3: "raster", 4: "raster"}


@dataclass(frozen=True)
class Directory:
    """Entries in ascending order of tile id; `run_lengths` is 0 for a leaf directory."""

    tile_ids: tuple[int, ...]
    run_lengths: tuple[int, ...]
    lengths: tuple[int, ...]
    offsets: tuple[int, ...]


class PmtilesMap:
    """A map in one PMTiles file, read-only.

    Raises:
        BaseMapError: no PMTiles file of version 3, or a compression that is not supported.
    """

    def __init__(self, path: Path) -> None:
        self._name = f"base map {path.name}"
        try:
            with open_regular_file(path, FILE_MAX_BYTES) as descriptor:
                self._descriptor = os.dup(descriptor)
        except ForeignFileError as error:
            raise BaseMapError(f"base map {error}") from error
        self._size = os.fstat(self._descriptor).st_size
        self._directories: OrderedDict[int, Directory] = OrderedDict()
        try:
            self.description = self._described(path)
            self._root = self._directory(*self._root_place)
        except BaseMapError:
            self.close()
            raise

    def tile(self, zoom: int, x: int, y: int) -> Tile | None:
        """The tile.

        Raises:
            BaseMapError: the file is damaged.
        """
        wanted, directory = tile_id(zoom, x, y), self._root
        for _ in range(DEPTH_MAX):
            found = bisect.bisect_right(directory.tile_ids, wanted) - 1
            if found < 0:
                return None
            offset, length = directory.offsets[found], directory.lengths[found]
            run = directory.run_lengths[found]
            if run:
                if wanted >= directory.tile_ids[found] + run:
                    return None
                return self._tile(offset, length)
            directory = self._leaf(offset, length)
        raise BaseMapError(f"{self._name}: its directories are nested too deeply; copy it again")

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    def _tile(self, offset: int, length: int) -> Tile | None:
        if length > TILE_MAX_BYTES:
            return None
        data = self._read(self._tiles_offset + offset, length)
        if self.description.kind == "vector":
            return Tile(data, MVT, "gzip" if self._tile_compression == GZIP else "")
        kind = media_type_of(data)
        return None if kind == MVT else Tile(data, kind)

    def _leaf(self, offset: int, length: int) -> Directory:
        known = self._directories.get(offset)
        if known is None:
            known = self._directory(self._leaves_offset + offset, length)
            self._directories[offset] = known
            while len(self._directories) > DIRECTORIES_CACHED:
                self._directories.popitem(last=False)
        return known

    def _described(self, path: Path) -> MapDescription:
        header = self._read(0, HEADER_BYTES)
        if header[:7] != b"PMTiles" or header[7] != 3:
            raise BaseMapError(
                f"{self._name}: no PMTiles file of version 3; convert it with pmtiles"
            )
        (
            root, root_length, metadata, metadata_length, self._leaves_offset, _,
            self._tiles_offset, _, _, _, _,
        ) = struct.unpack_from("<11Q", header, 8)  # fmt: skip
        _, self._compression, self._tile_compression, kind, first, last = struct.unpack_from(
            "<6B", header, 96
        )
        bounds = [value / 1e7 for value in struct.unpack_from("<4i", header, 102)]
        if kind not in _TYPES:
            raise BaseMapError(f"{self._name}: its tiles are neither MVT, PNG, JPEG nor WebP")
        if self._compression not in (NONE, GZIP) or self._tile_compression not in (0, NONE, GZIP):
            raise BaseMapError(
                f"{self._name}: is compressed by brotli or zstd; write it again with gzip"
            )
        if not 0 <= first <= last <= ZOOM_MAX:
            raise BaseMapError(
                f"{self._name}: zoom {first} to {last} is not within 0 to {ZOOM_MAX}"
            )
        self._root_place = root, root_length
        about = self._metadata(metadata, metadata_length)
        return MapDescription(
            str(about.get("name") or path.stem)[:100],
            "vector" if _TYPES[kind] == "vector" else "raster",
            first,
            last,
            checked_bounds(bounds, self._name),
            str(about.get("attribution") or "")[:500],
        )

    def _metadata(self, offset: int, length: int) -> dict[str, object]:
        if not length:
            return {}
        try:
            content = json.loads(self._unpacked(offset, length, METADATA_MAX_BYTES))
        except (ValueError, RecursionError) as error:
            raise BaseMapError(f"{self._name}: its metadata are no JSON; copy it again") from error
        return content if isinstance(content, dict) else {}

    def _directory(self, offset: int, length: int) -> Directory:
        data = self._unpacked(offset, length, DIRECTORY_MAX_BYTES)
        try:
            return parse_directory(data)
        except (IndexError, ValueError) as error:
            raise BaseMapError(
                f"{self._name}: a directory is damaged ({error}); copy the file again"
            ) from error

    def _unpacked(self, offset: int, length: int, max_bytes: int) -> bytes:
        if length > max_bytes:
            raise BaseMapError(
                f"{self._name}: a directory of {length} bytes; {max_bytes} is the limit"
            )
        data = self._read(offset, length)
        if self._compression != GZIP:
            return data
        unpacker = zlib.decompressobj(wbits=31)
        try:
            unpacked = unpacker.decompress(data, max_bytes)
        except zlib.error as error:
            raise BaseMapError(f"{self._name}: is damaged ({error}); copy it again") from error
        if unpacker.unconsumed_tail or not unpacker.eof:
            raise BaseMapError(
                f"{self._name}: a directory is damaged or larger than {max_bytes} bytes"
            )
        return unpacked

    def _read(self, offset: int, length: int) -> bytes:
        if offset + length > self._size:
            raise BaseMapError(f"{self._name}: is truncated; copy it again")
        data = os.pread(self._descriptor, length, offset)
        if len(data) != length:
            raise BaseMapError(f"{self._name}: is truncated; copy it again")
        return data


def tile_id(zoom: int, x: int, y: int) -> int:
    """Number of a tile: those of lower levels first, then along a Hilbert curve.

    Args:
        zoom: level.
        x: column.
        y: row, from the north.

    Returns:
        The number.

    Example:
        >>> tile_id(0, 0, 0), tile_id(1, 0, 0), tile_id(1, 1, 0), tile_id(2, 0, 0)
        (0, 1, 4, 5)
    """
    before = ((1 << 2 * zoom) - 1) // 3
    distance, side = 0, 1 << zoom >> 1
    while side:
        right, lower = int(bool(x & side)), int(bool(y & side))
        distance += side * side * ((3 * right) ^ lower)
        if not lower:
            if right:
                x, y = side - 1 - (x & (side - 1)), side - 1 - (y & (side - 1))
            x, y = y, x
        side >>= 1
    return before + distance


def parse_directory(data: bytes) -> Directory:
    """A directory from its uncompressed bytes.

    Args:
        data: the bytes.

    Returns:
        Its entries.

    Raises:
        ValueError, IndexError: it is damaged.
    """
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7
            if shift > 63:
                raise ValueError("a number is too long")

    count = varint()
    if count > ENTRIES_MAX or count > len(data):
        raise ValueError(f"{count} entries")
    ids, last = [], 0
    for _ in range(count):
        last += varint()
        ids.append(last)
    runs = tuple(varint() for _ in range(count))
    lengths = tuple(varint() for _ in range(count))
    offsets: list[int] = []
    for index in range(count):
        value = varint()
        if value == 0 and index == 0:
            raise ValueError("the first entry has no offset")
        offsets.append(offsets[-1] + lengths[index - 1] if value == 0 else value - 1)
    return Directory(tuple(ids), runs, lengths, tuple(offsets))
