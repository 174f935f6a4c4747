"""Versions of the tiles of the live orthomosaic, from the service's events."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, Final

TILES_MAX: Final = 20_000
LIST_MAX: Final = 1000
ABOUT: Final = (
    *("zoom", "min_zoom", "gsd_m", "ground", "images", "measured_only", "not_placed"),
    *("version", "pending"),
)

Json = dict[str, Any]
TileKey = tuple[int, int, int]


class LiveMapState:
    """What the events `orthomosaic` reported; the newest tiles last."""

    def __init__(self) -> None:
        self._about: Json = {}
        self._tiles: OrderedDict[TileKey, tuple[int, int]] = OrderedDict()
        self._dropped_version = 0

    @property
    def version(self) -> int:
        """Of the newest tile; 0 without one."""
        return int(self._about.get("version", 0))

    def clear(self) -> None:
        """Forget the tiles of the last mission."""
        self._about = {}
        self._tiles.clear()
        self._dropped_version = 0

    def apply(self, event: Mapping[str, Any]) -> None:
        """Take over an event."""
        self._about = {key: event[key] for key in ABOUT if key in event}
        for zoom, x, y, version, size in event.get("tiles", ()):
            self._tiles[zoom, x, y] = version, size
            self._tiles.move_to_end((zoom, x, y))
        while len(self._tiles) > TILES_MAX:
            _, (version, _) = self._tiles.popitem(last=False)
            self._dropped_version = max(self._dropped_version, version)

    def changes(self, after: int) -> Json:
        """What the map is, and the tiles [level, column, row, version, bytes] newer than a version,
        coarse ones first; of more than `LIST_MAX` the newest."""
        if not self._about:
            return {}
        newer: list[list[int]] = []
        for tile, (version, size) in reversed(self._tiles.items()):
            if version <= after or len(newer) > LIST_MAX:
                break
            newer.append([*tile, version, size])
        is_cut = len(newer) > LIST_MAX or after < self._dropped_version
        return {**self._about, "tiles": sorted(newer[:LIST_MAX]), "is_cut": is_cut}
