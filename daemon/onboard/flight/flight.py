"""The open exposures of a flight, from the pulse to the sealed record.

Pure bookkeeping on given instants. Input: the records of the devices, pulses, and results of the
disk. Output: `Flight.advance` returns the actions that are due.
`daemon.onboard.service.exposure_sequence` carries them out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Final

from daemon.configuration.model import LimitsSection
from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord, RecordState
from daemon.onboard.flight.decisions import Actions, PendingStore
from daemon.onboard.flight.fault_latches import DELIVERING
from daemon.onboard.flight.flight_identity import FlightIdentity
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.flight.open_exposure import OpenExposure
from daemon.onboard.flight.record_builder import (
    build_record,
    compare_ptp,
    instant_of,
    ptp_instant_of,
)
from daemon.onboard.flight.temperatures import TemperatureHistory
from daemon.onboard.timing.device_clocks import DeviceClocks
from daemon.onboard.timing.gps_clock import ClockEvent, GpsClock
from daemon.onboard.timing.matching import Cause, FiredPulse, Matcher
from daemon.onboard.timing.ptp_time import PtpTime
from daemon.orientation.navigation import Track
from drivers.contract import (
    ClockReading,
    DeviceEvent,
    EventMark,
    Frame,
    NavSample,
    PpsEdge,
    PtpReading,
    Record,
    TemperatureSample,
)
from processing.geometry.drift import lagged_sensors
from processing.quality.report import Flag
from processing.rig import Rig

NS = 1_000_000_000
NO_FLAG = Flag(0)
_LAST_NS: Final = 2**63
SEAL_RETRY_NS: Final = NS
"""Delay before a record that the disk refused is sealed again."""
_NOT_AWAITED = frozenset({"lost", "absent"})
"""Device events after which a head is not awaited."""


class Flight:
    """Exposures between trigger and seal.

    Every method that takes an instant takes `mono_ns`. Heads in `absent_heads` are known to be
    lost; their frames are not awaited. While `disk_is_low` is set, ordered exposures get the flag
    DISK_LOW. `sealing` is the record that is with the writer: one at a time, so that the chain of
    hashes has one order.
    """

    def __init__(
        self,
        rig: Rig,
        serial_of_head: Mapping[str, str],
        identity: FlightIdentity,
        limits: LimitsSection,
        ledger: Ledger,
        first_number: int,
    ) -> None:
        self.rig = rig
        self.identity = identity
        self.limits = limits
        self.ledger = ledger
        self.clock = GpsClock()
        self.device_clocks = DeviceClocks()
        self.ptp = PtpTime()
        self._steps_reported: dict[str, int] = {}
        self.track = Track()
        self.temperatures = TemperatureHistory(lagged_sensors(rig))
        self.absent_heads: set[str] = set()
        self.disk_is_low = False
        self.sealing: Exposure | None = None
        self._seal_after_ns = 0
        self._are_timeouts_expired = False
        self._receivers: set[str] = set()
        self.serial_of_head = serial_of_head
        self._cone_of_head = {head: rig.cone_of(head) for head in serial_of_head}
        self._matcher = Matcher({h: c.name for h, c in self._cone_of_head.items()}, self.clock)
        self._open: dict[int, OpenExposure] = {}
        self._next_number = first_number

    @property
    def last_number(self) -> int:
        """Number of the last ordered exposure; 0 before the first."""
        return self._next_number - 1

    @property
    def open_numbers(self) -> tuple[int, ...]:
        """Exposures that are not sealed or given up yet."""
        return tuple(self._open)

    @property
    def awaits_frames(self) -> bool:
        """Whether heads are still exposing or sending."""
        return any(exposure.awaits_frames for exposure in self._open.values())

    def order(self, mono_ns: int, line_id: str | None = None, strip_id: str = "") -> int:
        """Open the exposure of a trigger that is being ordered; return its number.

        `line_id` is that of the planned line being flown, None where nothing is planned.
        """
        number = self._next_number
        self._next_number += 1
        line = self.identity.line_id if line_id is None else line_id
        flags = Flag.DISK_LOW if self.disk_is_low else NO_FLAG
        self._open[number] = OpenExposure(
            number, mono_ns, line_id=line, strip_id=strip_id, flags=flags
        )
        self.ledger.trigger(number)
        self._matcher.forget_before(number - 64)
        return number

    def order_details(self, number: int) -> dict[str, Any]:
        """Line, strip and flags with which an open exposure was ordered."""
        exposure = self._open[number]
        return {
            "line_id": exposure.line_id,
            "strip_id": exposure.strip_id,
            "flags": int(exposure.flags),
        }

    def fired(self, pulse: FiredPulse) -> None:
        """The pulse was given."""
        if (exposure := self._open.get(pulse.number)) is not None:
            exposure.pulse = pulse
        self._matcher.pulse(pulse)

    def not_fired(self, number: int, sentence: str) -> None:
        """The trigger unit gave no pulse or did not answer: the exposure is lost."""
        exposure = self._open.get(number)
        if exposure is not None and not exposure.frames:
            exposure.lost = sentence

    # Records of the devices

    def take(self, record: Record) -> Cause | None:
        """Take in a record of a device.

        Returns:
            What became of a frame or mark; None for other records. The slot of a frame is retained
            only if the frame is used. A mark that is used or pending may change until its
            exposure is sealed.
        """
        handler = self._handlers.get(type(record))
        return None if handler is None else handler(self, record)

    def has_pulse_of(self, frame: Frame) -> bool:
        """Whether the pulse of a frame is already known."""
        return self._matcher.has_pulse_of(frame)

    def _frame(self, frame: Frame) -> Cause:
        self._read_latch(frame)
        match = self._matcher.frame(frame)
        cause = match.cause
        exposure = None if match.number is None else self._open.get(match.number)
        if cause is Cause.USED and (exposure is None or not exposure.awaits_frames):
            cause = Cause.LATE
        self.ledger.frame(frame.head, cause.value)
        if exposure is not None:
            if cause is Cause.USED:
                exposure.frames[frame.head] = frame
                return cause
            exposure.flags |= _FRAME_FLAGS[cause]
            exposure.causes[frame.head] = cause.value
        for number in match.possible:
            if number in self._open:
                self._open[number].ambiguous[frame.head] = _AMBIGUITIES[cause]
        return cause

    def _read_latch(self, frame: Frame) -> None:
        at_ns, mono_ns = frame.device_clock_ns, frame.device_clock_mono_ns
        if at_ns is not None and mono_ns is not None and frame.latch_sigma_ns is not None:
            reading = ClockReading(frame.head, at_ns, mono_ns, frame.latch_sigma_ns)
            self.device_clocks.read(reading)
            latched = self.clock.gps_at(mono_ns)
            self.ptp.compare_latch(
                frame.head, at_ns, latched, frame.latch_sigma_ns, mono_ns=mono_ns
            )

    def _mark(self, mark: EventMark) -> Cause:
        cause = self._matcher.mark(mark).cause
        is_open = cause in (Cause.USED, Cause.PENDING)
        self.ledger.mark(Cause.PENDING.value if is_open else cause.value)
        return cause

    def _navigation(self, sample: NavSample) -> None:
        self._receivers.add(sample.receiver)
        if sample.time_valid:
            self.track.add(sample)
            self.clock.message_arrived(sample.gps_ns, sample.mono_ns)
            self._matcher.marks.reconsider()

    def _pps(self, edge: PpsEdge) -> None:
        self.clock.pps_edge(edge.mono_ns, edge.sigma_ns)
        self._matcher.marks.reconsider()

    def _clock_reading(self, reading: ClockReading) -> None:
        self.device_clocks.read(reading)

    def _ptp_reading(self, reading: PtpReading) -> None:
        self.ptp.read(reading)

    def _temperature(self, sample: TemperatureSample) -> None:
        self.temperatures.add(sample)

    def _device_event(self, event: DeviceEvent) -> None:
        if event.name in DELIVERING:
            self.absent_heads.discard(event.device)
            if event.device in self._receivers:
                self.clock.receiver_recovered()
        elif event.name in _NOT_AWAITED:
            self.absent_heads.add(event.device)

    _handlers: ClassVar[Mapping[type, Callable[[Flight, Any], Cause | None]]] = {
        Frame: _frame,
        EventMark: _mark,
        NavSample: _navigation,
        PpsEdge: _pps,
        ClockReading: _clock_reading,
        PtpReading: _ptp_reading,
        TemperatureSample: _temperature,
        DeviceEvent: _device_event,
    }

    # What is due

    def advance(self, mono_ns: int) -> Actions:
        """The actions that are due at an instant; each is returned once."""
        store = tuple(self._due_to_store(mono_ns))
        lost = tuple(self._due_to_give_up(mono_ns))
        mark_wait_ns = round((self.limits.mark_timeout_s + self.limits.frame_timeout_s) * NS)
        spurious = self._give_up_marks(
            _LAST_NS if self._are_timeouts_expired else mono_ns - mark_wait_ns
        )
        if self.sealing is None and mono_ns >= self._seal_after_ns:
            self.sealing = seal = self._due_to_seal(mono_ns)
            provisional = self._due_provisionally() if seal is None else None
        else:
            seal = provisional = None
        clock_events = (
            *self.clock.events(mono_ns),
            *self.ptp.events(mono_ns),
            *self._clock_steps(),
        )
        next_ns = self._next_ns(mark_wait_ns)
        return Actions(mono_ns, store, lost, spurious, seal, provisional, clock_events, next_ns)

    def expire_timeouts(self) -> None:
        """End all waiting: what is open is stored and sealed with what is there."""
        self._are_timeouts_expired = True

    def land(self) -> None:
        """End the flight: pending marks become spurious."""
        self._give_up_marks(_LAST_NS)

    def _has_waited(self, exposure: OpenExposure, timeout_s: float, mono_ns: int) -> bool:
        waited_ns = mono_ns - exposure.ordered_mono_ns
        return self._are_timeouts_expired or waited_ns > timeout_s * NS

    def _next_ns(self, mark_wait_ns: int) -> int | None:
        """The instant after which the next time-out has expired."""
        frame_ns, mark_ns = (
            round(timeout_s * NS)
            for timeout_s in (self.limits.frame_timeout_s, self.limits.mark_timeout_s)
        )
        ends_ns = [
            exposure.ordered_mono_ns + frame_ns
            for exposure in self._open.values()
            if exposure.awaits_frames
        ]
        oldest = next(iter(self._open.values()), None)
        if oldest is not None and self.sealing is None:
            if oldest.lost:
                ends_ns.append(self._seal_after_ns)
            elif oldest.stored is not None:
                ends_ns.append(max(self._seal_after_ns, oldest.ordered_mono_ns + mark_ns))
        pending_ns = self._matcher.marks.oldest_pending_ns
        if pending_ns is not None:
            ends_ns.append(pending_ns + mark_wait_ns)
        return min(ends_ns) + 1 if ends_ns else None

    def _due_to_store(self, mono_ns: int) -> Iterator[PendingStore]:
        """Exposures whose frames are complete or timed out."""
        for exposure in self._open.values():
            if not exposure.awaits_frames or not exposure.frames:
                continue
            if (
                self._has_waited(exposure, self.limits.frame_timeout_s, mono_ns)
                or self._is_complete(exposure)
                or self._must_release_slots(exposure)
            ):
                exposure.being_stored = self._capture(exposure)
                slots = {head: frame.slot for head, frame in exposure.frames.items()}
                yield PendingStore(exposure.being_stored, slots)

    def _is_complete(self, exposure: OpenExposure) -> bool:
        """Whether every head that can send its frame has done so."""
        return exposure.frames.keys() >= self.serial_of_head.keys() - self.absent_heads

    def _must_release_slots(self, exposure: OpenExposure) -> bool:
        """Whether a newer exposure needs the slots of this one.

        A silent head must not exhaust the memory of the others. Heads deliver in order: a head that
        is as many exposures behind as there are slots is not awaited.
        """
        first = exposure.number + self.limits.exposures_in_memory - 1
        return any(
            other.number >= first and exposure.frames.keys() <= other.frames.keys()
            for other in self._open.values()
        )

    def _due_to_give_up(self, mono_ns: int) -> Iterator[tuple[int, str]]:
        """Exposures without any frame in time: now lost, with the cause."""
        for exposure in self._open.values():
            if not exposure.awaits_frames or exposure.frames:
                continue
            if self._has_waited(exposure, self.limits.frame_timeout_s, mono_ns):
                has_pulse = exposure.pulse is not None
                exposure.lost = "no head sent a frame" if has_pulse else "no pulse was given"
                yield exposure.number, exposure.lost

    def _due_to_seal(self, mono_ns: int) -> Exposure | None:
        """The oldest open exposure, once it is stored or lost and its mark and navigation final."""
        exposure = next(iter(self._open.values()), None)
        if exposure is None:
            return None
        if exposure.lost:
            return self._seal(exposure, self._capture(exposure), state="lost")
        if exposure.stored is None:
            return None
        is_final = self._matcher.marks.is_corroborated(exposure.number) and self._has_navigation(
            exposure
        )
        if is_final or self._has_waited(exposure, self.limits.mark_timeout_s, mono_ns):
            return self._seal(exposure, exposure.stored)
        return None

    def _due_provisionally(self) -> Exposure | None:
        """The oldest open exposure that only awaits a second mark.

        It is sealed with this record unless the second mark reassigns its own mark.
        """
        exposure = next(iter(self._open.values()), None)
        if exposure is None or exposure.stored is None or exposure.lost or exposure.provisional:
            return None
        mark = self._matcher.mark_of(exposure.number)
        if mark is None or not self._has_navigation(exposure):
            return None
        record = self._compose(exposure, exposure.stored, mark)
        exposure.provisional = mark, exposure.reported_flags, record
        return record

    def _has_navigation(self, exposure: OpenExposure) -> bool:
        mark = self._matcher.mark_of(exposure.number)
        return mark is not None and self.track.covers(mark.gps_ns)

    def _give_up_marks(self, before_mono_ns: int) -> tuple[EventMark, ...]:
        spurious = tuple(self._matcher.marks.give_up(before_mono_ns))
        for _ in spurious:
            self.ledger.mark(Cause.SPURIOUS.value)
        return spurious

    def _clock_steps(self) -> Iterator[ClockEvent]:
        for device, steps in self.device_clocks.steps().items():
            if steps > self._steps_reported.get(device, 0):
                self._steps_reported[device] = steps
                yield ClockEvent(
                    "device-clock-stepped",
                    True,
                    f"the clock of {device} stepped or restarted; it is estimated again; "
                    "check its power supply if this repeats",
                )

    # Results of the disk

    def stored(
        self, number: int, frames: tuple[FrameRecord, ...], disks: tuple[str, ...] = ()
    ) -> None:
        """The pixels are durable; `disks` are the ids of the mirrored disks that have them."""
        exposure = self._open[number]
        assert exposure.being_stored is not None
        exposure.stored = replace(exposure.being_stored, frames=frames)
        exposure.disks = disks
        if len(disks) == 1:
            exposure.flags |= Flag.NOT_MIRRORED
        self.ledger.stored(number)

    def not_stored(self, number: int, sentence: str) -> None:
        """The disk refused the pixels: the exposure is lost."""
        exposure = self._open[number]
        if exposure.stored is None:
            exposure.lost = sentence

    def sealed(self, number: int) -> Exposure:
        """The record is on disk: the exposure is closed. Returns the record."""
        record = self._close(number)
        self.ledger.sealed(number)
        return record

    def not_sealed(self, number: int) -> None:
        """The disk refused the record: the exposure is closed, and recovery seals it later."""
        self._close(number)

    def seal_refused(self, mono_ns: int) -> None:
        """The disk refused the record and may take it later: it is due again after a delay."""
        self.sealing, self._seal_after_ns = None, mono_ns + SEAL_RETRY_NS

    def _close(self, number: int) -> Exposure:
        record, self.sealing = self.sealing, None
        assert record is not None and record.number == number
        exposure = self._open.pop(number)
        causes = {
            head: exposure.missing_cause(head)
            for head in self.serial_of_head
            if head not in exposure.frames
        }
        if exposure.lost:
            causes["exposure"] = exposure.lost
        if self._matcher.mark_of(number) is not None:
            self.ledger.mark(Cause.USED.value)
        self.ledger.set_state(number, record.state, causes)
        return record

    # Records

    def _capture(self, exposure: OpenExposure) -> CaptureRecord:
        return exposure.capture(self.serial_of_head, self.identity)

    def _seal(
        self, exposure: OpenExposure, stored: CaptureRecord, *, state: RecordState | None = None
    ) -> Exposure:
        mark = self._matcher.mark_of(exposure.number)
        if mark is None and self._matcher.marks.has_ambiguous(exposure.number):
            exposure.flags |= Flag.MARK_AMBIGUOUS
        self._matcher.marks.seal(exposure.number)
        provisional = exposure.provisional
        if provisional is not None and provisional[:2] == (mark, exposure.reported_flags):
            return provisional[2]
        record = self._compose(exposure, stored, mark)
        return record if state is None else replace(record, state=state)

    def _compose(
        self, exposure: OpenExposure, stored: CaptureRecord, mark: EventMark | None
    ) -> Exposure:
        frames, pulse = exposure.frames.values(), exposure.pulse
        now_ns = max((frame.mono_ns for frame in frames), default=exposure.ordered_mono_ns)
        starts = [(frame.head, frame.device_ns) for frame in frames]
        ptp = ptp_instant_of(self.rig, starts, pulse, self.ptp, now_ns)
        if mark is not None:
            compare_ptp(self.rig, starts, pulse, mark, self.ptp)
        heads = [head for head, _ in starts]
        suspect = Flag.PTP_FAULT if self.ptp.is_suspect(heads, now_ns) else NO_FLAG
        record = build_record(
            self.rig,
            stored,
            pulse,
            instant_of(mark, pulse, self.clock, ptp),
            self.track,
            self.temperatures,
            exposure.reported_flags | suspect,
        )
        return replace(record, disks=exposure.disks)


_FRAME_FLAGS = {
    Cause.LATE: Flag.FRAME_LATE,
    Cause.DUPLICATE: Flag.FRAME_DUPLICATE,
    Cause.CORRUPT: Flag.FRAME_CORRUPT,
    Cause.SPURIOUS: NO_FLAG,
}
_AMBIGUITIES = {
    Cause.CORRUPT: "may be a corrupt frame that arrived; it may belong to another exposure",
    Cause.SPURIOUS: "may be a frame that arrived and could not be attributed",
}
"""Of a frame that may be of several exposures, or of none."""
