"""The public interface of `drivers`: record types, life cycle and device protocols.

The protocols are head, trigger, thermometer, navigator and pulse per second. Access to a device is
in the package of its family.

Times: `mono_ns` is CLOCK_MONOTONIC of the host at arrival, `gps_ns` counts nanoseconds since the
GPS epoch (1980-01-06T00:00:00), `device_ns` is the device's own clock. All are `int`.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol

from drivers import DriverError


class DeviceError(DriverError):
    """A device failed to do what was requested; the message states device, cause and remedy."""


class LifeCycle(enum.Enum):
    """The states of a device.

    CREATED: configured, not accessed yet. BOUND: the device answered and its settings are written.
    ACTIVE: it delivers. INACTIVE: closed, or lost and waiting for reconnection.
    """

    CREATED = "created"
    BOUND = "bound"
    ACTIVE = "active"
    INACTIVE = "inactive"


class FrameStatus(enum.Enum):
    """The usability of the pixels of a frame."""

    COMPLETE = "complete"
    INCOMPLETE = "incomplete"
    """Packets are missing after all resend requests: the pixels have holes."""
    CORRUPT = "corrupt"
    """Size or format differ from the configured ones."""


@dataclass(frozen=True)
class Frame:
    """The pixels of one sensor and one exposure, in slot `slot` of the head's memory.

    `device_ns` is the start of exposure on the head's clock (chunk data); `device_clock_ns` and
    `device_clock_mono_ns` are the last latch of that clock and the host time it belongs to, with
    `latch_sigma_ns` from the round trip. `counter` counts the frames the head exposed since its
    acquisition started, sent or not. `settings` are the head's own features: exposure time, gain...
    """

    head: str
    slot: int
    status: FrameStatus
    frame_id: int
    counter: int | None
    width_px: int
    height_px: int
    pixel_format: str
    device_ns: int | None
    device_clock_ns: int | None
    device_clock_mono_ns: int | None
    latch_sigma_ns: int | None
    mono_ns: int
    exposure_time_us: float | None
    temperature_c: float | None
    settings: Mapping[str, float | int | str] = field(default_factory=dict)


@dataclass(frozen=True)
class EventMark:
    """The receiver's time of one strobe edge at mid-exposure.

    `count` is the receiver's own count of edges; it is `count_bits` wide and wraps. If `count_bits`
    is 0, the receiver does not count and `count` has no meaning. `time_valid` is the receiver's
    flag that `gps_ns` is valid.
    """

    receiver: str
    channel: int
    gps_ns: int
    accuracy_ns: int
    count: int
    count_bits: int
    time_valid: bool
    mono_ns: int


Velocity = tuple[float, float, float | None]
"""North, east, down in m/s; down is None if the receiver does not send it."""

POSITION_FIXES: Final = ("2d", "3d", "dead-reckoning")
"""Fixes with a position; a "2d" fix has no height."""


@dataclass(frozen=True)
class NavSample:
    """Position, velocity and, if the receiver provides it, attitude at one GPS instant.

    Geographic coordinates in WGS 84, height above the ellipsoid; velocity north, east, down.
    `fix` is the fix status of the receiver: "none", "2d", "3d", "time", "dead-reckoning". A value
    that was not received is None, never 0: latitude and longitude without a fix, height in a 2d fix
    or without an ellipsoidal height, sigmas that are not sent. `sigma_source` is the source of
    `horizontal_sigma_m`: "receiver", "dop" (dilution of precision times a configured range error)
    or "none". `leap_source` is "receiver", or "table" if GPS time was computed from UTC with the
    built-in table of leap seconds. If that table is outdated, time is wrong by integer seconds.
    """

    receiver: str
    gps_ns: int
    mono_ns: int
    fix: str
    satellites: int | None
    latitude_deg: float | None
    longitude_deg: float | None
    height_m: float | None
    horizontal_sigma_m: float | None
    vertical_sigma_m: float | None
    velocity_ned_mps: Velocity | None
    speed_sigma_mps: float | None
    roll_rad: float | None
    pitch_rad: float | None
    heading_rad: float | None
    leap_seconds: int | None
    time_valid: bool
    sigma_source: str = "receiver"
    leap_source: str = "receiver"

    @property
    def position(self) -> tuple[float, float] | None:
        """Latitude and longitude, degrees; None without a fix."""
        if self.fix not in POSITION_FIXES or self.latitude_deg is None:
            return None
        return None if self.longitude_deg is None else (self.latitude_deg, self.longitude_deg)


@dataclass(frozen=True)
class TemperatureSample:
    """One reading of one probe; `value_c` is None if the probe is open."""

    probe: str
    value_c: float | None
    mono_ns: int


@dataclass(frozen=True)
class TriggerPulse:
    """A pulse that was fired.

    `mono_ns` is the host's estimate of the instant from which the delays count, `sigma_ns` its half
    width. `count` is the unit's own count since power-on. `spread_ns` is the standard deviation of
    the delays relative to each other.
    """

    sequence: int
    mono_ns: int
    sigma_ns: int
    count: int
    spread_ns: int = 1_000


@dataclass(frozen=True)
class PpsEdge:
    """The host's time of one edge of a pulse per second: an integer second of GPS time.

    The edge does not identify the second.

    `mono_ns` is corrected for the known latency of the source; `sigma_ns` is its standard
    deviation. `sequence` is the source's own count of edges.
    """

    source: str
    sequence: int
    mono_ns: int
    sigma_ns: int


@dataclass(frozen=True)
class ClockReading:
    """A reading of a device's clock, and the middle of the round trip on the host's clock.

    `half_width_ns` is half of the round trip. The clock was read within `mono_ns` plus or minus
    that; if the round trip was short, most likely near the middle.
    """

    device: str
    device_ns: int
    mono_ns: int
    half_width_ns: int


@dataclass(frozen=True)
class PtpReading:
    """What a device reports of its clock's synchronisation by PTP (IEEE 1588).

    `status` is the state of its port as GenICam names it: "Slave", "Master", "Listening" and
    others. `offset_ns` is its clock less its master's, None if it was not read. `grandmaster` is
    the identity of the grandmaster, of its master if it reports no grandmaster, or empty.
    """

    device: str
    mono_ns: int
    status: str
    offset_ns: int | None
    grandmaster: str


@dataclass(frozen=True)
class RawBytes:
    """Bytes as received from a device, for the flight log."""

    device: str
    mono_ns: int
    data: bytes


@dataclass(frozen=True)
class DeviceEvent:
    """A change of state or a fault of a device.

    `name` is a stable kebab-case word ("opened", "lost", "timeout", "checksum", "held-by-another").
    `sentence` is for the operator and ends with the remedy. `settings` of "opened" are what the
    driver wrote or switched off, with the value that the device holds; a truth value is 0 or 1.
    """

    device: str
    name: str
    is_fault: bool
    sentence: str
    mono_ns: int
    settings: Mapping[str, float | int | str] = field(default_factory=dict)


Record = (
    Frame
    | EventMark
    | NavSample
    | TemperatureSample
    | PpsEdge
    | ClockReading
    | PtpReading
    | RawBytes
    | DeviceEvent
)
Sink = Callable[[Record], None]
"""Receives the records of a device. Called from the device's own thread; returns quickly."""


CHUNK_ALLOWANCE_NBYTES = 4096
"""Bytes that a head may append to the pixels of a frame: time, exposure time, counter."""


class FrameMemory(Protocol):
    """Slots of pixel memory that outlive the driver; one ring per head.

    A slot holds the pixels and CHUNK_ALLOWANCE_NBYTES after them. Its address is a multiple of 8.
    """

    @property
    def slot_count(self) -> int:
        """Number of slots; they are numbered from 0."""

    @property
    def slot_nbytes(self) -> int:
        """Bytes of a slot, CHUNK_ALLOWANCE_NBYTES included."""

    def address(self, slot: int) -> int:
        """Address of a slot in this process.

        Args:
            slot: number of the slot, 0 to `slot_count` - 1.

        Returns:
            Address of its first byte, a multiple of 8.
        """


class Device(Protocol):
    """The interface of every device."""

    @property
    def name(self) -> str:
        """Name from the configuration."""

    @property
    def state(self) -> LifeCycle:
        """Present state of the life cycle."""

    def bind(self) -> Mapping[str, str]:
        """Open the device and write its settings.

        Returns:
            Its identity (model, serial number, ...) as text by name.

        Raises:
            DeviceError: it does not answer or refuses a setting; the message contains the remedy.
        """

    def run(self, sink: Sink) -> None:
        """Deliver until `close` is called; called from a thread of the caller.

        A device fault never raises. The driver reports it as a `DeviceEvent` and reconnects with
        back-off.

        Args:
            sink: receives every record, in this thread.
        """

    def close(self) -> None:
        """Stop `run` within two seconds and release the device. May be called twice."""

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation; from any thread.

        Returns:
            Counts by stable name.
        """


class Head(Device, Protocol):
    """A camera head: frames land in the memory it was created with."""

    def bind(self, sink: Sink | None = None) -> Mapping[str, str]:
        """Open the head and write its settings; see `Device.bind`.

        Args:
            sink: receives an event while another controller holds the head.

        Returns:
            Its identity as text by name.

        Raises:
            DeviceError: as for a device.
        """

    def recycle(self, slot: int) -> None:
        """Return a slot of a frame that is no longer needed; from any thread.

        Args:
            slot: `Frame.slot` of that frame.

        Raises:
            ValueError: the slot was not handed out, or is returned twice.
        """

    def trigger(self) -> None:
        """Fire the software trigger; from any thread.

        Raises:
            DeviceError: the head waits for a line, is not running, or refuses.
        """

    def adjust(self, exposure_time_us: float, gain_db: float, tdi_shifts: int) -> None:
        """Use these settings from the next frame on, also after a loss; from any thread.

        Args:
            exposure_time_us: exposure time, us.
            gain_db: gain, dB.
            tdi_shifts: number of line shifts that compensate forward motion; 0 without TDI.

        Raises:
            DeviceError: the head is lost, refuses them, or cannot be changed while it runs; the
                previous settings stay in force.
        """


class Thermometer(Device, Protocol):
    """Yields `TemperatureSample`."""


class Navigator(Device, Protocol):
    """Yields `NavSample` and `EventMark`."""


class PulsePerSecond(Device, Protocol):
    """Yields `PpsEdge`."""


class Trigger(Protocol):
    """A trigger unit: it answers requests and delivers no stream of records."""

    @property
    def name(self) -> str:
        """Name from the configuration."""

    def bind(self) -> Mapping[str, str]:
        """Open the unit.

        Returns:
            Its identity as text by name.

        Raises:
            DeviceError: it does not answer; the message contains the remedy.
        """

    def program(self, delays_ns: Mapping[str, int]) -> None:
        """Set the delays of outputs.

        Args:
            delays_ns: delay from the instant of firing by output (cone), ns; outputs that are not
                named keep theirs.

        Raises:
            DeviceError: an output does not exist, a delay is out of range, or there is no answer.
        """

    def fire(self, sequence: int) -> TriggerPulse:
        """Fire one pulse.

        Args:
            sequence: number of the pulse.

        Returns:
            The pulse with the host's estimate of its time.

        Raises:
            DeviceError: none was fired, or that is unknown.
        """

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation; from any thread.

        Returns:
            Counts by stable name.
        """

    def close(self) -> None:
        """Release the unit; may be called twice."""
