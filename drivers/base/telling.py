"""How a driver tells the operator what changed, and how often it may complain."""

from __future__ import annotations

from typing import Final

from drivers.contract import DeviceEvent, Sink
from drivers.timescales.clock import Clock

COMPLAINT_INTERVAL_NS: Final = 10_000_000_000
"""The same complaint is told again at most this often; the counters miss none."""


class Teller:
    """Sends the events of one device to whoever listens at the moment."""

    def __init__(self, device: str, clock: Clock) -> None:
        self._device = device
        self._clock = clock
        self._told_ns: dict[str, int] = {}
        self.sink: Sink | None = None

    def tell(self, event: str, sentence: str, *, fault: bool = False) -> None:
        """Tell a change of state."""
        if self.sink is not None:
            now_ns = self._clock.mono_ns()
            self.sink(DeviceEvent(self._device, event, fault, sentence, now_ns))

    def complain(self, event: str, sentence: str) -> None:
        """Tell a fault that may come with every message, at most once in ten seconds."""
        now_ns = self._clock.mono_ns()
        told_ns = self._told_ns.get(event)
        if told_ns is None or now_ns - told_ns >= COMPLAINT_INTERVAL_NS:
            self._told_ns[event] = now_ns
            self.tell(event, sentence, fault=True)
