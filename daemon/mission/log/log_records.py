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

from pydantic import BaseModel, Field, create_model

from daemon.mission.canonical_json import (
    EXACT_INTEGER_LIMIT,
    RecordError,
    canonical_bytes,
    parse_record,
)
from daemon.mission.record_types import (
    Count,
    Finite,
    Instant,
    Integer,
    LeapSeconds,
    LongText,
    NedVelocity,
    Ordinal,
    Scalars,
    read_record,
)
from drivers.contract import (
    ClockReading,
    DeviceEvent,
    EventMark,
    Frame,
    FrameStatus,
    NavSample,
    PpsEdge,
    PtpReading,
    RawBytes,
    Record,
    TemperatureSample,
    TriggerPulse,
    Velocity,
)
from processing.rig.value_types import Flag

AUDIT_TOPIC: Final = "audit"
"""Topic of operator commands, with their authors and answers."""


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
    | PtpReading
    | DeviceEvent
    | LoggedTrigger
)


def message_of(record: Record | LoggedTrigger) -> Message:
    """The message of a record: raw bytes as they came, everything else as canonical JSON.

    The keys are the names of the record's fields (docs/reference/formats.md).
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
    try:
        return read(parse_record(message.payload, message.topic), message.topic)
    except RecordError:
        return None


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


class _TriggerRecord(BaseModel):
    """The keys of a message of `trigger`."""

    number: Ordinal
    sequence: Instant
    mono_ns: Instant
    sigma_ns: Count
    count: Count
    spread_ns: Count = 1_000
    delays_ns: dict[str, Integer] = {}
    strobe_delay_ns: Count = 0


def _trigger(content: Mapping[str, Any], topic: str) -> LoggedTrigger:
    read = read_record(_TriggerRecord, content, topic)
    pulse = TriggerPulse(
        sequence=read.sequence,
        mono_ns=read.mono_ns,
        sigma_ns=read.sigma_ns,
        count=read.count,
        spread_ns=read.spread_ns,
    )
    return LoggedTrigger(read.number, pulse, read.delays_ns, read.strobe_delay_ns)


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
    "ptp": PtpReading,
    "event": DeviceEvent,
}
"""By the first word of their topic; the second word is the value of the first field."""

_TOPICS: Final = {kind: topic for topic, kind in _KINDS.items()}
_INSTANTS: Final = frozenset(
    ("gps_ns", "mono_ns", "device_ns", "device_clock_ns", "device_clock_mono_ns", "frame_id")
)
"""Written as texts: they may exceed what JSON's numbers hold."""

_TYPES: Final[Mapping[Any, Any]] = {
    "leap_seconds": LeapSeconds | None,
    **{(name, int): Instant for name in _INSTANTS},
    **{(name, int | None): Instant | None for name in _INSTANTS},
    ("offset_ns", int | None): Integer | None,
    str: LongText,
    int: Count,
    int | None: Count | None,
    float: Finite,
    float | None: Finite | None,
    bool: Flag,
    Velocity | None: NedVelocity | None,
    Mapping[str, float | int | str]: Scalars,
    FrameStatus: FrameStatus,
}
"""The type of a field in a record: by its name, its name and type, or its type."""


def _reader(kind: type[Any]) -> Callable[[Mapping[str, Any], str], LoggedRecord]:
    """A function that reads a record whose keys are the fields of a class."""
    hints = get_type_hints(kind)
    keys: dict[str, Any] = {}
    for one in fields(kind):
        hint = hints[one.name]
        by = next(key for key in (one.name, (one.name, hint), hint) if key in _TYPES)
        # A log of an earlier version has no later fields: those have defaults.
        keys[one.name] = (_TYPES[by], _default(one))
    model: type[BaseModel] = create_model(kind.__name__, **keys)
    return lambda content, topic: kind(**vars(read_record(model, content, topic)))


def _default(one: Any) -> Any:
    if one.default is not MISSING:
        return one.default
    return ... if one.default_factory is MISSING else Field(default_factory=one.default_factory)


_Reader = Callable[[Mapping[str, Any], str], LoggedRecord]
_READERS: Final[dict[str, _Reader]] = {topic: _reader(kind) for topic, kind in _KINDS.items()}
_READERS["trigger"] = _trigger
