"""Events of one device for the operator, and the throttling of repeated faults."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from drivers.contract import DeviceEvent, Sink
from drivers.timescales.clock import Clock

THROTTLE_INTERVAL_NS: Final = 10_000_000_000
"""Minimum time between two events of the same name; counters count every occurrence."""


class EventEmitter:
    """Sends the events of one device to the present sink, if there is one."""

    def __init__(self, device: str, clock: Clock) -> None:
        self._device = device
        self._clock = clock
        self._emitted_ns: dict[str, int] = {}
        self.sink: Sink | None = None

    def emit(
        self,
        event: str,
        sentence: str,
        *,
        fault: bool = False,
        settings: Mapping[str, float | int | str] | None = None,
    ) -> None:
        """Report a change of state; without effect while there is no sink.

        Args:
            event: name of the event, a stable kebab-case word.
            sentence: what happened and the remedy, for the operator.
            fault: whether it is a fault.
            settings: what the device holds, by name; for an opening.
        """
        if self.sink is not None:
            now_ns = self._clock.mono_ns()
            held = {} if settings is None else dict(settings)
            self.sink(DeviceEvent(self._device, event, fault, sentence, now_ns, held))

    def emit_throttled(self, event: str, sentence: str) -> None:
        """Report a fault that may occur with every message, at most once in ten seconds.

        Args:
            event: name of the event; each name is throttled separately.
            sentence: what happened and the remedy, for the operator.
        """
        now_ns = self._clock.mono_ns()
        emitted_ns = self._emitted_ns.get(event)
        if emitted_ns is None or now_ns - emitted_ns >= THROTTLE_INTERVAL_NS:
            self._emitted_ns[event] = now_ns
            self.emit(event, sentence, fault=True)
