"""The process of the live triangulation: its answers, and that its failures cost no exposure."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from daemon.configuration.model import TriangulationSection
from daemon.onboard.flight.fault_latches import FaultLatches
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.service import triangulation_link
from daemon.onboard.service.messages import (
    FinishTriangulation,
    Ping,
    Pong,
    ServiceEvent,
    Stop,
    TriangulateExposure,
    TriangulationFinished,
    UseMission,
)
from daemon.onboard.service.processes import ChildProcess
from daemon.onboard.service.supervisor import Supervisor
from daemon.onboard.service.triangulation_link import TARGET, TriangulationLink
from daemon.products.processing_threads import thread_counts
from tests.daemon.flown_block import flown_block

ON = TriangulationSection(enabled=True, landing_timeout_s=0.5)


class FakeSupervisor:
    """Takes messages as long as it is not full."""

    def __init__(self) -> None:
        self.is_full = False
        self.sent: list[object] = []
        self.spawned: list[str] = []
        self.ended: list[str] = []

    def spawn(self, name: str, *_rest: object) -> None:
        self.spawned.append(name)

    def try_send(self, _name: str, message: object) -> bool:
        if not self.is_full:
            self.sent.append(message)
        return not self.is_full

    async def end(self, names: tuple[str, ...]) -> None:
        self.ended += names


def _link(section: TriangulationSection = ON):
    supervisor, events = FakeSupervisor(), []

    def emit(event: str, **content: Any) -> None:
        events.append({"event": event, **content})

    link = TriangulationLink(cast(Supervisor, supervisor), section, emit)
    return link, supervisor, events


def test_switched_off_it_starts_nothing_and_lands_at_once() -> None:
    link, supervisor, events = _link(TriangulationSection())
    link.start(Path("m"))
    link.note({"event": "processed", "number": 1})
    assert asyncio.run(link.land())
    assert (supervisor.spawned, supervisor.sent, events) == ([], [], [])


def test_exposures_that_do_not_fit_are_sent_later_in_order() -> None:
    link, supervisor, _ = _link()
    link.start(Path("m"))
    supervisor.is_full = True
    for number in (1, 2):
        link.note({"event": "processed", "number": number})
    link.note({"event": "stored", "number": 3})
    supervisor.is_full = False
    link.use_mission(Path("other"))
    assert supervisor.sent == [
        TriangulateExposure(1), TriangulateExposure(2), UseMission(Path("other")),
    ]  # fmt: skip


def test_a_process_that_dies_is_started_again_three_times_and_is_a_named_fault(monkeypatch) -> None:
    monkeypatch.setattr(triangulation_link, "RESTART_S", 0.0)
    link, supervisor, events = _link()

    async def fly() -> None:
        link.start(Path("m"))
        for _ in range(5):
            link.died()
            link.note({"event": "processed", "number": 1})
            await asyncio.sleep(0.01)

    asyncio.run(fly())
    assert len(supervisor.spawned) == 1 + 3 and supervisor.sent == []
    assert "not started again" in events[-1]["sentence"]
    latches = FaultLatches()
    latches.apply(events[-1])
    (fault,) = latches.listed()
    assert fault["severity"] == "caution" and fault["code"] == "triangulation-failed"


def test_landing_waits_no_longer_than_its_limit_and_reports_it() -> None:
    link, supervisor, events = _link()
    link.start(Path("m"))
    begun = time.monotonic()
    assert not asyncio.run(link.land())
    assert time.monotonic() - begun < 3.0
    assert supervisor.sent == [FinishTriangulation()] and supervisor.ended == ["triangulation"]
    assert "not complete" in events[-1]["sentence"]


def test_a_landing_that_was_cut_off_names_the_exposures_left_out() -> None:
    link, _, events = _link()
    link.start(Path("m"))
    for number in (1, 2, 3, 5):
        link.note({"event": "processed", "number": number})
    link.note({"event": "triangulated", "number": 2})
    assert not asyncio.run(link.land())
    assert "exposures 1, 3, 5 are not in its orientations" in events[-1]["sentence"]


def test_landing_without_power_ends_the_process_at_once() -> None:
    link, supervisor, events = _link()
    link.start(Path("m"))
    assert not asyncio.run(link.land(adjusts=False))
    assert supervisor.sent == [] and supervisor.ended == ["triangulation"] and events == []


def test_the_page_is_given_the_last_exposure_and_the_last_block() -> None:
    state = FlightState("test")
    state.apply({"event": "triangulated", "number": 4, "tie_points": 30, "mono_ns": "1"})
    state.apply({"event": "triangulation", "sigma0": 0.9, "findings": []})
    assert state.triangulation() == {
        "latest": {"number": 4, "tie_points": 30},
        "block": {"sigma0": 0.9, "findings": []},
    }
    state.apply({"event": "mission", "id": "next"})
    assert state.triangulation() == {}


def _until_finished(child: ChildProcess, limit_s: float) -> list[object]:
    received: list[object] = []
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        if child.connection.poll(0.2):
            received += child.receive()
        if any(isinstance(one, TriangulationFinished) for one in received):
            return received
    pytest.fail(f"not finished in {limit_s} s: {received}")


@pytest.mark.timeout(300)
def test_the_process_takes_in_a_mission_in_flight_and_one_started_again_all_of_it(tmp_path) -> None:
    flown = flown_block(tmp_path, 3, 1)
    image = flown.mission / "L2/000003/pan.tif"
    image.rename(tmp_path / "later.tif")
    section = TriangulationSection(enabled=True, landing_timeout_s=240.0)
    child = ChildProcess("triangulation", TARGET, (flown.mission, section), thread_counts(1))
    try:
        child.send(Ping())
        (tmp_path / "later.tif").rename(image)
        for number in (3, 3, 77):
            child.send(TriangulateExposure(number))
        child.send(FinishTriangulation())
        received = _until_finished(child, 240.0)
        pid = child.process.pid
        assert os.getpriority(os.PRIO_PROCESS, pid) == 19
        assert os.sched_getscheduler(pid) == os.SCHED_IDLE
        assert Pong({}) in received
        events = [m.event for m in received if isinstance(m, ServiceEvent)]
        numbers = [e["number"] for e in events if e["event"] == "triangulated"]
        assert set(numbers) == {1, 2, 3}
        (block,) = [e for e in events if e["event"] == "triangulation"]
        assert block["exposures"] == 3 and not block["is_preliminary"]
        json.dumps(events)
        child.send(Stop())
        child.process.join(20.0)
        assert child.process.exitcode == 0
    finally:
        child.end(1.0)
    record = json.loads((flown.mission / "export/triangulation/live/live.json").read_text())
    assert [o["exposure"] for o in record["orientations"]] == [1, 2, 3]
    assert [s["exposure"] for s in record["skipped"]] == [77]


def _landed(mission: Path, kills: list[float]) -> dict[str, bytes]:
    """The products of a flight whose process is killed so many seconds after it began each time."""
    section = TriangulationSection(enabled=True, landing_timeout_s=240.0, orthomosaic_gsd_m=0.8)
    for seconds in [*kills, None]:
        child = ChildProcess("triangulation", TARGET, (mission, section), thread_counts(1))
        try:
            child.send(FinishTriangulation())
            if seconds is None:
                _until_finished(child, 240.0)
                continue
            deadline = time.monotonic() + 240.0
            while not list(mission.glob("export/live-orthomosaic/tiles/**/*.webp")):
                assert time.monotonic() < deadline, "no tile in 240 s"
                time.sleep(0.05)
            time.sleep(seconds)
            child.process.kill()
            child.process.join(20.0)
        finally:
            child.end(1.0)
    names = ("live-orthomosaic/orthomosaic.tif", "live-orthomosaic/orthomosaic.pmtiles",
             "triangulation/live/orientations.csv")  # fmt: skip
    return {name: (mission / "export" / name).read_bytes() for name in names}


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_a_process_killed_at_any_time_leaves_nothing_that_the_next_one_does_not_replace(
    flown, tmp_path
) -> None:
    for name in ("whole", "killed"):
        copy = tmp_path / name / "mission"
        shutil.copytree(flown.mission, copy, ignore=shutil.ignore_patterns("export"))
    expected = _landed(tmp_path / "whole/mission", [])
    random = np.random.default_rng(1)
    assert _landed(tmp_path / "killed/mission", random.uniform(0.0, 6.0, 6).tolist()) == expected
    whole, killed = (
        sorted(str(p.relative_to(tmp_path / n)) for p in (tmp_path / n).rglob("export/**/*"))
        for n in ("whole", "killed")
    )
    assert killed == whole
