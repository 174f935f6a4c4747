"""Seams as a GeoPackage: one layer of areas, by image, and one of the lines between them.

Source: OGC 12-128r18, GeoPackage Encoding Standard 1.3: clauses 1.1.2, 1.1.3, 2.1; geometry as ISO
well-known binary behind the header of clause 2.1.3.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.store.durable import sync_file
from daemon.orientation.georeference import Georeference
from processing.image.orthoimage.ground_grid import GroundGrid

Array = NDArray[Any]
Segment = tuple[float, float, float, float]

AREAS: Final = "seam_areas"
LINES: Final = "seam_lines"
_APPLICATION_ID: Final = 0x47504B47
_USER_VERSION: Final = 10300
_CHANGED: Final = "1980-01-06T00:00:00.000Z"
"""The same inputs give the same bytes: the time of a run is in no file."""
_SRS_FROM: Final = 100_000
"""Number of a coordinate system without a code of EPSG."""

_TABLES: Final = f"""
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL,
  definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
  identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL,
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL,
  m TINYINT NOT NULL, CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
CREATE TABLE {AREAS} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom MULTIPOLYGON,
  image TEXT NOT NULL, exposure INTEGER NOT NULL);
CREATE TABLE {LINES} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom MULTILINESTRING,
  image_a TEXT NOT NULL, image_b TEXT NOT NULL);
"""


def write_seams(
    path: Path,
    owner: Array,
    grid: GroundGrid,
    images: Sequence[tuple[str, int]],
    georeference: Georeference,
) -> int:
    """Write the areas taken from each image, and the lines between them.

    Args:
        path: a new file.
        owner: (rows, columns), index of the image of each cell, -1: none.
        grid: of the cells.
        images: name and exposure of each image.
        georeference: coordinate system of the grid.

    Returns:
        How many seam lines there are.

    Raises:
        OSError: the disk refused.
    """
    areas = _areas(owner, grid)
    lines = _lines(owner, grid)
    half = grid.gsd_m / 2.0
    west, north = grid.east_m - half, grid.north_m + half
    box = (
        west, north - grid.height_px * grid.gsd_m, west + grid.width_px * grid.gsd_m, north,
    )  # fmt: skip
    srs = georeference.crs
    srs = srs.sub_crs_list[0] if srs.is_compound else srs
    code = srs.to_epsg()
    number = code or _SRS_FROM
    connection = sqlite3.connect(path)
    try:
        connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {_USER_VERSION}")
        connection.executescript(_TABLES)
        connection.executemany(
            "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)",
            [
                ("Undefined Cartesian", -1, "NONE", -1, "undefined", None),
                ("Undefined geographic", 0, "NONE", 0, "undefined", None),
                (
                    srs.name,
                    number,
                    "EPSG" if code else "NONE",
                    number,
                    srs.to_wkt("WKT1_GDAL"),
                    None,
                ),
            ],
        )
        for table, kind in ((AREAS, "MULTIPOLYGON"), (LINES, "MULTILINESTRING")):
            connection.execute(
                "INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', ?, ?, ?, ?, ?, ?)",
                (table, table, _CHANGED, *box, number),
            )
            connection.execute(
                "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)",
                (table, kind, number),
            )
        connection.executemany(
            f"INSERT INTO {AREAS} (geom, image, exposure) VALUES (?, ?, ?)",
            [(_geometry(_multipolygon(rings), number), *images[k]) for k, rings in areas],
        )
        connection.executemany(
            f"INSERT INTO {LINES} (geom, image_a, image_b) VALUES (?, ?, ?)",
            [
                (_geometry(_multiline(parts), number), images[a][0], images[b][0])
                for (a, b), parts in lines
            ],
        )
        connection.commit()
    finally:
        connection.close()
    sync_file(path)
    return len(lines)


def _areas(owner: Array, grid: GroundGrid) -> list[tuple[int, list[list[list[list[float]]]]]]:
    """Polygons, each a list of rings, by image."""
    from rasterio.features import shapes
    from rasterio.transform import Affine

    half = grid.gsd_m / 2.0
    place = Affine(grid.gsd_m, 0.0, grid.east_m - half, 0.0, -grid.gsd_m, grid.north_m + half)
    found: dict[int, list[list[list[list[float]]]]] = {}
    for shape, value in shapes(owner.astype(np.int32), mask=owner >= 0, transform=place):
        found.setdefault(int(value), []).append([list(map(list, r)) for r in shape["coordinates"]])
    return sorted(found.items())


def _lines(owner: Array, grid: GroundGrid) -> list[tuple[tuple[int, int], list[Segment]]]:
    """Straight pieces of the border between every two images."""
    half = grid.gsd_m / 2.0
    west, north, step = grid.east_m - half, grid.north_m + half, grid.gsd_m
    found: dict[tuple[int, int], list[Segment]] = {}
    for turned in (False, True):
        cells = owner.T if turned else owner
        a, b = cells[:, :-1], cells[:, 1:]
        for row, column in zip(*np.nonzero((a != b) & (a >= 0) & (b >= 0)), strict=True):
            pair = sorted((int(a[row, column]), int(b[row, column])))
            across, along = float(column + 1), float(row)
            if turned:
                piece = (west + along * step, north - across * step,
                         west + (along + 1.0) * step, north - across * step)  # fmt: skip
            else:
                piece = (west + across * step, north - along * step,
                         west + across * step, north - (along + 1.0) * step)  # fmt: skip
            found.setdefault((pair[0], pair[1]), []).append(piece)
    return sorted((pair, _joined(pieces)) for pair, pieces in found.items())


def _joined(pieces: Sequence[Segment]) -> list[Segment]:
    """Pieces that continue one another in a straight line as one."""
    joined: list[Segment] = []
    for piece in sorted(pieces, key=_along):
        last = joined[-1] if joined else None
        if (
            last is not None
            and last[2:] == piece[:2]
            and ((last[0] == last[2]) == (piece[0] == piece[2]))
        ):
            joined[-1] = (*last[:2], *piece[2:])
        else:
            joined.append(piece)
    return joined


def _along(piece: Segment) -> tuple[bool, float, float]:
    """Upright pieces from north to south, then level ones from west to east, line by line."""
    if piece[0] == piece[2]:
        return False, piece[0], -piece[1]
    return True, -piece[1], piece[0]


def _geometry(wkb: bytes, srs: int) -> bytes:
    """Header of clause 2.1.3: little endian, no envelope."""
    return struct.pack("<2sBBi", b"GP", 0, 1, srs) + wkb


def _multipolygon(polygons: Sequence[Sequence[Sequence[Sequence[float]]]]) -> bytes:
    parts = [struct.pack("<BII", 1, 6, len(polygons))]
    for rings in polygons:
        parts.append(struct.pack("<BII", 1, 3, len(rings)))
        for ring in rings:
            parts.append(struct.pack("<I", len(ring)))
            parts.append(np.asarray(ring, "<f8").tobytes())
    return b"".join(parts)


def _multiline(pieces: Sequence[Segment]) -> bytes:
    parts = [struct.pack("<BII", 1, 5, len(pieces))]
    parts.extend(struct.pack("<BII4d", 1, 2, 2, *piece) for piece in pieces)
    return b"".join(parts)
