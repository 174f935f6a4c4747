"""A disk's own path: one thread that does all work on one disk, so that a stalled one holds up
nothing but itself.

What is done, and what follows from a refusal, is decided in `daemon.mission.mirror.mirrored`.
"""

from __future__ import annotations

import errno
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import TypeVar

from daemon import DaemonError
from daemon.mission.store.disk_identity import Disk

STALL_STEP_S = 0.25
"""No look counts for more: a process that was itself held up does not accuse its disks."""

T = TypeVar("T")


class DroppedError(DaemonError, OSError):
    """The disk was dropped while work on it was running; the result is discarded."""

    def __init__(self, disk: Disk) -> None:
        super().__init__(errno.ENODEV, f"disk {disk} was dropped")


class DiskExecutor:
    """Works on one disk, in order, in a thread of its own.

    `waited_s` is how long work has been pending without progress, as `look` counts it.

    Args:
        disk: the disk.
        release: closes what is open on the disk; the last thing that the thread does.
    """

    def __init__(self, disk: Disk, release: Callable[[], None] = lambda: None) -> None:
        self.disk = disk
        self._release = release
        self.waited_s = 0.0
        self._queue: deque[tuple[Callable[[], object], Future[object]]] = deque()
        self._pending = 0
        self._steps = 0
        self._seen = 0
        self._is_abandoned = False
        self._changed = threading.Condition()
        # A thread that hangs in the kernel must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name=f"disk-{disk.label}", daemon=True)
        self._thread.start()

    @property
    def is_abandoned(self) -> bool:
        return self._is_abandoned

    @property
    def is_idle(self) -> bool:
        """Whether nothing is pending."""
        return self._pending == 0

    @property
    def is_alive(self) -> bool:
        """Whether its thread still works, or hangs, on the disk."""
        return self._thread.is_alive()

    def submit(self, work: Callable[[], T]) -> Future[T]:
        """Have something done after what was submitted before; cancelled where the disk is dropped.

        `work` calls `step` whenever the disk has done something.
        """
        future: Future[T] = Future()
        with self._changed:
            if self._is_abandoned:
                future.set_exception(DroppedError(self.disk))
                return future
            # One queue holds futures of any result.
            self._queue.append((work, future))  # type: ignore[arg-type]
            self._pending += 1
            self._changed.notify()
        return future

    def step(self) -> None:
        """The disk has done something.

        Raises:
            DroppedError: the disk was dropped; what is being written must not get its name.
        """
        self._steps += 1
        if self._is_abandoned:
            raise DroppedError(self.disk)

    def update_waited(self, elapsed_s: float) -> float:
        """Count the time since the last look as waited, if there was no progress; the sum."""
        if self.is_idle or self._steps != self._seen:
            self.waited_s = 0.0
        else:
            self.waited_s += min(elapsed_s, STALL_STEP_S)
        self._seen = self._steps
        return self.waited_s

    def abandon(self) -> None:
        """Begin nothing more on the disk; what is under way ends with the next step."""
        with self._changed:
            self._is_abandoned = True
            cancelled, self._queue = list(self._queue), deque()
            self._pending -= len(cancelled)
            self._changed.notify()
        for _, future in cancelled:
            future.set_exception(DroppedError(self.disk))

    def end(self, timeout_s: float) -> bool:
        """End the thread after its current work; False on timeout."""
        self.abandon()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._queue and not self._is_abandoned:
                    self._changed.wait()
                if self._is_abandoned:
                    break
                work, future = self._queue.popleft()
            done = _outcome(work, future)
            with self._changed:
                self._pending -= 1
                self._steps += 1
            done()
        self._release()


def _outcome(work: Callable[[], object], future: Future[object]) -> Callable[[], None]:
    """Do the work; returns the call that sets the future's result."""
    try:
        result = work()
    except Exception as error:  # noqa: BLE001 - it belongs to the waiting caller
        return partial(future.set_exception, error)
    return partial(future.set_result, result)
