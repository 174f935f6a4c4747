"""Who starts a service or an emulator and is killed leaves neither of them behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from daemon.mission.layout import Mission
from daemon.mission.store.level0_folder import read_sealed
from daemon.mission.verification.verification import verify

pytestmark = pytest.mark.realtime


ROOT = Path(__file__).parents[3]
ENDED_WITHIN_S = 60.0
STARTER = """
import os, subprocess, sys
child = subprocess.Popen([sys.executable, "-m", *sys.argv[1:], "--parent", str(os.getpid())])
print(child.pid, file=sys.stderr, flush=True)
child.wait()
"""
CONFIG = """
[mission]
root = "missions"
rig = "rededge"
[trigger]
driver = "software"
[[head]]
sensor = "R"
driver = "folder"
folder = "none"
"""


@contextmanager
def started(folder: Path, *program: str) -> Iterator[tuple[subprocess.Popen[str], int, Path]]:
    """A process that starts a program; with the program's pid and what it prints."""
    output_file = folder / "output"
    with output_file.open("w") as out:
        starter = subprocess.Popen(
            [sys.executable, "-c", STARTER, *program],
            cwd=ROOT,
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert starter.stderr is not None
    pid = int(starter.stderr.readline())
    try:
        yield starter, pid, output_file
    finally:
        starter.kill()
        starter.wait(ENDED_WITHIN_S)
        starter.stderr.close()
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def has_ended_process(pid: int) -> bool:
    """Whether a process has ended; one that nobody has waited for has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def wait_for_exit(pid: int) -> None:
    deadline = time.monotonic() + ENDED_WITHIN_S
    while not has_ended_process(pid):
        assert time.monotonic() < deadline, "it lives on"
        time.sleep(0.05)


def bearing(mark: str) -> list[int]:
    """All processes that have this in their environment."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if mark.encode() in path.read_bytes() and not has_ended_process(int(path.parent.name)):
                found.append(int(path.parent.name))
    return found


def wait_for_event(output_file: Path, pid: int, event: str) -> dict[str, object]:
    """Wait for an event in what a service prints."""
    deadline = time.monotonic() + ENDED_WITHIN_S
    while True:
        has_ended = has_ended_process(pid)
        for line in output_file.read_text().splitlines(keepends=True):
            if line.endswith("\n") and (event_json := json.loads(line))["event"] == event:
                return dict(event_json)
        assert time.monotonic() < deadline and not has_ended, f"no event {event}"
        time.sleep(0.05)


def test_a_service_whose_starter_is_killed_lands_in_order(tmp_path: Path) -> None:
    config = tmp_path / "service.toml"
    config.write_text(CONFIG)
    with started(tmp_path, "daemon", "run", str(config), "--json-lines") as (
        starter,
        pid,
        output_file,
    ):
        mission = Mission.open(Path(str(wait_for_event(output_file, pid, "mission")["path"])))
        starter.kill()
        wait_for_exit(pid)
    ended = wait_for_event(output_file, pid, "ended")
    assert ended["failure"] is None
    assert Mission.current(mission.root) is None, "the mission is not closed"


def test_an_emulator_whose_starter_is_killed_ends(tmp_path: Path) -> None:
    with started(tmp_path, "sim_hw", "ultracam-l-mini", "--out", str(tmp_path)) as (
        starter,
        pid,
        _,
    ):
        starter.kill()
        wait_for_exit(pid)


@pytest.mark.soak
def test_a_demonstration_that_is_killed_leaves_a_sealed_mission_and_no_process(
    tmp_path: Path,
) -> None:
    mark = f"SYNTOPIC_DEMO={tmp_path}"
    demo = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "daemon",
            "demo",
            "--rig",
            "ultracam-l-mini",
            "--out",
            str(tmp_path),
        ],
        cwd=ROOT,
        env=os.environ | {"SYNTOPIC_DEMO": str(tmp_path)},
        stdout=subprocess.DEVNULL,
    )
    while not (sealed := list(tmp_path.glob("demo-*/missions/*/L0/000002/exposure.json"))):
        assert demo.poll() is None, "the demonstration ended"
        time.sleep(0.1)
    assert len(bearing(mark)) > 5
    demo.kill()
    demo.wait()
    deadline = time.monotonic() + ENDED_WITHIN_S
    while left := bearing(mark):
        assert time.monotonic() < deadline, left
        time.sleep(0.1)
    mission = Mission.open(sealed[0].parents[2])
    assert Mission.current(mission.root) is None
    assert verify(mission).problems == ()
    assert all(read_sealed(mission.level0(number)) for number in mission.numbers())
