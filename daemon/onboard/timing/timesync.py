"""Asking an autopilot for its time: MAVLink TIMESYNC, once a second, as readings of its clock.

What becomes of the readings is in `daemon.onboard.timing.device_clocks`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final, Protocol, TypeGuard

from drivers.contract import ClockReading, Sink

INTERVAL_S: Final = 1.0
ANSWER_MAX_NS: Final = 1_000_000_000
"""An answer that took longer is of no use."""


class TimesyncPort(Protocol):
    """What a navigator offers that can be asked."""

    @property
    def name(self) -> str: ...

    def subscribe_timesync(self, on_answer: Callable[[Any], None] | None) -> None: ...

    def send_timesync(self, *, tc1_ns: int, ts1_ns: int) -> bool: ...


def supports_timesync(device: object) -> TypeGuard[TimesyncPort]:
    """Whether a device has the port."""
    return hasattr(device, "subscribe_timesync") and hasattr(device, "send_timesync")


class TimesyncRequester:
    """Asks one autopilot and hands its answers on as readings."""

    def __init__(
        self, port: TimesyncPort, sink: Sink, *, mono_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._port, self._sink, self._mono_ns = port, sink, mono_ns
        self._stop = threading.Event()
        self._outstanding: set[int] = set()
        port.subscribe_timesync(self.on_answer)

    def run(self) -> None:
        """Send requests until `stop` is called; runs in a thread of the caller."""
        while not self._stop.wait(INTERVAL_S):
            self.request()

    def request(self) -> bool:
        """Send one request; False where the line is not open."""
        ts1_ns = self._mono_ns()
        # Before sending: the answer may arrive before `send` returns.
        self._outstanding = {
            sent_ns for sent_ns in self._outstanding if ts1_ns - sent_ns <= ANSWER_MAX_NS
        } | {ts1_ns}
        return self._port.send_timesync(tc1_ns=0, ts1_ns=ts1_ns)

    def on_answer(self, timesync: Any) -> None:
        """An answer to a question of ours becomes a reading; others, and requests, do not."""
        round_trip_ns = timesync.mono_ns - timesync.ts1_ns
        if (
            timesync.tc1_ns <= 0
            or timesync.ts1_ns not in self._outstanding
            or round_trip_ns > ANSWER_MAX_NS
        ):
            return
        self._outstanding.discard(timesync.ts1_ns)
        half_ns = (round_trip_ns + 1) // 2
        middle_ns = timesync.ts1_ns + half_ns
        self._sink(ClockReading(self._port.name, timesync.tc1_ns, middle_ns, half_ns))

    def stop(self) -> None:
        """End `run`, and listen no more."""
        self._stop.set()
        self._port.subscribe_timesync(None)
