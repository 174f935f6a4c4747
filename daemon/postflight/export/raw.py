"""The receivers' own bytes out of the flight log, for post-processing software.

One file a receiver in its native format, exactly as the bytes came, and the event files: one row an
exposure, one row a frame. Nothing is decoded here.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from daemon.mission.exposure import to_json
from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.store.durable import new_file
from daemon.orientation.exterior_orientation import sealed_exposures

NATIVE_SUFFIXES = {
    "ublox": "ubx",
    "novatel": "gps",
    "septentrio": "sbf",
    "sbg": "sbg",
    "vectornav": "vnb",
    "xsens": "mtb",
    "applanix": "pos",
    "gsof": "gsof",
    "nmea": "nmea",
    "mavlink": "raw",
}
"""File name that post-processing software expects for a receiver's recording, by driver."""

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
FRAME_COLUMNS = (
    "exposure",
    "sensor",
    "gps_week",
    "seconds_of_week",
    "sigma_ns",
    "source",
)
_WEEK_NS = 604_800_000_000_000


@dataclass(frozen=True)
class RawExport:
    """Written bytes by file name, and the number of exposures in the event file.

    Exposures whose record cannot be read are in `failures`, and in no file.
    """

    folder: Path
    nbytes: dict[str, int]
    events: int
    failures: tuple[ExposureFailure, ...] = ()


def export_raw(mission: Mission) -> RawExport:
    """Write `<receiver>.<ending>`, `events.csv` and `frames.csv` into `export/raw`.

    They take the place of earlier ones.
    Bytes of several service runs of one flight follow each other in the order they were received.

    Raises:
        OSError: the disk refused.
    """
    folder = mission.export_dir / "raw"
    folder.mkdir(parents=True, exist_ok=True)
    suffixes = _receivers(mission)
    nbytes = dict.fromkeys((f"{name}.{suffix}" for name, suffix in suffixes.items()), 0)
    with ExitStack() as stack:
        files: dict[str, BinaryIO] = {
            name: stack.enter_context(_new_binary(folder / f"{name}.{suffix}"))
            for name, suffix in suffixes.items()
        }
        for path in logs_of(mission.log_dir):
            for message in read(path):
                kind, _, device = message.topic.partition("/")
                if kind == "raw" and device in files:
                    files[device].write(message.payload)
                    nbytes[f"{device}.{suffixes[device]}"] += len(message.payload)
    sealed = sealed_exposures(mission)
    records = [to_json(exposure) for exposure in sealed.results.values()]
    rows = [row for record in records for row in _event(record)]
    _write(folder / "events.csv", EVENT_COLUMNS, rows)
    _write(folder / "frames.csv", FRAME_COLUMNS, [f for record in records for f in _frames(record)])
    return RawExport(folder, nbytes, len(rows), sealed.failures)


@contextmanager
def _new_binary(path: Path) -> Iterator[BinaryIO]:
    with new_file(path) as part, part.open("wb") as file:
        yield file


def _write(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with new_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def _receivers(mission: Mission) -> dict[str, str]:
    """Ending by name of every navigator the flight was configured with."""
    flown = mission.flown_configuration()
    return {
        section["name"]: NATIVE_SUFFIXES.get(section["driver"], "bin")
        for section in flown.get("navigator", [])
    }


def _event(record: Mapping[str, Any]) -> Iterator[tuple[Any, ...]]:
    """The instant of the strobe, where it is known."""
    if record.get("mark_gps_ns") is None:
        return
    place = record.get("navigation") or {}
    yield (
        record["number"],
        *_week_and_seconds(record["mark_gps_ns"]),
        record.get("mark_sigma_ns"),
        record.get("mark_source"),
        record.get("mark_count"),
        place.get("latitude_deg"),
        place.get("longitude_deg"),
        place.get("height_m"),
    )


def _frames(record: Mapping[str, Any]) -> Iterator[tuple[Any, ...]]:
    """The mid-exposure of every frame whose time is known."""
    for frame in record.get("frames", []):
        if frame.get("mid_exposure_gps_ns") is not None:
            yield (
                record["number"],
                frame["sensor"],
                *_week_and_seconds(frame["mid_exposure_gps_ns"]),
                frame.get("time_sigma_ns"),
                frame.get("time_source"),
            )


def _week_and_seconds(gps_ns: str) -> tuple[int, str]:
    week, of_week_ns = divmod(int(gps_ns), _WEEK_NS)
    seconds, nanoseconds = divmod(of_week_ns, 1_000_000_000)
    return week, f"{seconds}.{nanoseconds:09d}"
