"""A head that cannot start, or stays silent, is reported once, and again once it delivers."""

from __future__ import annotations

import errno
import os
import select
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, cast

import pytest

from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.cameras.aravis.camera_access import ControlDeniedError
from drivers.cameras.aravis.head_session import AravisHeadLostError
from drivers.cameras.head_device import HeadDevice
from drivers.cameras.v4l2.v4l2_head import V4l2Head, _Session
from drivers.contract import DeviceError, LifeCycle, Record
from tests.drivers.fakes import FakeClock, RecordingSink
from tests.drivers.test_v4l2_hostile_buffers import Slots

FAILED_STARTS = 4


class FakeNode:
    """A video node whose stream starts, and gives a frame, as a test decides."""

    def __init__(self, start: Callable[[], None], has_frame: Callable[[], bool]) -> None:
        self.stream_on = start
        self.has_frame = has_frame
        self.clock = FakeClock()

    def make_buffers(self, count: int) -> int:
        return count

    def layout(self) -> None:
        return None

    def queue(self, index: int) -> None:
        pass

    def stream_off(self) -> None:
        pass

    def close(self) -> None:
        pass

    def check_alive(self) -> None:
        pass

    def wait(self, timeout_s: float) -> int:
        self.clock.now_ns += round(timeout_s * 1e9)
        return select.POLLIN if self.has_frame() else 0

    def dequeue(self) -> object:
        return object()


class FakeV4l2Head(V4l2Head):
    """A head on a `FakeNode`."""

    node: FakeNode

    def _open_device(self) -> None:
        camera = SimpleNamespace(
            node=self.node, layout=None, control_values=dict, temperature_c=lambda: None
        )
        self._session = _Session(cast(Any, camera), {})

    def _take(self, session: _Session, filled: object, sink: object) -> None:
        self.counters["frames"] += 1
        self._closing.set()


def v4l2_events(node: FakeNode, **settings: object) -> list[str]:
    head = FakeV4l2Head(
        "SU00", {"device": "/dev/video0", **settings}, memory=Slots(), clock=node.clock
    )
    head.node = node
    sink = RecordingSink()
    head.run(sink)
    assert head.state is LifeCycle.INACTIVE
    return sink.event_names


def test_a_v4l2_head_whose_stream_does_not_start_is_reported_once() -> None:
    left = [OSError(errno.EIO, os.strerror(errno.EIO))] * FAILED_STARTS

    def start() -> None:
        if left:
            raise left.pop()

    assert v4l2_events(FakeNode(start, lambda: True)) == ["lost", "opened"]


def test_a_silent_v4l2_head_is_reported_once_until_a_frame_comes() -> None:
    starts: list[None] = []

    def start() -> None:
        starts.append(None)

    events = v4l2_events(FakeNode(start, lambda: len(starts) > FAILED_STARTS), silence_s=3.0)
    assert events == ["opened", "lost", "opened"]
    assert len(starts) == FAILED_STARTS + 1


class FakeAravisHead(AravisHead):
    """A head whose control or start is refused as a test decides."""

    refusals: list[Exception]
    denials: list[Exception]

    def _open_now(self) -> Any:
        if self.denials:
            raise self.denials.pop()
        self._session = cast(Any, SimpleNamespace(is_lost=False, camera=self))
        return self._session

    held: Mapping[str, float | int | str] = {"ExposureAuto": "Off"}

    def start(self) -> None:
        if self.refusals:
            raise self.refusals.pop()

    def _deliver(self, session: object, sink: object) -> None:
        self._closing.set()

    def _close_session(self, session: object) -> None:
        pass


def aravis_events(refusals: list[Exception], denials: list[Exception]) -> list[str]:
    pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
    settings = {"address": "Maker-E-1", "control_wait_limit_s": 1.0}
    head = FakeAravisHead("SU00", settings, memory=Slots(), clock=FakeClock())
    head.refusals, head.denials = refusals, denials
    sink = RecordingSink()
    head.run(sink)
    return sink.event_names


def test_an_aravis_head_that_does_not_start_is_reported_once() -> None:
    refusals: list[Exception] = [AravisHeadLostError("no answer")] * FAILED_STARTS
    assert aravis_events(refusals, []) == ["lost", "opened"]


def test_a_head_under_the_control_of_another_is_reported_as_waiting_and_then_as_a_fault() -> None:
    denials: list[Exception] = [ControlDeniedError("SU00: in use")] * 12
    assert aravis_events([], denials) == ["held-by-another", "held-by-another", "opened"]


class StartsNever(HeadDevice):
    """A head that opens and fails before it begins to deliver; the fourth time it is closed."""

    starts = 0

    def _open_device(self) -> None:
        pass

    def _serve(self, sink: Callable[[Record], None]) -> None:
        self.starts += 1
        if self.starts == FAILED_STARTS:
            self._closing.set()
        self._emit_lost("The head SU00 was lost.")

    def _release_device(self) -> None:
        pass


def test_a_loss_and_the_refusals_to_reopen_are_one_report() -> None:
    head = StartsNever("SU00", {}, memory=Slots(), clock=FakeClock())
    sink = RecordingSink()
    errors = iter([DeviceError("no answer")] * 2)

    def open_device() -> None:
        for error in errors:
            raise error

    # Opens once, after two refusals.
    head._open_device = open_device  # type: ignore[method-assign]
    head.run(sink)
    assert sink.event_names == ["lost"]
    assert head.starts == FAILED_STARTS
