"""SIGINT to commands at work: one sentence, status 130, and no process that stays."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from daemon.cli import interrupt_messages
from daemon.cli.exit_status import ExitStatus
from tests.robustness.crash.kill_transfer import three_exposures

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]

WORKING_TIMEOUT_S = 120.0
END_TIMEOUT_S = 60.0
LARGE_NBYTES = 1 << 31
"""Size of a sparse file that takes seconds to read."""
MISSION = "20261121T101500Z-small"


@dataclass(frozen=True)
class Case:
    """A command, and how another process sees that it is at work."""

    name: str
    arguments: Callable[[Path, int], list[str]]
    is_working: Callable[[Path, int, socket.socket], bool]


def _loads(library: str) -> Callable[[Path, int, socket.socket], bool]:
    """The process has a library in memory that it needs for its work only."""

    def is_working(_folder: Path, pid: int, _server: socket.socket) -> bool:
        return library in Path(f"/proc/{pid}/maps").read_text("utf-8")

    return is_working


def _writes(pattern: str) -> Callable[[Path, int, socket.socket], bool]:
    return lambda folder, _pid, _server: any(folder.glob(pattern))


def _reads(name: str) -> Callable[[Path, int, socket.socket], bool]:
    """The process has a file of that name open."""

    def is_working(_folder: Path, pid: int, _server: socket.socket) -> bool:
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            try:
                if descriptor.readlink().name == name:
                    return True
            except FileNotFoundError:
                continue
        return False

    return is_working


def _is_called(_folder: Path, _pid: int, server: socket.socket) -> bool:
    """The process connected to the server of the test, which never answers."""
    try:
        connection, _ = server.accept()
    except BlockingIOError:
        return False
    held.append(connection)
    return True


held: list[socket.socket] = []


def _mission(folder: Path) -> str:
    return str(folder / "flown" / MISSION)


CASES = (
    Case("kernels", lambda f, p: ["kernels", "--json"], _writes("cache/**/*.nbi")),
    Case("demo", lambda f, p: ["demo", "--out", str(f / "out")], _writes("out/demo-*/sim")),
    Case("sim", lambda f, p: ["sim", "ultracam-x-mini", "--out", str(f / "out")], _writes("out")),
    Case("check", lambda f, p: ["check", "--find", f"tcp://127.0.0.1:{p}"], _is_called),
    Case("monitor", lambda f, p: ["monitor", f"127.0.0.1:{p}"], _is_called),
    Case("verify", lambda f, p: ["verify", _mission(f)], _reads("SU00.tif")),
    Case("transfer", lambda f, p: ["transfer", _mission(f), str(f / "disk")], _reads("SU00.tif")),
    Case("process", lambda f, p: ["process", _mission(f)], _loads("llvmlite")),
)


def _children(pid: int) -> list[str]:
    """Processes in the session of a command, and those that it started in sessions of their own."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            fields = (path / "stat").read_text("utf-8").rpartition(")")[2].split()
            arguments = (path / "cmdline").read_bytes().split(b"\0")
        except (FileNotFoundError, ProcessLookupError):
            continue
        is_own = int(fields[3]) == pid or (
            b"--parent" in arguments and str(pid).encode() in arguments
        )
        if is_own and fields[0] != "Z":
            found.append(path.name)
    return found


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_sigint_at_work_ends_in_one_sentence(case: Case, tmp_path: Path) -> None:
    if case.name in ("verify", "transfer", "process"):
        three_exposures(tmp_path / "flown")
    if case.name in ("verify", "transfer"):
        os.truncate(tmp_path / "flown" / MISSION / "L0/000002/SU00.tif", LARGE_NBYTES)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        port = server.getsockname()[1]
        command = [sys.executable, "-m", "daemon", *case.arguments(tmp_path, port)]
        process = subprocess.Popen(
            command,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "NO_COLOR": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            limit = time.monotonic() + WORKING_TIMEOUT_S
            while not case.is_working(tmp_path, process.pid, server):
                assert process.poll() is None, process.communicate()
                assert time.monotonic() < limit, "the command did not begin to work"
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=END_TIMEOUT_S)
        finally:
            process.kill()
            process.wait()
    lines = [line for line in errors.splitlines() if line.strip()]
    assert process.returncode == ExitStatus.INTERRUPTED, (output, errors)
    assert lines[-1] == interrupt_messages.sentence_of(case.name), (output, errors)
    assert "Traceback" not in output + errors
    limit = time.monotonic() + END_TIMEOUT_S
    while _children(process.pid):
        assert time.monotonic() < limit, "a process of the command stays"
        time.sleep(0.05)
