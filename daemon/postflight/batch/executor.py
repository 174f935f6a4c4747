"""The interface of executors: where the exposures of a command are computed.

A command describes its work once (`BatchWork`). An executor opens it where the work is done and
returns an outcome for each task. Retries, quarantine and order are in
`daemon.postflight.batch.batch_run`; no executor knows what is computed.
"""

from __future__ import annotations

import errno
from dataclasses import Field, dataclass
from typing import Any, ClassVar, Final, Literal, Protocol, TypeAlias

from daemon import DaemonError

_PASSING_ERRNOS: Final = frozenset(
    {errno.ETIMEDOUT, errno.EAGAIN, errno.ESTALE, errno.EINTR, errno.EBUSY, errno.EREMOTEIO}
)

_OPENCV_NO_MEMORY: Final = -4
"""cv2.Error.StsNoMem, as `code` of cv2.error."""


class ExecutorEndedError(DaemonError):
    """An executor that cannot continue; the message states what to do.

    What was computed before counts: the run lists the remaining exposures with this cause.
    """


class DataAbsentError(DaemonError):
    """A machine that does not have the data of the command: other machines may have it."""


def is_passing(error: Exception) -> bool:
    """Whether the same call may succeed a few seconds later."""
    if isinstance(error, TimeoutError | ConnectionError):
        return True
    return isinstance(error, OSError) and error.errno in _PASSING_ERRNOS


def is_out_of_memory(error: Exception) -> bool:
    """Whether memory was exhausted: a statement of Python, the kernel, or OpenCV.

    Args:
        error: of a task; what it was raised from counts, too.
    """
    found: BaseException | None = error
    while found is not None:
        if isinstance(found, MemoryError):
            return True
        if isinstance(found, OSError) and found.errno == errno.ENOMEM:
            return True
        if type(found).__module__ == "cv2" and getattr(found, "code", None) == _OPENCV_NO_MEMORY:
            return True
        found = found.__cause__
    return False


def failure_of(number: int, error: Exception) -> TaskFailed:
    """The outcome of a task that raised an error.

    Args:
        number: of the task.
        error: that was raised; what exhausted memory becomes a MemoryError, which can be pickled.
    """
    if isinstance(error, MemoryError) or not is_out_of_memory(error):
        return TaskFailed(number, error)
    return TaskFailed(number, MemoryError(str(error)))


@dataclass(frozen=True)
class BatchTask:
    """One exposure, and what its action has to know about it."""

    number: int
    payload: Any = None


class BatchAction(Protocol):
    """Computes one task at a time in the process that opened it."""

    def __call__(self, task: BatchTask) -> Any:
        """The result of a task; it can be pickled."""

    def clone(self) -> BatchAction:
        """Another action with separate buffers and shared calibrations."""


class BatchWork(Protocol):
    """Description of the work of a command: a frozen dataclass that can be pickled.

    `memory_nbytes` is what one task occupies. `threads` is a field, the threads of one action: an
    allocation replaces it.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def memory_nbytes(self) -> int: ...

    @property
    def threads(self) -> int: ...

    def open(self) -> BatchAction:
        """Load calibrations and kernels; called once in each process.

        Raises:
            Exception: the work cannot be done at all; the run ends with its sentence.
        """


@dataclass(frozen=True)
class TaskDone:
    """A task and its result."""

    number: int
    result: Any


@dataclass(frozen=True)
class TaskFailed:
    """A task whose action raised an error."""

    number: int
    error: Exception


LossKind: TypeAlias = Literal["killed", "out-of-memory", "scheduler"]


@dataclass(frozen=True)
class TaskLost:
    """A task whose process ended before it returned a result.

    `process` names the process, so that several tasks it had count one end; empty: its only one.
    """

    number: int
    kind: LossKind
    cause: str
    process: str = ""


TaskOutcome: TypeAlias = TaskDone | TaskFailed | TaskLost


class BatchExecutor(Protocol):
    """Computes tasks, at most `capacity` at a time: what waits occupies no memory of a worker."""

    @property
    def capacity(self) -> int:
        """Tasks that may be in work now."""

    @property
    def description(self) -> str:
        """Where the work is done, in words for a person."""

    def start(self, work: BatchWork) -> None:
        """Open the work; returns when one process is ready.

        Raises:
            Exception: what `BatchWork.open` raised.
        """

    def submit(self, task: BatchTask) -> None:
        """Begin a task; never called for more than `capacity` at a time."""

    def wait(self, timeout_s: float) -> list[TaskOutcome]:
        """Outcomes since the last call; waits for the first one up to `timeout_s`.

        Raises:
            ExecutorEndedError: it cannot continue.
        """

    def close(self, timeout_s: float) -> list[TaskOutcome]:
        """Let tasks in work finish for up to `timeout_s`, then end all processes.

        Returns:
            Outcomes of tasks that finished.
        """
