"""The files of a catalog: GeoParquet, its copy as GeoPackage, and STAC collections.

A catalog is replaced as a whole, so a reader sees the earlier one or the new one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from daemon.mission.store.direct_io import create_file
from daemon.mission.store.durable import sync_file
from daemon.mission.store.publication import published
from daemon.orientation.antimeridian import bbox_of, polygon
from daemon.orientation.stac_items import STAC_VERSION, VIEW
from daemon.postflight.mission_catalog.catalog_areas import footprint_geometry
from daemon.postflight.mission_catalog.exposure_rows import COLUMNS, MissionRows, rings_of

TABLE = "exposures.parquet"
PACKAGE = "exposures.gpkg"
CATALOG = "catalog.json"


def write_catalog(folder: Path, missions: Sequence[MissionRows], sources: Sequence[str]) -> int:
    """Write the catalog of some missions.

    Args:
        folder: of the catalog; replaced as a whole.
        missions: their rows.
        sources: places, kept so that the catalog can be built again.

    Returns:
        Number of exposures.

    Raises:
        OSError: the disk refused; the earlier catalog is kept.
    """
    import geopandas
    import pandas

    rows = [(values, ring) for one in missions for values, ring in one.rows]
    geometry = [None if ring is None else footprint_geometry(ring) for _, ring in rows]
    table = geopandas.GeoDataFrame(
        {name: [values[name] for values, _ in rows] for name in COLUMNS},
        geometry=geopandas.GeoSeries(geometry, crs="EPSG:4326"),
    )
    table["utc"] = pandas.to_datetime(table["utc"], utc=True)
    table["gps_ns"] = table["gps_ns"].astype("Int64")
    with published(folder) as part:
        table.to_parquet(part / TABLE)
        copy = table.assign(gps_ns=table["gps_ns"].astype("string"))
        copy.to_file(part / PACKAGE, layer="exposures", driver="GPKG", engine="pyogrio")
        for name in (TABLE, PACKAGE):
            sync_file(part / name)
        links = []
        for one in missions:
            (part / one.mission_id).mkdir()
            for name, content in _collection(one).items():
                _write(part / one.mission_id / name, content)
            href = f"./{one.mission_id}/collection.json"
            links.append({"rel": "child", "href": href, "type": "application/json"})
        _write(part / CATALOG, _root(links, sources))
    return len(rows)


def read_sources(folder: Path) -> list[str]:
    """Places that a catalog was built from; empty without one."""
    try:
        content = json.loads((folder / CATALOG).read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return []
    sources = content.get("syntopic:sources", []) if isinstance(content, dict) else []
    return [str(source) for source in sources] if isinstance(sources, list) else []


def _root(links: Sequence[Mapping[str, str]], sources: Sequence[str]) -> dict[str, Any]:
    return {
        "type": "Catalog",
        "stac_version": STAC_VERSION,
        "id": "syntopic-missions",
        "description": "Missions of Syntopic.",
        "syntopic:sources": list(sources),
        "links": [{"rel": "root", "href": "./catalog.json", "type": "application/json"}, *links],
    }


def _collection(one: MissionRows) -> dict[str, dict[str, Any]]:
    """The collection of a mission, and one item an exposure that has a time and a footprint."""
    items = {
        f"{values['exposure']:06d}.json": _item(one, values, ring)
        for values, ring in one.rows
        if ring is not None and values["utc"] is not None
    }
    times = sorted(item["properties"]["datetime"] for item in items.values())
    rings = list(rings_of(one))
    collection = {
        "type": "Collection",
        "stac_version": STAC_VERSION,
        "id": one.mission_id,
        "description": f"Exposures of {one.rig_title}, with the navigation of the flight.",
        "license": "other",
        "extent": {
            "spatial": {"bbox": [bbox_of(rings) if rings else [-180.0, -90.0, 180.0, 90.0]]},
            "temporal": {"interval": [[times[0], times[-1]] if times else [None, None]]},
        },
        "links": [
            {"rel": "root", "href": "../catalog.json", "type": "application/json"},
            {"rel": "parent", "href": "../catalog.json", "type": "application/json"},
            *({"rel": "item", "href": f"./{n}", "type": "application/geo+json"} for n in items),
        ],
    }
    return {"collection.json": collection, **items}


def _item(
    one: MissionRows, values: Mapping[str, Any], ring: Sequence[tuple[float, float]]
) -> dict[str, Any]:
    sun = {
        f"view:sun_{name}": values[f"sun_{name}_deg"]
        for name in ("elevation", "azimuth")
        if values[f"sun_{name}_deg"] is not None
    }
    record = f"{one.place}/L0/{values['exposure']:06d}/exposure.json"
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "stac_extensions": [VIEW] if sun else [],
        "id": f"{one.mission_id}-{values['exposure']:06d}",
        "geometry": polygon(ring),
        "bbox": bbox_of([ring]),
        "collection": one.mission_id,
        "properties": {
            "datetime": values["utc"],
            "platform": "aircraft",
            "instruments": [values["rig"]],
            **({} if values["gsd_m"] is None else {"gsd": values["gsd_m"]}),
            **sun,
            **{
                f"syntopic:{name}": values[name]
                for name in ("exposure", "verdict", "line", "strip", "simulated", "record_sha256")
            },
        },
        "links": [
            {"rel": rel, "href": href, "type": "application/json"}
            for rel, href in (
                ("root", "../catalog.json"),
                ("parent", "./collection.json"),
                ("collection", "./collection.json"),
            )
        ],
        "assets": {"record": {"href": record, "type": "application/json", "roles": ["metadata"]}},
    }


def _write(path: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    create_file(path, [text.encode("utf-8")], mode=0o644)
