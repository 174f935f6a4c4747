"""A clock and a serial port that are controlled by a test."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drivers.contract import Device, DeviceError, DeviceEvent, Record


class FakeClock:
    """Time passes only where somebody waits."""

    def __init__(self) -> None:
        self.now_ns = 1_000_000_000
        self.waits_s: list[float] = []

    def mono_ns(self) -> int:
        return self.now_ns

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        self.waits_s.append(timeout_s)
        self.now_ns += round(timeout_s * 1e9)
        return event.is_set()


class FakePort:
    """A port whose bytes come from `answer`, asked whenever the driver finds nothing to read.

    Waiting for a byte that does not come costs the time-out on the clock.
    """

    def __init__(self, clock: FakeClock, answer: Callable[[FakePort], bytes]) -> None:
        self.clock = clock
        self.answer = answer
        self.timeout: float = 0.0
        self.written = b""
        self.closed = False
        self._ready = b""

    @property
    def in_waiting(self) -> int:
        return len(self._ready)

    def read(self, size: int = 1) -> bytes:
        if not self._ready:
            self._ready = self.answer(self)
        if not self._ready:
            self.clock.now_ns += round(self.timeout * 1e9)
        data, self._ready = self._ready[:size], self._ready[size:]
        return data

    def write(self, data: bytes, /) -> int:
        self.written += data
        return len(data)

    def close(self) -> None:
        self.closed = True


class RecordingSink:
    """A sink that remembers, and calls `stop` once enough has come."""

    def __init__(self) -> None:
        self.records: list[Record] = []
        self.stop: Callable[[Record], None] = lambda record: None

    def __call__(self, record: Record) -> None:
        self.records.append(record)
        self.stop(record)

    @property
    def events(self) -> list[DeviceEvent]:
        return [record for record in self.records if isinstance(record, DeviceEvent)]

    @property
    def event_names(self) -> list[str]:
        return [event.name for event in self.events]


@contextmanager
def running(device: Device, recorder: RecordingSink) -> Iterator[None]:
    """The device runs in a thread of its own, which ends with the block."""
    thread = threading.Thread(target=device.run, args=(recorder,))
    thread.start()
    try:
        yield
    finally:
        device.close()
        thread.join(5)
    assert not thread.is_alive()


def refusing_port(path: str, baudrate: int, parity: str) -> FakePort:
    """A port that cannot be opened."""
    raise DeviceError(f"port {path} cannot be opened: there is no such port; check the cable")
