"""A captured line holds its limits until it is left, and deviations are reported once."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from daemon.configuration.model import PlanSection
from daemon.onboard.flight.fault_latches import FaultLatches
from daemon.onboard.service.guidance_feed import FRAME_INTERVAL_NS, GuidanceFeed, planned_height_m
from daemon.onboard.service.service import Service
from drivers.contract import NavSample
from processing.rig import load_rig, shipped_rigs
from tests.daemon.onboard.flight.test_flight import nav as any_sample
from tests.daemon.planning.test_steering import NS, PLANE, line, trigger

PLAN = PlanSection(ground_height_m=500.0, height_above_ground_m=1000.0, across_tolerance_m=40.0)


class Rehearsal:
    """Flies straight north at 60 m/s, `east_m` right of line A1, 5 samples a second."""

    def __init__(self, *, plan: PlanSection = PLAN) -> None:
        self.steering = trigger(line("A1", 0.0), line("A2", 400.0))
        self.sample: NavSample | None = None
        self.frames: list[Any] = []
        self.events: list[dict[str, Any]] = []
        self.latches = FaultLatches()
        rig = load_rig(shipped_rigs()["ultracam-x-mini"])
        self.feed = GuidanceFeed(
            self.steering, plan, rig, lambda: self.sample, self.frames.append, self.emit
        )
        self.now_ns = 0

    def emit(self, event: str, **content: Any) -> None:
        self.events.append({"event": event, **content})
        self.latches.apply(self.events[-1])

    def fly(self, from_m: float, to_m: float, east_m: float, *, up_m: float = 0.0) -> None:
        north_m, sign = from_m, 1 if to_m > from_m else -1
        while (to_m - north_m) * sign > 0:
            place = PLANE.place(east_m, north_m)
            self.now_ns += NS // 5
            self.sample = replace(
                any_sample(0.0), mono_ns=self.now_ns, latitude_deg=place.latitude_deg,
                longitude_deg=place.longitude_deg, height_m=1500.0 + up_m,
                velocity_ned_mps=(60.0 * sign, 0.0, 0.0),
            )  # fmt: skip
            self.feed.step(self.now_ns)
            north_m += sign * 12.0

    @property
    def faults(self) -> list[bool]:
        return [one["fault"] for one in self.events if one["event"] == "deviation"]


def test_every_sample_is_one_frame_with_line_limits_and_turn() -> None:
    rehearsal = Rehearsal()
    rehearsal.fly(-600.0, 1200.0, 5.0)
    assert len(rehearsal.frames) == 150
    assert rehearsal.feed.step(rehearsal.now_ns + NS) is None, "the same sample is not sent twice"
    frame = rehearsal.frames[80]
    assert (frame["line"], frame["stage"], frame["is_captured"]) == ("A1", "line", True)
    assert frame["across_m"] == pytest.approx(5.0, abs=0.1)
    assert frame["limits"]["across_m"] == 40.0
    assert (frame["turn"]["line"], frame["turn"]["side"]) == ("A2", "right")
    assert rehearsal.feed.lines == {"flown": ["A1"], "current": None, "next": "A2"}
    assert rehearsal.faults == []


def test_a_sample_that_comes_too_soon_is_due_when_the_interval_has_passed() -> None:
    rehearsal = Rehearsal()
    rehearsal.fly(0.0, 12.0, 0.0)
    assert rehearsal.feed.advance(rehearsal.now_ns) is None, "the sample has been handled"
    assert rehearsal.sample is not None
    rehearsal.sample = replace(rehearsal.sample, mono_ns=rehearsal.now_ns + NS // 20)
    due_ns = rehearsal.feed.advance(rehearsal.now_ns + NS // 20)
    assert due_ns == rehearsal.now_ns + FRAME_INTERVAL_NS
    assert len(rehearsal.frames) == 1
    assert rehearsal.feed.advance(due_ns) is None
    assert len(rehearsal.frames) == 2


def test_the_service_handles_guidance_after_every_message() -> None:
    steps = 0

    def advance() -> None:
        nonlocal steps
        steps += 1

    async def run() -> list[int]:
        service = Service.__new__(Service)
        service.sequence = cast("Any", SimpleNamespace(advance=lambda: None))
        service.exposure = cast("Any", SimpleNamespace(apply=lambda: False))
        service.guidance = cast("Any", SimpleNamespace(advance=advance))
        service.dispatcher = cast("Any", SimpleNamespace(dispatch=lambda _: None))
        service.changed = asyncio.Event()
        task = asyncio.create_task(service._run_sequence())
        counts = []
        for _ in range(3):
            await run_pending()
            counts.append(steps)
            service._dispatch("message")
        task.cancel()
        return counts

    async def run_pending() -> None:
        for _ in range(10):
            await asyncio.sleep(0)

    assert asyncio.run(run()) == [1, 2, 3]


def test_a_deviation_is_reported_once_with_its_correction_and_ends() -> None:
    rehearsal = Rehearsal()
    rehearsal.fly(-200.0, 300.0, 0.0)
    rehearsal.fly(300.0, 500.0, 60.0)
    assert rehearsal.faults == [True]
    (event,) = rehearsal.events
    assert event["sentence"] == "60 m right of line A1 (limit 40 m). Steer left"
    assert [fault["stands"] for fault in rehearsal.latches.listed()] == [True]
    rehearsal.fly(500.0, 600.0, 36.0)
    assert rehearsal.faults == [True], "within the limit, but not well within"
    rehearsal.fly(600.0, 700.0, 20.0)
    assert rehearsal.faults == [True, False]
    assert [fault["stands"] for fault in rehearsal.latches.listed()] == [False]
    assert rehearsal.feed.deviations == 1


def test_one_outlier_is_no_deviation() -> None:
    rehearsal = Rehearsal()
    rehearsal.fly(0.0, 300.0, 0.0)
    rehearsal.fly(300.0, 310.0, 60.0)
    rehearsal.fly(312.0, 600.0, 0.0)
    assert rehearsal.faults == []


def test_beyond_the_corridor_a_captured_line_still_alarms() -> None:
    """Positions there belong to no line and cause no exposures: the alarm must not be silent."""
    rehearsal = Rehearsal()
    rehearsal.fly(0.0, 300.0, 0.0)
    rehearsal.fly(300.0, 600.0, 150.0)
    assert rehearsal.faults == [True]


def test_turning_away_or_passing_another_line_raises_nothing() -> None:
    rehearsal = Rehearsal()
    rehearsal.fly(-2000.0, -1000.0, 300.0)
    rehearsal.fly(0.0, 1100.0, 0.0)
    rehearsal.fly(1400.0, 1100.0, 200.0)
    assert rehearsal.faults == []


def test_height_has_limits_only_where_the_plan_states_a_height() -> None:
    low = Rehearsal()
    low.fly(0.0, 300.0, 0.0, up_m=-200.0)
    assert low.faults == [True]
    assert "below the planned height" in low.events[0]["sentence"]
    assert low.events[0]["sentence"].endswith("Climb")
    unknown = Rehearsal(plan=PlanSection(across_tolerance_m=40.0))
    unknown.fly(0.0, 300.0, 0.0, up_m=-200.0)
    assert unknown.faults == []
    assert unknown.frames[-1]["height_deviation_m"] is None
    assert planned_height_m(PlanSection(height_above_ground_m=900.0)) is None
    assert planned_height_m(PLAN) == 1500.0
