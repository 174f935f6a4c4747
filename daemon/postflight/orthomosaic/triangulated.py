"""Orientations and object points of a triangulation, and whether they are of this mission."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import sealed_exposures
from daemon.orientation.geodesy import east_north_m
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import FRAME_FILE, LocalFrame
from daemon.postflight.adjustment.csv_tables import read_table

Array = NDArray[np.float64]

EXTERIOR_FILE: Final = "exterior.csv"
POINTS_FILE: Final = "adjusted_points.csv"
REPORT_FILE: Final = "report.json"
NAVIGATION_LIMIT_M: Final = 100.0
"""Positions of photographs err by tens of metres; farther away are those of another mission."""
_CRS_LINE: Final = re.compile(r"^# Adjusted exterior orientation in ([^\s,]+),")
_ANGLES: Final = ("omega_deg", "phi_deg", "kappa_deg")
_PLACE: Final = ("east_m", "north_m", "height_m")
_GEOGRAPHIC: Final = ("latitude_deg", "longitude_deg")
_SAME_PLACE_M: Final = 1.0
_ALSO: Final = (*_GEOGRAPHIC, "sx_m", "sy_m", "sz_m", "so_deg", "sp_deg")


class OrthomosaicError(DaemonError, ValueError):
    """A mission without an orthomosaic; the message states what is missing."""


@dataclass(frozen=True)
class ObjectPoints:
    """Adjusted object points: latitude, longitude, deg, and height above the ellipsoid, m, (n, 3);
    standard deviations of the heights, m, (n,)."""

    geodetic: Array
    sigma_m: Array


def only_triangulation(mission: Mission) -> Path | None:
    """The mission's triangulation; several are refused, for they differ."""
    found = sorted(p.parent for p in mission.export_dir.glob(f"triangulation/*/{EXTERIOR_FILE}"))
    if len(found) > 1:
        raise OrthomosaicError(
            f"{mission.path}: {len(found)} triangulations ({', '.join(p.name for p in found)}); "
            "name one with --triangulation"
        )
    return found[0] if found else None


def adjusted_orientations(
    folder: Path, crs: str | None
) -> tuple[Georeference, Sequence[str], Array, Array]:
    """System, names, places (n, 3) and angles (n, 3) deg of adjusted orientations."""
    file = folder / EXTERIOR_FILE
    table = read_table(file, ("image", *_PLACE, *_ANGLES), (*_ALSO, "sk_deg"))
    with file.open(encoding="utf-8") as text:
        stated = _CRS_LINE.match(text.readline())
    if stated is None:
        raise OrthomosaicError(f"{file}: its first line names no coordinate system")
    if crs is not None and crs != stated[1]:
        raise OrthomosaicError(
            f"{folder} is in {stated[1]}, not in {crs}; leave --crs out, or triangulate in {crs}"
        )
    names = table.names("image")
    place = np.array([table.numbers(c) for c in _PLACE]).T.reshape(-1, 3)
    angles = np.array([table.numbers(c) for c in _ANGLES]).T.reshape(-1, 3)
    if table.problems or not np.isfinite(place).all() or not np.isfinite(angles).all():
        raise OrthomosaicError("; ".join(table.problems) or f"{file}: a cell without a number")
    georeference = Georeference(stated[1])
    stated_deg = np.array([table.numbers(c) for c in _GEOGRAPHIC]).T.reshape(-1, 2)
    away = [
        float(np.hypot(*east_north_m((row[0], row[1]), (found[0], found[1]))))
        for row, found in zip(stated_deg, georeference.geodetic(place), strict=True)
        if np.isfinite(row).all()
    ]
    if max(away, default=0.0) > _SAME_PLACE_M:
        raise OrthomosaicError(
            f"{file}: east and north lie up to {max(away):.0f} m from latitude and longitude of "
            "the same rows; the table was changed. Run syntopic triangulate again"
        )
    return georeference, names, place, angles


def refuse_other_mission(
    mission: Mission, folder: Path, names: Sequence[str], geodetic: Array
) -> tuple[ExposureFailure, ...]:
    """Refuse a triangulation of another mission.

    Args:
        mission: of the orthomosaic.
        folder: of the triangulation.
        names: of its images.
        geodetic: latitude, longitude, deg, and height of its projection centres, (n, 3).

    Returns:
        The sealed exposures with frames that have no orientation in it.

    Raises:
        OrthomosaicError: it names another mission, or lies elsewhere than the navigation recorded.
    """
    of, own = _mission_of(folder), mission.about().get("id")
    if of is not None and own is not None and of != own:
        raise OrthomosaicError(
            f"{folder} is a triangulation of mission {of}, not of {own}; run syntopic triangulate "
            f"{mission.path}, or name another one with --triangulation"
        )
    sealed = sealed_exposures(mission)
    numbers = [int(n) if n.isdecimal() else -1 for n in (one.partition("_")[0] for one in names)]
    away = []
    for number, (latitude, longitude, _) in zip(numbers, geodetic, strict=True):
        record = sealed.results.get(number)
        if record is not None and record.navigation is not None:
            at = (record.navigation.latitude_deg, record.navigation.longitude_deg)
            away.append(float(np.hypot(*east_north_m(at, (float(latitude), float(longitude))))))
    if away and float(np.median(away)) > NAVIGATION_LIMIT_M:
        raise OrthomosaicError(
            f"orientations of {folder} lie {np.median(away):.0f} m from the positions that the "
            f"flight recorded (median; limit {NAVIGATION_LIMIT_M:.0f} m): they are of another "
            "mission or in another system. Name another triangulation with --triangulation"
        )
    cause = f"no orientation in triangulation {folder.name}; run syntopic triangulate again"
    missing = [
        ExposureFailure(number, cause)
        for number, record in sorted(sealed.results.items())
        if number not in set(numbers) and record.state != "lost" and record.frames
    ]
    return (*sealed.failures, *missing)


def object_points(folder: Path) -> ObjectPoints | None:
    """The adjusted object points; None without any.

    Args:
        folder: of the triangulation.
    """
    frame = _frame_of(folder)
    if frame is None or not (folder / POINTS_FILE).exists():
        return None
    axes = ("x_m", "y_m", "z_m")
    table = read_table(folder / POINTS_FILE, ("point", *axes), ("sx_m", "sy_m", "sz_m", "rays"))
    xyz = np.array([table.numbers(c) for c in axes]).T.reshape(-1, 3)
    known = np.isfinite(xyz).all(axis=1)
    sigma = np.asarray(table.numbers("sz_m"), dtype=float).reshape(-1)
    sigma = sigma if len(sigma) == len(xyz) else np.zeros(len(xyz))
    if not known.any():
        return None
    return ObjectPoints(frame.to_geodetic(xyz[known]), np.nan_to_num(sigma[known]))


def _mission_of(folder: Path) -> str | None:
    """The mission that a triangulation names; earlier versions named none."""
    try:
        stated = json.loads((folder / REPORT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    named = stated.get("mission") if isinstance(stated, dict) else None
    return named if isinstance(named, str) else None


def _frame_of(folder: Path) -> LocalFrame | None:
    """The local frame of a triangulation's points."""
    try:
        stated = json.loads((folder / FRAME_FILE).read_text(encoding="utf-8"))
        return LocalFrame(float(stated["latitude_deg"]), float(stated["longitude_deg"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
