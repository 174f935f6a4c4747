"""The record of one exposure: what was triggered, which frames came, when and where it was.

Data and their JSON form only. How a record is put on disk is in `daemon.mission.store.store`, what
an exposure's state may become in `daemon.onboard.flight.transitions`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict
from pydantic_core import CoreSchema, core_schema

from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.record_types import (
    Count,
    FileName,
    Finite,
    Instant,
    InstantOrZero,
    Integer,
    LeapSeconds,
    LongText,
    NedVelocity,
    Ordinal,
    Scalars,
    Sha256,
    distinct,
    read_record,
)
from processing.rig.problem_sentences import Finding, shown
from processing.rig.value_types import Flag, Name

TimeSource = Literal["event-mark", "ptp", "pps", "interpolated", "host", "none"]
RecordState = Literal["complete", "degraded", "lost"]
_KNOWN_KEYS_ONLY: Final = ConfigDict(extra="forbid")


class _MissingFrame(BaseModel):
    """A frame that is missing, as the record has it."""

    model_config = ConfigDict(extra="forbid")

    sensor: LongText
    cause: LongText = "not stated"


class _FromObject:
    """Reads a pair from an object of two keys."""

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, handler: Any) -> CoreSchema:
        return core_schema.no_info_after_validator_function(
            lambda frame: (frame.sensor, frame.cause), handler.generate_schema(_MissingFrame)
        )


MissingFrames = tuple[Annotated[tuple[str, str], _FromObject], ...]
"""Missing frames of an exposure: (sensor, cause) pairs."""

EXPOSURE_FORMAT = 1


@dataclass(frozen=True)
class FrameRecord:
    """One sensor's frame as stored on disk, and what is known of its instant.

    `file` is a name in the folder of the exposure; `sha256` is of that whole file. Both are empty
    before the frame is stored. `mid_exposure_gps_ns` is final when the exposure is sealed.
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    sensor: Name
    head_serial: LongText = ""
    file: FileName = ""
    sha256: Sha256 = ""
    width_px: Count = 0
    height_px: Count = 0
    pixel_format: LongText = "Mono16"
    device_ns: Instant | None = None
    counter: Count | None = None
    exposure_time_us: Finite | None = None
    temperature_c: Finite | None = None
    mono_ns: InstantOrZero = 0
    mid_exposure_gps_ns: Instant | None = None
    time_sigma_ns: Count | None = None
    time_source: TimeSource = "none"
    settings: Scalars = field(default_factory=dict)


@dataclass(frozen=True)
class TemperatureRecord:
    """A probe's reading that belongs to the exposure; `age_ns` is its age at the trigger."""

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    probe: LongText
    value_c: Finite | None = None
    age_ns: Integer = 0


@dataclass(frozen=True, kw_only=True)
class NavigationRecord:
    """Position, velocity and attitude at the event mark.

    Geographic coordinates in `crs` at the epoch of the observation, `height_m` above
    `height_reference`; heading from true north; velocity north, east, down. `gap_ns` is the span
    between the two samples used, or the distance to the nearest one where it was extrapolated.
    What the receiver did not send is None. `sigma_source` and `leap_source` say where sigmas and
    GPS time come from (`drivers.contract.NavSample`).
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    receiver: LongText = ""
    gps_ns: Instant
    method: Literal["interpolated", "extrapolated", "nearest"] = "nearest"
    gap_ns: Count = 0
    fix: LongText = "none"
    satellites: Count | None = None
    latitude_deg: Finite
    longitude_deg: Finite
    height_m: Finite | None = None
    horizontal_sigma_m: Finite | None = None
    vertical_sigma_m: Finite | None = None
    velocity_ned_mps: NedVelocity | None = None
    speed_sigma_mps: Finite | None = None
    roll_rad: Finite | None = None
    pitch_rad: Finite | None = None
    heading_rad: Finite | None = None
    leap_seconds: LeapSeconds | None = None
    crs: LongText = "EPSG:4979"
    height_reference: Literal["ellipsoid", "geoid"] = "ellipsoid"
    sigma_source: LongText = "receiver"
    leap_source: LongText = "receiver"


Frames = Annotated[
    tuple[FrameRecord, ...], distinct(attrgetter("sensor")), distinct(attrgetter("file"))
]


@dataclass(frozen=True)
class CaptureRecord:
    """What is known when the pixels become durable: enough to seal the exposure after a crash.

    Written as `capture.json` next to the frames. `trigger_mono_ns` counts on the CLOCK_MONOTONIC
    of the boot `boot_id`.
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    number: Ordinal
    trigger_sequence: Count = 0
    trigger_mono_ns: InstantOrZero = 0
    trigger_sigma_ns: Count = 0
    boot_id: LongText = ""
    frames: Frames = ()
    missing: MissingFrames = ()
    line_id: LongText = ""
    strip_id: LongText = ""
    calibration_id: LongText = ""
    calibration_sha256: Sha256 = ""
    configuration_sha256: Sha256 = ""
    software: LongText = ""
    simulated: Flag = False
    flags: Count = 0


@dataclass(frozen=True)
class Exposure:
    """The sealed record of an exposure, `exposure.json`.

    `mark_gps_ns` is the instant of the rig's strobe, from the source `mark_source`; `flags`
    is the bit set of `processing.quality.report.Flag` as far as capture knows it. `time_budget_ns`
    are the standard deviations that make up that of the least certain frame, by what they come
    from. `disks` are the ids of the disks on which its frames were durable when it was stored;
    empty where the mission has one disk. `previous_sha256` is the hash of the record sealed before
    this one.
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    number: Ordinal
    trigger_sequence: Count = 0
    trigger_mono_ns: InstantOrZero = 0
    trigger_sigma_ns: Count = 0
    boot_id: LongText = ""
    mark_gps_ns: Instant | None = None
    mark_sigma_ns: Count | None = None
    mark_source: TimeSource = "none"
    mark_count: Count | None = None
    time_budget_ns: Mapping[str, Count] = field(default_factory=dict)
    frames: Frames = ()
    missing: MissingFrames = ()
    temperatures: Annotated[tuple[TemperatureRecord, ...], distinct(attrgetter("probe"))] = ()
    navigation: NavigationRecord | None = None
    line_id: LongText = ""
    strip_id: LongText = ""
    calibration_id: LongText = ""
    calibration_sha256: Sha256 = ""
    configuration_sha256: Sha256 = ""
    software: LongText = ""
    simulated: Flag = False
    state: RecordState = "complete"
    flags: Count = 0
    disks: tuple[Name, ...] = ()
    previous_sha256: Sha256 = ""

    def frame(self, sensor: str) -> FrameRecord | None:
        """The frame of a sensor, or None where it is missing."""
        return next((frame for frame in self.frames if frame.sensor == sensor), None)


def to_json(exposure: Exposure) -> dict[str, Any]:
    """The exposure as an object of JSON types; every key but `disks` is always present."""
    return {
        **_shared_json(exposure, "exposure"),
        "mark_gps_ns": _instant(exposure.mark_gps_ns),
        "mark_sigma_ns": exposure.mark_sigma_ns,
        "mark_source": exposure.mark_source,
        "mark_count": exposure.mark_count,
        "time_budget_ns": dict(exposure.time_budget_ns),
        "temperatures": [
            {"probe": t.probe, "value_c": _float(t.value_c), "age_ns": t.age_ns}
            for t in exposure.temperatures
        ],
        "navigation": navigation_to_json(exposure.navigation) if exposure.navigation else None,
        "state": exposure.state,
        **({"disks": list(exposure.disks)} if exposure.disks else {}),
        "previous_sha256": exposure.previous_sha256,
    }


def exposure_bytes(exposure: Exposure) -> bytes:
    """The exact content of `exposure.json`; its SHA-256 is what the next record quotes."""
    return canonical_bytes(to_json(exposure))


def capture_bytes(capture: CaptureRecord) -> bytes:
    """The exact content of `capture.json`."""
    return canonical_bytes(_shared_json(capture, "capture"))


def from_json(content: Mapping[str, Any], file: str = "exposure.json") -> Exposure:
    """Read an exposure record, ours or written by hand; absent keys take documented defaults.

    Raises:
        RecordError: with one sentence per mistake: file, key, value, and what would be right.
    """
    return read_record(Exposure, *_without_header(content, "exposure", file))


def capture_from_json(content: Mapping[str, Any], file: str = "capture.json") -> CaptureRecord:
    """Read what `capture_bytes` wrote. RecordError as for `from_json`."""
    return read_record(CaptureRecord, *_without_header(content, "capture", file))


def navigation_from_json(content: Mapping[str, Any]) -> NavigationRecord:
    """Read what `navigation_to_json` wrote. RecordError as for `from_json`."""
    return read_record(NavigationRecord, content, "navigation")


def navigation_to_json(navigation: NavigationRecord) -> dict[str, Any]:
    """The navigation of an exposure as an object of JSON types."""
    velocity = navigation.velocity_ned_mps
    return {
        "receiver": navigation.receiver,
        "gps_ns": _instant(navigation.gps_ns),
        "method": navigation.method,
        "gap_ns": navigation.gap_ns,
        "fix": navigation.fix,
        "satellites": navigation.satellites,
        "latitude_deg": float(navigation.latitude_deg),
        "longitude_deg": float(navigation.longitude_deg),
        "height_m": _float(navigation.height_m),
        "horizontal_sigma_m": _float(navigation.horizontal_sigma_m),
        "vertical_sigma_m": _float(navigation.vertical_sigma_m),
        "velocity_ned_mps": None if velocity is None else [_float(v) for v in velocity],
        "speed_sigma_mps": _float(navigation.speed_sigma_mps),
        "roll_rad": _float(navigation.roll_rad),
        "pitch_rad": _float(navigation.pitch_rad),
        "heading_rad": _float(navigation.heading_rad),
        "leap_seconds": navigation.leap_seconds,
        "crs": navigation.crs,
        "height_reference": navigation.height_reference,
        "sigma_source": navigation.sigma_source,
        "leap_source": navigation.leap_source,
    }


def frame_to_json(frame: FrameRecord) -> dict[str, Any]:
    """A frame's record as an object of JSON types."""
    return {
        "sensor": frame.sensor,
        "head_serial": frame.head_serial,
        "file": frame.file,
        "sha256": frame.sha256,
        "width_px": frame.width_px,
        "height_px": frame.height_px,
        "pixel_format": frame.pixel_format,
        "device_ns": _instant(frame.device_ns),
        "counter": frame.counter,
        "exposure_time_us": _float(frame.exposure_time_us),
        "temperature_c": _float(frame.temperature_c),
        "mono_ns": _instant(frame.mono_ns),
        "mid_exposure_gps_ns": _instant(frame.mid_exposure_gps_ns),
        "time_sigma_ns": frame.time_sigma_ns,
        "time_source": frame.time_source,
        "settings": dict(frame.settings),
    }


def _shared_json(record: Exposure | CaptureRecord, kind: str) -> dict[str, Any]:
    return {
        "format": EXPOSURE_FORMAT,
        "kind": kind,
        "number": record.number,
        "trigger_sequence": record.trigger_sequence,
        "trigger_mono_ns": _instant(record.trigger_mono_ns),
        "trigger_sigma_ns": record.trigger_sigma_ns,
        "boot_id": record.boot_id,
        "frames": [frame_to_json(frame) for frame in record.frames],
        "missing": [{"sensor": sensor, "cause": cause} for sensor, cause in record.missing],
        "line_id": record.line_id,
        "strip_id": record.strip_id,
        "calibration_id": record.calibration_id,
        "calibration_sha256": record.calibration_sha256,
        "configuration_sha256": record.configuration_sha256,
        "software": record.software,
        "simulated": record.simulated,
        "flags": int(record.flags),
    }


def _without_header(
    content: Mapping[str, Any], kind: str, file: str
) -> tuple[dict[str, Any], str, list[Finding]]:
    """The record without the keys that state its format, its file, and what is wrong with them."""
    right = {"format": EXPOSURE_FORMAT, "kind": kind}
    findings: list[Finding] = [
        ((key,), f"is {shown(content[key])}; this version reads {value!r} here")
        for key, value in right.items()
        if content.get(key, value) != value
    ]
    return {key: value for key, value in content.items() if key not in right}, file, findings


def _instant(value: int | None) -> str | None:
    return None if value is None else str(int(value))


def _float(value: float | None) -> float | None:
    return None if value is None else float(value)
