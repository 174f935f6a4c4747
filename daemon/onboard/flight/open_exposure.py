"""An exposure between its trigger and its seal: what has arrived, and its record so far.

When it is stored and sealed is decided in `daemon.onboard.flight.flight`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord
from daemon.onboard.flight.flight_identity import FlightIdentity
from daemon.onboard.timing.pulses import FiredPulse
from drivers.contract import EventMark, Frame
from processing.quality.report import Flag

NO_FLAG = Flag(0)


@dataclass
class OpenExposure:
    """An exposure that is not sealed yet.

    `causes` and `ambiguous` name, by head, why a frame is missing; `ambiguous` is about frames that
    arrived and may belong to this exposure. `lost` is the cause of an exposure without frames.
    """

    number: int
    ordered_mono_ns: int
    pulse: FiredPulse | None = None
    frames: dict[str, Frame] = field(default_factory=dict)
    flags: Flag = NO_FLAG
    causes: dict[str, str] = field(default_factory=dict)
    ambiguous: dict[str, str] = field(default_factory=dict)
    line_id: str = ""
    strip_id: str = ""
    being_stored: CaptureRecord | None = None
    stored: CaptureRecord | None = None
    disks: tuple[str, ...] = ()
    provisional: tuple[EventMark, Flag, Exposure] | None = None
    lost: str = ""

    @property
    def awaits_frames(self) -> bool:
        """Whether a frame that arrives now becomes part of it."""
        return not self.lost and self.being_stored is None

    @property
    def reported_flags(self) -> Flag:
        """The flags, with FRAME_AMBIGUOUS if a missing frame may have arrived unattributed."""
        has_ambiguous_frame = self.ambiguous.keys() - self.frames.keys() - self.causes.keys()
        return self.flags | (Flag.FRAME_AMBIGUOUS if has_ambiguous_frame else NO_FLAG)

    def missing_cause(self, head: str) -> str:
        """Why the frame of a head is missing."""
        return self.causes.get(head) or self.ambiguous.get(head, "no frame came")

    def capture(self, serial_of_head: Mapping[str, str], identity: FlightIdentity) -> CaptureRecord:
        """The record of the frames that have arrived; a lost exposure has none."""
        usable = (
            {} if self.lost else {h: self.frames[h] for h in serial_of_head if h in self.frames}
        )
        missing = tuple(
            (head, self.lost or self.missing_cause(head))
            for head in serial_of_head
            if head not in usable
        )
        flags = self.reported_flags | (Flag.FRAME_MISSING if missing else NO_FLAG)
        return CaptureRecord(
            number=self.number,
            trigger_sequence=self.number,
            trigger_mono_ns=self.pulse.mono_ns if self.pulse else self.ordered_mono_ns,
            trigger_sigma_ns=self.pulse.sigma_ns if self.pulse else 0,
            boot_id=identity.boot_id,
            frames=tuple(_frame_record(f, serial_of_head[head]) for head, f in usable.items()),
            missing=missing,
            line_id=self.line_id,
            strip_id=self.strip_id,
            calibration_id=identity.calibration_id,
            calibration_sha256=identity.calibration_sha256,
            configuration_sha256=identity.configuration_sha256,
            software=identity.software,
            simulated=identity.simulated,
            flags=int(flags),
        )


def _frame_record(frame: Frame, head_serial: str) -> FrameRecord:
    return FrameRecord(
        sensor=frame.head,
        head_serial=head_serial,
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
