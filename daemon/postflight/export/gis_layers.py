"""What a mission is in a GIS: footprints, centres, lines, gaps and the density of tie points.

Layers are in WGS 84, longitude before latitude. How they are written is in
`daemon.postflight.export.geopackage` and `daemon.postflight.export.kmz`.
"""

from __future__ import annotations

import csv
import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from daemon import DaemonError
from daemon.mission.layout import Mission
from daemon.mission.store.level2 import read_report
from daemon.orientation.exterior_orientation import ExteriorOrientation
from daemon.orientation.footprints import footprint, ground_sample_m, utc_text
from daemon.orientation.geodesy import ELLIPSOID
from daemon.orientation.local_frame import FRAME_FILE, LocalFrame
from daemon.orientation.stac_items import sun_position_deg, view_of
from daemon.planning.mission_coverage import advice_of
from daemon.planning.model import Plan, Point
from daemon.planning.reflight_planning import ReflightPlan
from processing.rig import Rig

Kind = Literal["Point", "LineString", "Polygon"]
ColumnType = Literal["TEXT", "INTEGER", "REAL", "BOOLEAN"]
Places = tuple[tuple[float, float], ...]
Value = str | int | float | bool | None

DENSITY_CELLS = 20
"""Cells of the density along the longer side of the block."""
LAYER_NAMES = ("footprints", "centres", "lines", "gaps", "tie_points")


@dataclass(frozen=True)
class GisFeature:
    """A shape and its values. `places` are (longitude, latitude), rings not closed."""

    places: Places
    values: tuple[Value, ...]
    height_m: float | None = None


@dataclass(frozen=True)
class GisLayer:
    """Features of one kind; `note` states why there is none."""

    name: str
    title: str
    kind: Kind
    columns: Mapping[str, ColumnType]
    features: tuple[GisFeature, ...]
    note: str = ""


@dataclass(frozen=True)
class ImagePlace:
    """An image, the ring of its footprint where it has one, and the verdict with its flags."""

    eo: ExteriorOrientation
    ring: Places | None
    verdict: str | None
    flags: tuple[str, ...]


def image_places(
    mission: Mission,
    rig: Rig,
    oriented: Sequence[ExteriorOrientation],
    ground_m: float,
    rings: Mapping[str, Sequence[tuple[float, float]] | None] | None = None,
) -> list[ImagePlace]:
    """The images of a mission: the stitched one of an exposure, or one a head.

    Args:
        mission: for the verdicts.
        rig: the camera.
        oriented: orientations of all cones.
        ground_m: height of level ground above the ellipsoid.
        rings: footprints by image in place of those on level ground.

    Raises:
        RecordError: a quality report is damaged.
    """
    found = []
    for eo in oriented:
        if eo.is_virtual is not (rig.virtual_image is not None):
            continue
        ring = footprint(eo, rig, ground_m) if rings is None else rings.get(eo.name)
        report = read_report(mission.level2(eo.exposure)) or {}
        flags = tuple(dict.fromkeys(f["flag"] for f in report.get("findings", ()) if f.get("flag")))
        places = None if ring is None else tuple(ring)
        found.append(ImagePlace(eo, places, report.get("verdict"), flags))
    return found


def gis_layers(
    mission: Mission, rig: Rig, images: Sequence[ImagePlace], ground_m: float, *, simulated: bool
) -> tuple[GisLayer, ...]:
    """All layers, in the order of `LAYER_NAMES`.

    Args:
        mission: its plan and triangulations.
        rig: the camera.
        images: of the mission.
        ground_m: height of level ground above the ellipsoid.
        simulated: whether the hardware is emulated.
    """
    plan: Plan | None = None
    advice: ReflightPlan | None = None
    note = "the mission was flown without a plan"
    try:
        if (found := advice_of(mission)) is not None:
            plan, advice, note = found
    except DaemonError as error:
        note = f"the plan cannot be used: {error}"
    return (
        _footprints(images, rig, ground_m, simulated=simulated),
        _centres(images, simulated=simulated),
        _lines(images, plan),
        _gaps(advice, note),
        _tie_points(mission),
    )


def _footprints(
    images: Sequence[ImagePlace], rig: Rig, ground_m: float, *, simulated: bool
) -> GisLayer:
    columns: dict[str, ColumnType] = {
        "image": "TEXT", "exposure": "INTEGER", "cone": "TEXT", "line": "TEXT", "strip": "TEXT",
        "utc": "TEXT", "verdict": "TEXT", "flags": "TEXT", "gsd_m": "REAL",
        "off_nadir_deg": "REAL", "sun_elevation_deg": "REAL", "simulated": "BOOLEAN",
    }  # fmt: skip
    features = [
        GisFeature(
            image.ring,
            (
                *(eo.name, eo.exposure, eo.cone, eo.line_id, eo.strip_id, utc_text(eo.gps_ns)),
                *(image.verdict, " ".join(image.flags)),
                round(ground_sample_m(eo, rig, ground_m), 4),
                view_of(eo)["view:off_nadir"],
                round(sun_position_deg(eo)[0], 3),
                simulated,
            ),
        )
        for image in images
        if image.ring is not None
        for eo in (image.eo,)
    ]
    return GisLayer("footprints", "Footprints", "Polygon", columns, tuple(features))


def _centres(images: Sequence[ImagePlace], *, simulated: bool) -> GisLayer:
    columns: dict[str, ColumnType] = {
        "image": "TEXT", "exposure": "INTEGER", "cone": "TEXT", "line": "TEXT", "utc": "TEXT",
        "verdict": "TEXT", "height_m": "REAL", "omega_deg": "REAL", "phi_deg": "REAL",
        "kappa_deg": "REAL", "horizontal_sigma_m": "REAL", "vertical_sigma_m": "REAL",
        "method": "TEXT", "simulated": "BOOLEAN",
    }  # fmt: skip
    features = [
        GisFeature(
            ((eo.longitude_deg, eo.latitude_deg),),
            (
                *(eo.name, eo.exposure, eo.cone, eo.line_id, utc_text(eo.gps_ns), image.verdict),
                round(eo.height_m, 4),
                *(round(angle, 7) for angle in eo.omega_phi_kappa_deg),
                *(eo.horizontal_sigma_m, eo.vertical_sigma_m, eo.method, simulated),
            ),
            eo.height_m,
        )
        for image in images
        for eo in (image.eo,)
    ]
    return GisLayer("centres", "Projection centres", "Point", columns, tuple(features))


def _lines(images: Sequence[ImagePlace], plan: Plan | None) -> GisLayer:
    """Lines as planned, and as flown through the projection centres."""
    columns: dict[str, ColumnType] = {
        "line": "TEXT", "strip": "TEXT", "kind": "TEXT", "exposures": "INTEGER", "length_m": "REAL",
    }  # fmt: skip
    features = []
    for line in plan.lines if plan else ():
        places = _places((line.start, line.end))
        features.append(
            GisFeature(places, (line.id, line.strip, "planned", None, _length_m(places)))
        )
    by_line: dict[str, dict[int, ExteriorOrientation]] = {}
    for image in images:
        by_line.setdefault(image.eo.line_id, {}).setdefault(image.eo.exposure, image.eo)
    for line_id, of_line in by_line.items():
        flown = sorted(of_line.values(), key=lambda eo: eo.gps_ns)
        if not line_id or len(flown) < 2:
            continue
        places = tuple((eo.longitude_deg, eo.latitude_deg) for eo in flown)
        values = (line_id, flown[0].strip_id, "flown", len(flown), _length_m(places))
        features.append(GisFeature(places, values))
    return GisLayer("lines", "Flight lines", "LineString", columns, tuple(features))


def _gaps(advice: ReflightPlan | None, note: str) -> GisLayer:
    columns: dict[str, ColumnType] = {
        "line": "TEXT", "from_m": "REAL", "to_m": "REAL", "area_m2": "REAL", "images": "INTEGER",
        "needed": "INTEGER", "bands": "TEXT", "reasons": "TEXT",
    }  # fmt: skip
    features = [
        GisFeature(
            _places(ring),
            (
                *(segment.line.id, round(segment.from_m, 1), round(segment.to_m, 1)),
                *(round(hole.area_m2, 1), hole.images, hole.needed, " ".join(hole.bands)),
                "; ".join(segment.reasons),
            ),
        )
        for segment in (advice.segments if advice else ())
        for hole in segment.holes
        for ring in hole.rings
    ]
    note = "" if features else note or "nothing must be flown again"
    return GisLayer("gaps", "Gaps", "Polygon", columns, tuple(features), note)


def _tie_points(mission: Mission) -> GisLayer:
    """Adjusted tie points of each triangulation, counted in square cells."""
    columns: dict[str, ColumnType] = {
        "triangulation": "TEXT", "points": "INTEGER", "rays_mean": "REAL", "points_per_ha": "REAL",
    }  # fmt: skip
    features: list[GisFeature] = []
    notes = []
    for folder in sorted((mission.export_dir / "triangulation").glob("*/")):
        try:
            features += _density(folder)
        except (OSError, ValueError, KeyError) as error:
            notes.append(f"{folder.name}: cannot be read ({error})")
    note = "; ".join(notes) if notes or features else "no triangulation: run syntopic triangulate"
    return GisLayer("tie_points", "Tie points", "Polygon", columns, tuple(features), note)


def _density(folder: Path) -> Iterator[GisFeature]:
    frame_json: Mapping[str, Any] = json.loads((folder / FRAME_FILE).read_text("utf-8"))
    frame = LocalFrame(float(frame_json["latitude_deg"]), float(frame_json["longitude_deg"]))
    with (folder / "adjusted_points.csv").open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(line for line in file if not line.startswith("#"))
        found = [
            (float(row["x_m"]), float(row["y_m"]), float(row["z_m"]), int(row["rays"]))
            for row in rows
            if row["point"].startswith("t") and row["point"][1:].isdigit() and int(row["rays"]) > 1
        ]
    if not found:
        return
    points = np.array(found)
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    cell_m = max(float((high - low).max()) / DENSITY_CELLS, 1e-3)
    index = np.minimum((points[:, :2] - low) // cell_m, DENSITY_CELLS - 1).astype(int)
    height_m = float(np.median(points[:, 2]))
    for column, row in sorted(set(map(tuple, index.tolist()))):
        inside = (index == (column, row)).all(axis=1)
        west, south = low + np.array([column, row]) * cell_m
        corners = np.array(
            [
                [x, y, height_m]
                for x, y in (
                    (west, south),
                    (west + cell_m, south),
                    (west + cell_m, south + cell_m),
                    (west, south + cell_m),
                )
            ]
        )
        places = tuple((float(p[1]), float(p[0])) for p in frame.to_geodetic(corners))
        count = int(inside.sum())
        mean = round(float(points[inside, 3].mean()), 2)
        yield GisFeature(places, (folder.name, count, mean, round(count / cell_m**2 * 1e4, 3)))


def _places(points: Sequence[Point]) -> Places:
    return tuple((p.longitude_deg, p.latitude_deg) for p in points)


def _length_m(places: Places) -> float:
    """Along the ellipsoid."""
    return round(
        math.fsum(float(ELLIPSOID.inv(*a, *b)[2]) for a, b in itertools.pairwise(places)), 1
    )
