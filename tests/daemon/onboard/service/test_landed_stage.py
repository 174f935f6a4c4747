"""After landing a closed mission is verified, copied and reported, and the computer shut down."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import tempfile
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from daemon.mission.landing_messages import LandingProgress
from daemon.mission.layout import CURRENT_FILE, Mission
from daemon.mission.verification.verification import verify
from daemon.onboard.preflight.service_file import load
from daemon.onboard.service import landed_stage, poweroff
from daemon.onboard.service.command_execution import CommandHandlers, execute
from daemon.onboard.service.landed_stage import AUDIT_FILE, LandedStage
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import ServiceCommand
from daemon.onboard.service.notify import Notifier
from daemon.onboard.service.service import Service
from daemon.onboard.service.supervisor import Supervisor
from daemon.postflight import landing_job
from tests.daemon.onboard.service.flight_parts import Planted, in_threads
from tests.daemon.onboard.service.test_command_execution import FakeService
from tests.daemon.small_camera import fly, new_mission

WITHIN_S = 60.0
"""For a process to start and end on a machine that is busy."""


@pytest.fixture
def mission(tmp_path: Path) -> Mission:
    mission = new_mission(tmp_path / "flown")
    fly(mission, [1, 2])
    mission.close()
    return mission


@pytest.fixture
def other_disk() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        yield Path(folder)


class Landed:
    """The stage with a real supervisor, and what it emits."""

    def __init__(self, *folders: Path) -> None:
        self.events: list[dict[str, Any]] = []
        dispatcher = MessageDispatcher()
        self.supervisor = Supervisor(dispatcher.dispatch, lambda _name: self.stage.died())
        self.stage = LandedStage(self.supervisor, folders, self.emit, Notifier(""))
        dispatcher.add(self.stage.handlers)

    def emit(self, event: str, **content: Any) -> None:
        self.events.append({"event": event, **content})

    def states(self, action: str) -> list[str]:
        return [e["state"] for e in self.events if e.get("action") == action]

    def run(self, mission: Mission, acts: Callable[[], Coroutine[Any, Any, None]]) -> None:
        async def both() -> None:
            stay = asyncio.create_task(
                self.stage.stay(mission.path, lambda: {"event": "status"}, lambda _status: None)
            )
            await asyncio.sleep(0)
            try:
                await acts()
            finally:
                self.stage.leave()
                await stay

        asyncio.run(both())

    async def until_idle(self) -> dict[str, Any]:
        deadline = time.monotonic() + WITHIN_S
        while self.stage.running:
            assert time.monotonic() < deadline, self.events
            await asyncio.sleep(0.02)
        return self.events[-1]


def stalling_copy(link: Any, action: str, mission: Path, folder: Path) -> None:
    """A copy that stands still after its first progress."""

    def stall(done: int, total: int) -> None:
        link.send(LandingProgress(action, done, total))
        time.sleep(10 * WITHIN_S)

    landing_job.run_action(action, mission, folder, stall)


@pytest.mark.trust
def test_a_mission_is_verified_copied_and_reported_one_after_the_other(
    mission: Mission, other_disk: Path
) -> None:
    landed = Landed(other_disk)

    async def acts() -> None:
        assert landed.stage.request("verify", None, "anna") is None
        refusal = landed.stage.request("verify", None, "anna")
        assert refusal == "verify runs, started by anna; wait for its end"
        assert landed.stage.request("copy", None, "ben") == refusal
        done = await landed.until_idle()
        assert done["sentence"] == "2 exposures and 6 frames are verified; nothing is wrong"
        assert landed.stage.request("copy", str(other_disk), "ben") is None
        assert "2 exposures and 6 frames verified in" in (await landed.until_idle())["sentence"]
        assert landed.stage.request("report", None, "ben") is None
        assert (await landed.until_idle())["state"] == "done"

    landed.run(mission, acts)
    assert not verify(Mission.open(other_disk / mission.id)).problems
    assert (mission.path / "export" / "report.html").is_file()
    for action in ("verify", "copy", "report"):
        assert (landed.states(action)[0], landed.states(action)[-1]) == ("running", "done")
    assert landed.events[0]["folders"] == [str(other_disk)]
    recorded = (mission.root / AUDIT_FILE).read_text().splitlines()
    assert [json.loads(line)["action"] for line in recorded] == ["verify", "copy", "report"]


@pytest.mark.trust
def test_a_damaged_frame_is_found_and_named(mission: Mission) -> None:
    frame = mission.path / "L0" / "000001" / "SU00.tif"
    frame.chmod(0o644)
    frame.write_bytes(frame.read_bytes()[:-1] + b"x")
    landed = Landed()

    async def acts() -> None:
        assert landed.stage.request("verify", None, "anna") is None
        ended = await landed.until_idle()
        assert ended["state"] == "failed"
        assert "SU00.tif" in ended["sentence"]

    landed.run(mission, acts)


@pytest.mark.trust
def test_a_copy_that_was_killed_is_continued_by_the_next_one(
    mission: Mission, other_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    landed = Landed(other_disk)

    async def acts() -> None:
        monkeypatch.setattr(landed_stage, "TARGET", f"{__name__}:stalling_copy")
        assert landed.stage.request("copy", None, "anna") is None
        deadline = time.monotonic() + WITHIN_S
        while "total_bytes" not in landed.events[-1]:
            assert time.monotonic() < deadline, landed.events
            await asyncio.sleep(0.02)
        pid = landed.supervisor._children[landed_stage.JOB].process.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        ended = await landed.until_idle()
        assert ended["state"] == "failed"
        assert "request it again" in ended["sentence"]
        monkeypatch.undo()
        assert landed.stage.request("copy", None, "anna") is None
        assert (await landed.until_idle())["state"] == "done"

    landed.run(mission, acts)
    assert not verify(Mission.open(other_disk / mission.id)).problems
    assert not verify(mission).problems


@pytest.mark.trust
def test_a_copy_goes_only_into_a_configured_folder_of_another_disk(
    mission: Mission, other_disk: Path, tmp_path: Path
) -> None:
    same_disk = tmp_path / "shuttle"
    same_disk.mkdir()
    landed = Landed(same_disk, other_disk / "not mounted")

    async def acts() -> None:
        refused = landed.stage.request
        assert "is none of the configured folders" in str(refused("copy", "/etc", "eve"))
        assert "one of" in str(refused("copy", None, "anna"))
        for folder in (same_disk, other_disk / "not mounted"):
            sentence = str(refused("copy", str(folder), "anna"))
            assert sentence.startswith(f"no other disk is mounted at {folder}")

    landed.run(mission, acts)
    nowhere = Landed()
    nowhere.run(mission, lambda: _refused(nowhere, "copy", "no folder to copy into is configured"))


async def _refused(landed: Landed, action: str, words: str) -> None:
    assert words in str(landed.stage.request(action, None, "anna"))


@pytest.mark.trust
def test_the_shutdown_is_requested_of_the_helper_and_refused_without_it(
    mission: Mission, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "poweroff.socket"
    monkeypatch.setattr(landed_stage, "request_poweroff", lambda: poweroff.request_poweroff(path))
    monkeypatch.setattr(landed_stage, "poweroff_problem", lambda: poweroff.poweroff_problem(path))
    without = Landed()
    without.run(mission, lambda: _refused(without, "shutdown", "is not enabled. Run: sudo"))
    assert "syntopic-poweroff.socket" in without.events[0]["poweroff"]
    with socket.socket(socket.AF_UNIX) as helper:
        helper.bind(str(path))
        helper.listen()
        helper.settimeout(WITHIN_S)
        landed = Landed()

        async def acts() -> None:
            assert landed.stage.request("shutdown", None, "eva") is None

        landed.run(mission, acts)
        helper.accept()[0].close()
    assert landed.events[0]["poweroff"] == ""
    assert landed.states("shutdown") == ["done"]
    assert "did not answer" in str(poweroff.request_poweroff(path))


@pytest.mark.trust
def test_in_flight_every_action_is_refused_and_after_it_every_command_of_the_flight() -> None:
    flight = FakeService()
    for name in ("verify", "copy", "report", "shutdown"):
        answer = execute(ServiceCommand(1, name, {}, "eva", "administrator"), flight)
        assert (answer.done, answer.sentence) == (False, "the flight has not ended; land first")
    flight.landed.is_entered = True
    for name in ("arm", "start", "trigger", "land", "exposure", "retake", "reject"):
        answer = execute(ServiceCommand(2, name, {}, "eva", "administrator"), flight)
        assert (answer.done, "the flight has ended" in answer.sentence) == (False, True)
    flight.landed.running = "copy"
    answer = execute(ServiceCommand(3, "new-mission", {}, "eva", "administrator"), flight)
    assert answer.sentence == "copy runs; wait for its end"


@pytest.mark.trust
def test_an_operator_does_not_shut_down_and_each_attempt_is_recorded() -> None:
    flight, sent, events = FakeService(), [], []
    flight.landed.is_entered = True
    commands = CommandHandlers(
        flight,
        sent.append,
        lambda *to: sent.append(to),
        lambda event, **c: events.append((event, c)),
    )
    handle = commands.handlers[ServiceCommand]
    handle(ServiceCommand(1, "shutdown", {}, "ben", "operator", "10.0.0.9"))
    handle(ServiceCommand(2, "shutdown", {}, "eva", "administrator", "10.0.0.9"))
    handle(ServiceCommand(3, "verify", {}, "ben", "operator", "10.0.0.9"))
    assert [answer.done for answer in sent] == [False, True, True]
    assert flight.landed.requests == [("shutdown", None, "eva"), ("verify", None, "ben")]
    assert [(one["by"], one["done"]) for one in flight.landed.audited] == [
        ("ben", False),
        ("eva", True),
        ("ben", True),
    ]


@pytest.mark.realtime
def test_the_service_stays_after_the_command_land_until_it_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted = Planted(tmp_path, monkeypatch)
    in_threads(planted)
    for cone in "AB":
        planted.frames(cone)
    planted.write()
    configuration, rig = load(planted.config)
    events: list[Mapping[str, Any]] = []
    service = Service(configuration, rig, planted.config, events.append)

    async def fly() -> int:
        flying = asyncio.create_task(service.run())
        await until(flying, lambda: service.is_ready)
        service.land()
        await until(flying, lambda: service.landed.is_entered)
        assert not flying.done()
        assert not (configuration.mission.root / CURRENT_FILE).exists(), "the mission is not closed"
        service._end()
        return await flying

    async def until(flying: asyncio.Task[int], condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + WITHIN_S
        while not condition():
            assert not flying.done() and time.monotonic() < deadline, events
            await asyncio.sleep(0.02)

    assert asyncio.run(fly()) == 0
    names = [event["event"] for event in events]
    assert names.index("ended") < names.index("landing")
    # Also with nothing left to finish, after which no message advances the phase.
    assert [event["phase"] for event in events if event["event"] == "phase"][-1] == "landed"
    statuses = [event for event in events[names.index("landing") :] if event["event"] == "status"]
    assert all(event["phase"] == "landed" for event in statuses)
