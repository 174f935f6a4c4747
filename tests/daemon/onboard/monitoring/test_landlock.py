"""A page's process in the hands of an attacker does not get at the other processes of its user."""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from daemon.configuration.model import PlanSection, WatchSection
from daemon.onboard.monitoring import process_restrictions
from daemon.onboard.monitoring.access.tokens import add_token
from daemon.onboard.monitoring.process_restrictions import apply_resource_limits
from daemon.onboard.service.messages import Answer, ServiceCommand, ServiceEvent, Stop
from daemon.onboard.service.page_connection import PageConnection, PageProcess
from tests.daemon.onboard.monitoring import flight_events


def attacking(link: PageConnection, folder: str) -> None:
    """A monitoring process that accesses its parent and reports what succeeded."""
    parent = os.getppid()

    def can(what: str) -> bool:
        try:
            if what == "signal":
                os.kill(parent, 0)
            elif what == "memory":
                Path(f"/proc/{parent}/mem").open("r+b").close()
            elif what == "program":
                subprocess.run(["/bin/true"], check=True, timeout=10)
            else:
                (Path(folder) / "file").write_text("x")
        except OSError:
            return False
        return True

    def emit() -> None:
        done = " ".join(what for what in ("signal", "memory", "program", "file") if can(what))
        link.send(ServiceEvent({"event": "signing-state", "sentence": done}))

    emit()
    apply_resource_limits()
    emit()
    link.receive(30.0)


@pytest.mark.trust
@pytest.mark.attack
def test_a_confined_page_process_starts_no_program_and_reaches_no_other_process(
    tmp_path: Path,
) -> None:
    libc_abi = ctypes.CDLL(None).syscall(
        process_restrictions.CREATE_RULESET,
        None,
        ctypes.c_size_t(0),
        process_restrictions.ABI_VERSION,
    )
    if libc_abi < process_restrictions.SIGNALS_SINCE_ABI:
        pytest.skip("needs Linux 6.12 or newer with Landlock")
    child = PageProcess("watch", f"{__name__}:attacking", (str(tmp_path),), {})
    sentences: list[str] = []
    deadline = time.monotonic() + 60.0
    try:
        while len(sentences) < 2 and time.monotonic() < deadline:
            sentences += [
                one.event["sentence"] for one in child.receive() if isinstance(one, ServiceEvent)
            ]
            time.sleep(0.02)
    finally:
        child.end(0.0)
    assert sentences == ["signal memory program file", "file"]


def test_a_confined_page_process_serves_state_and_passes_commands_on(tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens.toml", "anna", "operator")
    settings = WatchSection(host="127.0.0.1", port=0, tokens=tmp_path / "tokens.toml")
    child = PageProcess(
        "watch", "daemon.onboard.monitoring.monitoring_process:main", (settings, PlanSection()), {}
    )
    try:
        watching = received(child, ServiceEvent).event
        assert watching["event"] == "watching"
        assert child.try_send(ServiceEvent(flight_events.status(triggers=2)))
        base = f"http://127.0.0.1:{watching['port']}/api/v1"
        deadline = time.monotonic() + 30.0
        while "ledger" not in (state := fetched(f"{base}/state")["status"]):
            assert time.monotonic() < deadline, "the status did not arrive"
            time.sleep(0.05)
        assert state["ledger"] == flight_events.status(triggers=2)["ledger"]
        with ThreadPoolExecutor(1) as pool:
            posted = pool.submit(fetched, f"{base}/commands/arm", token)
            command = received(child, ServiceCommand)
            assert (command.name, command.by, command.role) == ("arm", "anna", "operator")
            assert child.try_send(Answer(command.number, True, "armed"))
            assert posted.result(30)["sentence"] == "armed"
        assert child.invalid == 0
        assert child.try_send(Stop())
        child.process.join(30)
        assert child.process.exitcode == 0
    finally:
        child.end(0.0)


def received(child: PageProcess, kind: type) -> Any:
    """The next message of a kind; others are passed over."""
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        for one in child.receive():
            if isinstance(one, kind):
                return one
        time.sleep(0.02)
    raise TimeoutError(f"no {kind.__name__}")


def fetched(address: str, token: str | None = None) -> Any:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    method = "GET" if token is None else "POST"
    request = urllib.request.Request(address, method=method, headers=headers)
    with urllib.request.urlopen(request, timeout=30) as answer:
        return json.load(answer)
