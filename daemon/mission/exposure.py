"""The record of one exposure: what was triggered, which frames came, when and where it was.

Data and their JSON form only. How a record is put on disk is in `daemon.mission.store.store`, what
an exposure's state may become in `daemon.onboard.flight.transitions`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, cast, get_args

from daemon.mission.canonical_json import Fields, RecordError, canonical_bytes
from drivers.contract import Velocity

TimeSource = Literal["event-mark", "pps", "interpolated", "host", "none"]
RecordState = Literal["complete", "degraded", "lost"]
MissingFrames = tuple[tuple[str, str], ...]
"""Missing frames of an exposure: (sensor, cause) pairs."""

EXPOSURE_FORMAT = 1
TIME_SOURCES: tuple[str, ...] = get_args(TimeSource)
RECORD_STATES: tuple[str, ...] = get_args(RecordState)
NAVIGATION_METHODS = ("interpolated", "extrapolated", "nearest")
HEIGHT_REFERENCES = ("ellipsoid", "geoid")


@dataclass(frozen=True)
class FrameRecord:
    """One sensor's frame as stored on disk, and what is known of its instant.

    `file` is a name in the folder of the exposure; `sha256` is of that whole file. Both are empty
    before the frame is stored. `mid_exposure_gps_ns` is final when the exposure is sealed.
    """

    sensor: str
    head_serial: str
    file: str
    sha256: str
    width_px: int
    height_px: int
    pixel_format: str
    device_ns: int | None
    counter: int | None
    exposure_time_us: float | None
    temperature_c: float | None
    mono_ns: int
    mid_exposure_gps_ns: int | None = None
    time_sigma_ns: int | None = None
    time_source: TimeSource = "none"
    settings: Mapping[str, float | int | str] = field(default_factory=dict)


@dataclass(frozen=True)
class TemperatureRecord:
    """A probe's reading that belongs to the exposure; `age_ns` is its age at the trigger."""

    probe: str
    value_c: float | None
    age_ns: int = 0


@dataclass(frozen=True)
class NavigationRecord:
    """Position, velocity and attitude at the event mark.

    Geographic coordinates in `crs` at the epoch of the observation, `height_m` above
    `height_reference`; heading from true north; velocity north, east, down. `gap_ns` is the span
    between the two samples used, or the distance to the nearest one where it was extrapolated.
    What the receiver did not send is None. `sigma_source` and `leap_source` say where sigmas and
    GPS time come from (`drivers.contract.NavSample`).
    """

    receiver: str
    gps_ns: int
    method: Literal["interpolated", "extrapolated", "nearest"]
    gap_ns: int
    fix: str
    satellites: int | None
    latitude_deg: float
    longitude_deg: float
    height_m: float | None
    horizontal_sigma_m: float | None
    vertical_sigma_m: float | None
    velocity_ned_mps: Velocity | None
    speed_sigma_mps: float | None
    roll_rad: float | None = None
    pitch_rad: float | None = None
    heading_rad: float | None = None
    leap_seconds: int | None = None
    crs: str = "EPSG:4979"
    height_reference: Literal["ellipsoid", "geoid"] = "ellipsoid"
    sigma_source: str = "receiver"
    leap_source: str = "receiver"


@dataclass(frozen=True)
class CaptureRecord:
    """What is known when the pixels become durable: enough to seal the exposure after a crash.

    Written as `capture.json` next to the frames. `trigger_mono_ns` counts on the CLOCK_MONOTONIC
    of the boot `boot_id`.
    """

    number: int
    trigger_sequence: int = 0
    trigger_mono_ns: int = 0
    trigger_sigma_ns: int = 0
    boot_id: str = ""
    frames: tuple[FrameRecord, ...] = ()
    missing: MissingFrames = ()
    line_id: str = ""
    strip_id: str = ""
    calibration_id: str = ""
    calibration_sha256: str = ""
    configuration_sha256: str = ""
    software: str = ""
    simulated: bool = False
    flags: int = 0


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

    number: int
    trigger_sequence: int = 0
    trigger_mono_ns: int = 0
    trigger_sigma_ns: int = 0
    boot_id: str = ""
    mark_gps_ns: int | None = None
    mark_sigma_ns: int | None = None
    mark_source: TimeSource = "none"
    mark_count: int | None = None
    time_budget_ns: Mapping[str, int] = field(default_factory=dict)
    frames: tuple[FrameRecord, ...] = ()
    missing: MissingFrames = ()
    temperatures: tuple[TemperatureRecord, ...] = ()
    navigation: NavigationRecord | None = None
    line_id: str = ""
    strip_id: str = ""
    calibration_id: str = ""
    calibration_sha256: str = ""
    configuration_sha256: str = ""
    software: str = ""
    simulated: bool = False
    state: RecordState = "complete"
    flags: int = 0
    disks: tuple[str, ...] = ()
    previous_sha256: str = ""

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
    problems: list[str] = []
    fields = Fields(content, "", file, problems)
    shared = _shared_from(fields, "exposure")
    navigation = fields.object("navigation")
    exposure = Exposure(
        **shared,
        mark_gps_ns=fields.instant("mark_gps_ns"),
        mark_sigma_ns=fields.integer_or_none("mark_sigma_ns"),
        mark_source=cast(TimeSource, fields.choice("mark_source", TIME_SOURCES, "none")),
        mark_count=fields.integer_or_none("mark_count"),
        time_budget_ns=_budget(fields),
        temperatures=tuple(_temperature(item) for item in fields.objects("temperatures")),
        navigation=_navigation(navigation) if navigation else None,
        state=cast(RecordState, fields.choice("state", RECORD_STATES, "complete")),
        disks=fields.names("disks"),
        previous_sha256=fields.sha256("previous_sha256"),
    )
    _refuse_duplicates([t.probe for t in exposure.temperatures], "temperatures", fields)
    fields.refuse_unknown()
    if problems:
        raise RecordError(problems)
    return exposure


def capture_from_json(content: Mapping[str, Any], file: str = "capture.json") -> CaptureRecord:
    """Read what `capture_bytes` wrote. RecordError as for `from_json`."""
    problems: list[str] = []
    fields = Fields(content, "", file, problems)
    capture = CaptureRecord(**_shared_from(fields, "capture"))
    fields.refuse_unknown()
    if problems:
        raise RecordError(problems)
    return capture


def navigation_from_json(content: Mapping[str, Any]) -> NavigationRecord:
    """Read what `navigation_to_json` wrote. RecordError as for `from_json`."""
    problems: list[str] = []
    navigation = _navigation(Fields(content, "", "navigation", problems))
    if problems:
        raise RecordError(problems)
    return navigation


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


def _shared_from(fields: Fields, kind: str) -> dict[str, Any]:
    if fields.integer("format", EXPOSURE_FORMAT) != EXPOSURE_FORMAT:
        fields.add_problem("format", f"this version reads format {EXPOSURE_FORMAT}")
    fields.choice("kind", (kind,), kind)
    frames = tuple(_frame(item) for item in fields.objects("frames"))
    _refuse_duplicates([frame.sensor for frame in frames], "frames", fields)
    _refuse_duplicates([frame.file for frame in frames if frame.file], "frames", fields)
    return {
        "number": fields.integer("number", minimum=1),
        "trigger_sequence": fields.integer("trigger_sequence", 0),
        "trigger_mono_ns": fields.instant("trigger_mono_ns", 0) or 0,
        "trigger_sigma_ns": fields.integer("trigger_sigma_ns", 0),
        "boot_id": fields.text("boot_id", ""),
        "frames": frames,
        "missing": tuple(_missing(item) for item in fields.objects("missing")),
        "line_id": fields.text("line_id", ""),
        "strip_id": fields.text("strip_id", ""),
        "calibration_id": fields.text("calibration_id", ""),
        "calibration_sha256": fields.sha256("calibration_sha256"),
        "configuration_sha256": fields.sha256("configuration_sha256"),
        "software": fields.text("software", ""),
        "simulated": fields.flag("simulated", default=False),
        "flags": fields.integer("flags", 0),
    }


def _frame(fields: Fields) -> FrameRecord:
    frame = FrameRecord(
        sensor=fields.name("sensor"),
        head_serial=fields.text("head_serial", ""),
        file=fields.name("file", ""),
        sha256=fields.sha256("sha256"),
        width_px=fields.integer("width_px", 0),
        height_px=fields.integer("height_px", 0),
        pixel_format=fields.text("pixel_format", "Mono16"),
        device_ns=fields.instant("device_ns"),
        counter=fields.integer_or_none("counter"),
        exposure_time_us=fields.number_or_none("exposure_time_us"),
        temperature_c=fields.number_or_none("temperature_c"),
        mono_ns=fields.instant("mono_ns", 0) or 0,
        mid_exposure_gps_ns=fields.instant("mid_exposure_gps_ns"),
        time_sigma_ns=fields.integer_or_none("time_sigma_ns"),
        time_source=cast(TimeSource, fields.choice("time_source", TIME_SOURCES, "none")),
        settings=fields.scalars("settings"),
    )
    fields.refuse_unknown()
    return frame


def _temperature(fields: Fields) -> TemperatureRecord:
    record = TemperatureRecord(
        probe=fields.text("probe"),
        value_c=fields.number_or_none("value_c"),
        age_ns=fields.integer("age_ns", 0, minimum=-(2**53)),
    )
    fields.refuse_unknown()
    return record


def _missing(fields: Fields) -> tuple[str, str]:
    pair = (fields.text("sensor"), fields.text("cause", "not stated"))
    fields.refuse_unknown()
    return pair


def _navigation(fields: Fields) -> NavigationRecord:
    gps_ns = fields.instant("gps_ns")
    if gps_ns is None:
        fields.add_problem("gps_ns", "the instant of the position is needed")
    method = fields.choice("method", NAVIGATION_METHODS, "nearest")
    reference = fields.choice("height_reference", HEIGHT_REFERENCES, "ellipsoid")
    record = NavigationRecord(
        receiver=fields.text("receiver", ""),
        gps_ns=gps_ns or 0,
        method=cast(Literal["interpolated", "extrapolated", "nearest"], method),
        gap_ns=fields.integer("gap_ns", 0),
        fix=fields.text("fix", "none"),
        satellites=fields.integer_or_none("satellites"),
        latitude_deg=fields.number("latitude_deg"),
        longitude_deg=fields.number("longitude_deg"),
        height_m=fields.number_or_none("height_m"),
        horizontal_sigma_m=fields.number_or_none("horizontal_sigma_m"),
        vertical_sigma_m=fields.number_or_none("vertical_sigma_m"),
        velocity_ned_mps=fields.velocity("velocity_ned_mps"),
        speed_sigma_mps=fields.number_or_none("speed_sigma_mps"),
        roll_rad=fields.number_or_none("roll_rad"),
        pitch_rad=fields.number_or_none("pitch_rad"),
        heading_rad=fields.number_or_none("heading_rad"),
        leap_seconds=fields.integer_or_none("leap_seconds", minimum=-1000),
        crs=fields.text("crs", "EPSG:4979"),
        height_reference=cast(Literal["ellipsoid", "geoid"], reference),
        sigma_source=fields.text("sigma_source", "receiver"),
        leap_source=fields.text("leap_source", "receiver"),
    )
    fields.refuse_unknown()
    return record


def _budget(fields: Fields) -> dict[str, int]:
    found = fields.scalars("time_budget_ns")
    if not all(isinstance(value, int) and value >= 0 for value in found.values()):
        fields.add_problem(
            "time_budget_ns", "whole nanoseconds, by what they come from, are needed"
        )
    return {name: value for name, value in found.items() if isinstance(value, int)}


def _refuse_duplicates(names: list[str], key: str, fields: Fields) -> None:
    for name in dict.fromkeys(n for n in names if names.count(n) > 1):
        fields.problems.append(f"{fields.file}: {key} names {name!r} twice; once is right")


def _instant(value: int | None) -> str | None:
    return None if value is None else str(int(value))


def _float(value: float | None) -> float | None:
    return None if value is None else float(value)
