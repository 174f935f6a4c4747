"""Exposures are begun before they are sealed where that is safe, and written only afterwards."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.service.messages import Process, RecordFinalized, Recycle


def exposure(number: int) -> Any:
    return SimpleNamespace(number=number)


def ready_queue() -> PipelineQueue:
    queue = PipelineQueue(1)
    assert queue.ready() == []
    return queue


def test_a_provisional_exposure_frees_its_processor_and_is_published_when_sealed() -> None:
    queue, first = ready_queue(), exposure(1)
    queue.retain(1, {"SU00": 2})
    assert queue.provisional(first) == [Process(first, {"SU00": 2}, is_sealed=False)]
    assert queue.frames_read(1) == [Recycle({"SU00": 2})]
    assert queue.staged(1) == [] and len(queue) == 0
    assert queue.sealed(first) == [RecordFinalized(1, is_confirmed=True)]
    assert len(queue) == 1, "it is not published yet"
    assert queue.finished(1) == [] and len(queue) == 0


def test_an_exposure_that_waits_for_its_record_delays_no_other() -> None:
    """Its disk may refuse the record for an hour."""
    queue = ready_queue()
    queue.provisional(exposure(1))
    assert queue.sealed(exposure(2)) == []
    assert queue.staged(1) == [Process(exposure(2), None)]
    assert queue.sealed(exposure(1)) == [RecordFinalized(1, is_confirmed=True)]
    assert queue.sealed(exposure(3)) == []
    assert queue.finished(1) == [], "exposure 2 is in progress"
    assert queue.finished(2) == [Process(exposure(3), None)]


def test_a_record_that_is_sealed_while_its_products_are_computed_counts_once() -> None:
    queue, first = ready_queue(), exposure(1)
    queue.provisional(first)
    assert queue.sealed(first) == [RecordFinalized(1, is_confirmed=True)]
    assert queue.staged(1) == [] and len(queue) == 1, "sent before the record arrived"
    assert queue.finished(1) == [] and len(queue) == 0


@pytest.mark.parametrize("is_staged", [False, True])
def test_an_exposure_with_another_record_is_processed_again(is_staged: bool) -> None:
    queue, other = ready_queue(), SimpleNamespace(number=1, mark_source="interpolated")
    queue.provisional(exposure(1))
    if is_staged:
        queue.staged(1)
    dropped, again = queue.sealed(cast(Any, other))
    assert dropped == RecordFinalized(1, is_confirmed=False)
    assert again == Process(cast(Any, other), None, is_sealed=True)
    assert queue.finished(1) == [] and len(queue) == 0


def test_an_unsealed_exposure_that_failed_is_tried_again_when_sealed() -> None:
    queue, first = ready_queue(), exposure(1)
    queue.provisional(first)
    assert queue.finished(1) == [] and len(queue) == 0
    assert queue.sealed(first) == [Process(first, None, is_sealed=True)]


def test_one_that_was_still_waiting_when_it_was_sealed_is_begun_as_sealed() -> None:
    queue, first = PipelineQueue(1), exposure(1)
    assert queue.provisional(first) == queue.sealed(first) == []
    assert queue.ready() == [Process(first, None, is_sealed=True)]


def test_an_exposure_that_is_never_sealed_frees_its_pipeline_and_memory() -> None:
    queue = ready_queue()
    queue.retain(1, {"SU00": 0})
    queue.provisional(exposure(1))
    assert queue.not_sealed(1) == [RecordFinalized(1, is_confirmed=False), Recycle({"SU00": 0})]
    assert len(queue) == 0


def test_an_exposure_behind_an_older_one_frees_its_memory_and_is_read_from_disk() -> None:
    queue = ready_queue()
    for number in (1, 2, 3):
        queue.retain(number, {"SU00": number})
    assert queue.stored(1) == []
    assert queue.stored(2) == [Recycle({"SU00": 2})]
    assert queue.sealed(exposure(1)) == [Process(exposure(1), {"SU00": 1})]
    assert queue.sealed(exposure(2)) == [] and len(queue) == 2
    assert queue.frames_read(1) == [Recycle({"SU00": 1})]
    assert queue.stored(3) == [Recycle({"SU00": 3})], "exposure 2 waits before it"
    assert queue.finished(1) == [Process(exposure(2), None)]


def test_frames_that_the_disk_refused_are_freed() -> None:
    queue = ready_queue()
    queue.retain(1, {"SU00": 0})
    assert queue.not_stored(1) == [Recycle({"SU00": 0})]
    assert queue.not_stored(1) == []
