"""The work of `syntopic verify`: one exposure's folder compared with what is expected of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from daemon.mission.verification.verified_exposure import (
    ExpectedExposure,
    FoundExposure,
    check_exposure,
)
from daemon.postflight.batch.batch_run import run_batch
from daemon.postflight.batch.capacity import PROCESS_NBYTES
from daemon.postflight.batch.executor import BatchExecutor, BatchTask

BLOCKS_NBYTES: Final = 16_000_000
"""What is in memory of a file that is hashed, and the records."""


@dataclass(frozen=True)
class VerificationWork:
    """Nothing is in common to all exposures; `threads` is of one process."""

    threads: int = 1

    @property
    def memory_nbytes(self) -> int:
        return PROCESS_NBYTES + BLOCKS_NBYTES

    def open(self) -> VerificationAction:
        """Nothing is loaded."""
        return VerificationAction()


class VerificationAction:
    """Compares one exposure at a time."""

    def clone(self) -> VerificationAction:
        """The same: it has no buffers."""
        return self

    def __call__(self, task: BatchTask) -> tuple[FoundExposure, int]:
        """What was found of the exposure, and the bytes that were read.

        Raises:
            OSError: the folder cannot be reached.
        """
        counts: list[int] = []
        found = check_exposure(task.payload, counts.append)
        return found, sum(counts)


def verified_by(
    executor: BatchExecutor,
) -> Callable[[Sequence[ExpectedExposure], Callable[[int], None]], list[FoundExposure]]:
    """Compares exposures on an executor, for `daemon.mission.verification.verification.verify`.

    An exposure that no process could compare is a problem of the mission, with the cause.

    Args:
        executor: where they are compared.
    """

    def check_all(
        expected: Sequence[ExpectedExposure], step: Callable[[int], None]
    ) -> list[FoundExposure]:
        outcome = run_batch(
            executor, VerificationWork(), [BatchTask(one.number, one) for one in expected]
        )
        if outcome.is_interrupted:
            raise KeyboardInterrupt
        causes = {failure.exposure: failure.cause for failure in outcome.failures}
        found = []
        for one in expected:
            if one.number in outcome.results:
                exposure, nbytes = outcome.results[one.number]
                step(nbytes)
            else:
                exposure = FoundExposure(one.number, one.folder.name, is_readable=False)
                exposure.add_problem(f"could not be verified: {causes[one.number]}")
            found.append(exposure)
        return found

    return check_all
