"""Executor of this machine: worker processes that are started again when they die.

The first process loads the work alone, so that kernels are compiled once; the others follow. A
process that compiled kernels computes nothing: another one loads them. A worker ignores Ctrl-C and
ends when the command's end of its pipe is closed.

Quirk: numba lets a process that compiles a kernel run functions that were optimized apart from it;
where they permit other orders of operations, its results differ by last bits from those of every
process that loads the kernel from the cache (numba 0.62; two of 3,497 tie points of a block of
noise). Upstream: no report known (2026-11-28).
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from typing import Any, Final

from daemon import DaemonError
from daemon.mission.exposure_batch import cause_of
from daemon.postflight.batch.executor import (
    BatchTask,
    BatchWork,
    ExecutorEndedError,
    LossKind,
    TaskDone,
    TaskFailed,
    TaskLost,
    TaskOutcome,
    failure_of,
    is_passing,
)
from daemon.postflight.batch.memory_kills import CAUSE, memory_kills
from daemon.products.processing_threads import configure_threads, thread_counts

OPEN_TIMEOUT_S: Final = 600.0
"""Kernels of a new version are compiled within this time."""
RESTART_MAX: Final = 3
"""Starts in a row that end before the work is loaded; then the machine cannot do it."""
REOPEN_DELAYS_S: Final = (1.0, 4.0, 16.0)
"""Delays before the starts after the work could not be loaded, because of what passes."""

_SPAWN = multiprocessing.get_context("spawn")


class WorkerStartError(ExecutorEndedError):
    """Worker processes cannot be started; the message states what to do."""


class WorkerError(DaemonError, ValueError):
    """An error of a worker process, by its message."""


class _Ready:
    """The work is loaded."""


class _Compiled:
    """The work is loaded, with kernels that this process compiled."""


class _Worker:
    """One process, its pipe, and the task it has.

    Args:
        work: pickled.
        environment: variables that limit its threads.
        replaces_compiled: whether it takes the place of one that compiled kernels; it computes in
            any case, so that a cache that cannot be written ends no run.
    """

    def __init__(
        self, work: bytes, environment: dict[str, str], *, replaces_compiled: bool = False
    ) -> None:
        self.connection, child_end = _SPAWN.Pipe(duplex=True)
        self.task: BatchTask | None = None
        self.is_ready = False
        self.oom_kills = memory_kills()
        self.process = _SPAWN.Process(
            target=worker_main, args=(child_end, work, replaces_compiled), daemon=True
        )
        before = {name: os.environ.get(name) for name in environment}
        os.environ.update(environment)
        # The child inherits the mask: Ctrl-C cannot end it before it ignores the signal.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
        child_end.close()
        self.begun_s = time.monotonic()

    def end(self, timeout_s: float) -> None:
        self.connection.close()
        self.process.join(timeout_s)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class LocalProcessExecutor:
    """`count` worker processes, one task each at a time.

    Args:
        count: of processes.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._workers: list[_Worker] = []
        self._found: deque[TaskOutcome] = deque()
        self._work = b""
        self._environment: dict[str, str] = {}
        self._failed_starts = 0
        self._failed_opens = 0
        self._next_start_s = 0.0
        self._was_ready = False
        self._is_closing = False

    @property
    def capacity(self) -> int:
        return sum(worker.is_ready for worker in self._workers)

    @property
    def description(self) -> str:
        return f"{self._count} processes"

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of the workers."""
        return tuple(w.process.pid for w in self._workers if w.process.pid is not None)

    def start(self, work: BatchWork) -> None:
        self._work, self._environment = pickle.dumps(work), thread_counts(work.threads)
        self._start_worker()
        while not self._workers[0].is_ready:
            self._receive(1.0)
        for _ in range(self._count - 1):
            self._start_worker()

    def submit(self, task: BatchTask) -> None:
        worker = next((w for w in self._workers if w.is_ready and w.task is None), None)
        if worker is None:
            raise WorkerStartError("no process is free; no more tasks than capacity are in work")
        worker.task = task
        with suppress(BrokenPipeError, ConnectionError):  # `_receive` finds it dead
            worker.connection.send(task)

    def wait(self, timeout_s: float) -> list[TaskOutcome]:
        if not self._found:
            self._receive(timeout_s)
        found = list(self._found)
        self._found.clear()
        return found

    def close(self, timeout_s: float) -> list[TaskOutcome]:
        limit_s = time.monotonic() + timeout_s
        self._is_closing = True  # what dies now is not started again
        while any(w.task for w in self._workers) and time.monotonic() < limit_s:
            self._receive(0.2)
        for worker in self._workers:
            worker.connection.close()
        for worker in self._workers:
            # One that loads the work, which may take minutes, does not see the closed pipe.
            worker.end(5.0 if worker.is_ready and not worker.task else 0.0)
        self._workers.clear()
        return self.wait(0.0)

    def _start_worker(self, *, replaces_compiled: bool = False) -> None:
        self._workers.append(
            _Worker(self._work, self._environment, replaces_compiled=replaces_compiled)
        )

    def _receive(self, timeout_s: float) -> None:
        if len(self._workers) < self._count and self._next_start_s and not self._is_closing:
            remaining_s = self._next_start_s - time.monotonic()
            timeout_s = max(0.0, min(timeout_s, remaining_s))
            if remaining_s <= 0:
                self._next_start_s = 0.0
                while len(self._workers) < self._count:
                    self._start_worker()
        ends: dict[Any, _Worker] = {w.connection: w for w in self._workers}
        for ready in wait(list(ends), timeout_s):
            worker = ends[ready]
            try:
                message = worker.connection.recv()
            except (EOFError, OSError, pickle.UnpicklingError):
                self._replace(worker)
                continue
            if isinstance(message, _Ready):
                worker.is_ready, self._was_ready = True, True
                self._failed_starts = self._failed_opens = 0
            elif isinstance(message, _Compiled):
                worker.end(5.0)
                self._workers.remove(worker)
                if not self._is_closing:
                    self._start_worker(replaces_compiled=True)
            elif worker.is_ready:
                worker.task = None
                self._found.append(message)
            else:
                self._take_open_failure(worker, message.error)
        for worker in self._workers:
            if not worker.is_ready and time.monotonic() - worker.begun_s > OPEN_TIMEOUT_S:
                worker.process.kill()

    def _take_open_failure(self, worker: _Worker, error: Exception) -> None:
        """A process could not load the work: what passes is tried again later.

        Raises:
            Exception: the first process could not; the work cannot be done at all.
            WorkerStartError: a later one could not, for good or too often.
        """
        if not self._was_ready:
            raise error
        worker.end(5.0)
        self._workers.remove(worker)
        if self._is_closing:
            return
        if not is_passing(error):
            raise WorkerStartError(
                f"a process that was started later cannot load the work: {cause_of(error)}. "
                "Run the same command again; complete exposures are not computed again"
            )
        if self._next_start_s:
            return  # another process failed by the same cause just now
        is_alone = not any(w.is_ready for w in self._workers)
        if self._failed_opens >= len(REOPEN_DELAYS_S) and is_alone:
            raise WorkerStartError(
                f"no process can load the work, after {self._failed_opens + 1} attempts: "
                f"{cause_of(error)}. Run the same command again; complete exposures are not "
                "computed again"
            )
        delay_s = REOPEN_DELAYS_S[min(self._failed_opens, len(REOPEN_DELAYS_S) - 1)]
        self._failed_opens += 1
        self._next_start_s = time.monotonic() + delay_s

    def _replace(self, worker: _Worker) -> None:
        worker.process.join(5.0)
        kind, cause = _cause_of(worker)
        worker.end(0.0)
        self._workers.remove(worker)
        if worker.task is not None:
            self._found.append(TaskLost(worker.task.number, kind, cause))
        if not worker.is_ready and not self._is_closing:
            self._failed_starts += 1
            if self._failed_starts >= RESTART_MAX and not any(w.is_ready for w in self._workers):
                raise WorkerStartError(
                    f"a worker process ended {RESTART_MAX} times before it was ready: {cause}. "
                    "Give fewer --processes, or see its messages above"
                )
        if len(self._workers) < self._count and not self._is_closing:
            self._start_worker()


def worker_main(
    connection: Connection, pickled_work: bytes, computes_compiled: bool = False
) -> None:
    """Open the work and compute tasks until the other end is closed.

    Args:
        connection: to the command.
        pickled_work: the work.
        computes_compiled: whether tasks are computed where kernels were compiled.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    configure_threads()
    try:
        with compilations() as compiled:
            action = pickle.loads(pickled_work).open()
    except Exception as error:  # noqa: BLE001 - the command states it
        connection.send(TaskFailed(0, picklable(error)))
        return
    try:
        if compiled and not computes_compiled:
            connection.send(_Compiled())
            return
        connection.send(_Ready())
        while True:
            task = connection.recv()
            connection.send(outcome_of(action, task))
    except (EOFError, ConnectionError):
        return  # the command ended, or was killed


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Kernels that are compiled in the block, not loaded from the cache; a list that is filled."""
    from numba.core import event

    found: list[str] = []

    class Recorder(event.Listener):  # type: ignore[misc]  # numba has no types
        def on_start(self, event: Any) -> None:
            found.append(str(event.data.get("dispatcher")))

        def on_end(self, event: Any) -> None:
            """The start counts."""

    with event.install_listener("numba:compile", Recorder()):
        yield found


def outcome_of(action: Any, task: BatchTask) -> TaskOutcome:
    """The outcome of a task, with its error where it raised one."""
    try:
        return TaskDone(task.number, action(task))
    except Exception as error:  # noqa: BLE001 - it is the outcome of this task
        failed = failure_of(task.number, error)
        return replace(failed, error=picklable(failed.error))


def picklable(error: Exception) -> Exception:
    """The error, or its message where pickling would lose or alter it."""
    try:
        again = pickle.loads(pickle.dumps(error))
        is_same = type(again) is type(error) and str(again) == str(error)
    except Exception:  # noqa: BLE001 - errors of libraries do what they like here
        is_same = False
    return error if is_same else WorkerError(cause_of(error))


def _cause_of(worker: _Worker) -> tuple[LossKind, str]:
    code = worker.process.exitcode
    if code is None or code >= 0:
        return "killed", f"its process ended with status {code}"
    name = signal.Signals(-code).name
    if -code == signal.SIGKILL and memory_kills() > worker.oom_kills:
        return "out-of-memory", CAUSE
    return "killed", f"its process was killed by {name}"
