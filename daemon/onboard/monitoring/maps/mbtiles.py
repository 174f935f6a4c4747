"""MBTiles: a map as tiles in an SQLite file, raster or vector.

Source: MBTiles specification 1.3.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Final
from urllib.parse import quote

from daemon.mission.foreign_files import ForeignFileError, open_regular_file
from daemon.onboard.monitoring.maps.tiles import (
    MVT,
    TILE_MAX_BYTES,
    WORLD,
    ZOOM_MAX,
    BaseMapError,
    MapDescription,
    Tile,
    checked_bounds,
    media_type_of,
)

FILE_MAX_BYTES: Final = 1 << 42
CACHE_KIB: Final = 4000
STEPS_MAX: Final = 2_000_000
"""Steps of SQLite for one tile; a file without an index on its tiles would take minutes."""
_RASTER: Final = frozenset({"png", "jpg", "jpeg", "webp"})


class MbtilesMap:
    """A map in one MBTiles file, read-only.

    Raises:
        BaseMapError: no MBTiles file, or one of another content.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with open_regular_file(path, FILE_MAX_BYTES):
                pass
        except ForeignFileError as error:
            raise BaseMapError(f"base map {error}") from error
        address = f"file:{quote(str(path))}?mode=ro&immutable=1"
        try:
            self._database = sqlite3.connect(address, uri=True, check_same_thread=False)
            self._database.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
            self._database.execute("PRAGMA trusted_schema = OFF")
            self._database.text_factory = lambda data: data.decode("utf-8", "replace")
            # A view may stand in place of a table; what it costs is bounded.
            self._steps = 0
            self._database.set_progress_handler(self._is_too_long, 10_000)
            self.description = self._described()
        except sqlite3.Error as error:
            raise BaseMapError(
                f"base map {path}: no MBTiles file that can be read ({error}); copy it again, or "
                "write it with gdal_translate -of MBTILES"
            ) from error

    def tile(self, zoom: int, x: int, y: int) -> Tile | None:
        """The tile; rows count from the south in the file.

        Raises:
            BaseMapError: the file is damaged.
        """
        self._steps = 0
        row = (1 << zoom) - 1 - y
        where = "zoom_level = ? AND tile_column = ? AND tile_row = ?"
        try:
            with closing(
                self._database.execute(
                    f"SELECT length(tile_data), CASE WHEN length(tile_data) <= {TILE_MAX_BYTES} "
                    f"THEN tile_data END FROM tiles WHERE {where} LIMIT 1",
                    (zoom, x, row),
                )
            ) as found:
                answer = found.fetchone()
        except sqlite3.Error as error:
            raise BaseMapError(
                f"base map {self._path.name}: {error}; copy the file again"
            ) from error
        if answer is None or not isinstance(answer[1], bytes) or not answer[1]:
            return None
        data = answer[1]
        if self.description.kind == "vector":
            return Tile(data, MVT, "gzip" if data[:2] == b"\x1f\x8b" else "")
        kind = media_type_of(data)
        return None if kind == MVT else Tile(data, kind)

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def _is_too_long(self) -> int:
        self._steps += 10_000
        return int(self._steps > STEPS_MAX)

    def _described(self) -> MapDescription:
        rows = self._database.execute("SELECT name, value FROM metadata LIMIT 200").fetchall()
        about = {str(name): str(value)[:4000] for name, value in rows}
        file = f"base map {self._path.name}"
        kind = about.get("format", "").lower()
        if kind not in _RASTER | {"pbf"}:
            raise BaseMapError(f"{file}: its format {kind!r} is none of pbf, png, jpg and webp")
        try:
            first, last = int(about.get("minzoom", 0)), int(about.get("maxzoom", -1))
        except ValueError as error:
            raise BaseMapError(f"{file}: minzoom and maxzoom are no numbers") from error
        if last < 0:
            levels = self._database.execute(
                "SELECT min(zoom_level), max(zoom_level) FROM tiles"
            ).fetchone()
            if levels[0] is None:
                raise BaseMapError(f"{file}: holds no tile; write it again")
            first, last = int(levels[0]), int(levels[1])
        if not 0 <= first <= last <= ZOOM_MAX:
            raise BaseMapError(f"{file}: zoom {first} to {last} is not within 0 to {ZOOM_MAX}")
        bounds = about.get("bounds")
        return MapDescription(
            about.get("name", self._path.stem)[:100],
            "vector" if kind == "pbf" else "raster",
            first,
            last,
            WORLD if bounds is None else checked_bounds(bounds.split(","), file),
            about.get("attribution", "")[:500],
        )
