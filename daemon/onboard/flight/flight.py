"""The open exposures of a flight, from the pulse to the sealed record.

Pure bookkeeping on given instants. Input: frames, marks, navigation and temperatures. Output: the
exposures that are due to be stored, sealed or given up. `daemon.onboard.service.service` handles
processes and disk.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from daemon.configuration.model import LimitsSection
from daemon.mission.exposure import (
    CaptureRecord,
    Exposure,
    FrameRecord,
    RecordState,
)
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.flight.record_builder import build_record, instant_of
from daemon.onboard.flight.temperatures import TemperatureHistory
from daemon.onboard.timing.device_clocks import DeviceClocks
from daemon.onboard.timing.gps_clock import ClockEvent, GpsClock
from daemon.onboard.timing.matching import Cause, FiredPulse, Matcher
from daemon.orientation.navigation import Track
from drivers.contract import (
    ClockReading,
    EventMark,
    Frame,
    NavSample,
    PpsEdge,
    TemperatureSample,
)
from processing.geometry.drift import lagged_sensors
from processing.quality.report import Flag
from processing.rig import Rig

NS = 1_000_000_000
NO_FLAG = Flag(0)


@dataclass(frozen=True)
class FlightIdentity:
    """Values that every record of a flight contains."""

    boot_id: str
    line_id: str
    calibration_id: str
    calibration_sha256: str
    configuration_sha256: str
    software: str
    simulated: bool


@dataclass(frozen=True)
class PendingStore:
    """An exposure to be stored: its frames have arrived or timed out."""

    capture: CaptureRecord
    slots: Mapping[str, int]


@dataclass
class _OpenExposure:
    number: int
    ordered_mono_ns: int
    pulse: FiredPulse | None = None
    frames: dict[str, Frame] = field(default_factory=dict)
    flags: Flag = NO_FLAG
    causes: dict[str, str] = field(default_factory=dict)
    ambiguous: dict[str, str] = field(default_factory=dict)
    """Cause by head, for frames that arrived and may belong to this exposure."""
    line_id: str = ""
    strip_id: str = ""
    being_stored: CaptureRecord | None = None
    stored: CaptureRecord | None = None
    disks: tuple[str, ...] = ()
    provisional: tuple[EventMark, Flag, Exposure] | None = None
    lost: str = ""

    @property
    def reported_flags(self) -> Flag:
        """The flags, with FRAME_AMBIGUOUS if a missing frame may have arrived unattributed."""
        has_ambiguous_frame = self.ambiguous.keys() - self.frames.keys() - self.causes.keys()
        return self.flags | (Flag.FRAME_AMBIGUOUS if has_ambiguous_frame else NO_FLAG)

    def missing_cause(self, head: str) -> str:
        """Why the frame of a head is missing."""
        return self.causes.get(head) or self.ambiguous.get(head, "no frame came")


class Flight:
    """Exposures between trigger and seal.

    Every method that takes an instant takes `mono_ns`. Slots of frames that are not used are
    collected in `idle_slots`, to be returned to the heads. Marks that became final after their
    arrival are in `resolved_marks`. Heads in `absent_heads` are known to be lost; their frames are
    not awaited. While `disk_is_low` is set, ordered exposures get the flag DISK_LOW.
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
        self._steps_reported: dict[str, int] = {}
        self.track = Track()
        self.temperatures = TemperatureHistory(lagged_sensors(rig))
        self.idle_slots: list[tuple[str, int]] = []
        self.resolved_marks: list[tuple[EventMark, Cause]] = []
        self.absent_heads: set[str] = set()
        self.disk_is_low = False
        self.serial_of_head = serial_of_head
        self._cone_of_head = {head: rig.cone_of(head) for head in serial_of_head}
        self._matcher = Matcher({h: c.name for h, c in self._cone_of_head.items()}, self.clock)
        self._open: dict[int, _OpenExposure] = {}
        self._next_number = first_number

    @property
    def open_numbers(self) -> tuple[int, ...]:
        """Exposures that are not sealed or given up yet."""
        return tuple(self._open)

    @property
    def awaits_frames(self) -> bool:
        """Whether heads are still exposing or sending."""
        return any(not e.lost and e.being_stored is None for e in self._open.values())

    def order(self, mono_ns: int, line_id: str | None = None, strip_id: str = "") -> int:
        """Open the exposure of a trigger that is being ordered; return its number.

        `line_id` is that of the planned line being flown, None where nothing is planned.
        """
        number = self._next_number
        self._next_number += 1
        line = self.identity.line_id if line_id is None else line_id
        flags = Flag.DISK_LOW if self.disk_is_low else NO_FLAG
        self._open[number] = _OpenExposure(
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
        self._open[pulse.number].pulse = pulse
        self._matcher.pulse(pulse)

    def frame(self, frame: Frame) -> Cause:
        """A frame arrived. Its slot is kept only where the frame is used."""
        self._read_latch(frame)
        match = self._matcher.frame(frame)
        cause = match.cause
        exposure = None if match.number is None else self._open.get(match.number)
        if cause is Cause.USED and (exposure is None or exposure.being_stored is not None):
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
        self.idle_slots.append((frame.head, frame.slot))
        return cause

    def has_pulse_of(self, frame: Frame) -> bool:
        """Whether the pulse of a frame is already known."""
        return self._matcher.has_pulse_of(frame)

    def _read_latch(self, frame: Frame) -> None:
        at_ns, mono_ns = frame.device_clock_ns, frame.device_clock_mono_ns
        if at_ns is not None and mono_ns is not None and frame.latch_sigma_ns is not None:
            reading = ClockReading(frame.head, at_ns, mono_ns, frame.latch_sigma_ns)
            self.device_clocks.read(reading)

    def mark(self, mark: EventMark) -> Cause:
        """An event mark arrived. USED and PENDING may change until its exposure is sealed."""
        cause = self._matcher.mark(mark).cause
        is_open = cause in (Cause.USED, Cause.PENDING)
        self.ledger.mark(Cause.PENDING.value if is_open else cause.value)
        return cause

    def pps(self, edge: PpsEdge) -> None:
        """An edge of the pulse per second arrived."""
        self.clock.pps_edge(edge.mono_ns, edge.sigma_ns)
        self._matcher.marks.reconsider()

    def clock_reading(self, reading: ClockReading) -> None:
        """A device's clock was read."""
        self.device_clocks.read(reading)

    def clock_events(self, mono_ns: int) -> list[ClockEvent]:
        """Events of the clocks since the last call."""
        events = self.clock.events(mono_ns)
        for device, steps in self.device_clocks.steps().items():
            if steps > self._steps_reported.get(device, 0):
                self._steps_reported[device] = steps
                events.append(
                    ClockEvent(
                        "device-clock-stepped",
                        True,
                        f"the clock of {device} stepped or restarted; it is estimated again; "
                        "check its power supply if this repeats",
                    )
                )
        return events

    def land(self) -> None:
        """End the flight: pending marks become spurious."""
        self._give_up_marks(2**63)

    def navigation(self, sample: NavSample) -> None:
        """A position arrived."""
        if sample.time_valid:
            self.track.add(sample)
            self.clock.message_arrived(sample.gps_ns, sample.mono_ns)
            self._matcher.marks.reconsider()

    def temperature(self, sample: TemperatureSample) -> None:
        """A probe was read."""
        self.temperatures.add(sample)

    def due_to_store(self, mono_ns: int) -> list[PendingStore]:
        """Exposures whose frames are complete or timed out; each is returned once."""
        due = []
        for exposure in self._open.values():
            if exposure.being_stored is not None or exposure.lost or not exposure.frames:
                continue
            waited_ns = mono_ns - exposure.ordered_mono_ns
            is_timed_out = waited_ns > self.limits.frame_timeout_s * NS
            if is_timed_out or self._is_complete(exposure) or self._must_release_slots(exposure):
                exposure.being_stored = self._capture(exposure)
                slots = {head: frame.slot for head, frame in exposure.frames.items()}
                due.append(PendingStore(exposure.being_stored, slots))
        return due

    def _is_complete(self, exposure: _OpenExposure) -> bool:
        """Whether every head that can send its frame has done so."""
        return exposure.frames.keys() >= self.serial_of_head.keys() - self.absent_heads

    def _must_release_slots(self, exposure: _OpenExposure) -> bool:
        """Whether a newer exposure needs the slots of this one.

        A silent head must not exhaust the memory of the others. Heads deliver in order: a head that
        is as many exposures behind as there are slots is not awaited.
        """
        first = exposure.number + self.limits.exposures_in_memory - 1
        return any(
            other.number >= first and exposure.frames.keys() <= other.frames.keys()
            for other in self._open.values()
        )

    def due_to_give_up(self, mono_ns: int) -> list[tuple[int, str]]:
        """Exposures without any frame in time: now lost, with the cause; returned once."""
        lost = []
        for exposure in self._open.values():
            waited_ns = mono_ns - exposure.ordered_mono_ns
            if exposure.frames or exposure.lost or waited_ns <= self.limits.frame_timeout_s * NS:
                continue
            cause = "no pulse was given" if exposure.pulse is None else "no head sent a frame"
            lost.append((exposure.number, cause))
            self._mark_lost(exposure, cause)
        return lost

    def not_fired(self, number: int, sentence: str) -> None:
        """The trigger unit gave no pulse or did not answer: the exposure is lost."""
        exposure = self._open.get(number)
        if exposure is not None and not exposure.frames:
            self._mark_lost(exposure, sentence)

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
            self._mark_lost(exposure, sentence)

    def due_to_seal(self, mono_ns: int) -> Exposure | None:
        """The oldest open exposure, once it is stored or lost and its mark and navigation final."""
        mark_wait_ns = round((self.limits.mark_timeout_s + self.limits.frame_timeout_s) * NS)
        self._give_up_marks(mono_ns - mark_wait_ns)
        if not self._open:
            return None
        exposure = next(iter(self._open.values()))
        if exposure.lost:
            return self._seal(exposure, self._capture(exposure), state="lost")
        if exposure.stored is None:
            return None
        waited_ns = mono_ns - exposure.ordered_mono_ns
        is_waiting = waited_ns <= self.limits.mark_timeout_s * NS
        is_corroborated = self._matcher.marks.is_corroborated(exposure.number)
        if is_waiting and not (is_corroborated and self._has_navigation(exposure)):
            return None
        return self._seal(exposure, exposure.stored)

    def due_provisionally(self) -> Exposure | None:
        """The oldest open exposure that only awaits a second mark; returned once.

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

    def _has_navigation(self, exposure: _OpenExposure) -> bool:
        mark = self._matcher.mark_of(exposure.number)
        return mark is not None and self.track.covers(mark.gps_ns)

    def sealed(self, number: int, state: RecordState) -> None:
        """The record is on disk: the exposure is closed."""
        self._close(number, state)
        self.ledger.sealed(number)

    def not_sealed(self, number: int, state: RecordState) -> None:
        """The disk refused the record: the exposure is closed, and recovery seals it later."""
        self._close(number, state)

    def _close(self, number: int, state: RecordState) -> None:
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
        self.ledger.set_state(number, state, causes)

    def _give_up_marks(self, before_mono_ns: int) -> None:
        for mark in self._matcher.marks.give_up(before_mono_ns):
            self.ledger.mark(Cause.SPURIOUS.value)
            self.resolved_marks.append((mark, Cause.SPURIOUS))

    def _mark_lost(self, exposure: _OpenExposure, cause: str) -> None:
        exposure.lost = cause
        self.idle_slots += [(head, frame.slot) for head, frame in exposure.frames.items()]

    def _capture(self, exposure: _OpenExposure) -> CaptureRecord:
        usable = {} if exposure.lost else _in_order(exposure.frames, self.serial_of_head)
        missing = [
            (head, exposure.lost or exposure.missing_cause(head))
            for head in self.serial_of_head
            if head not in usable
        ]
        flags = exposure.reported_flags | (Flag.FRAME_MISSING if missing else NO_FLAG)
        return CaptureRecord(
            number=exposure.number,
            trigger_sequence=exposure.number,
            trigger_mono_ns=exposure.pulse.mono_ns if exposure.pulse else exposure.ordered_mono_ns,
            trigger_sigma_ns=exposure.pulse.sigma_ns if exposure.pulse else 0,
            boot_id=self.identity.boot_id,
            frames=tuple(self._frame_record(frame) for frame in usable.values()),
            missing=tuple(missing),
            line_id=exposure.line_id,
            strip_id=exposure.strip_id,
            calibration_id=self.identity.calibration_id,
            calibration_sha256=self.identity.calibration_sha256,
            configuration_sha256=self.identity.configuration_sha256,
            software=self.identity.software,
            simulated=self.identity.simulated,
            flags=int(flags),
        )

    def _frame_record(self, frame: Frame) -> FrameRecord:
        return FrameRecord(
            sensor=frame.head,
            head_serial=self.serial_of_head[frame.head],
            file="",
            sha256="",
            width_px=frame.width_px,
            height_px=frame.height_px,
            pixel_format=frame.pixel_format,
            device_ns=frame.device_ns,
            counter=frame.counter,
            exposure_time_us=frame.exposure_time_us,
            temperature_c=frame.temperature_c,
            mono_ns=frame.mono_ns,
            settings=dict(frame.settings),
        )

    def _seal(
        self, exposure: _OpenExposure, stored: CaptureRecord, *, state: RecordState | None = None
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
        self, exposure: _OpenExposure, stored: CaptureRecord, mark: EventMark | None
    ) -> Exposure:
        record = build_record(
            self.rig,
            stored,
            exposure.pulse,
            instant_of(mark, exposure.pulse, self.clock),
            self.track,
            self.temperatures,
            exposure.reported_flags,
        )
        return replace(record, disks=exposure.disks)


def _in_order(frames: Mapping[str, Frame], heads: Iterable[str]) -> dict[str, Frame]:
    return {head: frames[head] for head in heads if head in frames}


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
