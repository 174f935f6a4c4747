"""Run tasks on an executor: order, retries, quarantine, progress and interruption.

What passes is tried again: a killed process, a store that did not answer, an exposure that another
run computes now. What does not pass is set aside with its cause, and all other exposures are done.
"""

from __future__ import annotations

import errno
import heapq
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

from daemon.mission.exposure_batch import ExposureFailure, cause_of
from daemon.mission.store.product_manifests import ClaimedElsewhereError
from daemon.mission.transfer.object_store import ObjectStoreAccessError
from daemon.postflight.batch.executor import (
    BatchExecutor,
    BatchTask,
    BatchWork,
    ExecutorEndedError,
    LossKind,
    TaskDone,
    TaskFailed,
    TaskLost,
    TaskOutcome,
    is_passing,
)
from daemon.postflight.batch.in_process import InProcessExecutor

LOSSES_MAX: Final = 3
"""Ends of the process that an exposure may cause; the last attempt is made with no other in work,
so that an exposure next to it cannot be the cause."""
OUT_OF_MEMORY_MAX: Final = 2
"""The same where memory was exhausted."""
OUT_OF_MEMORY: Final = "out of memory: the process could not allocate it"
STORE_RETRIES_S: Final = (1.0, 4.0, 16.0)
"""Delays before the attempts after a store did not answer."""
CLAIM_RETRY_S: Final = 1.0
CLAIM_TIMEOUT_S: Final = 900.0
"""How long another run may compute an exposure before this one lists it as failed."""
FINISH_TIMEOUT_S: Final = 30.0
"""How long exposures in work may take to finish after Ctrl-C."""
_POLL_S: Final = 0.5

_UNWRITABLE_CURES: Final = {
    errno.ENOSPC: "Free space on the disk",
    errno.EDQUOT: "Free space below the quota",
    errno.EROFS: "Mount the disk for writing",
}


@dataclass
class BatchCounts:
    """What happened in a run."""

    done: int = 0
    failed: int = 0
    lost_processes: int = 0
    memory_retries: int = 0
    store_retries: int = 0
    claimed_elsewhere: int = 0

    def as_json(self) -> dict[str, int]:
        """As an object of JSON types."""
        return dict(vars(self))


@dataclass
class BatchOutcome:
    """Results by exposure, failures in order of exposures, and counts."""

    results: dict[int, Any] = field(default_factory=dict)
    failures: list[ExposureFailure] = field(default_factory=list)
    counts: BatchCounts = field(default_factory=BatchCounts)
    is_interrupted: bool = False


Compute: TypeAlias = Callable[[BatchWork, Sequence[BatchTask]], BatchOutcome]
"""Computes all tasks of a work somewhere; after Ctrl-C it raises KeyboardInterrupt."""
StepCompute: TypeAlias = Callable[[str], Compute]
"""Where the tasks of a step are computed, such as "tiles"."""


def in_this_process(work: BatchWork, tasks: Sequence[BatchTask]) -> BatchOutcome:
    """Compute tasks in this process, one at a time.

    Args:
        work: what is computed.
        tasks: one for each exposure.

    Raises:
        KeyboardInterrupt: after Ctrl-C, when the task in work is finished.
        Exception: the work cannot be opened.
    """
    return completed(run_batch(InProcessExecutor(1), work, tasks))


def completed(outcome: BatchOutcome) -> BatchOutcome:
    """The outcome of a run that was not interrupted.

    Args:
        outcome: of `run_batch`.

    Raises:
        KeyboardInterrupt: it was.
    """
    if outcome.is_interrupted:
        raise KeyboardInterrupt
    return outcome


def run_batch(
    executor: BatchExecutor,
    work: BatchWork,
    tasks: Iterable[BatchTask],
    progress: Callable[[BatchCounts], None] = lambda _counts: None,
) -> BatchOutcome:
    """Compute tasks; a failed one does not end the batch, a full disk does.

    On KeyboardInterrupt no further task begins; those in work may finish within 30 s.

    Args:
        executor: where they are computed. It is closed on return.
        work: what is computed.
        tasks: one for each exposure.
        progress: called after every change of the counts.

    Where the executor cannot continue, the remaining tasks are failures with its cause.

    Raises:
        Exception: the work cannot be opened.
    """
    run = _Run(executor, tasks, progress)
    ended_by: ExecutorEndedError | None = None
    try:
        executor.start(work)
        try:
            run.to_end()
        except ExecutorEndedError as error:
            ended_by = error
    except KeyboardInterrupt:
        run.outcome.is_interrupted = True
    finally:
        run.take(executor.close(FINISH_TIMEOUT_S if run.outcome.is_interrupted else 5.0))
    if ended_by is not None:
        run.fail_remaining(f"not computed: {ended_by}")
    run.outcome.failures.sort(key=lambda failure: failure.exposure)
    return run.outcome


class _Run:
    """State of one run: what waits, what is in work, and what happened to each exposure."""

    def __init__(
        self,
        executor: BatchExecutor,
        tasks: Iterable[BatchTask],
        progress: Callable[[BatchCounts], None],
    ) -> None:
        self.outcome = BatchOutcome()
        self._executor, self._progress = executor, progress
        self._waiting = deque(tasks)
        self._deferred: list[tuple[float, int, BatchTask]] = []
        self._last: deque[BatchTask] = deque()
        self._in_work: dict[int, BatchTask] = {}
        self._losses: Counter[tuple[int, str]] = Counter()
        self._ended_processes: set[str] = set()
        self._store_retries: Counter[int] = Counter()
        self._claimed_since_s: dict[int, float] = {}
        self._ended_by = ""

    def to_end(self) -> None:
        """Until every task has a result or a failure."""
        while self._waiting or self._in_work or self._deferred or self._last:
            self._submit()
            self.take(self._executor.wait(_POLL_S))

    def take(self, outcomes: Iterable[TaskOutcome]) -> None:
        """Note outcomes, and what follows from each."""
        for outcome in outcomes:
            task = self._in_work.pop(outcome.number, None)
            if task is None:
                continue
            if isinstance(outcome, TaskDone):
                self.outcome.results[outcome.number] = outcome.result
                self.outcome.counts.done += 1
            elif isinstance(outcome, TaskLost):
                self._take_loss(task, outcome)
            else:
                self._take_failure(task, outcome)
            self._progress(self.outcome.counts)

    def fail_remaining(self, cause: str) -> None:
        """List every task without result as failed.

        Args:
            cause: why.
        """
        deferred = [task for _, _, task in self._deferred]
        for task in (*self._in_work.values(), *self._waiting, *deferred, *self._last):
            self._fail(task, cause)

    def _submit(self) -> None:
        now_s = time.monotonic()
        while self._deferred and self._deferred[0][0] <= now_s:
            self._waiting.append(heapq.heappop(self._deferred)[2])
        capacity = self._executor.capacity
        while self._waiting and len(self._in_work) < capacity:
            self._begin(self._waiting.popleft())
        is_alone = not (self._waiting or self._in_work or self._deferred)
        if self._last and is_alone and capacity:
            self._begin(self._last.popleft())  # alone

    def _begin(self, task: BatchTask) -> None:
        if self._ended_by:
            self._fail(task, self._ended_by)
            return
        self._in_work[task.number] = task
        self._executor.submit(task)

    def _take_loss(self, task: BatchTask, lost: TaskLost) -> None:
        if lost.kind == "scheduler":
            self._waiting.appendleft(task)
            return
        if not lost.process or lost.process not in self._ended_processes:
            self._ended_processes.add(lost.process)
            self.outcome.counts.lost_processes += 1
        self._take_attempt(task, lost.kind, lost.cause)

    def _take_attempt(self, task: BatchTask, kind: LossKind, cause: str) -> None:
        """An attempt that ended with its process or for memory: another one, or quarantine."""
        self._losses[task.number, kind] += 1
        count = self._losses[task.number, kind]
        limit = OUT_OF_MEMORY_MAX if kind == "out-of-memory" else LOSSES_MAX
        if count >= limit:
            alone = ", the last time with no other exposure in work"
            cure = (
                "give fewer --processes or a machine with more memory"
                if kind == "out-of-memory"
                else "repeat the command with --processes 0 to see its messages"
            )
            self._fail(task, f"quarantined after {count} attempts: {cause}{alone}; {cure}")
            return
        self.outcome.counts.memory_retries += kind == "out-of-memory"
        if count == limit - 1:
            self._last.append(task)
        else:
            self._waiting.appendleft(task)

    def _take_failure(self, task: BatchTask, failed: TaskFailed) -> None:
        error, number = failed.error, task.number
        if isinstance(error, MemoryError):
            detail = f" ({error})" if str(error) else ""
            self._take_attempt(task, "out-of-memory", f"{OUT_OF_MEMORY}{detail}")
            return
        if isinstance(error, ClaimedElsewhereError):
            self.outcome.counts.claimed_elsewhere += 1
            since_s = self._claimed_since_s.setdefault(number, time.monotonic())
            if time.monotonic() - since_s < CLAIM_TIMEOUT_S:
                self._defer(task, CLAIM_RETRY_S)
                return
        elif is_passing(error) and self._store_retries[number] < len(STORE_RETRIES_S):
            delay_s = STORE_RETRIES_S[self._store_retries[number]]
            self._store_retries[number] += 1
            self.outcome.counts.store_retries += 1
            self._defer(task, delay_s)
            return
        cause = cause_of(error)
        if isinstance(error, ObjectStoreAccessError):
            self._ended_by = f"not attempted, because the store refused exposure {number}"
        elif isinstance(error, OSError) and error.errno in _UNWRITABLE_CURES:
            self._ended_by = f"not attempted, because of exposure {number}: {error.strerror}"
            cause += f". {_UNWRITABLE_CURES[error.errno]}, and run the same command again"
        self._fail(task, cause)

    def _defer(self, task: BatchTask, delay_s: float) -> None:
        heapq.heappush(self._deferred, (time.monotonic() + delay_s, task.number, task))

    def _fail(self, task: BatchTask, cause: str) -> None:
        self.outcome.failures.append(ExposureFailure(task.number, cause))
        self.outcome.counts.failed += 1
        self._progress(self.outcome.counts)
