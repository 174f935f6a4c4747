"""Recordings of receivers with the answer of gpsd's own tests: what we read, compared with it.

The recordings are gpsd's regression tests (BSD licence). `read_by_us` is what our decoders make of
one, `read_through_gpsd` what our gpsd driver makes of the real gpsd that reads it.
"""

from __future__ import annotations

import datetime
import json
import os
import socket
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from drivers.contract import NavSample
from drivers.receivers.gpsd.reports import GpsdReports
from drivers.receivers.message_decoder import MessageDecoder
from drivers.receivers.nmea.decoder import NmeaDecoder
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.receivers.ublox.decoder import UbxDecoder
from tests.drivers.real_gpsd import running_gpsd

CORPUS: Final = Path(__file__).parents[3] / "shared" / "data" / "nav" / "gpsd-daemon"
EPOCH: Final = datetime.datetime(1980, 1, 6)
SLACK_MS: Final = 2
"""gpsd rounds its times to a millisecond."""
PLACE_DEG: Final = 2e-7
HEIGHT_M: Final = 0.02
ROLL_OVER_MS: Final = 1024 * 7 * 86_400_000
DECODERS: Final[Mapping[str, type[MessageDecoder]]] = {
    "ublox": UbxDecoder, "septentrio": SbfDecoder, "novatel": NovatelDecoder, "nmea": NmeaDecoder,
}  # fmt: skip
QUIET_S: Final = 0.4
"""So long without a report, and gpsd has read everything."""

OTHER_POSITION: Final = "other position"
NOT_MEASURED: Final = (7, 8)
"""`status` of TPV: a surveyed position, a simulated one."""
STARTUP_S: Final = 1.0
"""gpsd empties the line when it has opened it, and opens it when somebody watches."""

Report = Mapping[str, Any]


@dataclass
class Comparison:
    """`epochs` with a position are gpsd's; `differences` are counted by their kind."""

    samples: int
    epochs: int
    compared: int = 0
    differences: Counter[str] = field(default_factory=Counter)


def answer_of(recording: Path) -> dict[int, list[Report]]:
    """gpsd's reports with a position, by their UTC in ms."""
    found: dict[int, list[Report]] = defaultdict(list)
    text = recording.with_name(recording.name + ".chk").read_text("utf-8", errors="replace")
    for line in text.splitlines():
        if not line.startswith('{"class":"TPV"'):
            continue
        report = json.loads(line)
        is_measured = report.get("status") not in NOT_MEASURED
        if "time" in report and "lat" in report and report.get("mode", 0) >= 2 and is_measured:
            found[_utc_ms(report["time"])].append(report)
    return found


def read_by_us(recording: Path) -> tuple[str, list[NavSample]]:
    """The driver whose decoder understands it, binary ones first, and its samples."""
    data = recording.read_bytes()
    best = ("", 0, list[NavSample]())
    for driver, new in DECODERS.items():
        decoder = new("gnss")
        samples = [s for s in decoder.feed(data, 0) if isinstance(s, NavSample)]
        worth = (len(samples), sum(decoder.seen.values()))
        if worth > (len(best[2]), best[1]):
            best = (driver, worth[1], samples)
    return best[0], best[2]


def read_through_gpsd(recording: Path, *, patience: float = 1.0) -> list[NavSample]:
    """What our reading of reports makes of the real gpsd that receives the recording at once.

    Args:
        patience: factor of the waits, for a busy machine.
    """
    lines = recording.read_bytes().splitlines(keepends=True)
    while lines and lines[0].startswith(b"#"):
        lines.pop(0)
    data = b"".join(lines)
    reports, samples = GpsdReports("gnss"), list[NavSample]()
    with running_gpsd() as gpsd:
        host, _, port = gpsd.address.rpartition(":")
        with socket.create_connection((host, int(port)), timeout=5) as connection:
            connection.sendall(b'?WATCH={"enable":true,"json":true};\n')
            connection.settimeout(0.02)
            os.set_blocking(gpsd.receiver, False)
            began = time.monotonic()
            while not reports.devices or time.monotonic() - began < patience * STARTUP_S:
                with suppress(TimeoutError):
                    reports.feed(connection.recv(65_536), 0)
            at, quiet_since = 0, time.monotonic()
            while time.monotonic() - quiet_since < patience * QUIET_S:
                if at < len(data):
                    at += _written(gpsd.receiver, data[at : at + 2048])
                    quiet_since = time.monotonic()
                try:
                    received = connection.recv(65_536)
                except TimeoutError:
                    continue
                samples += reports.feed(received, 0)
                quiet_since = time.monotonic()
    return samples


def compare(samples: Sequence[NavSample], answer: Mapping[int, Sequence[Report]]) -> Comparison:
    """Time, mode, latitude, longitude and height of each sample with gpsd's reports of its time.

    gpsd reports a time again with every sentence: the nearest of its reports counts.
    """
    result = Comparison(len(samples), len(answer))
    for sample in samples:
        if sample.position is None:
            continue
        utc_ms = round((sample.gps_ns - (sample.leap_seconds or 0) * 10**9) / 1e6)
        reports, rolled = _of_time(answer, utc_ms)
        if not reports:
            result.differences["no report of that time"] += 1
            continue
        result.compared += 1
        result.differences["weeks rolled over"] += rolled
        kinds = [_differences(sample, report) for report in reports]
        result.differences.update(min(kinds, key=_weight))
    result.differences = +result.differences
    return result


def _of_time(answer: Mapping[int, Sequence[Report]], utc_ms: int) -> tuple[list[Report], bool]:
    for rolls in (0, -1, 1, -2, 2):
        reports = [
            report
            for away in range(-SLACK_MS, SLACK_MS + 1)
            for report in answer.get(utc_ms + rolls * ROLL_OVER_MS + away, ())
        ]
        if reports:
            return reports, rolls != 0
    return [], False


def _differences(sample: NavSample, report: Report) -> list[str]:
    found = []
    assert sample.position is not None
    latitude, longitude = sample.position
    away = max(abs(latitude - report["lat"]), abs(_signed_deg(longitude - report["lon"])))
    if away > PLACE_DEG:
        found.append(OTHER_POSITION)
    ours = 2 if sample.fix == "2d" else 3
    if ours != report["mode"]:
        found.append(f"{ours}d, gpsd {report['mode']}d")
    height = report.get("altHAE")
    if sample.height_m is None and height is not None:
        found.append("height absent, gpsd has one")
    elif sample.height_m is not None and height is None:
        found.append("height, gpsd has none")
    elif sample.height_m is not None and abs(sample.height_m - height) > HEIGHT_M:
        found.append("other height")
    return found


def _signed_deg(angle_deg: float) -> float:
    """An angle between -180 and 180 degrees."""
    return (angle_deg + 180) % 360 - 180


def _weight(differences: Sequence[str]) -> tuple[bool, int]:
    return OTHER_POSITION in differences, len(differences)


def _written(descriptor: int, data: bytes) -> int:
    try:
        return os.write(descriptor, data)
    except BlockingIOError:
        return 0


def _utc_ms(text: str) -> int:
    seconds_part = datetime.datetime.strptime(text[:19], "%Y-%m-%dT%H:%M:%S") - EPOCH
    return (seconds_part.days * 86_400 + seconds_part.seconds) * 1000 + int(text[20:23])


def recordings(names: Iterable[str] | None = None) -> list[Path]:
    """All of them, or those named."""
    found = sorted(CORPUS.glob("*.log"))
    return found if names is None else [path for path in found if path.stem in set(names)]
