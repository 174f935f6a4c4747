"""Apply one action to every exposure of a mission, and continue after failures.

Every command over the exposures of a mission uses this. Failures are returned with their causes;
the command lists them at its end (`daemon.cli.exit_status`).
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from daemon import DaemonError

T = TypeVar("T")

_UNWRITABLE_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS})
"""Errors of the disk that fail for every exposure: the batch ends there."""


@dataclass(frozen=True)
class ExposureFailure:
    """An exposure that a command could not do, and why."""

    exposure: int
    cause: str

    def as_json(self) -> dict[str, int | str]:
        """As an object of JSON types."""
        return {"exposure": self.exposure, "cause": self.cause}


@dataclass(frozen=True)
class BatchResult(Generic[T]):
    """Outcome of each exposure, in order: a result, or a failure."""

    results: Mapping[int, T]
    failures: tuple[ExposureFailure, ...]


def for_each_exposure(
    numbers: Iterable[int],
    action: Callable[[int], T],
    progress: Callable[[int], None] = lambda _done: None,
) -> BatchResult[T]:
    """Apply an action to exposures one after another; a failed one does not end the batch.

    A full or read-only disk ends it: the remaining exposures are listed as not attempted.

    Args:
        numbers: of the exposures.
        action: processes one of them.
        progress: called with the count of exposures done, failed ones among them.
    """
    pending = list(numbers)
    results: dict[int, T] = {}
    failures: list[ExposureFailure] = []
    for done, number in enumerate(pending, start=1):
        try:
            results[number] = action(number)
        except OSError as error:
            failures.append(ExposureFailure(number, cause_of(error)))
            if error.errno in _UNWRITABLE_ERRNOS:
                cause = f"not attempted, because of exposure {number}: {error.strerror}"
                failures += [ExposureFailure(n, cause) for n in pending[done:]]
                break
        except Exception as error:  # noqa: BLE001 - whatever one exposure holds, the next is done
            failures.append(ExposureFailure(number, cause_of(error)))
        progress(done)
    return BatchResult(results, tuple(failures))


def cause_of(error: Exception) -> str:
    """Why an exposure failed, as a message; errors of libraries are named by their kind."""
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}"
    if isinstance(error, DaemonError):
        return str(error)
    return f"{type(error).__name__}: {error}"
