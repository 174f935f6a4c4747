"""A child whose service is gone: ended, and without a word."""

from __future__ import annotations

import threading

import pytest

from daemon.onboard.service.processes import ChildProcess, ServiceConnection


def chatter(link: ServiceConnection, is_waiting: bool) -> None:
    """A child that sends without end, from a thread of its own or from its first one."""

    def send() -> None:
        while True:
            link.send("here")

    if is_waiting:
        threading.Thread(target=send, daemon=True).start()
        while True:
            link.receive(timeout_s=1.0)
    send()


@pytest.mark.parametrize("is_waiting", [True, False])
def test_a_child_without_its_service_ends_silently(
    is_waiting: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    child = ChildProcess("chatter", f"{__name__}:chatter", (is_waiting,), {})
    assert child.connection.poll(30), "the child never spoke"
    child.connection.close()
    child.process.join(30)
    assert child.process.exitcode == 1
    assert capfd.readouterr().err == ""
