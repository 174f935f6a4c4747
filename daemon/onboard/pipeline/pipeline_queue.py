"""Queue of sealed exposures for the pipeline, and their frames in memory.

The pipeline never delays capture. An exposure that has to wait is read from disk later and gets the
flag PROCESSING_BEHIND.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from daemon.mission.exposure import Exposure
from daemon.onboard.flight.decisions import Decision
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import (
    FramesRead,
    IndexProducts,
    Process,
    Processed,
    ProcessFailed,
    RecordFinalized,
    Recycle,
    VerdictReady,
    WorkerReady,
)
from daemon.onboard.service.record_ingest import EmitEvent


@dataclass(frozen=True)
class _QueuedExposure:
    """An exposure waiting for the worker; `slots` while its frames are still in memory."""

    exposure: Exposure
    slots: Mapping[str, int] | None
    is_sealed: bool = True


class PipelineQueue(MessageDispatcher):
    """Passes exposures to the worker, a limited number at a time.

    Args:
        parallel_exposures: exposures processed at a time.
        send: sends a message to a process, by its name.
        emit: emits the event of each result.
        on_decision: called when an exposure is processed, with its source.
        on_histograms: called with the raw histograms of an exposure, counts of DN by sensor.
    """

    def __init__(
        self,
        parallel_exposures: int,
        send: Callable[[str, object], None],
        emit: EmitEvent,
        on_decision: Callable[[Decision], None] = lambda _: None,
        on_histograms: Callable[
            [int, Mapping[str, Sequence[int]]], None
        ] = lambda _number, _counts: None,
    ) -> None:
        self._max_in_progress = parallel_exposures
        self._send = send
        self._emit = emit
        self._on_decision = on_decision
        self._on_histograms = on_histograms
        self.is_ready = False
        self._in_progress: set[int] = set()
        self._unsealed: set[int] = set()
        self._waiting: deque[_QueuedExposure] = deque()
        self._in_memory: dict[int, Mapping[str, int]] = {}

    def __len__(self) -> int:
        return len(self._waiting) + len(self._in_progress)

    def retain(self, number: int, slots: Mapping[str, int]) -> None:
        """Retain the slots of an exposure's frames; they are not reused yet."""
        self._in_memory[number] = slots

    def stored(self, number: int) -> None:
        """The disk has the frames."""
        if self._waiting or any(other < number for other in self._in_memory):
            # An older exposure is still being worked on: this one is read from disk later.
            self.recycle(self._in_memory.pop(number))

    def not_stored(self, number: int) -> None:
        """The disk refused the frames; the flight returns their slots."""
        self._in_memory.pop(number, None)

    def provisional(self, exposure: Exposure) -> None:
        """Enqueue an exposure with a provisional record; `sealed` or `not_sealed` follows."""
        self._unsealed.add(exposure.number)
        self._enqueue(exposure, is_sealed=False)

    def sealed(self, exposure: Exposure) -> None:
        """An exposure may be processed, and its products written."""
        if exposure.number in self._unsealed and not self._remove_waiting(exposure.number):
            self._send("worker", RecordFinalized(exposure.number, exposure))
        else:
            self._enqueue(exposure, is_sealed=True)

    def not_sealed(self, number: int) -> None:
        """The disk has no record of it: drop its products."""
        if number in self._unsealed and not self._remove_waiting(number):
            self._send("worker", RecordFinalized(number, None))
        self._finish(number)

    def _enqueue(self, exposure: Exposure, *, is_sealed: bool) -> None:
        slots = self._in_memory.get(exposure.number)
        self._waiting.append(_QueuedExposure(exposure, slots, is_sealed))
        self._dispatch_waiting()

    def _remove_waiting(self, number: int) -> bool:
        """Remove an unsealed exposure from the queue; True if it was still waiting."""
        self._unsealed.discard(number)
        waiting = [task for task in self._waiting if task.exposure.number != number]
        was_waiting = len(waiting) < len(self._waiting)
        self._waiting = deque(waiting)
        return was_waiting

    def recycle(self, slots: Mapping[str, int]) -> None:
        """Return these slots, by head, to capture."""
        self._send("capture", Recycle(slots))

    def _on_worker_ready(self, ready: WorkerReady) -> None:
        self._emit("kernels", warm_up_s=round(ready.warm_up_s, 2))
        self.is_ready = True
        self._dispatch_waiting()

    def _on_frames_read(self, read: FramesRead) -> None:
        if read.number in self._in_memory:
            self.recycle(self._in_memory.pop(read.number))

    def _on_verdict_ready(self, verdict: VerdictReady) -> None:
        self._emit("judged", number=verdict.number, report=dict(verdict.report))

    def _on_processed(self, done: Processed) -> None:
        seconds = round(done.duration_s, 3)
        self._emit("processed", number=done.number, report=dict(done.report), duration_s=seconds)
        self._on_histograms(done.number, done.histograms)
        self._send("writer", IndexProducts(done.number, done.files, done.report.get("verdict")))
        self._finish(done.number)

    def _on_failed(self, failed: ProcessFailed) -> None:
        self._emit(
            "not-processed",
            number=failed.number,
            sentence=failed.sentence,
            report=dict(failed.report),
        )
        self._finish(failed.number)

    def _finish(self, number: int) -> None:
        self._in_progress.discard(number)
        if number in self._in_memory:
            self.recycle(self._in_memory.pop(number))
        self._dispatch_waiting()

    def _dispatch_waiting(self) -> None:
        while self.is_ready and self._waiting and len(self._in_progress) < self._max_in_progress:
            task = self._waiting.popleft()
            number, deferred = task.exposure.number, task.slots is None
            self._in_progress.add(number)
            now_ns = time.monotonic_ns()
            self._on_decision(Decision("process", now_ns, number, {"deferred": deferred}))
            self._send("worker", Process(task.exposure, task.slots, task.is_sealed))

    handlers: ClassVar = {
        WorkerReady: _on_worker_ready,
        FramesRead: _on_frames_read,
        VerdictReady: _on_verdict_ready,
        Processed: _on_processed,
        ProcessFailed: _on_failed,
    }
