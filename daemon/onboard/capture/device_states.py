"""The state of every device: whether it answers and delivers, its serial number, its counters."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from daemon.onboard.flight.fault_latches import DELIVERING, UNAVAILABLE
from daemon.onboard.flight.flight import Flight
from daemon.onboard.service.message_dispatcher import Handlers
from daemon.onboard.service.messages import BindFailed, Bound, EmitEvent, Pong
from drivers.contract import DeviceEvent


class DeviceStates:
    """Follows the devices by the messages of the capture process.

    `delivering` are the devices that deliver, `serials` the serial numbers of heads ("" for none),
    and `counters` the counters of each device since the service began.

    Args:
        flight: does not await frames of heads that are lost.
        log: writes a record to the flight log.
        emit: emits an event for every change.
        on_bound: called with each device that answers.
    """

    def __init__(
        self,
        flight: Flight,
        log: Callable[[DeviceEvent], None],
        emit: EmitEvent,
        on_bound: Callable[[Bound], None] = lambda _: None,
    ) -> None:
        self._flight = flight
        self._log = log
        self._emit = emit
        self._on_each_bound = on_bound
        self.delivering: set[str] = set()
        self.has_trigger = False
        self.serials: dict[str, str] = {}
        self.counters: Mapping[str, Mapping[str, int]] = {}
        self._counters_reported: Mapping[str, Mapping[str, int]] = {}

    @property
    def handlers(self) -> Handlers:
        """The messages about devices."""
        return {
            Bound: self._on_bound,
            BindFailed: self._on_bind_failed,
            DeviceEvent: self._on_device_event,
            Pong: self._on_pong,
        }

    def _on_bound(self, bound: Bound) -> None:
        self._emit("bound", kind=bound.kind, device=bound.name, found=dict(bound.found))
        if bound.kind == "trigger":
            self.has_trigger = True
        elif bound.kind == "head":
            self.serials[bound.name] = bound.found.get("serial", "")
        self._on_each_bound(bound)

    def _on_bind_failed(self, unbound: BindFailed) -> None:
        now_ns = time.monotonic_ns()
        self._on_device_event(DeviceEvent(unbound.name, "absent", True, unbound.sentence, now_ns))

    def _on_device_event(self, event: DeviceEvent) -> None:
        self._flight.take(event)
        self._log(event)
        self._emit(
            "device",
            device=event.device,
            name=event.name,
            fault=event.is_fault,
            sentence=event.sentence,
        )
        if event.name in DELIVERING:
            self.delivering.add(event.device)
        elif event.name in UNAVAILABLE:
            self.delivering.discard(event.device)

    def _on_pong(self, pong: Pong) -> None:
        if pong.statistics:
            self.counters = pong.statistics

    def changed_counters(self) -> dict[str, Any] | None:
        """The event of the counters, for watchers; None if they are as at the last call."""
        if self.counters == self._counters_reported:
            return None
        self._counters_reported = self.counters
        return {"event": "counters", "devices": {n: dict(c) for n, c in self.counters.items()}}
