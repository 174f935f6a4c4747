"""Layers as an OGC GeoPackage 1.3, with the styles that QGIS loads by itself.

A GeoPackage is an SQLite database, so nothing but the standard library is needed. The table
`layer_styles` is that of QGIS.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from daemon.orientation.antimeridian import Ring, continuous
from daemon.orientation.geodesy import CRS
from daemon.postflight.export.gis_layers import GisFeature, GisLayer, Kind, Places
from daemon.postflight.export.qgis_styles import style_of

APPLICATION_ID = 0x47504B47
USER_VERSION = 10300
WGS84 = 4326
_WKB = {"Point": 1, "LineString": 2, "Polygon": 3}
_ENVELOPE_XY = 1

_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT
);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id)
);
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id)
);
CREATE TABLE layer_styles (
  id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256),
  f_table_schema TEXT(256), f_table_name TEXT(256), f_geometry_column TEXT(256),
  styleName TEXT(30), styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT,
  owner TEXT(30), ui TEXT(30), update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now'))
);
"""


def write_geopackage(
    path: Path, layers: Sequence[GisLayer], *, changed: datetime | None = None
) -> None:
    """Write layers into a new file.

    Args:
        path: of the file; it must not exist. The caller makes it durable.
        layers: each becomes a table with its style.
        changed: time of the last change (default: now), UTC.

    Raises:
        OSError: the file cannot be written.

    Source: OGC 12-128r18, GeoPackage Encoding Standard 1.3.1.
    """
    stamp = f"{changed or datetime.now(UTC):%Y-%m-%dT%H:%M:%S.000Z}"
    try:
        with closing(sqlite3.connect(path)) as database, database:
            database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            database.execute(f"PRAGMA user_version = {USER_VERSION}")
            database.executescript(_TABLES)
            database.executemany(
                "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)",
                [
                    ("Undefined Cartesian", -1, "NONE", -1, "undefined", None),
                    ("Undefined geographic", 0, "NONE", 0, "undefined", None),
                    ("WGS 84", WGS84, "EPSG", WGS84, CRS(WGS84).to_wkt("WKT1_GDAL"), None),
                ],
            )
            database.execute(
                "INSERT INTO gpkg_contents (table_name, data_type, identifier, last_change, "
                "srs_id) VALUES ('layer_styles', 'attributes', 'layer_styles', ?, 0)",
                (stamp,),
            )
            for layer in layers:
                _write_layer(database, layer, stamp)
    except sqlite3.OperationalError as error:
        raise OSError(f"{path}: cannot be written ({error})") from error


def _write_layer(database: sqlite3.Connection, layer: GisLayer, stamp: str) -> None:
    columns = "".join(f', "{name}" {kind}' for name, kind in layer.columns.items())
    database.execute(
        f'CREATE TABLE "{layer.name}" (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, '
        f"geom {layer.kind.upper()}{columns})"
    )
    # Longitudes beyond 180 degrees keep a mission across the antimeridian in one piece.
    places = continuous([place for feature in layer.features for place in feature.places])
    layer = _with_places(layer, places)
    box = _box(tuple(places)) if places else (None, None, None, None)
    database.execute(
        "INSERT INTO gpkg_contents VALUES (?, 'features', ?, ?, ?, ?, ?, ?, ?, ?)",
        (layer.name, layer.title, layer.note, stamp, *box, WGS84),
    )
    has_heights = any(feature.height_m is not None for feature in layer.features)
    database.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, ?, 0)",
        (layer.name, layer.kind.upper(), WGS84, int(has_heights)),
    )
    marks = ", ".join("?" * (1 + len(layer.columns)))
    names = ", ".join(f'"{name}"' for name in ("geom", *layer.columns))
    database.executemany(
        f'INSERT INTO "{layer.name}" ({names}) VALUES ({marks})',
        [(geometry_bytes(layer.kind, one), *one.values) for one in layer.features],
    )
    database.execute(
        "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, "
        "f_geometry_column, styleName, styleQML, styleSLD, useAsDefault, description, owner, ui, "
        "update_time) VALUES ('', '', ?, 'geom', ?, ?, '', 1, ?, '', NULL, ?)",
        (layer.name, layer.name, style_of(layer), layer.title, stamp),
    )


def _with_places(layer: GisLayer, places: Ring) -> GisLayer:
    """The layer with the places of all features in order."""
    rest = iter(places)
    features = (replace(one, places=tuple(islice(rest, len(one.places)))) for one in layer.features)
    return replace(layer, features=tuple(features))


def geometry_bytes(kind: Kind, feature: GisFeature) -> bytes:
    """A geometry as GeoPackage binary, little-endian.

    Args:
        kind: of the geometry.
        feature: its places; a height makes a point with Z.

    Returns:
        Header with envelope (none for a point), then ISO WKB.

    Source: OGC 12-128r18, clause 2.1.3.

    Example:
        >>> geometry_bytes("Point", GisFeature(((16.0, 47.0),), ())).hex()
        '47500001e6100000010100000000000000000030400000000000804740'
    """
    has_envelope = kind != "Point"
    header = struct.pack("<2sBBi", b"GP", 0, 1 | (_ENVELOPE_XY << 1 if has_envelope else 0), WGS84)
    if has_envelope:
        west, south, east, north = _box(feature.places)
        header += struct.pack("<4d", west, east, south, north)
    has_z = feature.height_m is not None and kind == "Point"
    body = struct.pack("<BI", 1, _WKB[kind] + (1000 if has_z else 0))
    places = feature.places
    if kind == "Point":
        longitude, latitude = places[0]
        values = (longitude, latitude, feature.height_m) if has_z else (longitude, latitude)
        return header + body + struct.pack(f"<{len(values)}d", *values)
    if kind == "Polygon":
        places = (*places, places[0])
        body += struct.pack("<I", 1)
    flat = [value for place in places for value in place]
    return header + body + struct.pack(f"<I{len(flat)}d", len(places), *flat)


def _box(places: Places) -> tuple[float, float, float, float]:
    """West, south, east, north."""
    longitudes, latitudes = zip(*places, strict=True)
    return min(longitudes), min(latitudes), max(longitudes), max(latitudes)
