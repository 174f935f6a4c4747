"""How a driver tells the operator what changed, and how often it may complain."""

from __future__ import annotations

from typing import Final

from drivers.contract import DeviceEvent, Sink
from drivers.timescales.clock import Clock

THROTTLE_INTERVAL_NS: Final = 10_000_000_000
"""The same complaint is told again at most this often; the counters miss none."""


class EventEmitter:
    """Sends the events of one device to whoever listens at the moment."""

    def __init__(self, device: str, clock: Clock) -> None:
        self._device = device
        self._clock = clock
        self._emitted_ns: dict[str, int] = {}
        self.sink: Sink | None = None

    def emit(self, event: str, sentence: str, *, fault: bool = False) -> None:
        """Tell a change of state."""
        if self.sink is not None:
            now_ns = self._clock.mono_ns()
            self.sink(DeviceEvent(self._device, event, fault, sentence, now_ns))

    def emit_throttled(self, event: str, sentence: str) -> None:
        """Tell a fault that may come with every message, at most once in ten seconds."""
        now_ns = self._clock.mono_ns()
        emitted_ns = self._emitted_ns.get(event)
        if emitted_ns is None or now_ns - emitted_ns >= THROTTLE_INTERVAL_NS:
            self._emitted_ns[event] = now_ns
            self.emit(event, sentence, fault=True)
