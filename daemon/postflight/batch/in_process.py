"""Executor in this process: pipelines with separate buffers and their threads, as in flight."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable

from daemon.postflight.batch.executor import (
    BatchAction,
    BatchTask,
    BatchWork,
    TaskDone,
    TaskOutcome,
    failure_of,
)


class InProcessExecutor:
    """`count` actions of one process.

    Args:
        count: tasks in work at a time.
        usable_count: how many of them this process can run once the work is open; numba without
            OpenMP permits one.
    """

    def __init__(
        self, count: int, usable_count: Callable[[int], int] = lambda count: count
    ) -> None:
        self._count, self._usable_count = count, usable_count
        self._tasks: queue.SimpleQueue[BatchTask | None] = queue.SimpleQueue()
        self._outcomes: queue.SimpleQueue[TaskOutcome] = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []

    @property
    def capacity(self) -> int:
        return self._count

    @property
    def description(self) -> str:
        return f"this process, {self._count} at a time"

    def start(self, work: BatchWork) -> None:
        first = work.open()
        self._count = self._usable_count(self._count)
        actions = [first, *(first.clone() for _ in range(self._count - 1))]
        self._threads = [
            threading.Thread(target=self._run, args=(action,), name="exposure", daemon=True)
            for action in actions
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, task: BatchTask) -> None:
        self._tasks.put(task)

    def wait(self, timeout_s: float) -> list[TaskOutcome]:
        try:
            found = [self._outcomes.get(timeout=timeout_s)]
        except queue.Empty:
            return []
        while not self._outcomes.empty():
            found.append(self._outcomes.get())
        return found

    def close(self, timeout_s: float) -> list[TaskOutcome]:
        for _ in self._threads:
            self._tasks.put(None)
        limit_s = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, limit_s - time.monotonic()))
        found = []
        while not self._outcomes.empty():
            found.append(self._outcomes.get())
        return found

    def _run(self, action: BatchAction) -> None:
        while (task := self._tasks.get()) is not None:
            try:
                self._outcomes.put(TaskDone(task.number, action(task)))
            except Exception as error:  # noqa: BLE001 - it is the outcome of this task
                self._outcomes.put(failure_of(task.number, error))
