"""A mission as a STAC 1.1 collection: an item an image, with links to its files.

Written to `export/stac/`: `collection.json`, and one folder an item. Links are relative, so that
the mission folder can be moved.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daemon.mission.exposure_batch import ExposureFailure, for_each_exposure
from daemon.mission.layout import Mission, exposure_name
from daemon.mission.store.direct_io import create_file
from daemon.mission.store.durable import sync_directory
from daemon.mission.store.level0 import read_description
from daemon.mission.store.level2 import verdict_of
from daemon.mission.store.output_places import refuse_foreign_files
from daemon.mission.store.publication import published
from daemon.orientation.antimeridian import bbox_of, polygon
from daemon.orientation.exterior_orientation import ExteriorOrientation, sealed_exposures
from daemon.orientation.footprints import footprint
from daemon.orientation.geodesy import GEOGRAPHIC, Transformer
from daemon.orientation.orientation_inputs import OrientationError, read_orientation_inputs
from daemon.orientation.stac_items import (
    FILE,
    PROJECTION,
    STAC_VERSION,
    ItemContext,
    level2_assets,
    stac_item,
)
from daemon.postflight.export.stac_rasters import (
    COG_TYPE,
    GEOTIFF_TYPE,
    file_fields,
    raster_asset,
)
from daemon.products.level3 import level3_root

ORTHOIMAGES = ("export/orthomosaic", "export/ortho")
"""Folders whose GeoTIFFs are orthoimages of the whole mission."""
GIS_ASSETS = {
    "mission.gpkg": ("application/geopackage+sqlite3", "footprints, centres, lines and gaps"),
    "mission.kmz": ("application/vnd.google-earth.kmz", "footprints for viewers of KML"),
}
_TO_ITEM, _TO_MISSION = "..", "../../.."
_FILES = re.compile(r"collection\.json|([^/]+)/\1\.json")


@dataclass(frozen=True)
class StacExport:
    """The collection's file, its number of items, linked COGs, and what failed."""

    collection: Path
    items: int
    cogs: int
    orthoimages: int
    failures: tuple[ExposureFailure, ...]


def export_stac(
    mission: Mission,
    *,
    license_id: str = "other",
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
    progress: Callable[[int], None] = lambda _done: None,
) -> StacExport:
    """Write the collection and its items.

    Args:
        mission: whose images are described.
        license_id: SPDX identifier, or "other".
        crs: coordinate system of the orientation; it does not change the items.
        trajectory_file: post-processed trajectory.
        mount_file: TOML file with the mount.
        progress: called with the number of exposures done.

    Raises:
        OrientationError: no exposure could be oriented.
        AssetError: an orthoimage cannot be read.
        OutputPlaceError: the folder holds something else.
        TrajectoryError, GeoreferenceError: as their modules say.
    """
    read = sealed_exposures(mission)
    exposures = list(read.results.values())
    inputs = read_orientation_inputs(
        mission, exposures, crs=crs, trajectory_file=trajectory_file, mount_file=mount_file
    )
    simulated = any(exposure.simulated for exposure in exposures)
    context = ItemContext(mission.id, inputs.rig, inputs.ground_height_m, simulated)

    def items_of(number: int) -> list[dict[str, Any]]:
        oriented = inputs.oriented([read.results[number]])
        return list(_items(mission, context, oriented))

    done = for_each_exposure(read.results, items_of, progress)
    items = [item for number in sorted(done.results) for item in done.results[number]]
    failures = (*read.failures, *done.failures)
    if not items:
        causes = "; ".join(dict.fromkeys(failure.cause for failure in failures))
        raise OrientationError(
            f"{mission.path}: no image has a footprint. Give --trajectory with one that has the "
            f"attitude{f' ({causes})' if causes else ''}"
        )
    orthoimages = [_orthoimage(mission, path, items) for path in _orthoimage_files(mission)]
    every = [*items, *orthoimages]
    collection = _collection(mission, context, every, license_id)
    folder = mission.export_dir / "stac"
    refuse_foreign_files(folder, _FILES)
    with published(folder) as part:
        _write(part / "collection.json", collection)
        for item in every:
            (part / item["id"]).mkdir()
            _write(part / item["id"] / f"{item['id']}.json", item)
            sync_directory(part / item["id"])
    cogs = sum(asset["type"] == COG_TYPE for item in items for asset in item["assets"].values())
    return StacExport(folder / "collection.json", len(items), cogs, len(orthoimages), failures)


def _items(
    mission: Mission, context: ItemContext, oriented: Sequence[ExteriorOrientation]
) -> Iterator[dict[str, Any]]:
    """Items of the images of an exposure: the stitched one, or one a head."""
    for eo in oriented:
        if eo.is_virtual is not (context.rig.virtual_image is not None):
            continue
        ring = footprint(eo, context.rig, context.ground_m)
        if ring is None:
            continue
        folder = mission.level2(eo.exposure)
        assets = level2_assets(folder, _TO_MISSION) if eo.is_virtual else {}
        assets |= _head_assets(folder, eo)
        assets |= _cog_assets(mission, eo)
        item = stac_item(
            context, eo, ring, assets, verdict=verdict_of(folder), collection=mission.id,
            links=_LINKS,
        )  # fmt: skip
        yield item


_LINKS = tuple(
    {"rel": rel, "href": f"{_TO_ITEM}/collection.json", "type": "application/json"}
    for rel in ("root", "parent", "collection")
)


def _head_assets(folder: Path, eo: ExteriorOrientation) -> dict[str, Any]:
    path = folder / f"{eo.cone}.tif"
    if eo.is_virtual or not path.exists():
        return {}
    asset = {
        "href": f"{_TO_MISSION}/L2/{folder.name}/{path.name}",
        "type": "image/tiff",
        "title": f"image of head {eo.cone}",
        "roles": ["data"],
        "file:size": path.stat().st_size,
    }
    return {"image": asset}


def _cog_assets(mission: Mission, eo: ExteriorOrientation) -> dict[str, Any]:
    """COGs that `export pictures` wrote for an image, with the bands of their source."""
    assets = {}
    sources = [("", mission.level2(eo.exposure) / f"{eo.cone}.tif")]
    if eo.is_virtual:
        folders = mission.level2(eo.exposure), level3_root(mission) / exposure_name(eo.exposure)
        sources = [(f"_{p.stem}", p) for folder in folders for p in sorted(folder.glob("*.tif"))]
    for suffix, source in sources:
        path = mission.export_dir / "cog" / suffix[1:] / f"{eo.name}{suffix}.tif"
        if not path.exists() or not source.exists():
            continue
        bands = [str(band) for band in read_description(source).get("bands", ("pan",))]
        assets[f"cog{suffix}".replace("-", "_")] = raster_asset(
            path,
            f"{_TO_MISSION}/{path.relative_to(mission.path).as_posix()}",
            media_type=COG_TYPE,
            title=f"{', '.join(bands)}: perspective image with control points",
            roles=["data"],
            bands=bands,
        )
    return assets


def _orthoimage_files(mission: Mission) -> list[Path]:
    return [p for name in ORTHOIMAGES for p in sorted((mission.path / name).glob("*.tif"))]


def _orthoimage(mission: Mission, path: Path, items: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """An orthoimage as an item, from its own coordinate system and transform."""
    from tifffile import TiffFile

    with TiffFile(path) as tiff:
        count = int(tiff.pages[0].samplesperpixel)
    href = f"{_TO_MISSION}/{path.relative_to(mission.path).as_posix()}"
    asset = raster_asset(
        path, href, media_type=GEOTIFF_TYPE, title="orthoimage", roles=["data"],
        bands=[f"band{k}" for k in range(1, count + 1)],
    )  # fmt: skip
    if "proj:transform" not in asset or "proj:code" not in asset:
        raise OrientationError(
            f"{path}: has no EPSG code or no transform, so it is no orthoimage; move it away"
        )
    west, south, east, north = asset["proj:bbox"]
    to_wgs84 = Transformer.from_crs(asset["proj:code"], GEOGRAPHIC, always_xy=True)
    ring = [
        (float(x), float(y))
        for x, y in (
            to_wgs84.transform(*corner)
            for corner in ((west, south), (east, south), (east, north), (west, north))
        )
    ]
    times = sorted(item["properties"]["datetime"] for item in items)
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        # The schema of view refuses an item without a view; an orthoimage has none.
        "stac_extensions": [PROJECTION, FILE],
        "id": f"{mission.id}-{path.stem}",
        "geometry": polygon(ring),
        "bbox": bbox_of([ring]),
        "properties": {
            "datetime": None,
            "start_datetime": times[0],
            "end_datetime": times[-1],
            "gsd": asset["proj:transform"][0],
            "mission": mission.id,
            **{key: asset[key] for key in ("proj:code", "proj:bbox")},
        },
        "links": list(_LINKS),
        "assets": {"orthoimage": asset},
        "collection": mission.id,
    }


def _collection(
    mission: Mission, context: ItemContext, items: Sequence[Mapping[str, Any]], license_id: str
) -> dict[str, Any]:
    properties = [item["properties"] for item in items]
    times = sorted(p.get("datetime") or p["start_datetime"] for p in properties)
    gsd = [float(p["gsd"]) for p in properties]
    boxes = [item["bbox"] for item in items]
    bands = {
        band["name"]: band
        for item in items
        for asset in item["assets"].values()
        for band in asset.get("bands", ())
    }
    rig = context.rig
    simulated = "Simulated. " if context.simulated else ""
    uncalibrated = "" if rig.is_calibrated else "Uncalibrated rig: its geometry is nominal. "
    gis = mission.export_dir / "gis"
    assets = {
        name.rpartition(".")[2]: {
            "href": f"../gis/{name}",
            "type": media_type,
            "title": title,
            "roles": ["metadata"],
            **file_fields(gis / name),
        }
        for name, (media_type, title) in GIS_ASSETS.items()
        if (gis / name).exists()
    }
    codes = sorted(
        {
            str(asset["proj:code"])
            for item in items
            for asset in item["assets"].values()
            if "proj:code" in asset
        }
    )
    links = [
        {"rel": "root", "href": "./collection.json", "type": "application/json"},
        *(
            {"rel": "item", "href": f"./{i['id']}/{i['id']}.json", "type": "application/geo+json"}
            for i in items
        ),
    ]
    return {
        "type": "Collection",
        "stac_version": STAC_VERSION,
        "stac_extensions": [PROJECTION, *([FILE] if assets else [])],
        "id": mission.id,
        "title": f"Mission {mission.id}",
        "description": f"{simulated}{uncalibrated}Aerial images of {rig.title or rig.name}.",
        "license": license_id,
        "extent": {
            "spatial": {
                "bbox": [bbox_of([((w, s), (e, s), (e, n), (w, n)) for w, s, e, n in boxes])]
            },
            "temporal": {"interval": [[times[0], times[-1]]]},
        },
        "summaries": {
            "gsd": {"minimum": min(gsd), "maximum": max(gsd)},
            "platform": ["aircraft"],
            "instruments": [rig.name],
            **({"proj:code": codes} if codes else {}),
            **({"bands": list(bands.values())} if bands else {}),
        },
        "links": links,
        "assets": assets,
    }  # fmt: skip


def _write(path: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    create_file(path, [text.encode("utf-8")], mode=0o644)
