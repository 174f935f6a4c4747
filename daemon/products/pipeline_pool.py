"""Parallel processing of exposures: several processors with separate buffers, and their threads.

One exposure leaves cores idle where its work is serial (adjustment, seams, writing); a second one
uses them. Each exposure is processed by one processor alone, so the result does not depend on the
others.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import Generic, Protocol, TypeVar

import numba

Result = TypeVar("Result")


def usable_count(count: int) -> int:
    """Exposures that one process can have in work: one if numba has only its own thread pool.

    Args:
        count: as requested.

    Returns:
        `count`, or 1. Where no parallel kernel ran yet, numba's thread pool is started.
    """
    numba.get_num_threads()
    return 1 if numba.threading_layer() == "workqueue" else count


class Cloneable(Protocol):
    """A processor of one exposure at a time that can be cloned."""

    def clone(self: PipelineT) -> PipelineT:
        """Another processor with separate buffers and shared calibrations."""


PipelineT = TypeVar("PipelineT", bound=Cloneable)


class PipelinePool(Generic[PipelineT]):
    """`count` processors and as many threads.

    Args:
        first: warmed up; the others share its calibrations.
        count: exposures processed at a time. It is one if numba has only its own thread pool
            ("workqueue"), which two threads may not enter.
    """

    def __init__(self, first: PipelineT, count: int) -> None:
        self.count = usable_count(count)
        self._free: SimpleQueue[PipelineT] = SimpleQueue()
        self._free.put(first)
        for _ in range(self.count - 1):
            self._free.put(first.clone())
        self._threads = ThreadPoolExecutor(self.count, thread_name_prefix="exposure")

    def submit(self, task: Callable[[PipelineT], Result]) -> Future[Result]:
        """Run a task with an exclusive processor, as soon as one is free."""
        return self._threads.submit(self._run, task)

    def end(self) -> None:
        """Finish running tasks and end the threads."""
        self._threads.shutdown()

    def _run(self, task: Callable[[PipelineT], Result]) -> Result:
        # There are as many as threads: one is free whenever a task begins.
        pipeline = self._free.get_nowait()
        try:
            return task(pipeline)
        finally:
            self._free.put(pipeline)
