"""Areas of a query: a box or polygons in degrees, and footprints across the antimeridian.

Geometries lie within 180 degrees west and east; what crosses the antimeridian is in two parts
(RFC 7946, section 3.1.9).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from daemon import DaemonError
from daemon.mission.foreign_files import ForeignFileError, read_regular_file

_POLYGON_MAX_BYTES = 50_000_000
_WGS84 = re.compile(r"(CRS84|EPSG:+4326)$")
"""End of the names of WGS 84 in the member `crs` of GeoJSON of 2008."""


class QueryError(DaemonError):
    """A query that cannot be answered; the message states why."""


def box_area(bbox: Sequence[float]) -> Any:
    """A box; where its west is larger than its east, it crosses the antimeridian.

    Args:
        bbox: west, south, east, north, degrees.

    Raises:
        QueryError: no numbers, beyond the earth, or south above north.
    """
    from shapely import union_all
    from shapely.geometry import box

    west, south, east, north = bbox
    is_on_earth = max(abs(west), abs(east)) <= 180.0 and max(abs(south), abs(north)) <= 90.0
    if not all(math.isfinite(value) for value in bbox) or not is_on_earth:
        raise QueryError(
            f"--bbox {_words(bbox)}: is not on the earth; give west, south, east, north in "
            "degrees, longitudes within 180 and latitudes within 90"
        )
    if south > north:
        raise QueryError(
            f"--bbox {_words(bbox)}: its south is above its north; the order is west, south, "
            "east, north"
        )
    if west <= east:
        return box(west, south, east, north)
    return union_all([box(west, south, 180.0, north), box(-180.0, south, east, north)])


def file_area(path: Path) -> Any:
    """The polygons of a GeoJSON file in one geometry.

    Raises:
        QueryError: it cannot be read, has no valid polygon, or is not in degrees of WGS 84.
    """
    from shapely import GEOSException, union_all
    from shapely.geometry import shape

    try:
        content = json.loads(read_regular_file(path, _POLYGON_MAX_BYTES))
        _refuse_other_crs(path, content.get("crs"))
        features = content.get("features", [content])
        shapes = [shape(one.get("geometry", one)) for one in features]
        found = union_all([one for one in shapes if one.geom_type.endswith("Polygon")])
    except RecursionError as error:
        raise QueryError(f"{path}: is nested too deeply for GeoJSON") from error
    except (ForeignFileError, ValueError, KeyError, AttributeError, TypeError, GEOSException) as e:
        raise QueryError(f"{path}: no polygon in GeoJSON can be read ({e})") from e
    if found.is_empty or not found.is_valid:
        raise QueryError(f"{path}: has no valid polygon in WGS 84")
    west, south, east, north = found.bounds
    if max(abs(west), abs(east)) > 180.0 or max(abs(south), abs(north)) > 90.0:
        raise QueryError(
            f"{path}: reaches from {west:g}, {south:g} to {east:g}, {north:g}, no degrees "
            "of longitude and latitude; convert it: ogr2ogr -t_srs EPSG:4326 OUT.geojson "
            f"{path.name}"
        )
    return found


def footprint_geometry(ring: Sequence[tuple[float, float]]) -> Any:
    """A footprint; two parts where it crosses the antimeridian.

    Args:
        ring: corners (longitude, latitude), degrees.
    """
    from shapely import union_all
    from shapely.affinity import translate
    from shapely.geometry import Polygon, box

    longitudes = [longitude for longitude, _ in ring]
    if max(longitudes) - min(longitudes) <= 180.0:
        return Polygon(ring)
    shifted = Polygon([(lon + 360.0 if lon < 0.0 else lon, lat) for lon, lat in ring])
    western = shifted.intersection(box(0.0, -90.0, 180.0, 90.0))
    eastern = shifted.intersection(box(180.0, -90.0, 540.0, 90.0))
    return union_all([western, translate(eastern, -360.0)])


def _refuse_other_crs(path: Path, crs: Any) -> None:
    if crs is None:
        return
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str) or not _WGS84.search(name):
        raise QueryError(
            f"{path}: its coordinates are in {name or crs}; GeoJSON is in WGS 84. Convert it: "
            f"ogr2ogr -t_srs EPSG:4326 OUT.geojson {path.name}"
        )


def _words(values: Sequence[float]) -> str:
    return " ".join(f"{value:g}" for value in values)
