"""Frames lie in memory that a spawned child sees as well, and that a kill leaves nothing of."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from daemon.onboard.capture.frame_ring import FrameRing
from daemon.onboard.service.messages import Ping, Pong, Stop
from daemon.onboard.service.processes import ChildProcess, ServiceConnection

WAIT_S = 30.0


def invert_second_slot(link: ServiceConnection, ring: FrameRing) -> None:
    """Runs in the child: writes where the parent looks."""
    ring.frame(1, 4, 6)[:] = 4095 - ring.frame(0, 4, 6)
    link.send("inverted")
    while not isinstance(order := link.receive(1.0), Stop):
        if isinstance(order, Ping):
            link.send(Pong({"child": {"pid": os.getpid()}}))


def start(ring: FrameRing) -> ChildProcess:
    return ChildProcess(
        "test", "tests.daemon.onboard.service.test_frame_ring:invert_second_slot", (ring,), {}
    )


def message_of(child: ChildProcess) -> object:
    assert child.connection.poll(WAIT_S), "the child sent nothing in time"
    return child.connection.recv()


def test_a_child_reads_and_writes_the_same_slots() -> None:
    ring = FrameRing.create("SU00", 3, 4 * 6 * 2)
    ring.frame(0, 4, 6)[:] = np.arange(24, dtype=np.uint16).reshape(4, 6)
    child = start(ring)
    assert message_of(child) == "inverted"
    np.testing.assert_array_equal(ring.frame(1, 4, 6).ravel(), 4095 - np.arange(24))
    child.send(Stop())
    child.end(WAIT_S)
    assert child.process.exitcode == 0


def test_the_address_of_a_slot_is_where_its_pixels_are() -> None:
    ring = FrameRing.create("SU00", 2, 64)
    ring.frame(1, 4, 8)[0, 0] = 1234
    assert ctypes.c_uint16.from_address(ring.address(1)).value == 1234


def test_a_frame_larger_than_its_slot_is_refused() -> None:
    ring = FrameRing.create("SU00", 2, 64)
    with pytest.raises(ValueError, match="a slot has 64"):
        ring.frame(0, 8, 8)
    with pytest.raises(ValueError, match="slot 2"):
        ring.frame(2, 4, 8)


def test_memory_leaves_no_name_behind() -> None:
    before = set(Path("/dev/shm").iterdir())
    FrameRing.create("SU00", 2, 1 << 20)
    assert set(Path("/dev/shm").iterdir()) == before


def test_a_child_dies_with_its_parent(tmp_path: Path) -> None:
    import subprocess
    import sys

    code = (
        "from daemon.onboard.capture.frame_ring import FrameRing\n"
        "from tests.daemon.onboard.service.test_frame_ring import start, message_of\n"
        "from daemon.onboard.service.messages import Ping\n"
        "import signal\n"
        "if __name__ == '__main__':\n"
        "    child = start(FrameRing.create('SU00', 2, 64))\n"
        "    message_of(child)\n"
        "    print(child.process.pid, flush=True)\n"
        "    signal.pause()\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    parent = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[4],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[4])},
    )
    assert parent.stdout is not None
    child_pid = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.wait(WAIT_S)
    deadline = time.monotonic() + 5.0
    while _is_running(child_pid):
        assert time.monotonic() < deadline, "the child outlived its parent by five seconds"
        time.sleep(0.02)


def _is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
