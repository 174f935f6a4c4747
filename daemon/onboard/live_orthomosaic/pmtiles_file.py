"""Writes a PMTiles file of pictures.

Source: PMTiles specification, version 3. Tiles are in the order of their numbers; directories are
compressed by gzip without a time stamp, so that the same tiles give the same bytes.
"""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from daemon.mission.store import durable
from daemon.onboard.live_orthomosaic.map_layout import TileId
from daemon.onboard.monitoring.maps.pmtiles import HEADER_BYTES, tile_id
from daemon.onboard.monitoring.maps.tiles import Bounds

ROOT_MAX_BYTES: Final = 16_384 - HEADER_BYTES
"""Header and root directory lie in the first 16 kB."""
LEAF_ENTRIES: Final = 4096
_GZIP: Final = 2
_NONE: Final = 1
_WEBP: Final = 4

Entry = tuple[int, int, int, int]
"""Number, offset, length, run length; a run length of 0 is a leaf directory."""


def write_pmtiles(
    path: Path, tiles: Mapping[TileId, Path], bounds: Bounds, metadata: Mapping[str, Any]
) -> int:
    """Write the file.

    Args:
        path: its final name; it appears when it is complete.
        tiles: files of WebP pictures.
        bounds: west, south, east, north, deg.
        metadata: name, attribution and more.

    Returns:
        Its size in bytes.

    Raises:
        ValueError: there is no tile.
        OSError: a file cannot be read, or the disk refused.
    """
    if not tiles:
        raise ValueError("a map without tiles")
    ordered = sorted(tiles, key=lambda tile: tile_id(*tile))
    entries, offset = [], 0
    for tile in ordered:
        size = tiles[tile].stat().st_size
        entries.append((tile_id(*tile), offset, size, 1))
        offset += size
    root, leaves = _directories(entries)
    about = gzip.compress(json.dumps(metadata, sort_keys=True).encode("utf-8"), mtime=0)
    places, at = [], HEADER_BYTES
    for size in (len(root), len(about), len(leaves), offset):
        places += [at, size]
        at += size
    zooms = [tile[0] for tile in ordered]
    corners = [round(value * 1e7) for value in bounds]
    middle = [round((bounds[k] + bounds[k + 2]) / 2 * 1e7) for k in (0, 1)]
    header = b"PMTiles\x03" + struct.pack(
        "<11Q6B4iB2i", *places, len(entries), len(entries), len(entries),
        1, _GZIP, _NONE, _WEBP, min(zooms), max(zooms), *corners, min(zooms), *middle,
    )  # fmt: skip
    with durable.new_file(path) as part, part.open("wb") as file:
        for piece in (header, root, about, leaves):
            file.write(piece)
        for tile in ordered:
            file.write(tiles[tile].read_bytes())
    return path.stat().st_size


def _directories(entries: Sequence[Entry]) -> tuple[bytes, bytes]:
    """The root directory, and all leaf directories; none if the root holds every entry."""
    root = _directory(entries)
    if len(root) <= ROOT_MAX_BYTES:
        return root, b""
    leaves, pointers = b"", []
    for first in range(0, len(entries), LEAF_ENTRIES):
        leaf = _directory(entries[first : first + LEAF_ENTRIES])
        pointers.append((entries[first][0], len(leaves), len(leaf), 0))
        leaves += leaf
    return _directory(pointers), leaves


def _directory(entries: Sequence[Entry]) -> bytes:
    numbers = [entry[0] for entry in entries]
    steps = [a - b for a, b in zip(numbers, [0, *numbers], strict=False)]
    values = [len(entries), *steps, *(e[3] for e in entries), *(e[2] for e in entries)]
    end = -1
    for _, offset, length, _ in entries:
        values.append(0 if offset == end else offset + 1)
        end = offset + length
    return gzip.compress(b"".join(_varints(values)), mtime=0)


def _varints(values: Sequence[int]) -> Iterator[bytes]:
    for value in values:
        while value > 0x7F:
            yield bytes([value & 0x7F | 0x80])
            value >>= 7
        yield bytes([value])
