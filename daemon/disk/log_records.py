"""What the drivers yield, as messages of the flight log and back.

Topic and payload only; how messages are put into a file is in `daemon.disk.flight_log`. Instants
are decimal strings of nanoseconds, as in every record of ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from daemon.disk.records import (
    EXACT_INTEGER_LIMIT,
    Fields,
    RecordError,
    canonical_bytes,
    parse_record,
)
from drivers.contract import (
    ClockReading,
    DeviceEvent,
    EventMark,
    Frame,
    FrameStatus,
    NavSample,
    PpsEdge,
    RawBytes,
    Record,
    TemperatureSample,
    TriggerPulse,
)


@dataclass(frozen=True)
class Message:
    """A message of the flight log: topic, arrival on the host's monotonic clock, and content."""

    topic: str
    mono_ns: int
    payload: bytes


@dataclass(frozen=True)
class LoggedTrigger:
    """A pulse that was given, and the exposure it was given for.

    `delays_ns` by cone lead from the pulse to the start of exposure, `strobe_delay_ns` to the
    strobe that the receiver stamps.
    """

    number: int
    pulse: TriggerPulse
    delays_ns: Mapping[str, int] = field(default_factory=dict)
    strobe_delay_ns: int = 0


LoggedRecord = (
    Frame
    | EventMark
    | NavSample
    | TemperatureSample
    | PpsEdge
    | ClockReading
    | DeviceEvent
    | LoggedTrigger
)


def message_of(record: Record | LoggedTrigger) -> Message:
    """The message of a record: raw bytes as they came, everything else as canonical JSON."""
    if isinstance(record, RawBytes):
        return Message(f"raw/{record.device}", record.mono_ns, record.data)
    if isinstance(record, LoggedTrigger):
        return Message("trigger", record.pulse.mono_ns, loose_bytes(_trigger_json(record)))
    if isinstance(record, Frame):
        topic, content = f"frame/{record.head}", _frame_json(record)
    elif isinstance(record, EventMark):
        topic, content = f"mark/{record.receiver}", _mark_json(record)
    elif isinstance(record, NavSample):
        topic, content = f"navigation/{record.receiver}", _navigation_json(record)
    elif isinstance(record, TemperatureSample):
        topic = f"temperature/{record.probe}"
        content = {"probe": record.probe, "value_c": record.value_c}
    elif isinstance(record, PpsEdge):
        topic = f"pps/{record.source}"
        content = {
            "source": record.source,
            "sequence": record.sequence,
            "sigma_ns": record.sigma_ns,
        }
    elif isinstance(record, ClockReading):
        topic = f"clock/{record.device}"
        content = {
            "device": record.device,
            "device_ns": str(record.device_ns),
            "half_width_ns": record.half_width_ns,
        }
    else:
        topic = f"event/{record.device}"
        content = {
            "device": record.device,
            "name": record.name,
            "is_fault": record.is_fault,
            "sentence": record.sentence,
        }
    content["mono_ns"] = str(record.mono_ns)
    return Message(topic, record.mono_ns, loose_bytes(content))


def record_of(message: Message) -> LoggedRecord | None:
    """The record a message was made of; None for raw bytes, other topics and damaged content."""
    read = _READERS.get(message.topic.partition("/")[0])
    if read is None:
        return None
    problems: list[str] = []
    try:
        fields = Fields(parse_record(message.payload, message.topic), "", message.topic, problems)
        record = read(fields)
    except RecordError:
        return None
    return None if problems else record


def loose_bytes(content: Mapping[str, Any]) -> bytes:
    """Any content as canonical JSON: what JSON cannot hold becomes a text. Never raises."""
    return canonical_bytes(_loose(content))


def _loose(value: Any) -> Any:
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return _unicode(value)
    if isinstance(value, int):
        return int(value) if abs(value) <= EXACT_INTEGER_LIMIT else str(int(value))
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {_unicode(str(key)): _loose(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_loose(item) for item in value]
    return str(value)


def _trigger_json(record: LoggedTrigger) -> dict[str, Any]:
    return {
        "number": record.number,
        "sequence": str(record.pulse.sequence),
        "mono_ns": str(record.pulse.mono_ns),
        "sigma_ns": record.pulse.sigma_ns,
        "count": record.pulse.count,
        "spread_ns": record.pulse.spread_ns,
        "delays_ns": dict(record.delays_ns),
        "strobe_delay_ns": record.strobe_delay_ns,
    }


def _frame_json(frame: Frame) -> dict[str, Any]:
    return {
        "head": frame.head,
        "slot": frame.slot,
        "status": frame.status.value,
        "frame_id": str(frame.frame_id),
        "counter": frame.counter,
        "width_px": frame.width_px,
        "height_px": frame.height_px,
        "pixel_format": frame.pixel_format,
        "device_ns": _text(frame.device_ns),
        "device_clock_ns": _text(frame.device_clock_ns),
        "device_clock_mono_ns": _text(frame.device_clock_mono_ns),
        "latch_sigma_ns": frame.latch_sigma_ns,
        "exposure_time_us": frame.exposure_time_us,
        "temperature_c": frame.temperature_c,
        "settings": _loose(frame.settings),
    }


def _mark_json(mark: EventMark) -> dict[str, Any]:
    return {
        "receiver": mark.receiver,
        "channel": mark.channel,
        "gps_ns": str(mark.gps_ns),
        "accuracy_ns": mark.accuracy_ns,
        "count": mark.count,
        "count_bits": mark.count_bits,
        "time_valid": mark.time_valid,
    }


def _navigation_json(sample: NavSample) -> dict[str, Any]:
    return {
        "receiver": sample.receiver,
        "gps_ns": str(sample.gps_ns),
        "fix": sample.fix,
        "satellites": sample.satellites,
        "latitude_deg": sample.latitude_deg,
        "longitude_deg": sample.longitude_deg,
        "height_m": sample.height_m,
        "horizontal_sigma_m": sample.horizontal_sigma_m,
        "vertical_sigma_m": sample.vertical_sigma_m,
        "velocity_ned_mps": list(sample.velocity_ned_mps),
        "speed_sigma_mps": sample.speed_sigma_mps,
        "roll_rad": sample.roll_rad,
        "pitch_rad": sample.pitch_rad,
        "heading_rad": sample.heading_rad,
        "leap_seconds": sample.leap_seconds,
        "time_valid": sample.time_valid,
    }


def _trigger(fields: Fields) -> LoggedTrigger:
    pulse = TriggerPulse(
        sequence=_needed(fields, "sequence"),
        mono_ns=_needed(fields, "mono_ns"),
        sigma_ns=fields.integer("sigma_ns"),
        count=fields.integer("count"),
        spread_ns=fields.integer("spread_ns", 1_000),
    )
    delays_ns = {
        cone: value for cone, value in fields.scalars("delays_ns").items() if isinstance(value, int)
    }
    strobe_ns = fields.integer("strobe_delay_ns", 0)
    return LoggedTrigger(fields.integer("number", minimum=1), pulse, delays_ns, strobe_ns)


def _frame(fields: Fields) -> Frame:
    statuses = [status.value for status in FrameStatus]
    return Frame(
        head=fields.text("head"),
        slot=fields.integer("slot"),
        status=FrameStatus(fields.choice("status", statuses)),
        frame_id=_needed(fields, "frame_id"),
        counter=fields.integer_or_none("counter"),
        width_px=fields.integer("width_px"),
        height_px=fields.integer("height_px"),
        pixel_format=fields.text("pixel_format"),
        device_ns=fields.instant("device_ns"),
        device_clock_ns=fields.instant("device_clock_ns"),
        device_clock_mono_ns=fields.instant("device_clock_mono_ns"),
        latch_sigma_ns=fields.integer_or_none("latch_sigma_ns"),
        mono_ns=_needed(fields, "mono_ns"),
        exposure_time_us=fields.number_or_none("exposure_time_us"),
        temperature_c=fields.number_or_none("temperature_c"),
        settings=fields.scalars("settings"),
    )


def _mark(fields: Fields) -> EventMark:
    return EventMark(
        receiver=fields.text("receiver"),
        channel=fields.integer("channel"),
        gps_ns=_needed(fields, "gps_ns"),
        accuracy_ns=fields.integer("accuracy_ns"),
        count=fields.integer("count"),
        count_bits=fields.integer("count_bits"),
        time_valid=fields.flag("time_valid", default=False),
        mono_ns=_needed(fields, "mono_ns"),
    )


def _navigation(fields: Fields) -> NavSample:
    return NavSample(
        receiver=fields.text("receiver"),
        gps_ns=_needed(fields, "gps_ns"),
        mono_ns=_needed(fields, "mono_ns"),
        fix=fields.text("fix"),
        satellites=fields.integer("satellites"),
        latitude_deg=fields.number("latitude_deg"),
        longitude_deg=fields.number("longitude_deg"),
        height_m=fields.number("height_m"),
        horizontal_sigma_m=fields.number("horizontal_sigma_m"),
        vertical_sigma_m=fields.number("vertical_sigma_m"),
        velocity_ned_mps=fields.triple("velocity_ned_mps"),
        speed_sigma_mps=fields.number("speed_sigma_mps"),
        roll_rad=fields.number_or_none("roll_rad"),
        pitch_rad=fields.number_or_none("pitch_rad"),
        heading_rad=fields.number_or_none("heading_rad"),
        leap_seconds=fields.integer_or_none("leap_seconds", minimum=-1000),
        time_valid=fields.flag("time_valid", default=False),
    )


def _temperature(fields: Fields) -> TemperatureSample:
    return TemperatureSample(
        probe=fields.text("probe"),
        value_c=fields.number_or_none("value_c"),
        mono_ns=_needed(fields, "mono_ns"),
    )


def _pps(fields: Fields) -> PpsEdge:
    return PpsEdge(
        source=fields.text("source"),
        sequence=fields.integer("sequence"),
        mono_ns=_needed(fields, "mono_ns"),
        sigma_ns=fields.integer("sigma_ns"),
    )


def _clock(fields: Fields) -> ClockReading:
    return ClockReading(
        device=fields.text("device"),
        device_ns=_needed(fields, "device_ns"),
        mono_ns=_needed(fields, "mono_ns"),
        half_width_ns=fields.integer("half_width_ns"),
    )


def _event(fields: Fields) -> DeviceEvent:
    return DeviceEvent(
        device=fields.text("device"),
        name=fields.text("name"),
        is_fault=fields.flag("is_fault", default=False),
        sentence=fields.text("sentence"),
        mono_ns=_needed(fields, "mono_ns"),
    )


_READERS: Mapping[str, Callable[[Fields], LoggedRecord]] = {
    "trigger": _trigger,
    "frame": _frame,
    "mark": _mark,
    "navigation": _navigation,
    "temperature": _temperature,
    "pps": _pps,
    "clock": _clock,
    "event": _event,
}


def _needed(fields: Fields, key: str) -> int:
    value = fields.instant(key)
    if value is None:
        fields.complain(key, "a decimal string is needed")
        return 0
    return value


def _text(value: int | None) -> str | None:
    return None if value is None else str(value)


def _unicode(text: str) -> str:
    return text.encode("utf-8", "replace").decode("utf-8")
