"""Guidance for page and pilot: each navigation sample becomes one frame, deviations become events.

A line is captured when the aircraft flies along it within its corridor. From then on the limits of
the plan hold until it is passed or left, so that a deviation is reported before an exposure is
lost. The figures are computed in `daemon.planning.guidance`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

from daemon.configuration.model import PlanSection
from daemon.onboard.service.messages import EmitEvent
from daemon.planning.guidance import Guidance, GuidanceLimits, guide, limits_of, turn_deg
from daemon.planning.image_size import ground_pixel_m, image_on_ground_m
from daemon.planning.model import LocalPlane, PlannedLine, Point
from daemon.planning.steering import PlanTrigger
from drivers.contract import NavSample
from processing.rig import Rig

FRAME_INTERVAL_NS: Final = 90_000_000
"""Shortest interval between two frames: 10 Hz pass, faster receivers are thinned."""
LEAVING_DEG: Final = 45.0
"""A captured line is left when the track differs by more from its course, ..."""
LEAVING_CORRIDORS: Final = 3.0
"""... or at this many corridors from it."""
CLEAR_SHARE: Final = 0.8
"""A deviation ends below this share of its limit."""
CONFIRMING_SAMPLES: Final = 2


class GuidanceFeed:
    """Computes frames and reports deviations.

    Args:
        steering: the lines of the plan, and which of them are flown.
        plan: planned heights and tolerances.
        rig: the camera.
        position: the last navigation sample, under the host's time of its own instant.
        send: sends a frame to the page's process; it is neither logged nor printed.
        emit: emits an event.
    """

    def __init__(
        self,
        steering: PlanTrigger,
        plan: PlanSection,
        rig: Rig,
        position: Callable[[], NavSample | None],
        send: Callable[[Mapping[str, Any]], None],
        emit: EmitEvent,
    ) -> None:
        self._steering = steering
        self._position = position
        self._send = send
        self._emit = emit
        self.limits = guidance_limits(steering, plan, rig)
        self._planned_height_m = planned_height_m(plan)
        self._last: NavSample | None = None
        self._sent_ns = -FRAME_INTERVAL_NS
        self._captured: tuple[PlannedLine, bool] | None = None
        self._exceeding = 0
        self.is_deviating = False
        self.deviations = 0
        """Number of reported deviations."""
        self.lines: dict[str, Any] = {}
        """Ids of the lines that are flown, of the current one and of the next, for the status."""

    def advance(self, now_ns: int | None = None) -> int | None:
        """Handle the newest sample; call it after every message.

        Args:
            now_ns: the host's monotonic time, ns; default: now.

        Returns:
            The monotonic instant at which a sample is due that came too soon after the last frame,
            ns; None for none.
        """
        self.step(now_ns)
        is_handled = self._position() is self._last
        return None if is_handled else self._sent_ns + FRAME_INTERVAL_NS

    def step(self, now_ns: int | None = None) -> Guidance | None:
        """Handle the newest sample, if it has not been handled.

        Args:
            now_ns: the host's monotonic time, ns; default: now.

        Returns:
            The guidance that was sent; None if there is no new sample or no line.
        """
        now_ns = time.monotonic_ns() if now_ns is None else now_ns
        sample = self._position()
        if sample is None or sample is self._last or now_ns - self._sent_ns < FRAME_INTERVAL_NS:
            return None
        self._last, self._sent_ns = sample, now_ns
        here = self._steering.advance(now_ns, sample)
        if here is not None:
            self._captured = (here.line, here.is_reversed)
        frame = self._guide(sample)
        if frame is not None and here is None and self._captured and self._has_left(frame):
            self._captured = None
            frame = self._guide(sample)
        self._report(frame)
        if frame is not None:
            self._send(self._frame_event(frame, sample))
        return frame

    def _guide(self, sample: NavSample) -> Guidance | None:
        target = self._captured or self._next_target(sample)
        if target is None or sample.position is None:
            self.lines = {"flown": sorted(self._steering.flown), "current": None, "next": None}
            return None
        line, is_reversed = target
        following = next(iter(self._steering.upcoming(line.id)), None)
        end = line.start if is_reversed else line.end
        self.lines = {
            "flown": sorted(self._steering.flown),
            "current": line.id if self._captured else None,
            "next": (following.id if following else None) if self._captured else line.id,
        }
        return guide(
            line,
            sample,
            is_reversed=is_reversed,
            places_m=self._steering.places_of(line, is_reversed=is_reversed),
            planned_height_m=self._planned_height_m,
            limits=self.limits,
            next_line=None if following is None else (following, _is_end_nearer(following, end)),
        )

    def _next_target(self, sample: NavSample) -> tuple[PlannedLine, bool] | None:
        line = next(iter(self._steering.upcoming()), None)
        if line is None or sample.position is None:
            return None
        return line, _is_end_nearer(line, Point(*sample.position))

    def _has_left(self, frame: Guidance) -> bool:
        is_away = abs(frame.across_m) > LEAVING_CORRIDORS * self._steering.corridor_m
        turned_deg = 0.0 if frame.track_deg is None else turn_deg(frame.course_deg, frame.track_deg)
        return frame.stage == "passed" or is_away or abs(turned_deg) > LEAVING_DEG

    def _report(self, frame: Guidance | None) -> None:
        """Report the beginning and the end of a deviation on a captured line."""
        if frame is None or self._captured is None:
            self._exceeding = 0
            if self.is_deviating:
                self._end_deviation("the line is left", frame)
            return
        self._exceeding = self._exceeding + 1 if frame.exceeded else 0
        if not self.is_deviating and self._exceeding >= CONFIRMING_SAMPLES:
            self.is_deviating = True
            self.deviations += 1
            self._emit(
                "deviation",
                fault=True,
                line=frame.line,
                exceeded=list(frame.exceeded),
                across_m=round(frame.across_m, 1),
                across_ahead_m=round(frame.across_ahead_m, 1),
                height_deviation_m=_rounded(frame.height_deviation_m),
                count=self.deviations,
                sentence=deviation_sentence(frame, self.limits),
            )
        elif self.is_deviating and not frame.exceeded and self._is_well_within(frame):
            self._end_deviation("the deviation is below its limits", frame)

    def _is_well_within(self, frame: Guidance) -> bool:
        limits, height_m = self.limits, frame.height_deviation_m or 0.0
        return (
            abs(frame.across_m) <= CLEAR_SHARE * limits.across_m
            and (limits.below_m is None or -height_m <= CLEAR_SHARE * limits.below_m)
            and (limits.above_m is None or height_m <= CLEAR_SHARE * limits.above_m)
        )

    def _end_deviation(self, why: str, frame: Guidance | None) -> None:
        self.is_deviating, self._exceeding = False, 0
        line = "" if frame is None else frame.line
        self._emit("deviation", fault=False, line=line, sentence=why)

    def _frame_event(self, frame: Guidance, sample: NavSample) -> dict[str, Any]:
        return {
            "event": "guidance",
            "sample_mono_ns": str(sample.mono_ns),
            "receiver": sample.receiver,
            "fix": sample.fix,
            "latitude_deg": sample.latitude_deg,
            "longitude_deg": sample.longitude_deg,
            "height_m": _rounded(sample.height_m),
            "is_captured": self._captured is not None,
            "is_deviating": self.is_deviating,
            "limits": {
                "across_m": round(self.limits.across_m, 1),
                "below_m": _rounded(self.limits.below_m),
                "above_m": _rounded(self.limits.above_m),
            },
            **frame.as_json(),
        }


def guidance_limits(steering: PlanTrigger, plan: PlanSection, rig: Rig) -> GuidanceLimits:
    """The limits of a plan for a camera.

    Args:
        steering: the plan and its corridor.
        plan: planned height and configured tolerances.
        rig: the camera.

    Returns:
        The limits.
    """
    height_m = plan.height_above_ground_m
    _, across_m = image_on_ground_m(rig, height_m)
    limits = limits_of(
        steering.plan.specification,
        image_across_m=across_m,
        height_above_ground_m=height_m,
        gsd_m=ground_pixel_m(rig, height_m),
        corridor_m=steering.corridor_m,
        height_tolerance_m=plan.height_tolerance_m,
    )
    if plan.across_tolerance_m is None:
        return limits
    return replace(limits, across_m=min(plan.across_tolerance_m, steering.corridor_m))


def planned_height_m(plan: PlanSection) -> float | None:
    """The planned height of flight above the ellipsoid, m; None if the plan does not state it."""
    if not {"ground_height_m", "height_above_ground_m"} <= plan.model_fields_set:
        return None
    return plan.ground_height_m + plan.height_above_ground_m


def deviation_sentence(frame: Guidance, limits: GuidanceLimits) -> str:
    """What deviates, by how much, and what to do."""
    parts = []
    if "across" in frame.exceeded:
        worst_m = max(frame.across_m, frame.across_ahead_m, key=abs)
        side = "right" if worst_m > 0 else "left"
        correction = "left" if worst_m > 0 else "right"
        when = "" if abs(frame.across_m) > limits.across_m else " at the next exposure"
        parts.append(
            f"{abs(worst_m):.0f} m {side} of line {frame.line}{when} "
            f"(limit {limits.across_m:.0f} m). Steer {correction}"
        )
    if "height" in frame.exceeded and frame.height_deviation_m is not None:
        is_high = frame.height_deviation_m > 0
        limit_m = limits.above_m if is_high else limits.below_m
        parts.append(
            f"{abs(frame.height_deviation_m):.0f} m {'above' if is_high else 'below'} the planned "
            f"height (limit {limit_m or 0.0:.0f} m). {'Descend' if is_high else 'Climb'}"
        )
    return ". ".join(parts)


def _is_end_nearer(line: PlannedLine, place: Point) -> bool:
    plane = LocalPlane(place)
    return math.hypot(*plane.flat(line.end)) < math.hypot(*plane.flat(line.start))


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 1)
