"""The loop that every emulated device on a line runs: wait, receive, send.

The messages of a device and their times are in its own file; its line is in `pseudo_terminal` or
`network_line`.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Protocol

from sim_hw.world.world_clock import NS_PER_S

DRAIN_S = 0.05
"""Longest wait between two checks of the host, of `close` and of the faults."""
UNPLUGGED_POLL_S = 0.02

ByteFilter = Callable[[bytes, int], bytes]
"""What happens to bytes on their way to the host, with the monotonic time in ns. It is also asked
with nothing, every 50 ms at the latest, so that it may keep bytes and let them go later."""


class DeviceLine(Protocol):
    """The device's end of its connection to a host. No method blocks on a host."""

    @property
    def port(self) -> str:
        """What a host opens."""

    @property
    def is_open_by_a_host(self) -> bool: ...

    def write(self, data: bytes) -> int:
        """Send; the number of bytes accepted."""

    def read(self, timeout_s: float) -> bytes:
        """What the host has written; b"" if nothing came within the timeout."""

    def close(self) -> None: ...


class LineDevice:
    """An emulated device on a line, from `start()` to `close()`; a host opens `port`.

    `due_mono_ns` is the time of the device's next message and `emit_due` its content. `on_received`
    returns the answer to what the host wrote, and `on_idle` what the device sends after
    `idle_timeout_s` without input. What the host does not read is lost and counted. `byte_filter`
    is applied to everything that the device sends.
    """

    idle_timeout_s: float = DRAIN_S

    def __init__(self, name: str, line: DeviceLine) -> None:
        self.byte_filter: ByteFilter = lambda data, _mono_ns: data
        self.counts: Counter[str] = Counter()
        self._line = line
        self._name = name
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    # Messages of a device

    def due_mono_ns(self) -> int | None:
        """Monotonic time of the next unsolicited message; None if the device only answers."""
        return None

    def emit_due(self) -> bytes:
        """The unsolicited message that is now due."""
        return b""

    def on_received(self, data: bytes) -> bytes:
        """The answer to what the host wrote; a device without commands discards it."""
        return b""

    def on_idle(self) -> bytes:
        """What the device sends after `idle_timeout_s` without input."""
        return b""

    def parts(self, data: bytes) -> list[tuple[str, bytes]]:
        """One transmission divided into messages with topics, for faults of some of them."""
        return [("", data)]

    def restart_count(self) -> None:
        """Restart the counters of the device."""

    def restart(self) -> None:
        """The power came back: the device is in its initial state."""
        self.restart_count()

    # The loop

    @property
    def port(self) -> str:
        """What a host opens: the path of a serial port, tcp://host:port, or udpin://host:port."""
        return self._line.port

    def start(self) -> None:
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop and unplug. May be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        self._line.close()

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation, by stable name."""
        names = ("bytes_sent", "bytes_lost", "bytes_received")
        return {name: self.counts[name] for name in names}

    def _run(self) -> None:
        while not self._stop.is_set():
            due_ns = self.due_mono_ns()
            left_s = self.idle_timeout_s
            if due_ns is not None:
                left_s = min(left_s, (due_ns - time.monotonic_ns()) / NS_PER_S)
            if left_s <= 0.0:
                self._send(self.emit_due())
            else:
                self._listen(left_s)

    def _listen(self, timeout_s: float) -> None:
        idle_timeout_s = self.idle_timeout_s
        received = self._line.read(timeout_s)
        self.counts["bytes_received"] += len(received)
        if received:
            self._send(self.on_received(received))
            return
        if not self._line.is_open_by_a_host:
            # A closed line returns at once without data.
            self._stop.wait(min(timeout_s, UNPLUGGED_POLL_S))
        self._send(self.on_idle() if timeout_s >= idle_timeout_s else b"")

    def _send(self, data: bytes) -> None:
        data = self.byte_filter(data, time.monotonic_ns())
        if data:
            sent = self._line.write(data)
            self.counts["bytes_sent"] += sent
            self.counts["bytes_lost"] += len(data) - sent
