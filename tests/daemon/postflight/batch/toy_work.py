"""Work that does to its process what a test wants, and notes every attempt in a file."""

from __future__ import annotations

import errno
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from daemon.mission.store.product_manifests import ClaimedElsewhereError
from daemon.postflight.batch.executor import BatchTask


@dataclass(frozen=True)
class ToyWork:
    """The payload of a task names what happens; a number behind it, in how many attempts."""

    attempts: Path
    threads: int = 1
    memory_nbytes: int = 1
    refuses: bool = False
    open_s: float = 0.0

    def open(self) -> ToyAction:
        time.sleep(self.open_s)
        if self.refuses:
            raise ValueError("no such calibration")
        return ToyAction(self)


class ToyAction:
    """Does what the payload names."""

    def __init__(self, work: ToyWork) -> None:
        self._work = work

    def clone(self) -> ToyAction:
        return ToyAction(self._work)

    def __call__(self, task: BatchTask) -> int:
        what, _, times = (task.payload or "").partition(" ")
        file = self._work.attempts / str(task.number)
        with file.open("ab") as attempts:
            attempts.write(b".")
        if file.stat().st_size <= int(times or 1):
            _happen(what)
        return task.number * 10


def _happen(what: str) -> None:
    if what == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    elif what == "status":
        os._exit(7)
    elif what == "kernel":
        _fill_a_group()
    elif what == "memory":
        raise MemoryError
    elif what == "chained":
        raise ValueError("SU00.tif cannot be read") from MemoryError()
    elif what == "full":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    elif what == "store":
        raise OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
    elif what == "claimed":
        raise ClaimedElsewhereError("in work")
    elif what == "bad":
        raise ValueError("frame 3 is damaged")
    elif what == "slow":
        time.sleep(0.5)


def memory_groups() -> Path | None:
    """Where control groups that limit memory can be made; None where they cannot."""
    for root in (Path("/sys/fs/cgroup/memory"), Path("/sys/fs/cgroup")):
        limit = "memory.max" if root.name == "cgroup" else "memory.limit_in_bytes"
        probe = root / f"syntopic-probe-{os.getpid()}"
        try:
            probe.mkdir()
        except OSError:
            continue
        is_usable = (probe / limit).exists()
        probe.rmdir()
        if is_usable:
            return root
    return None


def _fill_a_group() -> None:
    """Allocate more than a control group of this process alone permits: the kernel ends it."""
    root = memory_groups()
    assert root is not None
    group = root / f"syntopic-test-{os.getpid()}"
    group.mkdir()
    limit = "memory.max" if root.name == "cgroup" else "memory.limit_in_bytes"
    (group / limit).write_text("20000000")
    (group / "cgroup.procs").write_text(str(os.getpid()))
    held = [bytearray(b"\x01") * 1_000_000 for _ in range(200)]
    time.sleep(30.0)
    del held


def attempts_of(folder: Path, number: int | str) -> int:
    """How often a task was begun."""
    return (folder / str(number)).stat().st_size
