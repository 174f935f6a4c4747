"""From a plan to the next exposure: which line is being flown, and when its next place is reached.

Pure decisions on positions and a clock handed in, with the methods of the policies in
`daemon.onboard.flight.trigger_policies`. Places are fixed on the ground: a line gives the same ones
flown either way.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from daemon.planning.model import LocalPlane, Plan, PlannedLine, Point
from drivers.contract import NavSample

NANOSECONDS = 1_000_000_000
COURSE_TOLERANCE_RAD = math.radians(20.0)
"""A track that differs further from a line's direction crosses it, or turns onto it."""

LATE_SHARE = 0.25
"""A place passed by less than this share of the distance is exposed late, else left out."""

MIN_SPEED_MPS = 1.0
FLOWN_SHARE = 0.5
"""A line of which less than this share was passed is not flown."""


@dataclass(frozen=True)
class LinePosition:
    """Position on a planned line: metres along it and to the right of it, in flight direction.

    `along_m` is negative before the line begins. `speed_mps` is the part of the speed along it.
    """

    line: PlannedLine
    is_reversed: bool
    along_m: float
    across_m: float
    length_m: float
    speed_mps: float
    mono_ns: int

    def along_at_m(self, mono_ns: int) -> float:
        return self.along_m + self.speed_mps * (mono_ns - self.mono_ns) / NANOSECONDS


class PlanTrigger:
    """Exposes at the places of a plan, whichever of its lines is flown.

    Args:
        plan: what is to be flown.
        distance_m: between two exposures, for lines that do not say so themselves.
        corridor_m: how far from a line, across track, it is still flown.
        min_interval_ns: the camera's own; never faster than that.
        flown: ids of lines that were flown before a restart.

    A retake is a short line on top of a planned one. While it is not flown, the planned line below
    it, if that is flown, causes no exposures.
    """

    def __init__(
        self,
        plan: Plan,
        *,
        distance_m: float,
        corridor_m: float,
        min_interval_ns: int,
        flown: Iterable[str] = (),
    ) -> None:
        self.plan = plan
        self._distance_m = distance_m
        self._corridor_m = corridor_m
        self._min_interval_ns = min_interval_ns
        self._plane = LocalPlane(plan.lines[0].start)
        self._ends = [self._ends_of(line) for line in plan.lines]
        self._retakes: list[tuple[PlannedLine, str]] = []
        self._flown = set(flown)
        self._resting: set[tuple[str, bool]] = set()
        """Planned lines below a retake that was just flown, until they are left."""
        self._entered_m = 0.0
        self._pass: tuple[str, bool] | None = None
        self._next = 0
        self._known: tuple[NavSample | None, LinePosition | None] = (None, None)

    @property
    def distance_m(self) -> float:
        """Distance between two exposures on lines that do not state it."""
        return self._distance_m

    @property
    def corridor_m(self) -> float:
        """Distance from a line, across track, within which it is flown."""
        return self._corridor_m

    @property
    def flown(self) -> frozenset[str]:
        """Ids of lines and retakes that are flown."""
        return frozenset(self._flown)

    @property
    def retakes(self) -> tuple[PlannedLine, ...]:
        """Retakes in the order in which they were requested."""
        return tuple(line for line, _ in self._retakes)

    def add_retake(self, retake: PlannedLine, of: str) -> None:
        """Add a line to be flown again.

        Args:
            retake: the segment, with an id of its own.
            of: id of the planned line that it belongs to.
        """
        self._retakes.append((retake, of))
        self._ends.insert(len(self._retakes) - 1, self._ends_of(retake))
        self._known = (None, None)

    def advance(self, now_ns: int, nav: NavSample | None) -> LinePosition | None:
        """The line that is flown or lies straight ahead; lines behind are noted as flown."""
        here = self.on_line(nav)
        if here is not None and here.speed_mps >= MIN_SPEED_MPS:
            self._follow(here, now_ns)
        return here

    def upcoming(self, after: str | None = None) -> Sequence[PlannedLine]:
        """Lines that are not flown, pending retakes first, then in the order of the plan.

        Args:
            after: id of the line that is flown now; it is left out, and the planned lines begin
                behind it.
        """
        ids = [line.id for line in self.plan.lines]
        first = ids.index(after) + 1 if after in ids else 0
        planned = (*self.plan.lines[first:], *self.plan.lines[:first])
        return [
            line
            for line in (*self.retakes, *planned)
            if line.id not in self._flown and line.id != after
        ]

    def places_of(self, line: PlannedLine, *, is_reversed: bool) -> Sequence[float]:
        """Planned exposures along a line in flight direction, m."""
        (x0, y0), (x1, y1) = self._ends_of(line)
        length_m = math.hypot(x1 - x0, y1 - y0)
        return places_m(line, length_m, self._distance_m, is_reversed=is_reversed)

    def due(self, now_ns: int, last_fired_ns: int | None, nav: NavSample | None) -> int | None:
        """Host time of the next exposure; None while no line is flown, or it has been."""
        here = self.on_line(nav)
        if here is None or here.speed_mps < MIN_SPEED_MPS:
            return None
        places = self._follow(here, now_ns)
        if self._next >= len(places):
            return None
        ahead_m = places[self._next] - here.along_m
        due_ns = here.mono_ns + round(ahead_m / here.speed_mps * NANOSECONDS)
        if last_fired_ns is None:
            return due_ns
        return max(due_ns, last_fired_ns + self._min_interval_ns)

    def fired(self, mono_ns: int, nav: NavSample | None) -> None:
        """An exposure was made; it counts for the next place if it was near it."""
        here = self.on_line(nav)
        if here is None:
            return
        places = self._follow(here, mono_ns)
        if self._next < len(places):
            miss_m = abs(here.along_at_m(mono_ns) - places[self._next])
            self._next += miss_m <= LATE_SHARE * self._step_m(places)

    def line_of(self, mono_ns: int, nav: NavSample | None) -> PlannedLine | None:
        """The planned line an exposure made now belongs to."""
        here = self.on_line(nav)
        if here is None:
            return None
        margin_m = self._step_m(self._places_m(here)) / 2
        along_m = here.along_at_m(mono_ns)
        return here.line if -margin_m <= along_m <= here.length_m + margin_m else None

    def on_line(self, nav: NavSample | None) -> LinePosition | None:
        """The line that is flown, or that will be reached going straight on."""
        if self._known[0] is not nav:
            self._known = (nav, self._find(nav))
        return self._known[1]

    def _find(self, nav: NavSample | None) -> LinePosition | None:
        if nav is None or nav.position is None or nav.velocity_ned_mps is None:
            return None
        north, east = nav.velocity_ned_mps[:2]
        speed_mps = math.hypot(north, east)
        if speed_mps < MIN_SPEED_MPS:
            return None
        at = self._plane.flat(Point(*nav.position))
        found = [
            self._on(line, ends, at, (east, north), nav.mono_ns)
            for line, ends in zip((*self.retakes, *self.plan.lines), self._ends, strict=True)
            if not self._is_done(line)
        ]
        near = [
            one
            for one in found
            if one is not None
            and abs(one.across_m) <= self._corridor_m
            and one.speed_mps >= speed_mps * math.cos(COURSE_TOLERANCE_RAD)
            and one.along_m <= one.length_m + self._step_m(self._places_m(one))
        ]
        self._resting &= {(one.line.id, one.is_reversed) for one in near}
        waiting = {of for retake, of in self._retakes if retake.id not in self._flown}
        candidates = [
            one
            for one in near
            if not (one.line.id in waiting and one.line.id in self._flown)
            and (one.line.id, one.is_reversed) not in self._resting
        ]
        return min(candidates, key=_distance_key, default=None)

    def _is_done(self, line: PlannedLine) -> bool:
        """Whether a retake is flown and left; the pass that flies it is completed first."""
        is_current = self._pass is not None and self._pass[0] == line.id
        is_retake = any(line.id == retake.id for retake, _ in self._retakes)
        return is_retake and line.id in self._flown and not is_current

    def _ends_of(self, line: PlannedLine) -> tuple[tuple[float, float], tuple[float, float]]:
        return self._plane.flat(line.start), self._plane.flat(line.end)

    def _on(
        self,
        line: PlannedLine,
        ends: tuple[tuple[float, float], tuple[float, float]],
        at: tuple[float, float],
        velocity: tuple[float, float],
        mono_ns: int,
    ) -> LinePosition | None:
        (x0, y0), (x1, y1) = ends
        length_m = math.hypot(x1 - x0, y1 - y0)
        if length_m == 0.0:
            return None
        ahead = ((x1 - x0) / length_m, (y1 - y0) / length_m)
        is_reversed = ahead[0] * velocity[0] + ahead[1] * velocity[1] < 0
        if is_reversed:
            ahead, x0, y0 = (-ahead[0], -ahead[1]), x1, y1
        return LinePosition(
            line=line,
            is_reversed=is_reversed,
            along_m=ahead[0] * (at[0] - x0) + ahead[1] * (at[1] - y0),
            across_m=ahead[1] * (at[0] - x0) - ahead[0] * (at[1] - y0),
            length_m=length_m,
            speed_mps=ahead[0] * velocity[0] + ahead[1] * velocity[1],
            mono_ns=mono_ns,
        )

    def _follow(self, here: LinePosition, now_ns: int) -> Sequence[float]:
        """The places of the line that is flown; those that were missed are left behind."""
        places, along_m = self._places_m(here), here.along_at_m(now_ns)
        step_m = self._step_m(places)
        is_same = self._pass == (here.line.id, here.is_reversed)
        if not is_same or (self._next > 0 and along_m < places[self._next - 1] - step_m):
            self._pass, self._next = (here.line.id, here.is_reversed), 0
            self._entered_m = along_m
        late_m = LATE_SHARE * step_m
        while self._next < len(places) and along_m > places[self._next] + late_m:
            self._next += 1
        passed_m = min(along_m, here.length_m) - max(self._entered_m, 0.0)
        if along_m >= places[-1] and passed_m >= FLOWN_SHARE * here.length_m:
            self._flown.add(here.line.id)
            resting = {
                of for retake, of in self._retakes if retake.id == here.line.id
            } & self._flown
            self._resting |= {(of, here.is_reversed) for of in resting}
        return places

    def _places_m(self, here: LinePosition) -> Sequence[float]:
        return places_m(here.line, here.length_m, self._distance_m, is_reversed=here.is_reversed)

    def _step_m(self, places: Sequence[float]) -> float:
        """The smallest way between two places of a line."""
        spacings_m = (b - a for a, b in itertools.pairwise(places) if b > a)
        return min(spacings_m, default=self._distance_m)


def places_m(
    line: PlannedLine, length_m: float, distance_m: float, *, is_reversed: bool = False
) -> Sequence[float]:
    """Distances of planned exposures along a line, metres in flight direction, rising.

    The last one by distance is at the end of the line or behind it, so that the end is seen as
    often as the rest.
    """
    step_m = line.distance_m or distance_m
    count = math.ceil(length_m / step_m - 1e-9)
    places = line.at_m or tuple(index * step_m for index in range(count + 1))
    return tuple(length_m - place for place in reversed(places)) if is_reversed else places


def _distance_key(one: LinePosition) -> tuple[float, float]:
    """Lines being flown before those ahead, then the nearest across track."""
    return max(0.0, -one.along_m, one.along_m - one.length_m), abs(one.across_m)
