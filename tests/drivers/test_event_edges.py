"""Event marks are of the configured edge; where only the other one comes, that is reported."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from drivers.base import registry
from drivers.contract import DeviceEvent, EventMark, NavSample
from sim_hw.receivers.emulated_receiver import STROBE_WIDTH_NS, EmulatedReceiver
from sim_hw.receivers.septentrio_messages import FALLING, RISING
from sim_hw.receivers.septentrio_receiver import SeptentrioReceiver
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.world.world_clock import WorldClock
from tests.drivers.fakes import FakeClock, FakePort, RecordingSink, running
from tests.drivers.ubx_frames import nav_pvt, tim_tm2
from tests.sim_hw.receiver_state import state_at

WITHIN_S = 30.0
STROBES = 4
STROBE_INTERVAL_NS = 310_000_000
UTC = (2026, 11, 21, 9, 0, 0)


def fly(
    driver: str, receiver: EmulatedReceiver, clock: WorldClock, enough: type[Any], **settings: Any
) -> tuple[list[int], RecordingSink, Any]:
    """Strobes at a receiver that the driver reads, until so many marks or one event came."""
    navigator = registry.driver_for("navigator", driver)(
        "gnss", {"port": receiver.port, **settings}
    )
    recorder, done = RecordingSink(), threading.Event()

    def watch(_: object) -> None:
        marks = sum(isinstance(r, EventMark) for r in recorder.records)
        reported = any(e.name == "other-edge" for e in recorder.events)
        if marks == STROBES if enough is EventMark else reported:
            done.set()

    recorder.stop = watch
    receiver.start()
    try:
        navigator.bind()
        first_ns = clock.gps_ns(time.monotonic_ns()) + 200_000_000
        strobes = [first_ns + n * STROBE_INTERVAL_NS for n in range(STROBES)]
        for strobe_ns in strobes:
            receiver.mark(strobe_ns)
        with running(navigator, recorder):
            assert done.wait(WITHIN_S), navigator.statistics()
    finally:
        receiver.close()
    return strobes, recorder, navigator


@pytest.mark.trust
@pytest.mark.parametrize("edge", ["rising", "falling"])
@pytest.mark.parametrize(("driver", "within_ns"), [("ublox", 0), ("septentrio", 1)])
def test_the_configured_edge_of_a_strobe_is_its_mark(
    driver: str, within_ns: int, edge: str
) -> None:
    clock = WorldClock.from_wall_clock()
    receiver: EmulatedReceiver
    # A strobe that is high in rest: it falls at mid-exposure and rises at its end.
    if driver == "ublox":
        receiver = UbloxReceiver(clock, state_at, is_active_low=True)
    else:
        receiver = SeptentrioReceiver(clock, state_at, is_active_low=True)
        receiver.reported_edges = frozenset((RISING, FALLING))
    strobes, recorder, _ = fly(driver, receiver, clock, EventMark, edge=edge)
    late_ns = STROBE_WIDTH_NS if edge == "rising" else 0
    marks = [r for r in recorder.records if isinstance(r, EventMark)]
    for mark, strobe_ns in zip(marks, strobes, strict=True):
        assert abs(mark.gps_ns - strobe_ns - late_ns) <= within_ns
        assert mark.time_valid
    has_count = driver == "ublox" and edge == "rising"
    assert {mark.count_bits for mark in marks} == {16 if has_count else 0}
    assert "other-edge" not in recorder.event_names, "both edges of a strobe are its own"


@pytest.mark.trust
def test_a_septentrio_that_reports_the_other_edge_only_is_named_with_the_cure() -> None:
    clock = WorldClock.from_wall_clock()
    receiver = SeptentrioReceiver(clock, state_at)
    receiver.reported_edges = frozenset((FALLING,))
    _, recorder, navigator = fly("septentrio", receiver, clock, DeviceEvent)
    assert not [r for r in recorder.records if isinstance(r, EventMark)]
    (event,) = [e for e in recorder.events if e.name == "other-edge"]
    assert event.is_fault
    assert "reported 3 event marks of the falling edge" in event.sentence
    assert 'Set edge = "falling"' in event.sentence
    assert navigator.statistics()["marks_other_edge"] >= 3


def ublox_events(edges: list[tuple[bool, bool]], **settings: Any) -> tuple[list[Any], Any]:
    """What a u-blox with these new edges (rising, falling), one message each, makes."""
    clock, sink = FakeClock(), RecordingSink()
    messages = [nav_pvt(0, UTC)]
    for n, (rising, falling) in enumerate(edges):
        messages.append(tim_tm2(2445, 1000 * n, 7, rising=rising, falling=falling))
    waiting = iter(messages)
    port = FakePort(clock, lambda _: next(waiting, b""))
    navigator = registry.driver_for("navigator", "ublox")(
        "gnss",
        {"port": "x", **settings},
        clock=clock,
        open_port=lambda *_: port,
    )
    navigator.emitter.sink = sink
    line = navigator._open()
    for _ in messages:
        for record in navigator.step(line):
            sink(record)
    return sink.records, navigator


@pytest.mark.trust
def test_a_ublox_that_reports_the_other_edge_only_is_named_with_its_count() -> None:
    records, navigator = ublox_events([(False, True)] * 5)
    (event,) = [r for r in records if isinstance(r, DeviceEvent) and r.name == "other-edge"]
    assert "reported 3 event marks of the falling edge and none of the rising one" in event.sentence
    assert navigator.statistics()["marks_other_edge"] == 5
    assert [type(r) for r in records if isinstance(r, EventMark | NavSample)] == [NavSample]


def test_two_stray_edges_between_marks_are_counted_and_not_reported() -> None:
    records, navigator = ublox_events(([(False, True)] * 2 + [(True, True)]) * 3)
    assert not [r for r in records if isinstance(r, DeviceEvent) and r.name == "other-edge"]
    assert navigator.statistics()["marks_other_edge"] == 6
    assert sum(isinstance(r, EventMark) for r in records) == 3


def test_the_falling_edge_has_its_own_time_in_a_message_with_both() -> None:
    records, _ = ublox_events([(True, True)], edge="falling")
    (mark,) = [r for r in records if isinstance(r, EventMark)]
    assert mark.gps_ns % 1_000_000_000 == 1_000_007
