"""Faults of an emulated GigE Vision head, seen through Aravis by the driver that flies."""

from __future__ import annotations

import mmap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.contract import CHUNK_ALLOWANCE_NBYTES, DeviceEvent, Frame, FrameStatus, Record
from sim_hw.faults.plan import PlannedFault
from sim_hw.gige.gige_head import ExposureRequest, FrameSize, GigeHead, HeadIdentity, WireFaults
from sim_hw.world.world_clock import FreeRunningClock

pytest.importorskip("gi", reason="needs PyGObject (extra aravis)")
pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]

ADDRESS = "127.61.7.2"
WIDTH_PX, HEIGHT_PX = 128, 96
WITHIN_S = 40.0
EXPOSURE_US = 500.0


def expose(request: ExposureRequest) -> NDArray[np.uint16]:
    """Every pixel contains the number of its pulse."""
    return np.full((HEIGHT_PX, WIDTH_PX), request.pulse_count, np.uint16)


class Memory:
    """Slots in an anonymous mapping."""

    slot_count = 4
    slot_nbytes = WIDTH_PX * HEIGHT_PX * 2 + CHUNK_ALLOWANCE_NBYTES

    def __init__(self) -> None:
        mapping = mmap.mmap(-1, self.slot_count * self.slot_nbytes)
        self.slots = np.frombuffer(mapping, np.uint8).reshape(self.slot_count, self.slot_nbytes)

    def address(self, slot: int) -> int:
        return int(self.slots[slot].ctypes.data)

    def first_pixel(self, slot: int) -> int:
        return int(self.slots[slot, :2].view(np.uint16)[0])


class Host:
    """The driver in its thread, and what it yielded: frames with the pulse of their pixels."""

    def __init__(self) -> None:
        from drivers.cameras.aravis.aravis_head import AravisHead

        self.memory = Memory()
        self.driver = AravisHead(
            "SU00",
            {
                "address": ADDRESS,
                "trigger_source": "line",
                "exposure_time_us": EXPOSURE_US,
                "latch_interval_s": 0.5,
            },
            memory=self.memory,
        )
        self.frames: list[tuple[int, Frame]] = []
        self.events: list[DeviceEvent] = []
        self.changed = threading.Condition()
        self.thread = threading.Thread(target=self.driver.run, args=(self.sink,))

    def sink(self, record: Record) -> None:
        with self.changed:
            if isinstance(record, Frame):
                self.frames.append((self.memory.first_pixel(record.slot), record))
                self.driver.recycle(record.slot)
            elif isinstance(record, DeviceEvent):
                self.events.append(record)
            self.changed.notify_all()

    def wait(self, is_so: Callable[[], bool], within_s: float = WITHIN_S) -> bool:
        with self.changed:
            return self.changed.wait_for(is_so, within_s)

    def named(self, name: str) -> int:
        return sum(event.name == name for event in self.events)


@contextmanager
def flying(*planned: PlannedFault) -> Iterator[tuple[GigeHead, Host]]:
    head = GigeHead(
        HeadIdentity(ADDRESS, "faulty-1", "test", "Syntopic emulator", "SU00"),
        FrameSize(WIDTH_PX, HEIGHT_PX),
        expose,
        lambda _: 30.0,
        FreeRunningClock(),
        faults=WireFaults(planned=planned),
    )
    head.start()
    host = Host()
    host.thread.start()
    try:
        assert host.wait(lambda: host.named("opened") >= 1)
        deadline = time.monotonic() + WITHIN_S
        while not head._acquisition.is_acquiring:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        head.channel.begin(time.monotonic_ns())
        yield head, host
    finally:
        host.driver.close()
        host.thread.join(10)
        head.close()


def at_pulse(name: str, pulse: int, amount: float = 0.0) -> PlannedFault:
    return PlannedFault(name, "SU00", None, pulse, None, amount)


def test_each_fault_of_a_frame_is_seen_as_what_it_is_and_touches_no_other() -> None:
    faults = (
        at_pulse("lost", 3),
        at_pulse("older-frame", 5),
        at_pulse("half-frame", 7),
        at_pulse("corrupt", 9),
        at_pulse("duplicate", 11),
        at_pulse("counter-reset", 13),
        at_pulse("clock-step", 15, 1.5),
        at_pulse("late", 17, 0.4),
    )
    with flying(*faults) as (head, host):
        for pulse in range(1, 20):
            head.line(time.monotonic_ns(), pulse)
            due = pulse - 1
            host.wait(lambda due=due: len(host.frames) >= due, 1.0)
            time.sleep(0.1)
        assert host.wait(lambda: len(host.frames) >= 19), "one is lost, one comes twice"
        frames = host.frames
    complete = [(pulse, f) for pulse, f in frames if f.status is FrameStatus.COMPLETE]
    others = [f.status for _, f in frames if f.status is not FrameStatus.COMPLETE]
    assert others.count(FrameStatus.INCOMPLETE) == 1, "half a frame"
    assert others.count(FrameStatus.CORRUPT) == 1, "a frame of another size"
    pulses = [pulse for pulse, _ in complete]
    assert sorted(pulses) == sorted([*(set(range(1, 20)) - {3, 5, 7, 9}), 4, 11])
    older = [f for pulse, f in complete if pulse == 4]
    assert older[0].device_ns == older[1].device_ns and older[0].counter == older[1].counter
    by_pulse = dict(complete)
    assert by_pulse[12].counter == 12 and by_pulse[14].counter == 2
    before, after = by_pulse[14].device_ns, by_pulse[16].device_ns
    assert before is not None and after is not None
    assert after - before > 1_500_000_000


@pytest.mark.parametrize(("name", "lasts_s"), [("cable-pulled", 4.0), ("power-cycle", 4.0)])
def test_a_head_that_goes_away_is_lost_and_back_by_itself(name: str, lasts_s: float) -> None:
    with flying(PlannedFault(name, "SU00", 0.5, None, lasts_s, 0.0)) as (head, host):
        assert host.wait(lambda: host.named("lost") >= 1)
        assert host.wait(lambda: host.named("opened") >= 2)
        deadline = time.monotonic() + WITHIN_S
        pulse = 1
        while not host.frames:
            assert time.monotonic() < deadline
            head.line(time.monotonic_ns(), pulse)
            pulse += 1
            host.wait(lambda: bool(host.frames), 0.3)
        assert host.frames[0][1].status is FrameStatus.COMPLETE
    assert head.statistics()["resets"] == (1 if name == "power-cycle" else 0)
