"""What a base map is: tiles of the web map grid, with zoom levels, bounds and limits.

Tiles are in the web Mercator grid: x grows to the east, y to the south, 2^z tiles along an axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, Protocol

from daemon import DaemonError

ZOOM_MAX: Final = 24
TILE_MAX_BYTES: Final = 2_000_000
TILE_PX: Final = 256
MERCATOR_LIMIT_DEG: Final = 85.051128779806604
EARTH_HALF_M: Final = 20037508.342789244
"""Half of the width of the web Mercator plane, m."""

MapKind = Literal["raster", "vector"]
Bounds = tuple[float, float, float, float]
"""West, south, east, north, deg."""

WORLD: Final[Bounds] = (-180.0, -MERCATOR_LIMIT_DEG, 180.0, MERCATOR_LIMIT_DEG)

_MAGIC: Final = (
    (b"\x89PNG\r\n\x1a\n", "image/png"),
    (b"\xff\xd8\xff", "image/jpeg"),
    (b"GIF8", "image/gif"),
)
MVT: Final = "application/vnd.mapbox-vector-tile"


class BaseMapError(DaemonError):
    """A base map that cannot be used; the message names file, finding and remedy."""


@dataclass(frozen=True)
class Tile:
    """Bytes of a tile. `encoding` is "gzip" where they are compressed, else empty."""

    data: bytes
    media_type: str
    encoding: str = ""


@dataclass(frozen=True)
class MapDescription:
    """What a map offers, as the page needs it."""

    name: str
    kind: MapKind
    min_zoom: int
    max_zoom: int
    bounds: Bounds
    attribution: str = ""


class BaseMap(Protocol):
    """A source of tiles; `tile` is called from one worker thread at a time."""

    @property
    def description(self) -> MapDescription: ...

    def tile(self, zoom: int, x: int, y: int) -> Tile | None:
        """The tile, or None where the map has none."""
        ...

    def close(self) -> None:
        """Release the file."""
        ...


def tile_bounds(zoom: int, x: int, y: int) -> Bounds:
    """West, south, east and north of a tile, deg.

    Args:
        zoom: level.
        x: column.
        y: row, from the north.

    Returns:
        The bounds.

    Example:
        >>> tile_bounds(0, 0, 0)[:1] + tile_bounds(1, 1, 0)[:1]
        (-180.0, 0.0)
    """
    count = 1 << zoom

    def latitude_deg(row: int) -> float:
        return math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * row / count))))

    return (
        360.0 * x / count - 180.0,
        latitude_deg(y + 1),
        360.0 * (x + 1) / count - 180.0,
        (latitude_deg(y)),
    )


def mercator_bounds_m(zoom: int, x: int, y: int) -> Bounds:
    """The same in metres of EPSG:3857.

    Args:
        zoom: level.
        x: column.
        y: row, from the north.

    Returns:
        Left, bottom, right, top, m.
    """
    size_m = 2 * EARTH_HALF_M / (1 << zoom)
    left, top = x * size_m - EARTH_HALF_M, EARTH_HALF_M - y * size_m
    return left, top - size_m, left + size_m, top


def is_on_grid(zoom: int, x: int, y: int) -> bool:
    """Whether a tile of this number exists."""
    return 0 <= zoom <= ZOOM_MAX and 0 <= x < 1 << zoom and 0 <= y < 1 << zoom


def intersects(bounds: Bounds, zoom: int, x: int, y: int) -> bool:
    """Whether a tile touches the bounds of a map."""
    west, south, east, north = tile_bounds(zoom, x, y)
    return west <= bounds[2] and east >= bounds[0] and south <= bounds[3] and north >= bounds[1]


def checked_bounds(values: object, file: str) -> Bounds:
    """Bounds from a file.

    Args:
        values: four numbers: west, south, east, north, deg.
        file: name of the file.

    Returns:
        The bounds, limited to the web Mercator plane.

    Raises:
        BaseMapError: they are none.
    """
    try:
        # What is no sequence raises the TypeError that is caught.
        west, south, east, north = (float(value) for value in values)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise BaseMapError(
            f"{file}: its bounds are not four numbers; write the map again"
        ) from error
    found = (west, south, east, north)
    is_valid = all(map(math.isfinite, found)) and west < east and south < north
    if not is_valid or abs(west) > 180.001 or abs(east) > 180.001:
        raise BaseMapError(
            f"{file}: its bounds {found} are not west, south, east, north; write the map again"
        )
    limit = MERCATOR_LIMIT_DEG
    return max(west, -180.0), max(south, -limit), min(east, 180.0), min(north, limit)


def media_type_of(data: bytes) -> str:
    """The kind of an image by its first bytes; MVT where it is none."""
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "image/webp"
    return next((kind for magic, kind in _MAGIC if data.startswith(magic)), MVT)
