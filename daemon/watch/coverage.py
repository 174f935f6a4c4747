"""The plan of the mission being flown, and what of it is not well seen yet.

Exposures are gathered from the state as they come, so that those it no longer keeps still count.
What has to be flown again is `daemon.plan.advisor`'s to say.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from daemon.configuration import ConfigurationError
from daemon.disk.mission import Mission
from daemon.errors import DaemonError
from daemon.orientation.exterior import mount_of
from daemon.plan.advisor import Advice, Segment, Taken, advise
from daemon.plan.image_size import image_on_ground_m
from daemon.plan.model import Plan, Plane, PlannedLine, Point
from daemon.plan.reading import read_plan
from daemon.plan.steering import places_m
from daemon.watch.state import FlightState
from processing.rig import RigError, load_rig

Kind = Literal["hole", "to fly"]


@dataclass(frozen=True)
class _Known:
    plan: Plan
    along_m: float
    across_m: float
    height_m: float

    @property
    def base_m(self) -> float:
        return self.along_m * (1.0 - self.plan.specification.forward_overlap)


class Coverage:
    """What is planned and what has been seen of it. Without a plan there is neither."""

    def __init__(self, state: FlightState) -> None:
        self._state = state
        self._mission: str | None = None
        self._known: _Known | None = None
        self._taken: dict[int, tuple[str, Taken]] = {}
        self._cursor = 0

    def gather(self) -> None:
        """Take in what is new; often enough, since the state forgets."""
        if self._state.mission_path != self._mission:
            self._mission = self._state.mission_path
            self._known = None if self._mission is None else _known_of(Path(self._mission))
            self._taken.clear()
            self._cursor = 0
        if self._known is None:
            return
        for one in self._state.changed("exposures", self._cursor):
            self._cursor = one["sequence"]
            corners = one.get("footprint")
            if corners:
                places = tuple(Point(*place) for place in corners)
                taken = Taken(one["number"], places, _objection(one))
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
            advise, known.plan, taken, image_along_m=known.along_m, image_across_m=known.across_m
        )

    def kind_of(self, segment: Segment) -> Kind:
        """A hole lies where the line has been flown past, or has been left for another one."""
        plane = Plane(segment.line.start)
        east, north = plane.flat(segment.line.end)
        length_m = math.hypot(east, north) or 1.0
        flown_m = []
        latest = ""
        for latest, taken in (self._taken[number] for number in sorted(self._taken)):
            if latest == segment.line.id:
                x, y = plane.flat(_middle(taken.corners))
                flown_m.append((x * east + y * north) / length_m)
        if not flown_m:
            return "to fly"
        margin_m = self.distance_m / 2
        if flown_m[-1] >= flown_m[0]:
            is_passed = segment.to_m <= flown_m[-1] + margin_m
        else:
            is_passed = segment.from_m >= flown_m[-1] - margin_m
        return "hole" if is_passed or latest != segment.line.id else "to fly"

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
        "segments": [
            {
                "line": one.line.id,
                "strip": one.line.strip or one.line.id,
                "kind": coverage.kind_of(one),
                "from_m": round(one.from_m, 1),
                "to_m": round(one.to_m, 1),
                "at": [list(one.start), list(one.end)],
                "reasons": list(one.reasons),
            }
            for one in advice.segments
        ],
    }


def _known_of(path: Path) -> _Known | None:
    try:
        mission = Mission.open(path)
        if mission.plan_path is None:
            return None
        _, section = mount_of(mission)
        rig, plan = load_rig(mission.rig_path), read_plan(mission.plan_path)
    except (OSError, DaemonError, ConfigurationError, RigError):
        return None
    along_m, across_m = image_on_ground_m(rig, section.height_above_ground_m)
    return _Known(plan, along_m, across_m, section.height_above_ground_m)


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
