"""Ingest of device records: into the flight and the log, with events for changes.

`daemon.onboard.flight.flight` matches the records, `daemon.onboard.service.flight_line` orders
exposures.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, ClassVar, Final, Protocol

from daemon.mission.log.log_records import LoggedTrigger
from daemon.onboard.flight.decisions import Decision
from daemon.onboard.flight.fault_latches import DELIVERING, UNAVAILABLE
from daemon.onboard.flight.flight import Flight
from daemon.onboard.service.flight_line import Order
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import BindFailed, Bound, Fired
from daemon.onboard.timing.matching import Cause, FiredPulse
from drivers.contract import (
    ClockReading,
    DeviceEvent,
    EventMark,
    Frame,
    NavSample,
    PpsEdge,
    RawBytes,
    Record,
    TemperatureSample,
)

EARLY_FRAME_LIMIT_NS: Final = 12_000_000_000
"""Longest wait of a frame for the answer to its trigger, which comes within ten seconds."""
_NOT_AWAITED = frozenset({"lost", "absent"})
"""Device events after which a head is not awaited."""


class EmitEvent(Protocol):
    """Emits an event: its kind and its content."""

    def __call__(self, event: str, **content: Any) -> None: ...


class RecordIngest(MessageDispatcher):
    """Takes in what `daemon.onboard.capture.capture` passes on.

    `active` are the devices that deliver, `serials` the serial numbers of heads ("" for none), and
    `orders` the exposures whose pulse is not answered yet.

    Args:
        flight: matches the records.
        log: writes a record to the flight log.
        emit: emits events.
        on_decision: called with each decision.
    """

    def __init__(
        self,
        flight: Flight,
        log: Callable[[Record | LoggedTrigger], None],
        emit: EmitEvent,
        on_decision: Callable[[Decision], None] = lambda _: None,
    ) -> None:
        self._flight = flight
        self._log = log
        self._emit = emit
        self._on_decision = on_decision
        self.active: set[str] = set()
        self.has_trigger = False
        self.serials: dict[str, str] = {}
        self._navigators: set[str] = set()
        self.orders: dict[int, Order] = {}
        self._early: list[Frame] = []

    def emit_time_events(self, now_ns: int) -> None:
        """Emit events of marks and clocks since the last call."""
        if self._early and now_ns - self._early[0].mono_ns > EARLY_FRAME_LIMIT_NS:
            self._match_early_frames()
        for mark, cause in self._flight.resolved_marks:
            self._emit("mark", count=mark.count, cause=cause.value)
        self._flight.resolved_marks.clear()
        for clock_event in self._flight.clock_events(now_ns):
            event = DeviceEvent(
                "clock", clock_event.name, clock_event.is_fault, clock_event.sentence, now_ns
            )
            self._log(event)
            self._emit(
                "device",
                device="clock",
                name=clock_event.name,
                fault=clock_event.is_fault,
                sentence=clock_event.sentence,
            )

    def _on_frame(self, frame: Frame) -> None:
        if self.orders and not self._flight.has_pulse_of(frame):
            # A software trigger answers once all heads were asked: a frame may be there before.
            self._early.append(frame)
        else:
            self._match(frame)

    def _match_early_frames(self) -> None:
        """Match the frames that came before the answer to their trigger."""
        early, self._early = self._early, []
        for frame in early:
            self._match(frame)

    def _match(self, frame: Frame) -> None:
        cause = self._flight.frame(frame)
        if cause is not Cause.USED:
            self._emit("frame", head=frame.head, cause=cause.value)
        self._log(frame)

    def _on_mark(self, mark: EventMark) -> None:
        cause = self._flight.mark(mark)
        if cause not in (Cause.USED, Cause.PENDING):
            self._emit("mark", count=mark.count, cause=cause.value)
        self._log(mark)

    def _on_navigation(self, sample: NavSample) -> None:
        self._flight.navigation(sample)
        self._log(sample)

    def _on_pps(self, edge: PpsEdge) -> None:
        self._flight.pps(edge)
        self._log(edge)

    def _on_clock_reading(self, reading: ClockReading) -> None:
        self._flight.clock_reading(reading)
        self._log(reading)

    def _on_temperature(self, sample: TemperatureSample) -> None:
        self._flight.temperature(sample)
        self._log(sample)

    def _on_raw(self, raw: RawBytes) -> None:
        self._log(raw)

    def _on_device_event(self, event: DeviceEvent) -> None:
        self._log(event)
        self._emit(
            "device",
            device=event.device,
            name=event.name,
            fault=event.is_fault,
            sentence=event.sentence,
        )
        if event.name in DELIVERING:
            self.active.add(event.device)
            self._flight.absent_heads.discard(event.device)
            if event.device in self._navigators:
                self._flight.clock.receiver_recovered()
        elif event.name in UNAVAILABLE:
            self.active.discard(event.device)
            if event.name in _NOT_AWAITED:
                self._flight.absent_heads.add(event.device)

    def _on_bound(self, bound: Bound) -> None:
        self._emit("bound", kind=bound.kind, device=bound.name, found=dict(bound.found))
        if bound.kind == "trigger":
            self.has_trigger = True
        elif bound.kind == "navigator":
            self._navigators.add(bound.name)
        elif bound.kind == "head":
            self.serials[bound.name] = bound.found.get("serial", "")

    def _on_bind_failed(self, unbound: BindFailed) -> None:
        sentence = unbound.sentence
        if unbound.kind == "head":
            self._flight.absent_heads.add(unbound.name)
        self._log(DeviceEvent(unbound.name, "absent", True, sentence, time.monotonic_ns()))
        self._emit("device", device=unbound.name, name="absent", fault=True, sentence=sentence)

    def _on_fired(self, fired: Fired) -> None:
        self._record_answer(fired, self.orders.pop(fired.sequence))
        early, self._early = self._early, []
        for frame in early:
            self._on_frame(frame)

    def _record_answer(self, fired: Fired, order: Order) -> None:
        if fired.pulse is None:
            self._flight.not_fired(fired.sequence, fired.sentence)
            detail = {"sentence": fired.sentence}
            self._on_decision(Decision("not-fired", time.monotonic_ns(), fired.sequence, detail))
            self._emit("lost", number=fired.sequence, cause=fired.sentence)
            return
        pulse = FiredPulse(
            number=fired.sequence,
            mono_ns=fired.pulse.mono_ns,
            sigma_ns=fired.pulse.sigma_ns,
            count=fired.pulse.count,
            delays_ns=order.delays_ns,
            strobe_delay_ns=order.strobe_delay_ns,
            spread_ns=fired.pulse.spread_ns,
        )
        self._flight.fired(pulse)
        self._log(
            LoggedTrigger(fired.sequence, fired.pulse, order.delays_ns, order.strobe_delay_ns)
        )

    handlers: ClassVar = {
        Frame: _on_frame,
        EventMark: _on_mark,
        NavSample: _on_navigation,
        TemperatureSample: _on_temperature,
        PpsEdge: _on_pps,
        ClockReading: _on_clock_reading,
        RawBytes: _on_raw,
        DeviceEvent: _on_device_event,
        Bound: _on_bound,
        BindFailed: _on_bind_failed,
        Fired: _on_fired,
    }
