"""Exposures in work side by side: a few processors with buffers of their own, and their threads.

One exposure leaves cores idle wherever its work cannot be shared out (adjustment, seams, writing);
a second one fills them. Every exposure goes through one processor alone, so what comes out does not
depend on what its neighbour does.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import Generic, Protocol, TypeVar

import numba

Result = TypeVar("Result")


class Cloneable(Protocol):
    """What makes images of one exposure at a time, and can be had several times."""

    def clone(self: PipelineT) -> PipelineT:
        """Another with buffers of its own; calibrations are shared."""


PipelineT = TypeVar("PipelineT", bound=Cloneable)


class PipelinePool(Generic[PipelineT]):
    """`count` processors and as many threads.

    Args:
        first: warmed up; the others share its calibrations.
        count: exposures in work at a time. Where numba has only its own thread pool ("workqueue"),
            which two threads may not enter, it is one.
    """

    def __init__(self, first: PipelineT, count: int) -> None:
        self.count = 1 if numba.threading_layer() == "workqueue" else count
        self._free: SimpleQueue[PipelineT] = SimpleQueue()
        self._free.put(first)
        for _ in range(self.count - 1):
            self._free.put(first.clone())
        self._threads = ThreadPoolExecutor(self.count, thread_name_prefix="exposure")

    def submit(self, task: Callable[[PipelineT], Result]) -> Future[Result]:
        """Run a task with a processor of its own, as soon as one is free."""
        return self._threads.submit(self._run, task)

    def end(self) -> None:
        """Finish what is in work and let the threads go."""
        self._threads.shutdown()

    def _run(self, task: Callable[[PipelineT], Result]) -> Result:
        # There are as many as threads: one is free whenever a task begins.
        pipeline = self._free.get_nowait()
        try:
            return task(pipeline)
        finally:
            self._free.put(pipeline)
