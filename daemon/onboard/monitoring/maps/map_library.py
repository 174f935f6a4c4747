"""The configured base maps: opened at the start, tiles read by one thread, the last ones cached."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from daemon import DaemonError
from daemon.configuration.model import PlanSection
from daemon.onboard.monitoring.maps.geotiff import GeotiffMap
from daemon.onboard.monitoring.maps.hill_shade import HillShadeMap
from daemon.onboard.monitoring.maps.mbtiles import MbtilesMap
from daemon.onboard.monitoring.maps.pmtiles import PmtilesMap
from daemon.onboard.monitoring.maps.tiles import BaseMap, BaseMapError, Tile, intersects, is_on_grid
from daemon.onboard.preflight.check_results import CheckResult, failed, passed
from daemon.planning.relief import relief_of

CACHE_BYTES: Final = 16_000_000
SUFFIXES: Final[dict[str, Callable[[Path], BaseMap]]] = {
    ".mbtiles": MbtilesMap,
    ".pmtiles": PmtilesMap,
    ".tif": GeotiffMap,
    ".tiff": GeotiffMap,
}
HILL_SHADE_CELLS_MAX: Final = 16_000_000
"""A height model is in memory: 8 bytes a cell."""


def open_map(path: Path) -> BaseMap:
    """Open a base map by the ending of its name.

    Args:
        path: an MBTiles, PMTiles or GeoTIFF file.

    Returns:
        The map.

    Raises:
        BaseMapError: another ending, or a file that cannot be used.
    """
    kind = SUFFIXES.get(path.suffix.lower())
    if kind is None:
        raise BaseMapError(
            f"base map {path}: the name ends in none of {', '.join(SUFFIXES)}; [watch] maps names "
            "MBTiles, PMTiles and GeoTIFF files"
        )
    return kind(path)


def check_maps(paths: Iterable[Path]) -> Iterator[CheckResult]:
    """Open each base map and read one tile.

    Args:
        paths: the configured files.

    Returns:
        One result for each file.
    """
    for path in paths:
        try:
            opened = open_map(path)
            try:
                about = opened.description
                opened.tile(about.min_zoom, 0, 0)
            finally:
                opened.close()
        except BaseMapError as error:
            yield failed("watch", "maps", f"{error}. The page shows no such layer")
        else:
            sentence = f"{path.name}: {about.kind}, zoom {about.min_zoom} to {about.max_zoom}"
            yield passed("watch", "maps", sentence)


class MapLibrary:
    """Base maps by their number, and hill shade as the last one.

    Args:
        paths: the configured files; those that cannot be used are left out, `check` reports them.
        plan: the plan section, whose height model gives hill shade.
    """

    def __init__(self, paths: Sequence[Path], plan: PlanSection | None = None) -> None:
        self._maps: list[BaseMap] = []
        self.problems: list[str] = []
        self._lock = threading.Lock()
        self._cache: OrderedDict[tuple[int, int, int, int], Tile | None] = OrderedDict()
        self._cached_bytes = 0
        for path in paths:
            try:
                self._maps.append(open_map(path))
            except BaseMapError as error:
                self.problems.append(str(error))
        self._plan = plan
        self._has_hill_shade = plan is None or plan.elevation is None

    def descriptions(self) -> list[dict[str, Any]]:
        """What the page offers, in order; hill shade is a map of kind "raster" named so."""
        with self._lock:
            self._add_hill_shade()
            return [
                {
                    "id": number,
                    "is_overlay": isinstance(one, HillShadeMap),
                    **asdict(one.description),
                }
                for number, one in enumerate(self._maps)
            ]

    def tile(self, number: int, zoom: int, x: int, y: int) -> Tile | None:
        """A tile; None where there is none. It may take long; to be called in a thread.

        Raises:
            BaseMapError: the file is damaged.
        """
        if not 0 <= number < len(self._maps) or not is_on_grid(zoom, x, y):
            return None
        one = self._maps[number]
        about = one.description
        if not about.min_zoom <= zoom <= about.max_zoom or not intersects(about.bounds, zoom, x, y):
            return None
        key = number, zoom, x, y
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
            found = one.tile(zoom, x, y)
            self._cache[key] = found
            self._cached_bytes += 0 if found is None else len(found.data)
            while self._cached_bytes > CACHE_BYTES or len(self._cache) > 4096:
                _, dropped = self._cache.popitem(last=False)
                self._cached_bytes -= 0 if dropped is None else len(dropped.data)
            return found

    def close(self) -> None:
        """Close all files."""
        for one in self._maps:
            one.close()

    def _add_hill_shade(self) -> None:
        """Read the height model with the first request for maps, in its thread."""
        if self._has_hill_shade or self._plan is None:
            return
        self._has_hill_shade = True
        with suppress(DaemonError, MemoryError):
            relief = relief_of(self._plan)
            if relief is not None and relief.model.height_m.size <= HILL_SHADE_CELLS_MAX:
                self._maps.append(HillShadeMap(relief))
