"""The plan of the mission being flown, and what of it is not seen by enough images yet.

Exposures are gathered from the state as they come, so that those it no longer keeps still count.
What has to be flown again is computed by `daemon.planning.advisor`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from daemon.configuration.model import ConfigurationError, PlanSection
from daemon.errors import DaemonError
from daemon.mission.layout import Mission
from daemon.onboard.monitoring.state import FlightState
from daemon.orientation.exterior import mount_of
from daemon.planning.advisor import Advice, LineAdvice, advise
from daemon.planning.flown import NO_FOOTPRINT, area_and_cause
from daemon.planning.image_counts import Taken
from daemon.planning.image_size import image_on_ground_m
from daemon.planning.model import Plan, Plane, PlannedLine, Point
from daemon.planning.reading import read_plan
from daemon.planning.relief import TerrainRelief, relief_or_reason
from daemon.planning.steering import places_m
from daemon.planning.writing import hole_json
from processing.rig import Rig, RigError, load_rig


@dataclass(frozen=True)
class _Known:
    rig: Rig
    plan: Plan
    along_m: float
    across_m: float
    height_m: float
    ground_height_m: float
    relief: TerrainRelief | None
    level_because: str
    lines: dict[str, LineAdvice] = field(default_factory=dict)

    @property
    def base_m(self) -> float:
        return self.along_m * (1.0 - self.plan.specification.forward_overlap)


class Coverage:
    """What is planned and what has been seen of it. Without a plan there is neither.

    Args:
        state: the flight as it is watched.
        configured: where the service's own configuration puts the height model; without it the
            mission's names count, within its folder.
    """

    def __init__(self, state: FlightState, configured: PlanSection | None = None) -> None:
        self._state = state
        self._configured = configured
        self._mission: str | None = None
        self._known: _Known | None = None
        self._taken: dict[int, tuple[str, Taken]] = {}
        self._cursor = 0

    def gather(self) -> None:
        """Take in what is new; often enough, since the state forgets."""
        if self._state.mission_path != self._mission:
            self._mission = self._state.mission_path
            self._known = (
                None if self._mission is None else _known_of(Path(self._mission), self._configured)
            )
            self._taken.clear()
            self._cursor = 0
        if self._known is None:
            return
        for one in self._state.changed("exposures", self._cursor):
            self._cursor = one["sequence"]
            if one.get("step") not in ("triggered", "stored"):
                taken = _taken(one, self._known)
                self._taken[one["number"]] = (str(one.get("line") or ""), taken)

    def plan_json(self) -> dict[str, Any] | None:
        """Lines with their places, as the page draws them."""
        self.gather()
        if self._known is None:
            return None
        plan = self._known.plan
        return {
            "name": plan.name,
            "lines": [_line_json(line, self._known) for line in plan.lines],
            "specification": vars(plan.specification),
        }

    def question(self) -> Callable[[], Advice] | None:
        """What must be flown yet or again: the answer takes a while, and may in any thread."""
        self.gather()
        known = self._known
        if known is None:
            return None
        taken = [one for _, one in self._taken.values()]
        return partial(
            advise,
            known.plan,
            taken,
            image_along_m=known.along_m,
            image_across_m=known.across_m,
            relief=known.relief,
            rest=self._rest(known),
            known=known.lines,
        )

    def notes(self) -> list[str]:
        """What the advice assumes."""
        known = self._known
        return [known.level_because] if known is not None and known.level_because else []

    def _rest(self, known: _Known) -> dict[str, tuple[float, float]]:
        """By line, what is still to be flown: all of it, or what lies ahead on the line in work."""
        flown: dict[str, list[Taken]] = {}
        latest = ""
        for latest, taken in (self._taken[number] for number in sorted(self._taken)):
            flown.setdefault(latest, []).append(taken)
        rest: dict[str, tuple[float, float]] = {}
        for line in known.plan.lines:
            plane = Plane(line.start)
            east, north = plane.flat(line.end)
            length_m = math.hypot(east, north)
            if not length_m:
                continue
            placed = [one for one in flown.get(line.id, ()) if one.corners]
            at_m = []
            for one in placed:
                x, y = plane.flat(_middle(one.corners))
                at_m.append((x * east + y * north) / length_m)
            margin_m = known.base_m / 2
            if line.id not in flown:
                rest[line.id] = (0.0, length_m)
            elif line.id == latest and at_m:
                ahead = (at_m[-1] + margin_m, length_m)
                back = (0.0, at_m[-1] - margin_m)
                rest[line.id] = ahead if at_m[-1] >= at_m[0] else back
        return {line: (a, b) for line, (a, b) in rest.items() if a < b}

    @property
    def is_simulated(self) -> bool:
        return bool(self._state.brief()["simulated"])

    @property
    def height_m(self) -> float:
        """Height above ground as planned, for missions that are written out."""
        return self._known.height_m if self._known else 0.0

    @property
    def distance_m(self) -> float:
        """Between two exposures, by the overlap asked for."""
        return self._known.base_m if self._known else 0.0


def advice_json(advice: Advice, coverage: Coverage) -> dict[str, Any]:
    """Segments as the page lists and draws them."""
    return {
        "planned_m": round(advice.planned_m, 1),
        "well_m": round(advice.well_m, 1),
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


def _known_of(path: Path, configured: PlanSection | None) -> _Known | None:
    try:
        mission = Mission.open(path)
        if mission.plan_path is None:
            return None
        _, section = mount_of(mission)
        rig, plan = load_rig(mission.rig_path), read_plan(mission.plan_path)
    except (OSError, DaemonError, ConfigurationError, RigError):
        return None
    along_m, across_m = image_on_ground_m(rig, section.height_above_ground_m)
    relief, level_because = relief_or_reason(configured or section)
    return _Known(
        rig=rig,
        plan=plan,
        along_m=along_m,
        across_m=across_m,
        height_m=section.height_above_ground_m,
        ground_height_m=section.ground_height_m,
        relief=relief,
        level_because=level_because,
    )


def _taken(one: Mapping[str, Any], known: _Known) -> Taken:
    """An exposure as the advisor counts it; until it is judged, its missing heads alone decide."""
    corners, place = one.get("footprint"), one.get("place") or {}
    if not corners:
        return Taken(one["number"], (), _objection(one) or NO_FOOTPRINT)
    missing = [str(sensor) for sensor in one.get("missing") or ()]
    area, cause = area_and_cause(known.rig, one.get("valid_area"), missing)
    eye = None
    if place.get("height_m") is not None:
        eye = (
            Point(place["latitude_deg"], place["longitude_deg"]),
            place["height_m"] - known.ground_height_m,
        )
    places = tuple(Point(*corner) for corner in corners)
    return Taken(one["number"], places, _objection(one), area=area, partly=cause, eye=eye)


def _line_json(line: PlannedLine, known: _Known) -> dict[str, Any]:
    plane = Plane(line.start)
    east, north = plane.flat(line.end)
    length_m = math.hypot(east, north)
    places: Sequence[float] = places_m(line, length_m, known.base_m) if length_m else (0.0,)
    return {
        "id": line.id,
        "strip": line.strip or line.id,
        "at": [list(line.start), list(line.end)],
        "places_m": [round(place, 1) for place in places],
    }


def _objection(one: Mapping[str, Any]) -> str:
    """Why an exposure does not count; coverage itself is counted by the advisor."""
    if one.get("state") == "lost":
        return "lost"
    if one.get("verdict") != "refly":
        return ""
    grave = [f["flag"] for f in one.get("findings", []) if f.get("verdict") == "refly"]
    why = dict.fromkeys(flag for flag in grave if flag != "OVERLAP")
    return f"refly ({', '.join(why) or 'quality'})" if why or not grave else ""


def _middle(corners: Iterable[Point]) -> Point:
    latitudes, longitudes = zip(*corners, strict=True)
    return Point(sum(latitudes) / len(latitudes), sum(longitudes) / len(longitudes))
