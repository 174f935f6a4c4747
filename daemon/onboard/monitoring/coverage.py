"""The plan of the current mission, and its coverage by images.

Exposures are collected from the state as they arrive, so that those it has dropped still count.
Re-flights are computed by `daemon.planning.reflight_planning`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from daemon import DaemonError
from daemon.configuration.model import PlanSection
from daemon.mission.layout import Mission
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.orientation.exterior_orientation import mount_of
from daemon.planning.exposure_footprints import NO_FOOTPRINT, area_and_cause, rejection_of
from daemon.planning.image_counts import ExposureFootprint
from daemon.planning.image_size import image_on_ground_m
from daemon.planning.model import LocalPlane, Plan, PlannedLine, Point
from daemon.planning.plan_readers import read_plan
from daemon.planning.reflight_files import hole_json
from daemon.planning.reflight_planning import LineReflights, ReflightPlan, reflights
from daemon.planning.relief import TerrainRelief, relief_or_reason
from daemon.planning.steering import places_m
from processing.rig import Rig, RigError, load_rig


@dataclass(frozen=True)
class _PlanContext:
    rig: Rig
    plan: Plan
    along_m: float
    across_m: float
    height_m: float
    ground_height_m: float
    relief: TerrainRelief | None
    flat_ground_reason: str
    lines: dict[str, LineReflights] = field(default_factory=dict)

    @property
    def base_m(self) -> float:
        return self.along_m * (1.0 - self.plan.specification.forward_overlap)


class Coverage:
    """The plan and its coverage; both are empty without a plan.

    Args:
        state: the state of the flight.
        configured: the plan section of the service, with the path of the height model; without
            it the mission's names are used, relative to its folder.
    """

    def __init__(self, state: FlightState, configured: PlanSection | None = None) -> None:
        self._state = state
        self._configured = configured
        self._mission: str | None = None
        self._context: _PlanContext | None = None
        self._taken: dict[int, tuple[str, ExposureFootprint]] = {}
        self._cursor = 0

    def update(self) -> None:
        """Add new exposures; must be called often, since the state drops old ones."""
        if self._state.mission_path != self._mission:
            self._mission = self._state.mission_path
            self._context = (
                None
                if self._mission is None
                else _load_context(Path(self._mission), self._configured)
            )
            self._taken.clear()
            self._cursor = 0
        if self._context is None:
            return
        for one in self._state.changed("exposures", self._cursor):
            self._cursor = one["sequence"]
            if one.get("step") not in ("triggered", "stored"):
                taken = _taken(one, self._context)
                self._taken[one["number"]] = (str(one.get("line") or ""), taken)

    def plan_json(self) -> dict[str, Any] | None:
        """Lines with their exposure positions, for the page."""
        self.update()
        if self._context is None:
            return None
        plan = self._context.plan
        return {
            "name": plan.name,
            "lines": [_line_json(line, self._context) for line in plan.lines],
            "specification": vars(plan.specification),
            "retakes": self._state.retakes(),
        }

    def station_m(self, number: int) -> tuple[str, float] | None:
        """The planned line of an exposure and its station on it, m from the start.

        Args:
            number: the exposure.

        Returns:
            Id of the line that it was made for, or else of the nearest one; None without a plan or
            without a position.
        """
        self.update()
        exposure = self._state.exposure(number)
        if self._context is None or exposure is None:
            return None
        place = exposure.get("place") or {}
        if place.get("latitude_deg") is None or place.get("longitude_deg") is None:
            return None
        at = Point(place["latitude_deg"], place["longitude_deg"])
        lines = self._context.plan.lines
        own = [line for line in lines if line.id == exposure.get("line")]
        stations = [(line.id, *_station_of(line, at)) for line in own or lines]
        nearest = min(stations, key=lambda one: abs(one[2]))
        return nearest[0], nearest[1]

    def advice_task(self) -> Callable[[], ReflightPlan] | None:
        """The computation of remaining and repeated segments; it may run in any thread."""
        self.update()
        context = self._context
        if context is None:
            return None
        taken = [one for _, one in self._taken.values()]
        return partial(
            reflights,
            context.plan,
            taken,
            image_along_m=context.along_m,
            image_across_m=context.across_m,
            relief=context.relief,
            unflown=self._remaining(context),
            known=context.lines,
        )

    def notes(self) -> list[str]:
        """Assumptions of the advice."""
        context = self._context
        return (
            [context.flat_ground_reason]
            if context is not None and context.flat_ground_reason
            else []
        )

    def _remaining(
        self, context: _PlanContext, *, of_left_lines: bool = False
    ) -> dict[str, tuple[float, float]]:
        """Remaining segment of each line: all of it, or the part ahead on the current line.

        With `of_left_lines` also the rest of a line that was broken off before another one began;
        for re-flights that rest is a hole.
        """
        flown: dict[str, list[ExposureFootprint]] = {}
        latest = ""
        for latest, taken in (self._taken[number] for number in sorted(self._taken)):
            flown.setdefault(latest, []).append(taken)
        unflown: dict[str, tuple[float, float]] = {}
        for line in context.plan.lines:
            plane = LocalPlane(line.start)
            east, north = plane.flat(line.end)
            length_m = math.hypot(east, north)
            if not length_m:
                continue
            placed = [one for one in flown.get(line.id, ()) if one.corners]
            at_m = []
            for one in placed:
                x, y = plane.flat(_centroid(one.corners))
                at_m.append((x * east + y * north) / length_m)
            margin_m = context.base_m / 2
            if line.id not in flown:
                unflown[line.id] = (0.0, length_m)
            elif line.id == latest and at_m:
                ahead = (at_m[-1] + margin_m, length_m)
                back = (0.0, at_m[-1] - margin_m)
                unflown[line.id] = ahead if at_m[-1] >= at_m[0] else back
            elif of_left_lines and at_m:
                ahead = (max(at_m) + margin_m, length_m)
                back = (0.0, min(at_m) - margin_m)
                rest = ahead if at_m[-1] >= at_m[0] else back
                places = places_m(line, length_m, context.base_m)
                if any(rest[0] < place < rest[1] for place in places):
                    unflown[line.id] = rest
        return {line: (a, b) for line, (a, b) in unflown.items() if a < b}

    @property
    def sun_limit_deg(self) -> float | None:
        """Least elevation of the sun of the plan; None if it states none."""
        return self._context.plan.specification.sun_deg if self._context else None

    def first_place(self) -> tuple[float, float] | None:
        """Latitude and longitude of the begin of the plan; None without a plan."""
        self.update()
        if self._context is None or not self._context.plan.lines:
            return None
        start = self._context.plan.lines[0].start
        return start.latitude_deg, start.longitude_deg

    def lines_left(self) -> dict[str, Any] | None:
        """Lines and metres still to be flown for the first time; None without a plan.

        The rest of a line that was broken off counts.
        """
        self.update()
        context = self._context
        if context is None:
            return None
        remaining = self._remaining(context, of_left_lines=True)
        lengths_m = [
            math.hypot(*LocalPlane(line.start).flat(line.end)) for line in context.plan.lines
        ]
        latest = self._taken[max(self._taken)][0] if self._taken else ""
        return {
            "planned": len(lengths_m),
            "left": len(remaining),
            "current": latest,
            "left_m": round(sum(end_m - begin_m for begin_m, end_m in remaining.values()), 1),
            "planned_m": round(sum(lengths_m), 1),
        }

    @property
    def is_simulated(self) -> bool:
        return bool(self._state.brief()["simulated"])

    @property
    def height_m(self) -> float:
        """Planned height above ground, for exported missions."""
        return self._context.height_m if self._context else 0.0

    @property
    def distance_m(self) -> float:
        """Distance between two exposures for the required overlap."""
        return self._context.base_m if self._context else 0.0


def _station_of(line: PlannedLine, place: Point) -> tuple[float, float]:
    """Distance along a line and to the right of it, m."""
    plane = LocalPlane(line.start)
    east, north = plane.flat(line.end)
    length_m = math.hypot(east, north) or 1.0
    x, y = plane.flat(place)
    return (x * east + y * north) / length_m, (x * north - y * east) / length_m


def advice_json(advice: ReflightPlan, coverage: Coverage) -> dict[str, Any]:
    """Segments, for the page."""
    return {
        "planned_m": round(advice.planned_m, 1),
        "covered_m": round(advice.covered_m, 1),
        "hole_m2": round(advice.hole_m2, 1),
        "notes": coverage.notes(),
        "segments": [
            {
                "line": one.line.id,
                "strip": one.line.strip or one.line.id,
                "kind": one.kind,
                "from_m": round(one.from_m, 1),
                "to_m": round(one.to_m, 1),
                "at": [list(one.start), list(one.end)],
                "reasons": list(one.reasons),
                "holes": [hole_json(hole) for hole in one.holes],
            }
            for one in advice.segments
        ],
    }


def _load_context(path: Path, configured: PlanSection | None) -> _PlanContext | None:
    try:
        mission = Mission.open(path)
        if mission.plan_path is None:
            return None
        _, section = mount_of(mission)
        rig, plan = load_rig(mission.rig_path), read_plan(mission.plan_path)
    except (OSError, DaemonError, RigError):
        return None
    along_m, across_m = image_on_ground_m(rig, section.height_above_ground_m)
    relief, flat_ground_reason = relief_or_reason(configured or section)
    return _PlanContext(
        rig=rig,
        plan=plan,
        along_m=along_m,
        across_m=across_m,
        height_m=section.height_above_ground_m,
        ground_height_m=section.ground_height_m,
        relief=relief,
        flat_ground_reason=flat_ground_reason,
    )


def _taken(one: Mapping[str, Any], context: _PlanContext) -> ExposureFootprint:
    """An exposure for the coverage; before its verdict only its missing heads count."""
    corners, place = one.get("footprint"), one.get("place") or {}
    if not corners:
        return ExposureFootprint(one["number"], (), _exclusion_reason(one) or NO_FOOTPRINT)
    missing = [str(sensor) for sensor in one.get("missing") or ()]
    area, cause = area_and_cause(context.rig, one.get("valid_area"), missing)
    projection_centre = None
    if place.get("height_m") is not None:
        projection_centre = (
            Point(place["latitude_deg"], place["longitude_deg"]),
            place["height_m"] - context.ground_height_m,
        )
    places = tuple(Point(*corner) for corner in corners)
    return ExposureFootprint(
        one["number"],
        places,
        _exclusion_reason(one),
        area=area,
        gap_cause=cause,
        projection_centre=projection_centre,
    )


def _line_json(line: PlannedLine, context: _PlanContext) -> dict[str, Any]:
    plane = LocalPlane(line.start)
    east, north = plane.flat(line.end)
    length_m = math.hypot(east, north)
    places: Sequence[float] = places_m(line, length_m, context.base_m) if length_m else (0.0,)
    return {
        "id": line.id,
        "strip": line.strip or line.id,
        "at": [list(line.start), list(line.end)],
        "places_m": [round(place, 1) for place in places],
    }


def _exclusion_reason(one: Mapping[str, Any]) -> str:
    """The reason why an exposure is excluded; empty if it counts."""
    if one.get("state") == "lost":
        return "lost"
    manual = one.get("manual")
    if manual:
        return rejection_of(manual) if manual.get("kind") == "reject" else ""
    if one.get("verdict") != "refly":
        return ""
    grave = [f["flag"] for f in one.get("findings", []) if f.get("verdict") == "refly"]
    why = dict.fromkeys(flag for flag in grave if flag != "OVERLAP")
    return f"refly ({', '.join(why) or 'quality'})" if why or not grave else ""


def _centroid(corners: Iterable[Point]) -> Point:
    latitudes, longitudes = zip(*corners, strict=True)
    return Point(sum(latitudes) / len(latitudes), sum(longitudes) / len(longitudes))
