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

    def open(self) -> ToyAction:
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
    elif what == "memory":
        raise MemoryError
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


def attempts_of(folder: Path, number: int | str) -> int:
    """How often a task was begun."""
    return (folder / str(number)).stat().st_size
