"""What the drivers yield, as messages of the flight log and back.

Topic and payload only; how messages are put into a file is in `daemon.mission.log.flight_log`.
Instants are decimal strings of nanoseconds, as in every record of ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from enum import Enum
from typing import Any, Final, get_type_hints

from daemon.mission.canonical_json import (
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
    Velocity,
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
    """The message of a record: raw bytes as they came, everything else as canonical JSON.

    The keys are the names of the record's fields (docs/formats.md).
    """
    if isinstance(record, RawBytes):
        return Message(f"raw/{record.device}", record.mono_ns, record.data)
    if isinstance(record, LoggedTrigger):
        return Message("trigger", record.pulse.mono_ns, lenient_json_bytes(_trigger_json(record)))
    content = {field.name: getattr(record, field.name) for field in fields(record)}
    name = next(iter(content.values()))
    content |= {key: _text(content[key]) for key in _INSTANTS & content.keys()}
    return Message(f"{_TOPICS[type(record)]}/{name}", record.mono_ns, lenient_json_bytes(content))


def record_of(message: Message) -> LoggedRecord | None:
    """The record a message was made of; None for raw bytes, other topics and damaged content."""
    read = _READERS.get(message.topic.partition("/")[0])
    if read is None:
        return None
    problems: list[str] = []
    try:
        record = read(
            Fields(parse_record(message.payload, message.topic), "", message.topic, problems)
        )
    except RecordError:
        return None
    return None if problems else record


def lenient_json_bytes(content: Mapping[str, Any]) -> bytes:
    """Any content as canonical JSON: what JSON cannot hold becomes a text. Never raises."""
    return canonical_bytes(_lenient(content))


def _lenient(value: Any) -> Any:
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return _unicode(value)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, int):
        return int(value) if abs(value) <= EXACT_INTEGER_LIMIT else str(int(value))
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {_unicode(str(key)): _lenient(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_lenient(item) for item in value]
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


def _needed(fields: Fields, key: str) -> int:
    value = fields.instant(key)
    if value is None:
        fields.add_problem(key, "a decimal string is needed")
        return 0
    return value


def _status(fields: Fields, key: str) -> FrameStatus:
    return FrameStatus(fields.choice(key, [status.value for status in FrameStatus]))


def _flag(fields: Fields, key: str) -> bool:
    return fields.flag(key, default=False)


def _leap_seconds(fields: Fields, key: str) -> int | None:
    return fields.integer_or_none(key, minimum=-1000)


def _text(value: int | None) -> str | None:
    return None if value is None else str(value)


def _unicode(text: str) -> str:
    return text.encode("utf-8", "replace").decode("utf-8")


_KINDS: Final[Mapping[str, type[Any]]] = {
    "frame": Frame,
    "mark": EventMark,
    "navigation": NavSample,
    "temperature": TemperatureSample,
    "pps": PpsEdge,
    "clock": ClockReading,
    "event": DeviceEvent,
}
"""By the first word of their topic; the second word is the value of the first field."""

_TOPICS: Final = {kind: topic for topic, kind in _KINDS.items()}
_INSTANTS: Final = frozenset(
    ("gps_ns", "mono_ns", "device_ns", "device_clock_ns", "device_clock_mono_ns", "frame_id")
)
"""Written as texts: they may exceed what JSON's numbers hold."""

_TYPE_READERS: Final[Mapping[Any, Callable[[Fields, str], Any]]] = {
    "leap_seconds": _leap_seconds,
    **{(name, int): _needed for name in _INSTANTS},
    **{(name, int | None): Fields.instant for name in _INSTANTS},
    str: Fields.text,
    int: Fields.integer,
    int | None: Fields.integer_or_none,
    float: Fields.number,
    float | None: Fields.number_or_none,
    bool: _flag,
    Velocity | None: Fields.velocity,
    Mapping[str, float | int | str]: Fields.scalars,
    FrameStatus: _status,
}
"""How a field is read: by its name, its name and type, or its type."""


def _reader(kind: type[Any]) -> Callable[[Fields], LoggedRecord]:
    """A function that reads a record field by field, as the fields are declared."""
    field_readers = {
        name: next(_TYPE_READERS[key] for key in (name, (name, hint), hint) if key in _TYPE_READERS)
        for name, hint in get_type_hints(kind).items()
    }
    # A log of an earlier version has no later fields: those have defaults.
    optional = {one.name for one in fields(kind) if one.default is not MISSING}
    return lambda given: kind(
        **{
            name: read_field(given, name)
            for name, read_field in field_readers.items()
            if name in given.content or name not in optional
        }
    )


_READERS: Final = {"trigger": _trigger} | {topic: _reader(kind) for topic, kind in _KINDS.items()}
