"""What a device is to this program, and what it yields.

The public contract of `drivers`: record types, life cycle and the protocols head, trigger,
thermometer and navigator. How a device is reached is in the room of its family.

Times: `mono_ns` is CLOCK_MONOTONIC of the host at arrival, `gps_ns` counts nanoseconds since the
GPS epoch (1980-01-06T00:00:00), `device_ns` is the device's own clock. All are `int`.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol


class DeviceError(Exception):
    """A device that cannot do what was asked; the message names device, finding and cure."""


class LifeCycle(enum.Enum):
    """The states of a device, and no others.

    CREATED: configured, nothing touched yet. BOUND: its address answered and its settings are
    written. ACTIVE: it delivers. INACTIVE: closed for good, or lost and waiting to be found again.
    """

    CREATED = "created"
    BOUND = "bound"
    ACTIVE = "active"
    INACTIVE = "inactive"


class FrameStatus(enum.Enum):
    """Whether a frame's pixels can be used."""

    COMPLETE = "complete"
    INCOMPLETE = "incomplete"
    """Packets are missing for good: the pixels have holes."""
    CORRUPT = "corrupt"
    """Size or format differ from what was configured."""


@dataclass(frozen=True)
class Frame:
    """One sensor's pixels of one exposure, lying in slot `slot` of the head's memory.

    `device_ns` is the start of exposure on the head's clock (chunk data); `device_clock_ns` and
    `device_clock_mono_ns` are the last latch of that clock and the host time it belongs to, with
    `latch_sigma_ns` from the round trip. `counter` counts the frames the head exposed since its
    acquisition started, sent or not. `settings` are the head's own words: exposure time, gain...
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
    """The receiver's time of one strobe: of its edge at mid-exposure.

    `count` is the receiver's own count of edges (`count_bits` wide, it wraps); where `count_bits`
    is 0 the receiver does not count and `count` says nothing. `time_valid` is the receiver's word
    that `gps_ns` can be trusted.
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
"""North, east, down in m/s; down is None where the receiver does not send it."""

POSITION_FIXES: Final = ("2d", "3d", "dead-reckoning")
"""Fixes that come with a position; a "2d" fix has no height."""


@dataclass(frozen=True)
class NavSample:
    """Position, velocity and, where the receiver knows it, attitude at one GPS instant.

    Geographic coordinates in WGS 84, height above the ellipsoid; velocity north, east, down.
    `fix` is the receiver's word: "none", "2d", "3d", "time", "dead-reckoning". What was not
    received is None, never 0: latitude and longitude without a fix, height in a 2d fix or where
    only a height above the geoid came, sigmas that nobody stated. `sigma_source` says where
    `horizontal_sigma_m` comes from: "receiver", "dop" (dilution of precision times a configured
    range error) or "none". `leap_source` is "receiver", or "table" where GPS time was computed from
    UTC with our table of leap seconds: if the table is outdated, time is wrong by whole seconds.
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
    """One reading of one probe; `value_c` is None where the probe is open."""

    probe: str
    value_c: float | None
    mono_ns: int


@dataclass(frozen=True)
class TriggerPulse:
    """A pulse that was given.

    `mono_ns` is the host's estimate of the moment the delays count from, `sigma_ns` its half
    width; `count` is the unit's own count since power-on. `spread_ns` is how well the delays are
    kept against each other, as a standard deviation.
    """

    sequence: int
    mono_ns: int
    sigma_ns: int
    count: int
    spread_ns: int = 1_000


@dataclass(frozen=True)
class PpsEdge:
    """The host's time of one edge of a pulse per second: a whole second of GPS time, which one is
    not said.

    `mono_ns` has the source's known latency taken off; `sigma_ns` is its standard deviation.
    `sequence` is the source's own count of edges.
    """

    source: str
    sequence: int
    mono_ns: int
    sigma_ns: int


@dataclass(frozen=True)
class ClockReading:
    """A device's clock, asked for and answered: what it said, and the middle of the round trip.

    `half_width_ns` is half of the round trip: the reading was made within `mono_ns` plus or minus
    that, and most likely near the middle where the round trip was short.
    """

    device: str
    device_ns: int
    mono_ns: int
    half_width_ns: int


@dataclass(frozen=True)
class RawBytes:
    """Bytes as they came from a device, for the flight log."""

    device: str
    mono_ns: int
    data: bytes


@dataclass(frozen=True)
class DeviceEvent:
    """A change of state or a fault of a device.

    `name` is a stable kebab-case word ("opened", "lost", "timeout", "checksum", "held-by-another");
    `sentence` is for the operator and ends with what to do.
    """

    device: str
    name: str
    is_fault: bool
    sentence: str
    mono_ns: int


Record = (
    Frame
    | EventMark
    | NavSample
    | TemperatureSample
    | PpsEdge
    | ClockReading
    | RawBytes
    | DeviceEvent
)
Sink = Callable[[Record], None]
"""Where a device puts what it yields. Called from the device's own thread; returns quickly."""


CHUNK_ALLOWANCE_NBYTES = 4096
"""What a head may write behind the pixels of a frame: time, exposure time, counter."""


class FrameMemory(Protocol):
    """Slots of pixel memory that outlive the driver; one ring per head.

    A slot has room for the pixels and CHUNK_ALLOWANCE_NBYTES behind them; its address is a
    multiple of 8.
    """

    @property
    def slot_count(self) -> int: ...

    @property
    def slot_nbytes(self) -> int: ...

    def address(self, slot: int) -> int:
        """Address of a slot in this process."""


class Device(Protocol):
    """What every device has."""

    @property
    def name(self) -> str: ...

    @property
    def state(self) -> LifeCycle: ...

    def bind(self) -> Mapping[str, str]:
        """Reach the device, write its settings, and say what was found (model, serial, ...).

        Raises:
            DeviceError: it does not answer or refuses a setting; the sentence names the cure.
        """

    def run(self, sink: Sink) -> None:
        """Deliver until `close` is called, from a thread of the caller's.

        Never raises for what a device does: it is found again with back-off, and says so through
        `DeviceEvent`.
        """

    def close(self) -> None:
        """Stop `run` within two seconds and let go of the device. May be called twice."""

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation, by stable name."""


class Head(Device, Protocol):
    """A camera head: frames land in the memory it was created with."""

    def bind(self, sink: Sink | None = None) -> Mapping[str, str]:
        """As for a device; `sink` hears at once that another controller is waited out."""

    def recycle(self, slot: int) -> None:
        """Hand a slot back; from any thread."""

    def trigger(self) -> None:
        """Software trigger; from any thread. DeviceError where the head waits for a line."""

    def adjust(self, exposure_time_us: float, gain_db: float, tdi_shifts: int) -> None:
        """Expose with this from the next frame on, also after a loss; from any thread.

        Raises:
            DeviceError: the head is not there, refuses it, or cannot be changed while it runs; what
                was set before holds.
        """


class Thermometer(Device, Protocol):
    """Yields `TemperatureSample`."""


class Navigator(Device, Protocol):
    """Yields `NavSample` and `EventMark`."""


class PulsePerSecond(Device, Protocol):
    """Yields `PpsEdge`."""


class Trigger(Protocol):
    """Who fires. Not a stream of records: it is asked, and answers."""

    @property
    def name(self) -> str: ...

    def bind(self) -> Mapping[str, str]:
        """Reach the unit and say what was found. DeviceError as for a device."""

    def program(self, delays_ns: Mapping[str, int]) -> None:
        """Set the delay of every output, by cone, from the moment of firing."""

    def fire(self, sequence: int) -> TriggerPulse:
        """Give one pulse. DeviceError where none was given or nobody knows."""

    def close(self) -> None: ...
