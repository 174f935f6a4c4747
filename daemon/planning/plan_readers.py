"""Plans of others: GeoJSON, KML, QGroundControl's .plan. Untrusted input: limited in every way.

GeoJSON is ours as well: every LineString is a line, its `id` and `strip` are properties, and a
member `specification` of the collection contains the requirements (docs/how-to/flight/plan.md).
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from daemon import DaemonError
from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.mission.foreign_xml import XmlError, parse_xml
from daemon.planning.model import LocalPlane, Plan, PlannedLine, Point, Specification

PLAN_MAX_BYTES = 20_000_000
LINES_MAX = 20_000
CONTAINERS_MAX = 2_000_000
"""Lists and objects of a JSON plan: each takes a hundred bytes of memory for two in the file."""
ELEMENTS_MAX = 500_000
NAME_MAX_CHARACTERS = 200
WAYPOINT, DIGICAM_CONTROL, TRIGGER_DISTANCE, START_CAPTURE = 16, 203, 206, 2000
BEND_RAD = math.radians(5.0)
"""Exposures named one by one make a line as long as the way does not turn further."""


class PlanError(DaemonError):
    """A plan that cannot be used; the message names file, place and what would be right."""


def read_plan(path: Path) -> Plan:
    """Read a plan by the ending of its name: .geojson, .json, .kml, .plan.

    Raises:
        PlanError: too large, not of its kind, or without a line.
    """
    try:
        data = read_regular_file(path, PLAN_MAX_BYTES)
    except ForeignFileError as error:
        raise PlanError(f"flight plan {error}") from error
    return plan_from_bytes(path, data)


def plan_from_bytes(path: Path, data: bytes) -> Plan:
    """The plan in the bytes of a file; `path` determines its kind and names it in error messages.

    Raises:
        PlanError: not of its kind, or without a line.
    """
    readers = {".geojson": _geojson, ".json": _geojson, ".kml": _kml, ".plan": _qgroundcontrol}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise PlanError(f"{path.name}: a plan ends in {', '.join(readers)}")
    try:
        plan = reader(path.name, data)
    except RecursionError as error:
        raise PlanError(f"{path.name}: nested too deeply to be a plan") from error
    if not plan.lines:
        raise PlanError(
            f"{path.name}: holds no line; a line is a LineString, or a survey's transect"
        )
    if len(plan.lines) > LINES_MAX:
        raise PlanError(f"{path.name}: {len(plan.lines)} lines; {LINES_MAX} at most")
    uses = Counter(line.id for line in plan.lines)
    if twice := sorted(line_id for line_id, count in uses.items() if count > 1):
        raise PlanError(f"{path.name}: several lines are called {', '.join(twice[:5])}")
    return plan


def _geojson(name: str, data: bytes) -> Plan:
    content = _json(name, data)
    if content.get("type") != "FeatureCollection" or not isinstance(content.get("features"), list):
        raise PlanError(f"{name}: no FeatureCollection; a plan is one, with a LineString a line")
    lines: list[PlannedLine] = []
    places: dict[str, list[Point]] = {}
    for index, feature in enumerate(content["features"]):
        where = f"{name}: features[{index}]"
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
        if not isinstance(geometry, dict):
            continue
        properties = feature.get("properties") or {}
        if not isinstance(properties, dict):
            raise PlanError(f"{where}: its properties are no object")
        coordinates = geometry.get("coordinates")
        if geometry.get("type") == "Point" and "line" in properties:
            place = _point(where, coordinates, swapped=True)
            places.setdefault(_name(where, properties["line"]), []).append(place)
        if geometry.get("type") != "LineString":
            continue
        if not isinstance(coordinates, list) or len(coordinates) < 2:
            raise PlanError(f"{where}: a LineString has two places at least")
        points = [_point(where, pair, swapped=True) for pair in coordinates]
        line_id = _name(where, properties.get("id", feature.get("id", len(lines) + 1)))
        distance_m = _distance(where, properties.get("distance_m"))
        strip = _name(where, properties.get("strip", ""))
        lines += _straight(line_id, strip, points, distance_m)
    lines = [_exposed_at(line, places.pop(line.id, [])) for line in lines]
    if places:
        known = ", ".join(line.id for line in lines[:20])
        raise PlanError(
            f"{name}: exposures are planned on line {next(iter(places))!r}; there is {known}"
        )
    return Plan(name, tuple(lines), _specification(name, content.get("specification")))


def _exposed_at(line: PlannedLine, places: Sequence[Point]) -> PlannedLine:
    """The line with exposures at places, in whatever order they are named."""
    if not places:
        return line
    plane = LocalPlane(line.start)
    east, north = plane.flat(line.end)
    length_m = math.hypot(east, north) or 1.0
    at = sorted(
        round((x * east + y * north) / length_m, 3) for x, y in (plane.flat(p) for p in places)
    )
    return replace(line, at_m=tuple(at))


def _distance(where: str, value: Any) -> float | None:
    if value is None:
        return None
    good = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < 1e5
    if not good:
        raise PlanError(f"{where}: distance_m is {str(value)[:60]}; metres between two exposures")
    return float(value)


def _kml(name: str, data: bytes) -> Plan:
    try:
        root = parse_xml(data, elements_max=ELEMENTS_MAX)
    except XmlError as error:
        raise PlanError(f"{name}: {error}") from error
    lines: list[PlannedLine] = []
    for placemark in root.iter():
        if not placemark.tag.endswith("}Placemark") and placemark.tag != "Placemark":
            continue
        title = next((e.text for e in placemark if e.tag.endswith("name") and e.text), "")
        title = _name(f"{name}: a Placemark", title)
        for element in placemark.iter():
            if not element.tag.endswith("LineString"):
                continue
            text = next((e.text for e in element if e.tag.endswith("coordinates")), "") or ""
            where = f"{name}: {title or 'a Placemark'}"
            points = [_point(where, triple.split(","), swapped=True) for triple in text.split()]
            if len(points) < 2:
                raise PlanError(f"{where}: a LineString has two places at least")
            lines += _straight(title or str(len(lines) + 1), "", points)
    return Plan(name, tuple(lines))


def _qgroundcontrol(name: str, data: bytes) -> Plan:
    content = _json(name, data)
    mission = content.get("mission")
    if content.get("fileType") != "Plan" or not isinstance(mission, dict):
        raise PlanError(f"{name}: no QGroundControl plan (fileType, mission)")
    items = mission.get("items") or []
    if not isinstance(items, list):
        raise PlanError(f"{name}: mission.items is no list")
    lines = [
        PlannedLine(str(index), start, end, distance_m=distance_m)
        for index, (start, end, distance_m) in enumerate(_legs(name, items), start=1)
    ]
    for run in _runs_of_photographs(name, items):
        line = PlannedLine(str(len(lines) + 1), run[0], run[-1])
        lines.append(_exposed_at(line, run))
    return Plan(name, tuple(lines))


def _legs(name: str, items: Sequence[Any]) -> Iterator[tuple[Point, Point, float | None]]:
    """Transects of surveys, and legs between waypoints while a trigger distance is set."""
    distance_m, before = None, None
    for index, item in enumerate(items):
        where = f"{name}: mission.items[{index}]"
        if not isinstance(item, dict):
            raise PlanError(f"{where}: no object")
        transects = item.get("TransectStyleComplexItem")
        if isinstance(transects, dict):
            places = transects.get("VisualTransectPoints") or []
            if not isinstance(places, list):
                raise PlanError(f"{where}: VisualTransectPoints is no list")
            points = [_point(where, p) for p in places]
            camera = transects.get("CameraCalc")
            way = camera.get("AdjustedFootprintFrontal") if isinstance(camera, dict) else None
            spacing_m = _distance(where, way)
            for start, end in zip(points[0::2], points[1::2], strict=False):
                yield start, end, spacing_m
            continue
        parameters = _parameters(item)
        if item.get("command") == TRIGGER_DISTANCE and parameters:
            way = parameters[0]
            is_on = isinstance(way, int | float) and not isinstance(way, bool) and way > 0
            distance_m = _distance(where, way) if is_on else None
        elif item.get("command") == WAYPOINT and len(parameters) >= 6:
            here = _point(where, parameters[4:6])
            if distance_m is not None and before is not None:
                yield before, here, distance_m
            before = here


def _runs_of_photographs(name: str, items: Sequence[Any]) -> Iterator[list[Point]]:
    """Waypoints at which one photograph each is taken, as long as they lie in a row."""
    run: list[Point] = []
    here: Point | None = None
    for index, item in enumerate(items):
        parameters = _parameters(item)
        if item.get("command") == WAYPOINT and len(parameters) >= 6:
            here = _point(f"{name}: mission.items[{index}]", parameters[4:6])
            continue
        once = item.get("command") == START_CAPTURE and parameters[2:3] == [1]
        if here is None or not (once or item.get("command") == DIGICAM_CONTROL):
            continue
        if len(run) >= 2 and _bends(run[-2], run[-1], here):
            yield run
            run = []
        run.append(here)
        here = None
    if len(run) >= 2:
        yield run


def _parameters(item: Mapping[str, Any]) -> list[Any]:
    parameters = item.get("params")
    return parameters if isinstance(parameters, list) else []


def _bends(first: Point, second: Point, third: Point) -> bool:
    plane = LocalPlane(second)
    (x0, y0), (x1, y1) = plane.flat(first), plane.flat(third)
    heading_change = math.atan2(y1, x1) - math.atan2(-y0, -x0)
    return abs(math.remainder(heading_change, 2 * math.pi)) > BEND_RAD


def _straight(
    line_id: str, strip: str, points: Sequence[Point], distance_m: float | None = None
) -> list[PlannedLine]:
    """A line for each straight piece; the pieces of a bent one are a, b, c of its strip."""
    if len(points) == 2:
        return [PlannedLine(line_id, points[0], points[1], strip, distance_m)]
    return [
        PlannedLine(f"{line_id}.{i + 1}", points[i], points[i + 1], strip or line_id, distance_m)
        for i in range(len(points) - 1)
    ]


def _name(where: str, value: Any) -> str:
    """Name of a line or strip in a plan: one line of visible text."""
    if isinstance(value, dict | list) or len(text := str(value)) > NAME_MAX_CHARACTERS:
        raise PlanError(
            f"{where}: {str(value)[:60]!r} is no name; {NAME_MAX_CHARACTERS} characters at most"
        )
    text = " ".join(text.split())
    if not text.isprintable():
        raise PlanError(f"{where}: the name {text!r} holds characters that cannot be seen")
    return text


def _point(where: str, pair: Any, *, swapped: bool = False) -> Point:
    """A place from [latitude, longitude], or the other way round where `swapped`."""
    try:
        first, second = float(pair[0]), float(pair[1])
    except (TypeError, ValueError, IndexError, KeyError, OverflowError) as error:
        raise PlanError(f"{where}: {str(pair)[:60]!r} is no place") from error
    latitude, longitude = (second, first) if swapped else (first, second)
    if not (abs(latitude) <= 90 and abs(longitude) <= 180 and math.isfinite(latitude + longitude)):
        raise PlanError(f"{where}: {latitude} N {longitude} E is no place on earth")
    return Point(latitude, longitude)


def _specification(name: str, content: Any) -> Specification:
    if content is None:
        return Specification()
    if not isinstance(content, Mapping):
        raise PlanError(f"{name}: specification is no object")
    limits = {
        "forward_overlap": (0.0, 0.95),
        "sidelap": (0.0, 0.95),
        "overlap_tolerance": (0.0, 0.95),
        "gsd_m": (1e-4, 100.0),
        "tilt_deg": (0.0, 90.0),
        "crab_deg": (0.0, 180.0),
        "sun_deg": (-90.0, 90.0),
        "time_sigma_ns": (0.0, 1e12),
    }
    for key, value in content.items():
        if key not in limits:
            raise PlanError(f"{name}: specification.{str(key)[:60]}: there is {', '.join(limits)}")
        low, high = limits[key]
        good = isinstance(value, int | float) and not isinstance(value, bool)
        if not good or not low <= value <= high:
            raise PlanError(
                f"{name}: specification.{key} is {str(value)[:60]}; {low:g} to {high:g}"
            )
    return Specification(**{str(key): float(value) for key, value in content.items()})


def _json(name: str, data: bytes) -> dict[str, Any]:
    if data.count(b"[") + data.count(b"{") > CONTAINERS_MAX:
        raise PlanError(f"{name}: more than {CONTAINERS_MAX} lists and objects, no plan")
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except ValueError as error:
        raise PlanError(f"{name}: not JSON ({error})") from error
    if not isinstance(content, dict):
        raise PlanError(f"{name}: holds no object")
    return content
