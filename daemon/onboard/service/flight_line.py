"""A flight line: wait until the camera is ready, then order exposures as they fall due."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from daemon.configuration.model import Configuration
from daemon.mission.store import durable
from daemon.mission.store.disk_space import DiskSpaceMonitor
from daemon.onboard.capture.devices import exposure_times_ns, frame_nbytes
from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.trigger_policies import (
    DistanceTrigger,
    IntervalTrigger,
    TriggerPolicy,
    pulse_delays_ns,
)
from daemon.orientation.navigation import ARRIVAL_LATENCY_MAX_NS
from daemon.planning.image_size import image_on_ground_m
from daemon.planning.model import LocalPlane, PlannedLine
from daemon.planning.plan_readers import read_plan
from daemon.planning.retakes import RetakeError, retake_line
from daemon.planning.steering import FLOWN_SHARE, PlanTrigger, places_m
from drivers.contract import NavSample
from processing.rig import Rig

NS = 1_000_000_000
CORRIDOR_SHARE = 0.25
"""Largest distance from a planned line, as a fraction of the image width."""

PREDICTION_INTERVAL_S = 0.05
"""Interval between predictions of the due time; the last wait is exact."""
DISK_RETRY_S = 1.0


@dataclass(frozen=True)
class Order:
    """An ordered exposure: the settings for capture and for matching."""

    number: int
    mono_ns: int
    delays_ns: Mapping[str, int]
    strobe_delay_ns: int


class FlightLine:
    """Orders exposures of a flight until the planned number is reached.

    Args:
        configuration: when to expose.
        rig: the camera.
        flight: what is ordered is opened in it.
        mission: a folder on the disk that exposures go to.
        flown: exposures that were made before.
        plan: flight plan to be steered by, where there is one.
        flown_lines: number of exposures made before, by the id of their line.
    """

    def __init__(
        self,
        configuration: Configuration,
        rig: Rig,
        flight: Flight,
        mission: Path,
        flown: int,
        *,
        plan: Path | None = None,
        free_bytes: Callable[[Path], int] = durable.free_bytes,
        flown_lines: Mapping[str, int] | None = None,
    ) -> None:
        self._configuration = configuration
        self._rig = rig
        self._flight = flight
        self._mission = mission
        self._ordered = flown
        exposure_nbytes = sum(frame_nbytes(rig, head.sensor) for head in configuration.head)
        self.guard = DiskSpaceMonitor(configuration.limits, exposure_nbytes, mission, free_bytes)
        self._last_ns: int | None = None
        self._exposure_ns = exposure_times_ns(configuration, rig)
        self._steering = _steering(configuration, rig, plan, flown_lines or {})
        self._policy = _policy(configuration, rig)
        if configuration.trigger.mode == "plan" and self._steering is not None:
            self._policy = self._steering
        self.is_running = configuration.trigger.start == "immediate"
        self._last_position: tuple[NavSample | None, NavSample | None] = (None, None)
        self._pending_triggers = 0
        self._stop_at: int | None = None

    def set_exposure_times(self, times_ns: Mapping[str, int]) -> None:
        """Exposure times by cone have changed; delays follow from them."""
        self._exposure_ns = {**self._exposure_ns, **times_ns}

    def trigger_once(self) -> None:
        """Order one exposure as soon as the camera can, whether the line runs or not."""
        self._pending_triggers += 1

    def trigger_at_interval(self, interval_s: float, count: int) -> None:
        """Expose every so often from now on, `count` times or until stopped (0).

        Never faster than the camera.
        """
        min_interval_ns = round(self._rig.frame_interval_s * NS)
        self._policy = IntervalTrigger(max(round(interval_s * NS), min_interval_ns))
        self._stop_at = self._ordered + count if count else None
        self.is_running = True

    def trigger_at_distance(self, distance_m: float) -> None:
        """Expose every so many metres over ground from now on."""
        self._policy = DistanceTrigger(distance_m, round(self._rig.frame_interval_s * NS))
        self._stop_at = None
        self.is_running = True

    @property
    def remaining(self) -> int | None:
        """Planned exposures that are not ordered yet; None where the plan has no number."""
        count = self._configuration.trigger.count
        return None if count is None else max(0, count - self._ordered)

    @property
    def is_flown(self) -> bool:
        """Whether the planned number of exposures was ordered."""
        count = self._configuration.trigger.count
        return count is not None and self._ordered >= count

    async def fly(self, fire: Callable[[Order], None], disk_full: Callable[[str], None]) -> None:
        """Order exposures as they fall due, until the line is flown."""
        while not self.is_flown:
            now_ns = time.monotonic_ns()
            wait_s = self.wait_s(now_ns) if self.is_running else PREDICTION_INTERVAL_S
            if self._pending_triggers:
                wait_s = self._readiness_s(now_ns)
            if wait_s > 0:
                await asyncio.sleep(wait_s)
            elif not (space := self.guard.check()).is_full:
                self._flight.disk_is_low = space.is_low
                self._pending_triggers = max(0, self._pending_triggers - 1)
                fire(self.order(now_ns))
            else:
                disk_full(f"the disk is full: no more exposures are made; free {self._mission}")
                await asyncio.sleep(DISK_RETRY_S)

    def wait_s(self, now_ns: int) -> float:
        """How long to wait before asking again; 0 where an exposure is due."""
        due_ns = self._policy.due(now_ns, self._last_ns, self.position())
        remaining_s = PREDICTION_INTERVAL_S if due_ns is None else (due_ns - now_ns) / NS
        return max(0.0, min(PREDICTION_INTERVAL_S, remaining_s))

    @property
    def steering(self) -> PlanTrigger | None:
        """The lines of the plan; None without a plan."""
        return self._steering

    def add_retake(self, line_id: str, from_m: float, to_m: float) -> PlannedLine:
        """Add a segment of a planned line that is to be flown again.

        Args:
            line_id: the planned line.
            from_m: first station, m from the start of the line.
            to_m: last station, m.

        Returns:
            The added line.

        Raises:
            RetakeError: there is no plan, or the segment is not on a line of it.
        """
        steering = self._steering
        if steering is None:
            raise RetakeError("this mission is flown without a plan; configure [plan] file")
        retake = retake_line(
            steering.plan,
            line_id,
            from_m,
            to_m,
            distance_m=steering.distance_m,
            taken=[one.id for one in steering.retakes],
        )
        steering.add_retake(retake, of=line_id)
        return retake

    def position(self) -> NavSample | None:
        """The last position, under the host's time of its own instant.

        It arrives 10 to 700 ms later, which would be as much way flown at every exposure. How
        late is known once marks or pulses per second have come; until then it is not guessed.
        """
        nav = self._flight.track.last
        if nav is None or nav is self._last_position[0]:
            return self._last_position[1] if nav is not None else None
        now = self._flight.clock.gps_at(nav.mono_ns)
        latency_ns = 0 if now is None or now.is_coarse else now.gps_ns - nav.gps_ns
        latency_ns = min(max(latency_ns, 0), ARRIVAL_LATENCY_MAX_NS)
        self._last_position = nav, replace(nav, mono_ns=nav.mono_ns - latency_ns)
        return self._last_position[1]

    def _readiness_s(self, now_ns: int) -> float:
        """How long until the camera can expose again."""
        if self._last_ns is None:
            return 0.0
        remaining_s = self._rig.frame_interval_s - (now_ns - self._last_ns) / NS
        return max(0.0, min(PREDICTION_INTERVAL_S, remaining_s))

    def order(self, now_ns: int) -> Order:
        """An exposure that is due: ordered now."""
        nav = self.position()
        speed_mps = self._configuration.plan.ground_speed_mps
        if nav is not None and nav.velocity_ned_mps is not None:
            flown_mps = math.hypot(*nav.velocity_ned_mps[:2])
            speed_mps = flown_mps if flown_mps > 1.0 else speed_mps
        delays_ns = pulse_delays_ns(self._rig, speed_mps, self._exposure_ns)
        reference = self._rig.reference_cone
        strobe_ns = delays_ns[reference] + self._exposure_ns[reference] // 2
        number = self._order_on_line(now_ns, nav)
        self._ordered += 1
        if self._stop_at is not None and self._ordered >= self._stop_at:
            self.is_running, self._stop_at = False, None
        self._last_ns = now_ns
        self.guard.add_exposure(now_ns)
        self._policy.fired(now_ns, nav)
        return Order(number, now_ns, delays_ns, strobe_ns)

    def _order_on_line(self, now_ns: int, nav: NavSample | None) -> int:
        """Open the exposure under the ids of the planned line it belongs to."""
        if self._steering is None:
            return self._flight.order(now_ns)
        line = self._steering.line_of(now_ns, nav)
        if line is None:
            return self._flight.order(now_ns, "")
        return self._flight.order(now_ns, line.id, line.strip or line.id)


def _steering(
    configuration: Configuration, rig: Rig, path: Path | None, exposed: Mapping[str, int]
) -> PlanTrigger | None:
    """The flight plan of a file, where there is one.

    A line counts as flown before where at least half of its exposures were made.
    """
    if path is None:
        return None
    plan, section = read_plan(path), configuration.plan
    along_m, across_m = image_on_ground_m(rig, section.height_above_ground_m)
    by_overlap_m = along_m * (1.0 - plan.specification.forward_overlap)
    distance_m = configuration.trigger.distance_m or by_overlap_m
    flown = []
    for line in plan.lines:
        length_m = math.hypot(*LocalPlane(line.start).flat(line.end))
        planned = len(places_m(line, length_m, distance_m)) if length_m else 1
        if exposed.get(line.id, 0) >= FLOWN_SHARE * planned:
            flown.append(line.id)
    return PlanTrigger(
        plan,
        distance_m=distance_m,
        corridor_m=section.corridor_m or CORRIDOR_SHARE * across_m,
        min_interval_ns=round(rig.frame_interval_s * NS),
        flown=flown,
    )


def _policy(configuration: Configuration, rig: Rig) -> TriggerPolicy:
    trigger = configuration.trigger
    min_interval_ns = round(rig.frame_interval_s * NS)
    if trigger.mode == "distance" and trigger.distance_m is not None:
        return DistanceTrigger(trigger.distance_m, min_interval_ns)
    return IntervalTrigger(max(round(trigger.interval_s * NS), min_interval_ns))
