"""Images as STAC 1.1 items: time, footprint, bands, view, sun and files.

Extensions: projection, view and file. The images are perspective, so no asset has a
`proj:transform`; orthoimages have one (`daemon.postflight.export.stac_rasters`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daemon.mission.layout import Mission
from daemon.orientation.antimeridian import Ring, bbox_of, mean_longitude, polygon
from daemon.orientation.exterior_orientation import ExteriorOrientation
from daemon.orientation.footprints import footprint, ground_sample_m, utc_text
from drivers.timescales.gps_time import SECOND_NS
from drivers.timescales.leap_seconds import leap_seconds_at
from processing.geometry.sun import sun_azimuth_rad, sun_elevation_rad
from processing.rig import Rig

STAC_VERSION = "1.1.0"
PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
VIEW = "https://stac-extensions.github.io/view/v1.0.0/schema.json"
FILE = "https://stac-extensions.github.io/file/v2.1.0/schema.json"
EXTENSIONS = (PROJECTION, VIEW, FILE)

GPS_EPOCH_UNIX_S = 315_964_800
_NADIR_DEG = 1e-6
"""Below this tilt the direction of the axis on the ground is not defined."""

LEVEL2_ASSETS: Mapping[str, tuple[str, str, Sequence[str]]] = {
    "pan.tif": ("image/tiff", "panchromatic", ("data",)),
    "rgbn.tif": ("image/tiff", "colour", ("data",)),
    "quicklook.jpg": ("image/jpeg", "quick look", ("thumbnail",)),
    "quality.json": ("application/json", "quality report", ("metadata",)),
}


@dataclass(frozen=True)
class ItemContext:
    """What the items of a mission have in common; `ground_m` is above the ellipsoid."""

    mission_id: str
    rig: Rig
    ground_m: float
    simulated: bool


def stac_item(
    context: ItemContext,
    eo: ExteriorOrientation,
    ring: Ring,
    assets: Mapping[str, Mapping[str, Any]],
    *,
    verdict: str | None = None,
    links: Sequence[Mapping[str, str]] = (),
    collection: str | None = None,
) -> dict[str, Any]:
    """One image as a STAC item.

    Args:
        context: of the mission.
        eo: orientation of the image.
        ring: footprint, (longitude, latitude) in degrees, counter-clockwise, not closed.
        assets: by key, as STAC has them.
        verdict: of the exposure, where it is known.
        links: as STAC has them.
        collection: id of the collection that the item belongs to.

    Returns:
        The item as an object of JSON types.

    Source: STAC 1.1.0 item specification; extensions projection 2.0.0, view 1.0.0, file 2.1.0.
    """
    sun_elevation_deg, sun_azimuth = sun_position_deg(eo)
    properties: dict[str, Any] = {
        "datetime": utc_text(eo.gps_ns),
        "platform": "aircraft",
        "instruments": [context.rig.name],
        "mission": context.mission_id,
        "gsd": ground_sample_m(eo, context.rig, context.ground_m),
        # Perspective images lie in no coordinate system; files with control points name theirs.
        "proj:code": None,
        "proj:centroid": {
            "lat": round(sum(latitude for _, latitude in ring) / len(ring), 9),
            "lon": round(mean_longitude([longitude for longitude, _ in ring]), 9),
        },
        **view_of(eo),
        "view:sun_elevation": round(sun_elevation_deg, 3),
        "view:sun_azimuth": round(sun_azimuth, 3),
        "syntopic:exposure": eo.exposure,
        "syntopic:cone": eo.cone,
        "syntopic:line": eo.line_id,
        "syntopic:strip": eo.strip_id,
        "syntopic:verdict": verdict,
        "syntopic:simulated": context.simulated,
        "syntopic:calibrated": context.rig.is_calibrated,
    }
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "stac_extensions": list(EXTENSIONS),
        "id": f"{context.mission_id}-{eo.name}",
        "geometry": polygon(ring),
        "bbox": bbox_of([ring]),
        "properties": properties,
        "links": list(links),
        "assets": {key: dict(asset) for key, asset in assets.items()},
        **({} if collection is None else {"collection": collection}),
    }


def item_collection(
    mission: Mission,
    context: ItemContext,
    oriented: Sequence[ExteriorOrientation],
    *,
    verdicts: Mapping[int, str],
    base_href: str,
) -> dict[str, Any]:
    """Items of the stitched images there are, with links to their files, in one object.

    Args:
        mission: whose files are linked.
        context: of the mission.
        oriented: orientations; those of single heads are left out.
        verdicts: by number of the exposure.
        base_href: from the collection's folder to the mission folder.

    Returns:
        An ItemCollection as an object of JSON types.
    """
    items = []
    for eo in oriented:
        ring = footprint(eo, context.rig, context.ground_m)
        if not eo.is_virtual or ring is None:
            continue
        assets = level2_assets(mission.level2(eo.exposure), base_href)
        items.append(stac_item(context, eo, ring, assets, verdict=verdicts.get(eo.exposure)))
    return {"type": "FeatureCollection", "features": items}


def level2_assets(folder: Path, base_href: str) -> dict[str, dict[str, Any]]:
    """Files of a Level-2 folder, with their sizes.

    Args:
        folder: `L2/<exposure>`.
        base_href: from the item's folder to the mission folder.
    """
    return {
        name.split(".")[0]: {
            "href": f"{base_href}/L2/{folder.name}/{name}",
            "type": kind,
            "title": title,
            "roles": list(roles),
            "file:size": (folder / name).stat().st_size,
        }
        for name, (kind, title, roles) in LEVEL2_ASSETS.items()
        if (folder / name).exists()
    }


def view_of(eo: ExteriorOrientation) -> dict[str, float]:
    """`view:off_nadir` and, where the axis is tilted, `view:azimuth`, degrees.

    Example:
        Forward is north here, and the axis is tilted by 3 degrees to the east.

        >>> from types import SimpleNamespace
        >>> tilt = math.radians(3.0)
        >>> east = np.array([[math.cos(tilt), 0, -math.sin(tilt)], [0, 1, 0],
        ...                  [math.sin(tilt), 0, math.cos(tilt)]])
        >>> view_of(SimpleNamespace(enu_from_camera=east))
        {'view:off_nadir': 3.0, 'view:azimuth': 90.0}
    """
    axis = -np.asarray(eo.enu_from_camera)[:, 2]
    off_nadir_deg = math.degrees(math.acos(max(-1.0, min(1.0, -float(axis[2])))))
    # The field of the extension ends at 90 degrees; an axis above the horizon sees no ground.
    view = {"view:off_nadir": round(min(off_nadir_deg, 90.0), 4)}
    if off_nadir_deg > _NADIR_DEG:
        azimuth_deg = math.degrees(math.atan2(float(axis[0]), float(axis[1]))) % 360.0
        view["view:azimuth"] = round(azimuth_deg, 4) % 360.0
    return view


def sun_position_deg(eo: ExteriorOrientation) -> tuple[float, float]:
    """Elevation of the sun, and its azimuth clockwise from true north, at an image, degrees."""
    return sun_angles_deg(eo.gps_ns, eo.latitude_deg, eo.longitude_deg)


def sun_angles_deg(gps_ns: int, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """Elevation of the sun, and its azimuth clockwise from true north, degrees."""
    unix_s = gps_ns / SECOND_NS - leap_seconds_at(gps_ns) + GPS_EPOCH_UNIX_S
    place = math.radians(latitude_deg), math.radians(longitude_deg)
    return (
        math.degrees(sun_elevation_rad(unix_s, *place)),
        math.degrees(sun_azimuth_rad(unix_s, *place)),
    )
