"""The pulse per second on the real kernel: pps_parport stamps interrupts of a parallel port.

Pulses are made by strobing the port's own control register, whose acknowledgement the machine's
port answers with its interrupt.
"""

from __future__ import annotations

import os
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.contract import DeviceEvent, PpsEdge, Record
from drivers.triggers.pps.binding import CAN_WAIT, CAPTURE_ASSERT, KernelPps
from drivers.triggers.pps.device import PpsDevice

GUEST = Path(os.environ.get("KERNEL_GUEST", "/dev/kernel-guest"))
PORT, CONTROL, IRQ = 0x378, 0x37A, 7
IDLE, STROBE = 0x1C, 0x01
"""Interrupt enabled, selected, not in reset."""
TIMEOUT_S = 20.0


def load() -> None:
    subprocess.run(["insmod", GUEST / "modules/pps_parport.ko"], timeout=60, check=True)


def unload() -> None:
    subprocess.run(["rmmod", "pps_parport"], timeout=60, check=True)


@pytest.fixture(autouse=True)
def source() -> Iterator[None]:
    port = ["insmod", GUEST / "modules/parport_pc.ko", f"io={PORT:#x}", f"irq={IRQ}"]
    subprocess.run(port, timeout=60, check=True)
    load()
    yield
    unload()
    subprocess.run(["rmmod", "parport_pc"], timeout=60, check=True)


def pulse() -> tuple[int, int]:
    """One pulse; monotonic times before and after it."""
    with Path("/dev/port").open("r+b", buffering=0) as port:
        before = time.monotonic_ns()
        for value in (IDLE | STROBE, IDLE):
            port.seek(CONTROL)
            port.write(bytes([value]))
        return before, time.monotonic_ns()


class EdgeLog:
    """The driver's events, in order."""

    def __init__(self) -> None:
        self.edges: list[PpsEdge] = []
        self.events: list[DeviceEvent] = []
        self._changed = threading.Condition()

    def __call__(self, record: Record) -> None:
        with self._changed:
            if isinstance(record, PpsEdge):
                self.edges.append(record)
            elif isinstance(record, DeviceEvent):
                self.events.append(record)
            self._changed.notify_all()

    def has_edges(self, count: int, limit_s: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: len(self.edges) >= count, limit_s)

    def wait_edges(self, count: int) -> None:
        assert self.has_edges(count, TIMEOUT_S), self.events

    def wait_event(self, name: str, count: int = 1) -> None:
        with self._changed:
            assert self._changed.wait_for(
                lambda: [event.name for event in self.events].count(name) >= count, TIMEOUT_S
            ), self.events


def counted(device: PpsDevice) -> dict[str, int]:
    return {name: device.statistics()[name] for name in ("edges", "edges_missed")}


@contextmanager
def running() -> Iterator[tuple[PpsDevice, EdgeLog]]:
    device, seen = PpsDevice("pps", {"device": "/dev/pps0", "silence_s": 1.5}), EdgeLog()
    thread = threading.Thread(target=device.run, args=(seen,), daemon=True)
    thread.start()
    try:
        # An edge before the source is open is nobody's.
        first = time.monotonic() + TIMEOUT_S
        pulse()
        while not seen.has_edges(1, 2.0):
            assert time.monotonic() < first, seen.events
            pulse()
        yield device, seen
    finally:
        device.close()
        thread.join(TIMEOUT_S)
    assert not thread.is_alive()


def test_the_kernel_reports_the_capabilities_and_waits_no_longer_than_requested() -> None:
    pps = KernelPps("/dev/pps0")
    assert pps.capabilities() & CAPTURE_ASSERT
    assert pps.capabilities() & CAN_WAIT
    begin = time.monotonic()
    assert pps.fetch(0.5) is None
    assert time.monotonic() - begin < TIMEOUT_S
    pps.close()


def test_edges_carry_the_monotonic_time_of_their_interrupt() -> None:
    with running() as (device, seen):
        seen.edges.clear()
        brackets = []
        for count in range(1, 9):
            # Often enough the driver does not wait again yet.
            brackets.append(pulse())
            seen.wait_edges(count)
        assert [edge.sequence for edge in seen.edges] == list(
            range(seen.edges[0].sequence, seen.edges[0].sequence + 8)
        )
        for (before, after), edge in zip(brackets, seen.edges, strict=True):
            # An emulated processor takes its time to look at its interrupts.
            assert before - 3 * edge.sigma_ns <= edge.mono_ns <= after + 100_000_000
        assert device.statistics()["edges"] >= 9


def kernel_count() -> int:
    """How many edges the kernel itself has counted."""
    return int(Path("/sys/class/pps/pps0/assert").read_text().rpartition("#")[2])


def test_every_edge_of_a_burst_is_delivered_or_counted_as_missed() -> None:
    with running() as (device, _):
        already = kernel_count() - sum(counted(device).values())
        for _ in range(5):
            pulse()
        deadline = time.monotonic() + TIMEOUT_S
        while kernel_count() - sum(counted(device).values()) > already:
            assert time.monotonic() < deadline, (kernel_count(), already, device.statistics())
            time.sleep(0.1)


def test_a_source_that_goes_and_comes_again_is_used_again() -> None:
    with running() as (device, seen):
        unload()
        seen.wait_event("lost")
        load()
        seen.wait_event("opened", 2)
        seen.edges.clear()
        time.sleep(0.2)
        pulse()
        seen.wait_edges(1)
        assert device.statistics()["opened"] == 2
