"""What a process said before it ended is taken in, whoever notices its end first."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from daemon.service import supervisor
from daemon.service.messages import Stop, WorkerBuilt, WorkerRefused
from daemon.service.processes import Link
from daemon.service.supervisor import Supervisor
from tests.daemon.service.flight_parts import ThreadChild


def refusing(link: Link, *_: Any) -> None:
    """A process that says two things and ends."""
    link.send(WorkerBuilt())
    link.send(WorkerRefused("no calibration"))


@pytest.mark.trust
def test_a_refusal_is_taken_in_before_the_end_of_its_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supervisor, "Child", ThreadChild)
    said: list[object] = []

    async def begin() -> None:
        made = Supervisor(said.append, said.append)
        made.spawn("worker", "tests.daemon.service.test_supervisor:refusing", (), {})
        made._children["worker"].thread.join(10)  # type: ignore[attr-defined]
        made.send("worker", Stop())  # the loop has not run: nothing was read yet

    asyncio.run(begin())
    assert said == [WorkerBuilt(), WorkerRefused("no calibration"), "worker"]
