"""Exposures are begun before they are sealed where that is safe, and written only afterwards."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.service.messages import (
    Process,
    Processed,
    RecordFinalized,
    Recycle,
    WorkerReady,
)


class Bench:
    """A queue and what it sent to the worker and to the heads."""

    def __init__(self, parallel_exposures: int = 1) -> None:
        self.worker: list[Any] = []
        self.recycled: list[Any] = []
        self.queue = PipelineQueue(parallel_exposures, self._send, _untold)

    def _send(self, name: str, message: object) -> None:
        if name == "worker":
            self.worker.append(message)
        elif isinstance(message, Recycle):
            self.recycled.append(dict(message.slots))


def _untold(event: str, **content: Any) -> None:
    """Nobody listens."""


def exposure(number: int) -> Any:
    return SimpleNamespace(number=number)


def test_a_provisional_exposure_is_begun_once_and_finalized_when_sealed() -> None:
    bench = Bench()
    bench.queue.dispatch(WorkerReady(0.0))
    bench.queue.retain(1, {"SU00": 2})
    first = exposure(1)
    bench.queue.provisional(first)
    bench.queue.sealed(first)
    assert bench.worker == [Process(first, {"SU00": 2}, is_sealed=False), RecordFinalized(1, first)]
    bench.queue.dispatch(Processed(1, {}, {}, 0.1))
    assert len(bench.queue) == 0 and bench.recycled == [{"SU00": 2}]


def test_one_that_was_still_waiting_when_it_was_sealed_is_begun_as_sealed() -> None:
    bench = Bench()
    first = exposure(1)
    bench.queue.provisional(first)
    bench.queue.sealed(first)
    bench.queue.dispatch(WorkerReady(0.0))
    assert bench.worker == [Process(first, None, is_sealed=True)]


def test_an_exposure_that_is_never_sealed_frees_its_pipeline_and_memory() -> None:
    bench = Bench()
    bench.queue.dispatch(WorkerReady(0.0))
    bench.queue.retain(1, {"SU00": 0})
    bench.queue.provisional(exposure(1))
    bench.queue.not_sealed(1)
    assert bench.worker[-1] == RecordFinalized(1, None)
    assert len(bench.queue) == 0 and bench.recycled == [{"SU00": 0}]
