"""Queue of exposures for the pipeline, and their frames in memory.

The pipeline never delays capture. An exposure that has to wait is read from disk later and gets the
flag PROCESSING_BEHIND.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from daemon.mission.exposure import Exposure
from daemon.onboard.service.messages import Process, RecordFinalized, Recycle

Messages: TypeAlias = list[Process | RecordFinalized | Recycle]
"""Messages to the worker, and slots to return to capture, in this order."""


@dataclass(frozen=True)
class _QueuedExposure:
    """An exposure waiting for the worker; `slots` while its frames are still in memory."""

    exposure: Exposure
    slots: Mapping[str, int] | None
    is_sealed: bool = True


class PipelineQueue:
    """Exposures for the worker, a limited number at a time.

    Every change returns the messages that follow from it. `is_ready` is true once the worker has
    loaded its kernels.

    Args:
        parallel_exposures: exposures processed at a time.
    """

    def __init__(self, parallel_exposures: int) -> None:
        self._max_in_progress = parallel_exposures
        self.is_ready = False
        self._in_progress: set[int] = set()
        self._provisional: dict[int, Exposure] = {}
        self._waiting: deque[_QueuedExposure] = deque()
        self._in_memory: dict[int, Mapping[str, int]] = {}

    def __len__(self) -> int:
        return len(self._waiting) + len(self._in_progress)

    def retain(self, number: int, slots: Mapping[str, int]) -> None:
        """Retain the slots of an exposure's frames; they are not reused yet."""
        self._in_memory[number] = slots

    def stored(self, number: int) -> Messages:
        """The disk has the frames."""
        if self._waiting or any(other < number for other in self._in_memory):
            # An older exposure is still being worked on: this one is read from disk later.
            return list(self._release(number))
        return []

    def not_stored(self, number: int) -> Messages:
        """The disk refused the frames."""
        return list(self._release(number))

    def provisional(self, exposure: Exposure) -> Messages:
        """Enqueue an exposure with a provisional record; `sealed` or `not_sealed` follows."""
        self._provisional[exposure.number] = exposure
        return self._enqueue(exposure, is_sealed=False)

    def sealed(self, exposure: Exposure) -> Messages:
        """The record is final: an exposure may be processed, or its products published."""
        number = exposure.number
        begun = self._provisional.pop(number, None)
        if begun is None or self._remove_waiting(number):
            return self._enqueue(exposure, is_sealed=True)
        if begun == exposure:
            self._in_progress.add(number)
            return [RecordFinalized(number, is_confirmed=True)]
        # Its mark was reassigned: it is processed again.
        self._in_progress.discard(number)
        again = self._enqueue(exposure, is_sealed=True)
        return [RecordFinalized(number, is_confirmed=False), *again]

    def not_sealed(self, number: int) -> Messages:
        """The disk has no record of it: drop its products."""
        begun = self._provisional.pop(number, None)
        if begun is None or self._remove_waiting(number):
            return self.finished(number)
        return [RecordFinalized(number, is_confirmed=False), *self.finished(number)]

    def ready(self) -> Messages:
        """The worker has loaded its kernels."""
        self.is_ready = True
        return list(self._begin_waiting())

    def frames_read(self, number: int) -> Messages:
        """The frames are no longer needed in memory."""
        return list(self._release(number))

    def staged(self, number: int) -> Messages:
        """The worker has processed an unsealed exposure; `sealed` or `not_sealed` follows."""
        if number in self._provisional:
            self._in_progress.discard(number)
        return list(self._begin_waiting())

    def finished(self, number: int) -> Messages:
        """The worker has processed an exposure, or could not."""
        self._provisional.pop(number, None)
        self._in_progress.discard(number)
        return [*self._release(number), *self._begin_waiting()]

    def _enqueue(self, exposure: Exposure, *, is_sealed: bool) -> Messages:
        slots = self._in_memory.get(exposure.number)
        self._waiting.append(_QueuedExposure(exposure, slots, is_sealed))
        return list(self._begin_waiting())

    def _remove_waiting(self, number: int) -> bool:
        """Remove an unsealed exposure from the queue; True if it was still waiting."""
        waiting = [task for task in self._waiting if task.exposure.number != number]
        was_waiting = len(waiting) < len(self._waiting)
        self._waiting = deque(waiting)
        return was_waiting

    def _release(self, number: int) -> Iterator[Recycle]:
        slots = self._in_memory.pop(number, None)
        if slots is not None:
            yield Recycle(slots)

    def _begin_waiting(self) -> Iterator[Process]:
        while self.is_ready and self._waiting and len(self._in_progress) < self._max_in_progress:
            task = self._waiting.popleft()
            self._in_progress.add(task.exposure.number)
            yield Process(task.exposure, task.slots, task.is_sealed)
