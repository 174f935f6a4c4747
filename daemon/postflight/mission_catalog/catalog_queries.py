"""Queries of a catalog by place, time and quality; a selection names missions and exposures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, get_args

from daemon.mission.store.level2 import Verdict
from daemon.postflight.mission_catalog.catalog_areas import QueryError, box_area, file_area
from daemon.postflight.mission_catalog.catalog_files import TABLE

VERDICTS: Final = get_args(Verdict)
_NAMES_SHOWN: Final = 10


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
        QueryError: no catalog, or a condition that no exposure can fulfil.
    """
    import geopandas

    _check(query)
    area = _area(query)

    path = folder / TABLE
    if not path.is_file():
        raise QueryError(f"{folder}: no {TABLE} there; run syntopic catalog build")
    try:
        table = geopandas.read_parquet(path)
    except (OSError, ValueError) as error:
        raise QueryError(f"{path}: cannot be read ({error}); build it again") from error
    known = sorted(set(table["mission"]))
    if unknown := [name for name in query.missions if name not in known]:
        more = ", ..." if len(known) > _NAMES_SHOWN else ""
        raise QueryError(
            f"{folder}: has no mission {unknown[0]}; it has {', '.join(known[:_NAMES_SHOWN])}{more}"
        )
    if area is not None:
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


def _check(query: CatalogQuery) -> None:
    """Refuse conditions that no exposure can fulfil.

    Raises:
        QueryError: there is one.
    """
    for verdict in query.verdicts:
        if verdict not in VERDICTS:
            raise QueryError(f"--verdict {verdict}: there is none; give {', '.join(VERDICTS)}")
    if query.since is not None and query.until is not None and query.since > query.until:
        raise QueryError(
            f"--since {query.since:%Y-%m-%dT%H:%M:%SZ} is after --until "
            f"{query.until:%Y-%m-%dT%H:%M:%SZ}"
        )
    if query.gsd_max_m is not None and not (query.gsd_max_m > 0 and math.isfinite(query.gsd_max_m)):
        raise QueryError(f"--gsd-max {query.gsd_max_m:g}: a GSD is a positive number of metres")
    if query.sun_min_deg is not None and not abs(query.sun_min_deg) <= 90.0:
        raise QueryError(
            f"--sun-min {query.sun_min_deg:g}: give an elevation from -90 to 90 degrees"
        )


def _area(query: CatalogQuery) -> Any:
    """The polygon and the box in one geometry; None without both."""
    box = None if query.bbox is None else box_area(query.bbox)
    polygons = None if query.polygon is None else file_area(query.polygon)
    if box is None or polygons is None:
        return polygons if box is None else box
    both = box.intersection(polygons)
    if both.is_empty:
        raise QueryError(f"--bbox and {query.polygon} have no area in common")
    return both
