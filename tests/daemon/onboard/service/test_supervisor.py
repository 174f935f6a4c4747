"""Messages sent before a process ended are received, whoever detects its end first."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from typing import Any

import pytest

from daemon.onboard.service import supervisor
from daemon.onboard.service.messages import Ping, Pong, Stop, WorkerBuilt, WorkerRefused
from daemon.onboard.service.processes import ServiceConnection
from daemon.onboard.service.supervisor import Supervisor
from tests.daemon.onboard.service.flight_parts import ThreadChild
from tests.support.stopwatch import Stopwatch

pytestmark = pytest.mark.realtime


def refusing(link: ServiceConnection, *_: Any) -> None:
    """A process that sends two messages and ends."""
    link.send(WorkerBuilt())
    link.send(WorkerRefused("no calibration"))


@pytest.mark.trust
def test_a_refusal_is_taken_in_before_the_end_of_its_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supervisor, "_child_process", ThreadChild)
    received: list[object] = []

    async def begin() -> None:
        made = Supervisor(received.append, received.append)
        made.spawn("worker", "tests.daemon.onboard.service.test_supervisor:refusing", (), {})
        # The children are typed by their protocol, which has no thread.
        made._children["worker"].thread.join(10)  # type: ignore[attr-defined]
        made.send("worker", Stop())  # the loop has not run: nothing was read yet

    asyncio.run(begin())
    assert received == [WorkerBuilt(), WorkerRefused("no calibration"), "worker"]


def answering(link: ServiceConnection) -> None:
    """A process that answers every ping."""
    while True:
        if isinstance(link.receive(1.0), Ping):
            link.send(Pong({}))


@pytest.mark.trust
def test_a_page_process_that_hangs_is_ended_and_the_watchdog_fed_meanwhile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supervisor, "RESTART_LIMIT_S", {"watch": 4.0})
    on_death: list[str] = []

    async def watched() -> None:
        made = Supervisor(lambda _: None, on_death.append)
        made.spawn("watch", "tests.daemon.onboard.service.test_supervisor:answering", (), {})
        pid = made._children["watch"].process.pid or 0
        made._last_answer_s["watch"] += 30.0  # the process starts
        start = Stopwatch()
        while made._last_answer_s["watch"] > time.monotonic() and start.is_within(30.0):
            assert made.ping() == []
            await asyncio.sleep(0.05)
        for _ in range(30):
            assert made.ping() == []
            await asyncio.sleep(0.05)
        assert on_death == []
        os.kill(pid, signal.SIGSTOP)
        stopped = Stopwatch()
        while not on_death and stopped.is_within(30.0):
            watch = Stopwatch()
            assert made.ping() == []
            assert watch.is_within(1.0)
            await asyncio.sleep(0.05)

    asyncio.run(watched())
    assert on_death == ["watch"]
