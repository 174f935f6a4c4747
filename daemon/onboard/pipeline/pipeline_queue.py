"""Sealed exposures on their way through the pipeline, and the frames kept in memory for it.

The pipeline never holds up capture: what it is too slow for is read from disk later, and says so.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from daemon.mission.exposure import Exposure
from daemon.onboard.flight.decisions import Decision
from daemon.onboard.service.desk import Desk
from daemon.onboard.service.hearing import Tell
from daemon.onboard.service.messages import (
    FramesRead,
    Judged,
    NoteProducts,
    Process,
    Processed,
    ProcessFailed,
    Recycle,
    Settled,
    WorkerReady,
)


@dataclass(frozen=True)
class _Waiting:
    """An exposure waiting for the worker; `slots` while its frames are still in memory."""

    exposure: Exposure
    slots: Mapping[str, int] | None
    is_sealed: bool = True


class PipelineQueue(Desk):
    """Hands exposures to the worker, so many at a time.

    Args:
        lanes: exposures in work at a time.
        send: sends a message to a process of ours, by its name.
        tell: told of what became of an exposure.
        decided: told of when an exposure is processed, and from where.
        seen: told how bright an exposure became, counts of DN by sensor.
    """

    def __init__(
        self,
        lanes: int,
        send: Callable[[str, object], None],
        tell: Tell,
        decided: Callable[[Decision], None] = lambda _: None,
        seen: Callable[[int, Mapping[str, Sequence[int]]], None] = lambda _number, _counts: None,
    ) -> None:
        self._lanes = lanes
        self._send = send
        self._tell = tell
        self._decided = decided
        self._seen = seen
        self.is_ready = False
        self._in_work: set[int] = set()
        self._unsealed: set[int] = set()
        self._waiting: deque[_Waiting] = deque()
        self._in_memory: dict[int, Mapping[str, int]] = {}

    def __len__(self) -> int:
        return len(self._waiting) + len(self._in_work)

    def keep(self, number: int, slots: Mapping[str, int]) -> None:
        """The frames of an exposure lie in these slots; they are not filled again yet."""
        self._in_memory[number] = slots

    def stored(self, number: int) -> None:
        """The disk has the frames."""
        if self._waiting or any(other < number for other in self._in_memory):
            # An older exposure is still being worked on: this one is read from disk later.
            self.recycle(self._in_memory.pop(number))

    def not_stored(self, number: int) -> None:
        """The disk refused the frames; the flight hands back their slots."""
        self._in_memory.pop(number, None)

    def foreseen(self, exposure: Exposure) -> None:
        """An exposure may be begun; its record is as good as certain, and `sealed` will follow."""
        self._unsealed.add(exposure.number)
        self._wait(exposure, is_sealed=False)

    def sealed(self, exposure: Exposure) -> None:
        """An exposure may be processed, and its products written."""
        if exposure.number in self._unsealed and not self._forget(exposure.number):
            self._send("worker", Settled(exposure.number, exposure))
        else:
            self._wait(exposure, is_sealed=True)

    def not_sealed(self, number: int) -> None:
        """The disk has no record of it: what was begun comes to nothing."""
        if number in self._unsealed and not self._forget(number):
            self._send("worker", Settled(number, None))
        self._is_done(number)

    def _wait(self, exposure: Exposure, *, is_sealed: bool) -> None:
        slots = self._in_memory.get(exposure.number)
        self._waiting.append(_Waiting(exposure, slots, is_sealed))
        self._feed()

    def _forget(self, number: int) -> bool:
        """An unsealed exposure is one no longer; whether it was still waiting, and does not now."""
        self._unsealed.discard(number)
        waiting = [task for task in self._waiting if task.exposure.number != number]
        was_waiting = len(waiting) < len(self._waiting)
        self._waiting = deque(waiting)
        return was_waiting

    def recycle(self, slots: Mapping[str, int]) -> None:
        """These slots, by head, may be filled again."""
        self._send("capture", Recycle(slots))

    def _on_worker_ready(self, ready: WorkerReady) -> None:
        self._tell("kernels", warm_up_s=round(ready.warm_up_s, 2))
        self.is_ready = True
        self._feed()

    def _on_frames_read(self, read: FramesRead) -> None:
        if read.number in self._in_memory:
            self.recycle(self._in_memory.pop(read.number))

    def _on_judged(self, judged: Judged) -> None:
        self._tell("judged", number=judged.number, report=dict(judged.report))

    def _on_processed(self, done: Processed) -> None:
        seconds = round(done.duration_s, 3)
        self._tell("processed", number=done.number, report=dict(done.report), duration_s=seconds)
        self._seen(done.number, done.histograms)
        verdict = done.report.get("verdict")
        self._send("writer", NoteProducts(done.number, done.files, verdict))
        self._is_done(done.number)

    def _on_failed(self, failed: ProcessFailed) -> None:
        self._tell(
            "not-processed",
            number=failed.number,
            sentence=failed.sentence,
            report=dict(failed.report),
        )
        self._is_done(failed.number)

    def _is_done(self, number: int) -> None:
        self._in_work.discard(number)
        if number in self._in_memory:
            self.recycle(self._in_memory.pop(number))
        self._feed()

    def _feed(self) -> None:
        while self.is_ready and self._waiting and len(self._in_work) < self._lanes:
            task = self._waiting.popleft()
            number, deferred = task.exposure.number, task.slots is None
            self._in_work.add(number)
            now_ns = time.monotonic_ns()
            self._decided(Decision("process", now_ns, number, {"deferred": deferred}))
            self._send("worker", Process(task.exposure, task.slots, task.is_sealed))

    handlers: ClassVar = {
        WorkerReady: _on_worker_ready,
        FramesRead: _on_frames_read,
        Judged: _on_judged,
        Processed: _on_processed,
        ProcessFailed: _on_failed,
    }
