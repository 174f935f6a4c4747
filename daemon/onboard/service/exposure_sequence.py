"""The sequence of every exposure: order, pulse, frames, storage, seal, pipeline, verdict.

`ExposureSequence.handlers` lists the messages in the order in which an exposure causes them. After
each of them, and when a time-out expires, `ExposureSequence.advance` carries out the actions that
`daemon.onboard.flight.flight` returns. docs/explanation/architecture.md shows the whole sequence.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.log.log_records import LoggedTrigger, Message, message_of
from daemon.mission.verification.recovery import LEDGER_TOPIC
from daemon.onboard.flight.decisions import Decision, Kind
from daemon.onboard.flight.flight import Flight
from daemon.onboard.pipeline.pipeline_queue import Messages, PipelineQueue
from daemon.onboard.service.flight_line import Order
from daemon.onboard.service.message_dispatcher import Handlers
from daemon.onboard.service.messages import (
    AppendToLog,
    EmitEvent,
    Fire,
    Fired,
    FramesRead,
    IndexProducts,
    Process,
    Processed,
    ProcessFailed,
    ProductsStaged,
    Recycle,
    Seal,
    Sealed,
    Store,
    Stored,
    VerdictReady,
    WorkerReady,
    WriteFailed,
)
from daemon.onboard.service.monitoring_link import summary
from daemon.onboard.timing.matching import Cause, FiredPulse
from drivers.contract import (
    ClockReading,
    DeviceEvent,
    EventMark,
    Frame,
    NavSample,
    PpsEdge,
    PtpReading,
    RawBytes,
    Record,
    TemperatureSample,
)
from processing.quality.figures import QualityFigures
from processing.quality.figures.image import BandLevelFigures
from processing.quality.level_steps import LevelHistory

EARLY_FRAME_LIMIT_NS: Final = 12_000_000_000
"""Longest wait of a frame for the answer to its trigger, which comes within ten seconds."""


class ExposureSequence:
    """Carries every exposure from its trigger to its products.

    Args:
        flight: the open exposures and the ledger.
        queue: exposures that wait for the worker.
        send: sends a message to a process, by its name.
        emit: emits an event.
        on_histograms: called with the raw histograms of an exposure, counts of DN by sensor.
        mono_ns: the clock.
    """

    def __init__(
        self,
        flight: Flight,
        queue: PipelineQueue,
        send: Callable[[str, object], None],
        emit: EmitEvent,
        on_histograms: Callable[
            [int, Mapping[str, Sequence[int]]], None
        ] = lambda _number, _counts: None,
        mono_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._flight = flight
        self._queue = queue
        self._send = send
        self._emit = emit
        self._on_histograms = on_histograms
        self._mono_ns = mono_ns
        self._levels = LevelHistory()
        self._orders: dict[int, Order] = {}
        self._early: list[Frame] = []

    @property
    def handlers(self) -> Handlers:
        """The messages of an exposure, in their order."""
        return {
            # capture
            Fired: self._on_fired,
            Frame: self._on_frame,
            EventMark: self._on_record,
            NavSample: self._on_record,
            PpsEdge: self._on_record,
            ClockReading: self._on_record,
            PtpReading: self._on_record,
            TemperatureSample: self._on_record,
            RawBytes: self._on_record,
            # writer
            Stored: self._on_stored,
            Sealed: self._on_sealed,
            WriteFailed: self._on_write_failed,
            # worker
            WorkerReady: self._on_worker_ready,
            FramesRead: self._on_frames_read,
            VerdictReady: self._on_verdict_ready,
            ProductsStaged: self._on_products_staged,
            Processed: self._on_processed,
            ProcessFailed: self._on_failed,
        }

    # 1. A trigger is due

    def fire(self, order: Order) -> None:
        """Have capture give the pulse of an ordered exposure."""
        self._orders[order.number] = order
        details = self._flight.order_details(order.number)
        self._log_decision(Decision("order", order.mono_ns, order.number, details))
        self._send("capture", Fire(order.number, order.delays_ns))
        self._emit("triggered", number=order.number)

    def _on_fired(self, fired: Fired) -> None:
        order = self._orders.pop(fired.sequence)
        if fired.pulse is None:
            self._flight.not_fired(fired.sequence, fired.sentence)
            self._decide("not-fired", fired.sequence, {"sentence": fired.sentence})
            self._emit("lost", number=fired.sequence, cause=fired.sentence)
        else:
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
            self.log(
                LoggedTrigger(fired.sequence, fired.pulse, order.delays_ns, order.strobe_delay_ns)
            )
        early, self._early = self._early, []
        for frame in early:
            self._on_frame(frame)

    # 2. Frames and marks arrive

    def _on_frame(self, frame: Frame) -> None:
        if self._orders and not self._flight.has_pulse_of(frame):
            # A software trigger answers once all heads were asked: a frame may be there before.
            self._early.append(frame)
        else:
            self._on_record(frame)

    def _on_record(self, record: Record) -> None:
        cause = self._flight.take(record)
        if isinstance(record, Frame) and cause is not Cause.USED:
            self._send("capture", Recycle({record.head: record.slot}))
        if cause not in (None, Cause.USED, Cause.PENDING):
            self._emit_unused(record, cause)
        self.log(record)

    def _emit_unused(self, record: Record, cause: Cause) -> None:
        if isinstance(record, Frame):
            self._emit("frame", head=record.head, cause=cause.value)
        elif isinstance(record, EventMark):
            self._emit("mark", count=record.count, cause=cause.value)

    # 3. What is due is stored, sealed or given up

    def advance(self) -> int | None:
        """Carry out what is due now.

        Returns:
            The monotonic instant at which something is due without a message, in ns; None for none.
        """
        now_ns = self._mono_ns()
        if self._early and now_ns - self._early[0].mono_ns > EARLY_FRAME_LIMIT_NS:
            self._match_early_frames()
        actions = self._flight.advance(now_ns)
        if (decision := actions.decision) is not None:
            self._log_decision(decision)
        for due in actions.store:
            self._queue.retain(due.capture.number, due.slots)
            self._send("writer", Store(due.capture, due.slots))
        for number, cause in actions.lost:
            self._emit("lost", number=number, cause=cause)
        for mark in actions.spurious:
            self._emit_unused(mark, Cause.SPURIOUS)
        if actions.seal is not None:
            self._send("writer", Seal(actions.seal))
        if actions.provisional is not None:
            self._pass_on(self._queue.provisional(actions.provisional))
        for clock_event in actions.clock_events:
            name, fault, sentence = clock_event.name, clock_event.is_fault, clock_event.sentence
            self.log(DeviceEvent("clock", name, fault, sentence, now_ns))
            self._emit("device", device="clock", name=name, fault=fault, sentence=sentence)
        return actions.next_ns

    def expire_timeouts(self) -> None:
        """Store and seal what is open with what is there."""
        self._decide("timeouts-expired", 0)
        self._flight.expire_timeouts()
        self._match_early_frames()

    def _match_early_frames(self) -> None:
        early, self._early = self._early, []
        for frame in early:
            self._on_record(frame)

    # 4. The disk has the frames, then the record

    def _on_stored(self, stored: Stored) -> None:
        self._flight.stored(stored.number, stored.frames, stored.disks)
        where = {"disks": list(stored.disks)} if stored.disks else {}
        self._decide("stored", stored.number, where)
        duration_s = round(stored.duration_s, 4)
        self._emit("stored", number=stored.number, duration_s=duration_s, **where)
        self._pass_on(self._queue.stored(stored.number))

    def _on_sealed(self, sealed: Sealed) -> None:
        exposure = self._flight.sealed(sealed.number)
        self._decide("sealed", sealed.number)
        sheet = canonical_bytes(self._flight.ledger.sheet().as_json())
        self._send("writer", AppendToLog(Message(LEDGER_TOPIC, self._mono_ns(), sheet)))
        if exposure.state != "lost":
            self._emit("sealed", **summary(exposure))
            self._pass_on(self._queue.sealed(exposure))

    def _on_write_failed(self, failed: WriteFailed) -> None:
        number, sentence = failed.number, failed.sentence
        self._emit("not-written", number=number, sentence=sentence)
        sealing = self._flight.sealing
        if sealing is None or sealing.number != number:
            self._flight.not_stored(number, sentence)
            self._decide("not-stored", number, {"sentence": sentence})
            self._emit("lost", number=number, cause=sentence)
            self._pass_on(self._queue.not_stored(number))
        elif failed.is_transient:
            decision = Decision("seal-refused", self._mono_ns(), number)
            self._flight.seal_refused(decision.mono_ns)
            self._log_decision(decision)
        else:
            # Recovery seals it from the log when the service starts next.
            self._flight.not_sealed(number)
            self._decide("not-sealed", number)
            self._pass_on(self._queue.not_sealed(number))

    # 5. The pipeline processes the exposure

    def _pass_on(self, messages: Messages) -> None:
        for message in messages:
            if isinstance(message, Recycle):
                self._send("capture", message)
                continue
            if isinstance(message, Process):
                self._decide(
                    "process", message.exposure.number, {"deferred": message.slots is None}
                )
            self._send("worker", message)

    def _on_worker_ready(self, ready: WorkerReady) -> None:
        self._emit("kernels", warm_up_s=round(ready.warm_up_s, 2))
        self._pass_on(self._queue.ready())

    def _on_frames_read(self, read: FramesRead) -> None:
        self._pass_on(self._queue.frames_read(read.number))

    def _on_verdict_ready(self, verdict: VerdictReady) -> None:
        self._emit("judged", number=verdict.number, report=dict(verdict.report))

    def _on_products_staged(self, staged: ProductsStaged) -> None:
        self._pass_on(self._queue.staged(staged.number))

    def _on_processed(self, done: Processed) -> None:
        seconds = round(done.duration_s, 3)
        self._emit("processed", number=done.number, report=dict(done.report), duration_s=seconds)
        self._compare_levels(done.number, done.report)
        self._on_histograms(done.number, done.histograms)
        self._send("writer", IndexProducts(done.number, done.files, done.report.get("verdict")))
        self._pass_on(self._queue.finished(done.number))

    def _compare_levels(self, number: int, report: Mapping[str, Any]) -> None:
        """Report bands that change alone against the exposures before: one cannot show it."""
        figures = QualityFigures.from_json(report.get("figures", {}))
        levels = figures.of(BandLevelFigures).level_by_band
        known = {band: level for band, level in levels.items() if level is not None}
        for step in self._levels.add(number, known):
            self._emit(
                "band-level",
                number=number,
                band=step.band,
                before=step.before,
                factor=round(step.factor, 3),
                sentence=step.sentence,
            )

    def _on_failed(self, failed: ProcessFailed) -> None:
        report, sentence = dict(failed.report), failed.sentence
        self._emit("not-processed", number=failed.number, sentence=sentence, report=report)
        self._pass_on(self._queue.finished(failed.number))

    # Flight log

    def log(self, record: Record | LoggedTrigger) -> None:
        """Write a record to the flight log."""
        self._send("writer", AppendToLog(message_of(record)))

    def _decide(self, kind: Kind, number: int, detail: Mapping[str, Any] | None = None) -> None:
        self._log_decision(Decision(kind, self._mono_ns(), number, detail or {}))

    def _log_decision(self, decision: Decision) -> None:
        self._send("writer", AppendToLog(decision.message()))
