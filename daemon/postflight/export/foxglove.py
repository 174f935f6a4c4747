"""A mission as one MCAP file that Foxglove opens: track, thumbnails and messages, in UTC.

Derived from the flight logs and the records, which stay as they are. Channels are JSON with the
schema names Foxglove knows: foxglove.LocationFix, foxglove.CompressedImage, foxglove.Log.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from daemon.mission.canonical_json import RecordError
from daemon.mission.exposure import Exposure
from daemon.mission.exposure_batch import ExposureFailure, for_each_exposure
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.log.log_records import AUDIT_TOPIC, record_of
from daemon.mission.store import durable
from daemon.mission.store.level2 import read_report
from daemon.orientation.exterior_orientation import sealed_exposure
from drivers.contract import DeviceEvent, NavSample
from drivers.timescales.leap_seconds import leap_seconds_at

FILE_NAME = "foxglove.mcap"
GPS_EPOCH_UNIX_NS = 315_964_800_000_000_000
NS = 1_000_000_000
INFO, WARNING, ERROR = 2, 3, 4
LEVELS = {"good": INFO, "usable": WARNING, "refly": ERROR}
UNKNOWN_COVARIANCE, DIAGONAL_KNOWN = 0, 2

_TIME = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}


def _one_of(*names: str) -> dict[str, Any]:
    """Names numbered from 0, in the one form of an enumeration that Foxglove reads."""
    return {"oneOf": [{"title": name, "const": number} for number, name in enumerate(names)]}


SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    "foxglove.LocationFix": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "latitude": {"type": "number"},
        "longitude": {"type": "number"},
        "altitude": {"type": "number"},
        "position_covariance": {
            "type": "array",
            "items": {"type": "number"},
            "minItems": 9,
            "maxItems": 9,
        },
        "position_covariance_type": _one_of("UNKNOWN", "APPROXIMATED", "DIAGONAL_KNOWN", "KNOWN"),
    },
    "foxglove.CompressedImage": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": {"type": "string"},
    },
    "foxglove.Log": {
        "timestamp": _TIME,
        "level": _one_of("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL"),
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer", "minimum": 0},
    },
}
"""Properties by schema name, as Foxglove publishes them."""

_TopicMessage = tuple[int, str, str, dict[str, Any]]
"""UTC in ns since 1970, topic, schema, content without its timestamp."""


@dataclass(frozen=True)
class FoxgloveExport:
    """Written messages by topic, and the exposures that could not be read."""

    file: Path
    messages: dict[str, int]
    failures: tuple[ExposureFailure, ...] = ()


def export_foxglove(mission: Mission) -> FoxgloveExport:
    """Write `export/foxglove.mcap`, in place of an earlier one.

    Raises:
        OSError: the disk refused.
    """
    durable.make_directories(mission.export_dir)
    final = mission.export_dir / FILE_NAME
    counts: dict[str, int] = {}
    read = for_each_exposure(mission.numbers(), lambda number: _from_exposure(mission, number))
    of_exposures = (message for messages in read.results.values() for message in messages)
    entries = sorted([*_from_logs(mission), *of_exposures], key=itemgetter(0))
    with durable.new_file(final) as part, part.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="syntopic")
        channels: dict[str, int] = {}
        for utc_ns, topic, schema, content in entries:
            if topic not in channels:
                channels[topic] = _register(writer, topic, schema)
            message = {"timestamp": {"sec": utc_ns // NS, "nsec": utc_ns % NS}, **content}
            counts[topic] = counts.get(topic, 0) + 1
            writer.add_message(
                channels[topic],
                log_time=utc_ns,
                publish_time=utc_ns,
                sequence=counts[topic],
                data=json.dumps(message).encode(),
            )
        mark = {"simulated": "true"} if mission.is_simulated else {}
        writer.add_metadata("syntopic", {"mission": mission.id, **mark})
        writer.finish()
    return FoxgloveExport(final, counts, read.failures)


def _register(writer: Writer, topic: str, schema: str) -> int:
    content = {"title": schema, "type": "object", "properties": SCHEMAS[schema]}
    number = writer.register_schema(schema, "jsonschema", json.dumps(content).encode())
    return int(writer.register_channel(topic, "json", number))


def _from_logs(mission: Mission) -> Iterator[_TopicMessage]:
    """Positions, and messages of devices and people, from every log of the mission."""
    for path in logs_of(mission.log_dir):
        log_messages: list[tuple[int, int, str, str]] = []
        mono_less_gps_ns: int | None = None
        for message in read(path):
            if message.topic == AUDIT_TOPIC:
                log_messages.append((message.mono_ns, INFO, *_of_command(message.payload)))
                continue
            try:
                record = record_of(message)
            except RecordError:
                continue
            if isinstance(record, NavSample) and record.time_valid and record.position:
                # The earliest arrival is the nearest to the instant itself: tens of ms.
                lag_ns = record.mono_ns - record.gps_ns
                known_ns = lag_ns if mono_less_gps_ns is None else mono_less_gps_ns
                mono_less_gps_ns = min(known_ns, lag_ns)
                yield (utc_ns(record.gps_ns), "/fix", "foxglove.LocationFix", _fix(record))
            elif isinstance(record, DeviceEvent):
                level = ERROR if record.is_fault else INFO
                log_messages.append((record.mono_ns, level, record.device, record.sentence))
        if mono_less_gps_ns is None:
            continue  # the instant of these messages is unknown
        for mono_ns, level, name, sentence in log_messages:
            yield (utc_ns(mono_ns - mono_less_gps_ns), *_log_message(level, name, sentence))


def _from_exposure(mission: Mission, number: int) -> list[_TopicMessage]:
    """Thumbnail and findings of an exposure whose time is known."""
    exposure = sealed_exposure(mission, number)
    if exposure is None or exposure.mark_gps_ns is None:
        return []
    at_ns = utc_ns(exposure.mark_gps_ns)
    folder = mission.level2(number)
    messages: list[_TopicMessage] = [(at_ns, *_of_exposure(exposure, folder))]
    thumbnail = folder / "thumbnail.jpg"
    if thumbnail.exists():
        data = base64.b64encode(thumbnail.read_bytes()).decode("ascii")
        image = {"frame_id": "camera", "data": data, "format": "jpeg"}
        messages.insert(0, (at_ns, "/thumbnail", "foxglove.CompressedImage", image))
    return messages


def _of_exposure(exposure: Exposure, folder: Path) -> tuple[str, str, dict[str, Any]]:
    quality = read_report(folder) or {}
    verdict = quality.get("verdict", "not processed")
    sentences = [finding["sentence"] for finding in quality.get("findings", [])]
    where = f", line {exposure.line_id}" if exposure.line_id else ""
    entries = f"exposure {exposure.number}{where}: {exposure.state}, {verdict}"
    return _log_message(
        LEVELS.get(verdict, WARNING), "exposures", " ".join([f"{entries}.", *sentences])
    )


def _of_command(payload: bytes) -> tuple[str, str]:
    try:
        entries = json.loads(payload)
        return str(entries["by"]), f"{entries['command']}: {entries['sentence']}"
    except (ValueError, KeyError, TypeError):
        return "audit", "a command that cannot be read"


def _log_message(level: int, name: str, sentence: str) -> tuple[str, str, dict[str, Any]]:
    content = {"level": level, "message": sentence, "name": name, "file": "", "line": 0}
    return "/log", "foxglove.Log", content


def _fix(sample: NavSample) -> dict[str, Any]:
    horizontal_m, vertical_m = sample.horizontal_sigma_m, sample.vertical_sigma_m
    covariance = [0.0] * 9
    is_known = horizontal_m is not None and vertical_m is not None
    if horizontal_m is not None and vertical_m is not None:
        covariance[0::4] = (horizontal_m**2 / 2, horizontal_m**2 / 2, vertical_m**2)
    return {
        "frame_id": sample.receiver,
        "latitude": sample.latitude_deg,
        "longitude": sample.longitude_deg,
        **({} if sample.height_m is None else {"altitude": sample.height_m}),
        "position_covariance": covariance,
        "position_covariance_type": DIAGONAL_KNOWN if is_known else UNKNOWN_COVARIANCE,
    }


def utc_ns(gps_ns: int) -> int:
    """A GPS instant in ns since 1970, UTC."""
    leap_s = leap_seconds_at(gps_ns - leap_seconds_at(gps_ns) * NS)
    return gps_ns - leap_s * NS + GPS_EPOCH_UNIX_NS
