"""The map of a flown mission for its report: lines, footprints with verdicts, and gaps.

Coordinates are pixels of a drawing with north up, in a local plane. It shows what the operator's
page shows: track, and parts of images without data, without a base map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from daemon.mission.layout import Mission
from daemon.planning.exposure_footprints import exposure_footprints
from daemon.planning.flown_track import flown_track
from daemon.planning.image_counts import ExposureFootprint
from daemon.planning.model import LocalPlane, PlannedLine, Point, Specification
from daemon.planning.plan_readers import read_plan
from daemon.planning.reflight_planning import Segment

WIDTH_PX: Final = 900.0
MARGIN_PX: Final = 24.0
SCALE_SHARE: Final = 0.25
"""Longest scale bar, of the width."""


def flight_map(
    mission: Mission, verdicts: Mapping[int, str], segments: Sequence[Segment] = ()
) -> dict[str, Any] | None:
    """Lines, footprints and gaps as paths of a drawing.

    Args:
        mission: the mission, with a plan or without one.
        verdicts: verdict or state of each exposure.
        segments: what must be flown again, with the ground that too few images see.

    Returns:
        Width and height in pixels; `lines` with id and path, `footprints` with number, verdict and
        path, paths of `no_data` (parts of images without valid pixels), `track`, `holes` and
        `segments`, `scale` with length in m and in pixels, and `unplaced`, the exposures without a
        footprint. Lines and footprints determine the extent: a track may leave the drawing. None
        where there is neither line nor footprint.

    Raises:
        DaemonError, RigError, OSError: the mission's plan, rig or configuration cannot be used.
    """
    plan = None if mission.plan_path is None else read_plan(mission.plan_path)
    taken = exposure_footprints(mission, plan.specification if plan else Specification())
    lines = plan.lines if plan else ()
    placed = [one for one in taken if one.corners]
    if not lines and not placed:
        return None
    plane = LocalPlane(lines[0].start if lines else placed[0].corners[0])
    shapes = [*((line.start, line.end) for line in lines), *(one.corners for one in placed)]
    flat = [plane.flat(point) for shape in shapes for point in shape]
    west, east = min(x for x, _ in flat), max(x for x, _ in flat)
    south, north = min(y for _, y in flat), max(y for _, y in flat)
    px_per_m = WIDTH_PX / max(east - west, north - south, 1.0)

    def place(point: Point) -> tuple[float, float]:
        x, y = plane.flat(point)
        return MARGIN_PX + (x - west) * px_per_m, MARGIN_PX + (north - y) * px_per_m

    def path(points: Sequence[Point]) -> str:
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in map(place, points))

    length_m = _round_length_m(SCALE_SHARE * max(east - west, 100.0))
    return {
        "width": math.ceil((east - west) * px_per_m + 2 * MARGIN_PX),
        "height": math.ceil((north - south) * px_per_m + 2 * MARGIN_PX),
        "lines": [_line(line, place, path((line.start, line.end))) for line in lines],
        "footprints": [_footprint(one, verdicts, path(one.corners)) for one in placed],
        "no_data": [path(ring) for one in placed for ring in no_data_rings(one)],
        "track": [path(part) for part in flown_track(mission)],
        "holes": [path(ring) for one in segments for hole in one.holes for ring in hole.rings],
        "segments": [path((one.start, one.end)) for one in segments],
        "scale": {"length_m": length_m, "px": length_m * px_per_m},
        "unplaced": [one.number for one in taken if not one.corners],
    }


def no_data_rings(one: ExposureFootprint) -> list[tuple[Point, ...]]:
    """The parts of an exposure without valid pixels, of any band, on the ground.

    Places are bilinear between the corners of the footprint, as on the operator's page.

    Args:
        one: an exposure with a footprint.

    Returns:
        A ring of four corners for each part; empty where all of the image is valid.
    """
    area = one.area
    if area is None or len(one.corners) != 4:
        return []
    lower_left, lower_right, upper_right, upper_left = one.corners

    def place(column: int, row: int) -> Point:
        right, down = column / area.columns, row / area.rows
        top = _between(upper_left, upper_right, right)
        return _between(top, _between(lower_left, lower_right, right), down)

    boxes = dict.fromkeys(box for gaps in area.gaps.values() for box in gaps)
    return [
        (place(left, top), place(right, top), place(right, bottom), place(left, bottom))
        for left, top, right, bottom in boxes
    ]


def _between(a: Point, b: Point, share: float) -> Point:
    return Point(
        a.latitude_deg + share * (b.latitude_deg - a.latitude_deg),
        a.longitude_deg + share * (b.longitude_deg - a.longitude_deg),
    )


def _line(line: PlannedLine, place: Any, path: str) -> dict[str, Any]:
    x, y = place(line.start)
    return {"id": line.id, "path": path, "x": round(x, 1), "y": round(y, 1)}


def _footprint(one: ExposureFootprint, verdicts: Mapping[int, str], path: str) -> dict[str, Any]:
    return {"number": one.number, "verdict": verdicts.get(one.number, "unknown"), "path": path}


def _round_length_m(maximum_m: float) -> float:
    """The largest 1, 2 or 5 times a power of ten up to a length."""
    power = 10.0 ** math.floor(math.log10(maximum_m))
    return max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= maximum_m)
