"""The receivers' own bytes out of the flight log, for post-processing software.

One file a receiver in its native format, exactly as the bytes came, and the event file: one row an
exposure. Nothing is decoded here.
"""

from __future__ import annotations

import csv
import json
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from daemon.flight_log import logs_of, read
from daemon.mission import Mission

NATIVE_ENDINGS = {
    "ublox": "ubx",
    "novatel": "gps",
    "septentrio": "sbf",
    "nmea": "nmea",
    "mavlink": "raw",
}
"""How post-processing software expects a receiver's recording to be called, by driver."""

EVENT_COLUMNS = (
    "exposure",
    "gps_week",
    "seconds_of_week",
    "sigma_ns",
    "source",
    "count",
    "latitude_deg",
    "longitude_deg",
    "height_ellipsoid_m",
)
_WEEK_NS = 604_800_000_000_000


@dataclass(frozen=True)
class RawExport:
    """What was written: bytes by file name, and how many exposures are in the event file."""

    folder: Path
    nbytes: dict[str, int]
    events: int


def export_raw(mission: Mission) -> RawExport:
    """Write `export/raw/<receiver>.<ending>` and `export/raw/events.csv`, in place of earlier ones.

    Bytes of several service runs of one flight follow each other in the order they were received.

    Raises:
        OSError: the disk refused.
    """
    folder = mission.export_dir / "raw"
    folder.mkdir(parents=True, exist_ok=True)
    endings = _receivers(mission)
    nbytes = dict.fromkeys((f"{name}.{ending}" for name, ending in endings.items()), 0)
    with ExitStack() as stack:
        files: dict[str, BinaryIO] = {
            name: stack.enter_context((folder / f"{name}.{ending}").open("wb"))
            for name, ending in endings.items()
        }
        for path in logs_of(mission.log_dir):
            for message in read(path):
                kind, _, device = message.topic.partition("/")
                if kind == "raw" and device in files:
                    files[device].write(message.payload)
                    nbytes[f"{device}.{endings[device]}"] += len(message.payload)
    rows = list(_events(mission))
    with (folder / "events.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(EVENT_COLUMNS)
        writer.writerows(rows)
    return RawExport(folder, nbytes, len(rows))


def _receivers(mission: Mission) -> dict[str, str]:
    """Ending by name of every navigator the flight was configured with."""
    if not mission.service_path.exists():
        return {}
    flown = tomllib.loads(mission.service_path.read_text(encoding="utf-8"))
    return {
        section["name"]: NATIVE_ENDINGS.get(section["driver"], "bin")
        for section in flown.get("navigator", [])
    }


def _events(mission: Mission) -> Iterator[tuple[Any, ...]]:
    for number in mission.numbers():
        path = mission.level0(number) / "exposure.json"
        if not path.exists():
            continue
        record = json.loads(path.read_text(encoding="utf-8"))
        if record.get("mark_gps_ns") is None:
            continue
        week, of_week_ns = divmod(int(record["mark_gps_ns"]), _WEEK_NS)
        place = record.get("navigation") or {}
        seconds, nanoseconds = divmod(of_week_ns, 1_000_000_000)
        yield (
            number,
            week,
            f"{seconds}.{nanoseconds:09d}",
            record.get("mark_sigma_ns"),
            record.get("mark_source"),
            record.get("mark_count"),
            place.get("latitude_deg"),
            place.get("longitude_deg"),
            place.get("height_m"),
        )
