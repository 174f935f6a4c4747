"""Queries of a catalog by place, time and quality; a selection names missions and exposures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daemon import DaemonError
from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.postflight.mission_catalog.catalog_files import TABLE

_POLYGON_MAX_BYTES = 50_000_000


class QueryError(DaemonError):
    """A query that cannot be answered; the message states why."""


@dataclass(frozen=True)
class CatalogQuery:
    """What is searched; None and empty are no condition. Times are UTC, the end included."""

    polygon: Path | None = None
    bbox: tuple[float, float, float, float] | None = None
    since: datetime | None = None
    until: datetime | None = None
    verdicts: Sequence[str] = ()
    gsd_max_m: float | None = None
    sun_min_deg: float | None = None
    missions: Sequence[str] = ()


def select(folder: Path, query: CatalogQuery) -> list[dict[str, Any]]:
    """Exposures of a catalog that fulfil every condition, by mission and number.

    An exposure without a footprint, time, GSD or sun fulfils no condition on it.

    Raises:
        QueryError: no catalog, or the polygon cannot be used.
    """
    import geopandas

    path = folder / TABLE
    if not path.is_file():
        raise QueryError(f"{folder}: no {TABLE} there; run syntopic catalog build")
    try:
        table = geopandas.read_parquet(path)
    except (OSError, ValueError) as error:
        raise QueryError(f"{path}: cannot be read ({error}); build it again") from error
    if (area := _area(query)) is not None:
        table = table[table.geometry.notna() & table.intersects(area)]
    if query.since is not None:
        table = table[table["utc"] >= query.since]
    if query.until is not None:
        table = table[table["utc"] <= query.until]
    if query.verdicts:
        table = table[table["verdict"].isin(list(query.verdicts))]
    if query.gsd_max_m is not None:
        table = table[table["gsd_m"].astype(float) <= query.gsd_max_m]
    if query.sun_min_deg is not None:
        table = table[table["sun_elevation_deg"].astype(float) >= query.sun_min_deg]
    if query.missions:
        table = table[table["mission"].isin(list(query.missions))]
    table = table.sort_values(["mission", "place", "exposure"])
    return [
        {
            "mission": str(row.mission),
            "place": str(row.place),
            "exposure": int(row.exposure),
            "utc": None if row.utc != row.utc else f"{row.utc:%Y-%m-%dT%H:%M:%S.%fZ}",
            "verdict": row.verdict if isinstance(row.verdict, str) else None,
            "gsd_m": None if row.gsd_m != row.gsd_m else row.gsd_m,
        }
        for row in table.itertuples()
    ]


def process_arguments(selected: Sequence[dict[str, Any]]) -> list[list[str]]:
    """The arguments of `syntopic process` for each mission of a selection."""
    by_place: dict[str, list[str]] = {}
    for one in selected:
        by_place.setdefault(one["place"], []).extend(("--only", str(one["exposure"])))
    return [["syntopic", "process", place, *only] for place, only in by_place.items()]


def parse_time(text: str) -> datetime:
    """An instant in ISO 8601; without a zone it is UTC.

    Raises:
        QueryError: no instant.
    """
    try:
        instant = datetime.fromisoformat(text)
    except ValueError as error:
        raise QueryError(f"{text!r} is no time; write it as 2026-11-21T10:15:00Z") from error
    return instant.replace(tzinfo=UTC) if instant.tzinfo is None else instant.astimezone(UTC)


def _area(query: CatalogQuery) -> Any:
    """The polygon and the box in one geometry; None without both."""
    from shapely import GEOSException, union_all
    from shapely.geometry import box, shape

    area = None if query.bbox is None else box(*query.bbox)
    if query.polygon is None:
        return area
    try:
        content = json.loads(read_regular_file(query.polygon, _POLYGON_MAX_BYTES))
        features = content.get("features", [content])
        shapes = [shape(one.get("geometry", one)) for one in features]
        found = union_all([one for one in shapes if one.geom_type.endswith("Polygon")])
    except (ForeignFileError, ValueError, KeyError, AttributeError, TypeError, GEOSException) as e:
        raise QueryError(f"{query.polygon}: no polygon in GeoJSON can be read ({e})") from e
    if found.is_empty or not found.is_valid:
        raise QueryError(f"{query.polygon}: has no valid polygon in WGS 84")
    return found if area is None else found.intersection(area)
