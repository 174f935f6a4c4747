"""Recorded bytes of a device through its driver again, on a clock driven by their recorded times.

The driver is the one that flew; only its port and its clock are stand-ins. What comes out is held
against the records of the flight log by `daemon.postflight.replay.flight_replay`.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

from drivers.base import registry
from drivers.contract import (
    ClockReading,
    DeviceError,
    DeviceEvent,
    EventMark,
    NavSample,
    RawBytes,
    TemperatureSample,
)
from drivers.transport.serial_device import SerialDevice, SerialLine

Decoded = NavSample | EventMark | TemperatureSample | ClockReading
NEW_LINE = frozenset({"lost", "silent"})
"""Device events after which the port is reopened, and half a message is dropped."""


class _Clock:
    """Advances only by waits and by arriving bytes."""

    def __init__(self) -> None:
        self.now_ns = 0

    def mono_ns(self) -> int:
        return self.now_ns

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        self.now_ns += max(1, round(timeout_s * 1e9))
        return event.is_set()


class _Port:
    """Gives the recorded chunks one by one, whole, each whenever the driver waits for bytes."""

    def __init__(self, clock: _Clock) -> None:
        self.timeout: Any = 0.0
        self.chunks: deque[RawBytes] = deque()
        self._clock = clock
        self._remainder = b""

    @property
    def in_waiting(self) -> int:
        return len(self._remainder)

    def read(self, size: int = 1) -> bytes:
        if not self._remainder and self.timeout and self.chunks:
            chunk = self.chunks.popleft()
            self._remainder = chunk.data
            self._clock.now_ns = max(self._clock.now_ns, chunk.mono_ns)
        elif not self._remainder:
            # What was drained in flight is logged apart: a driver finds its line empty.
            self._clock.now_ns += round((self.timeout or 0.0) * 1e9)
        data, self._remainder = self._remainder[:size], self._remainder[size:]
        return data

    def write(self, data: bytes, /) -> int | None:
        return len(data)

    def close(self) -> None:
        """Nothing is held."""


class Codec:
    """A device of the flight, fed with its recorded bytes."""

    def __init__(self, driver: SerialDevice, port: _Port, clock: _Clock) -> None:
        self._driver = driver
        self._port = port
        self._clock = clock
        self._line = SerialLine(port, lambda _data: None)

    def decode(self, chunks: Iterable[RawBytes]) -> list[Decoded]:
        """Records decoded from these bytes, after those before them."""
        self._port.chunks.extend(chunks)
        if self._port.chunks:
            self._clock.now_ns = max(self._clock.now_ns, self._port.chunks[0].mono_ns)
        found: list[Decoded] = []
        while self._port.chunks:
            found += self._driver.step(self._line)
        return found

    def reopened(self) -> None:
        """The port was reopened: half a message is dropped."""
        self._driver.connected()


def codec_for(kind: str, driver: str, name: str, settings: Mapping[str, object]) -> Codec | None:
    """The codec of a device as configured; None where its records are not made of logged bytes."""
    try:
        driver_class = registry.driver_for(kind, driver)
    except (DeviceError, ImportError):
        return None
    if not issubclass(driver_class, SerialDevice):
        return None
    clock = _Clock()
    port = _Port(clock)
    return Codec(driver_class(name, settings, clock=clock, open_port=lambda *_: port), port, clock)


def has_first_bytes(recorded: Iterable[RawBytes | DeviceEvent]) -> bool:
    """Whether the log holds a device's bytes from before it was open, or there were none.

    They were not reported, but the decoder learned from them, such as whether attitudes come.
    """
    first = next(iter(recorded), None)
    return not isinstance(first, DeviceEvent) or first.name != "opened"


def decode_all(codec: Codec, recorded: Iterable[RawBytes | DeviceEvent]) -> list[Decoded]:
    """Everything a device sent in one run of the service.

    Args:
        recorded: its bytes and events in their order. Bytes before it is open came during
            discovery: they are decoded, but were not reported.
    """
    found: list[Decoded] = []
    chunks: list[RawBytes] = []
    was_opened = False
    for record in recorded:
        if isinstance(record, RawBytes):
            chunks.append(record)
        elif record.name == "opened" and not was_opened:
            codec.decode(chunks)
            chunks, was_opened = [], True
        elif record.name in NEW_LINE:
            found += codec.decode(chunks)
            chunks = []
            codec.reopened()
    return found + codec.decode(chunks)
