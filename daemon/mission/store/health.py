"""The health of disks as they state it themselves: SMART, temperature and wear.

Only root may ask a disk. `syntopic disk-health` does so (systemd/syntopic-disk-health.service) and
leaves its findings in a file that the service reads.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daemon import DaemonError
from daemon.mission.canonical_json import RecordError, parse_record
from daemon.mission.store import durable

REPORT = Path("/run/syntopic-health/disks.json")
"""File with the results of the helper."""

STALE_S = 600.0
"""The timer runs every two minutes; after five missed runs the report is old."""

TEMPERATURE_MAX_C = 70.0
"""NVMe drives begin to throttle at 70 to 85 degC, SATA drives are specified up to 70."""

WEAR_MAX_PERCENT = 90.0
SMARTCTL_TIMEOUT_S = 20.0
_REALLOCATED, _PENDING, _UNCORRECTABLE = 5, 197, 198
"""Attributes of ATA drives, by their usual ids."""

Run = Callable[[Sequence[str]], str]


class HealthError(DaemonError):
    """The health of the disks cannot be read; the message states what to do."""


@dataclass(frozen=True)
class DiskHealth:
    """SMART values of a disk; None where it reports none.

    `problems` are sentences about what is bad; empty for a healthy disk.
    """

    model: str = ""
    serial: str = ""
    temperature_c: float | None = None
    wear_percent: float | None = None
    problems: tuple[str, ...] = ()


def run_smartctl(arguments: Sequence[str]) -> str:
    """Run smartctl and return what it printed; its exit status is a set of bits, not a verdict.

    Raises:
        HealthError: it is not installed, or does not answer.
    """
    try:
        done = subprocess.run(
            ["smartctl", *arguments],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=SMARTCTL_TIMEOUT_S,
            check=False,
        )
    except FileNotFoundError as error:
        raise HealthError("smartctl is missing; run: apt-get install smartmontools") from error
    except subprocess.TimeoutExpired as error:
        raise HealthError(f"smartctl {' '.join(arguments)}: no answer") from error
    return done.stdout


def collect(run: Run = run_smartctl) -> dict[str, Any]:
    """Ask every disk that smartctl finds; plain JSON types.

    Raises:
        HealthError: smartctl is missing or lists nothing that can be read.
    """
    listed = _parsed(run(["--scan", "--json"])).get("devices")
    if not isinstance(listed, list):
        raise HealthError("smartctl --scan printed no list of devices; look at its version")
    disks = {}
    for device in listed:
        name = device.get("name") if isinstance(device, Mapping) else None
        if isinstance(name, str):
            try:
                disks[Path(name).name] = _parsed(run(["--all", "--json", name]))
            except HealthError as error:
                disks[Path(name).name] = {"error": str(error)}
    return {"monotonic_s": time.monotonic(), "disks": disks}


def is_report(head: bytes) -> bool:
    """Whether a file that begins so was written by `write_report`."""
    return head.startswith(b'{"monotonic_s": ')


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """Leave a report for the service, whole or not at all.

    Raises:
        OSError: the folder is missing or refuses.
    """
    durable.replace_file(path, json.dumps(report).encode())


def health_of(smart_data: Mapping[str, Any]) -> DiskHealth:
    """The health of one disk, from what `smartctl --all --json` printed of it.

    Source: smartctl(8) 7.2 and later, option `-j`; NVM Express Base Specification, SMART / Health
    Information log page.
    """
    if isinstance(error := smart_data.get("error"), str):
        return DiskHealth(problems=(error,))
    nvme = _object(smart_data.get("nvme_smart_health_information_log"))
    status = _object(smart_data.get("smart_status")).get("passed")
    temperature_c = _number(_object(smart_data.get("temperature")).get("current"))
    wear = _number(nvme.get("percentage_used"))
    if wear is None:
        wear = _number(_object(smart_data.get("endurance_used")).get("current_percent"))
    problems = list(_problems(smart_data, nvme, status))
    if temperature_c is not None and temperature_c > TEMPERATURE_MAX_C:
        problems.append(f"it is {temperature_c:g} degC hot; cool it, {TEMPERATURE_MAX_C:g} is much")
    if wear is not None and wear >= WEAR_MAX_PERCENT:
        problems.append(f"{wear:g} % of its endurance is used; change it")
    return DiskHealth(
        str(smart_data.get("model_name", "")),
        str(smart_data.get("serial_number", "")),
        temperature_c,
        wear,
        tuple(problems),
    )


def _problems(
    smart_data: Mapping[str, Any], nvme: Mapping[str, Any], status: object
) -> Iterator[str]:
    if status is False:
        yield "it states that it fails (SMART); copy what is on it and change it"
    if status is None and not nvme:
        yield "it states nothing of its health (SMART); enable SMART, or look at its controller"
    if _number(nvme.get("critical_warning")):
        yield f"it warns (NVMe critical warning {int(nvme['critical_warning']):#04x}); change it"
    spare, minimum = _number(nvme.get("available_spare")), nvme.get("available_spare_threshold")
    if spare is not None and spare < (_number(minimum) or 0.0):
        yield f"{spare:g} % of its spare blocks are left; change it"
    if errors := _number(nvme.get("media_errors")):
        yield f"it has lost data {errors:g} times (media errors); change it"
    table = _object(smart_data.get("ata_smart_attributes")).get("table")
    for one in table if isinstance(table, list) else []:
        attribute = _object(one)
        raw = _number(_object(attribute.get("raw")).get("value"))
        if attribute.get("id") in (_PENDING, _UNCORRECTABLE) and raw:
            yield f"{raw:g} of its sectors cannot be read ({attribute.get('name')}); change it"
        if attribute.get("id") == _REALLOCATED and attribute.get("when_failed"):
            yield f"its spare sectors are used up ({attribute.get('name')}); change it"


def read_health(root: Path, report: Path = REPORT) -> DiskHealth | None:
    """The health of the disk under a folder; None where it is not read.

    Several physical disks under one folder (RAID, LVM) count as one: the worst of each.
    """
    try:
        content = parse_record(report.read_bytes(), report.name)
    except FileNotFoundError:
        return None
    except (OSError, RecordError) as error:
        return DiskHealth(problems=(f"its health cannot be read ({error}); look at {report}",))
    written_s, disks = _number(content.get("monotonic_s")), _object(content.get("disks"))
    if isinstance(failure := content.get("failure"), str):
        return DiskHealth(problems=(f"its health is not known: {failure}",))
    age_s = None if written_s is None else time.monotonic() - written_s
    if age_s is None or not 0 <= age_s <= STALE_S:
        unit = "syntopic-disk-health.timer"
        return DiskHealth(problems=(f"its health was not read lately; look at {unit}",))
    names = physical_disks(root)
    found = [health_of(_object(disks[known])) for known in _matching(names, disks)]
    if not found:
        return DiskHealth(problems=("smartctl finds no disk under it; look at its controller",))
    return DiskHealth(
        ", ".join(one.model for one in found),
        ", ".join(one.serial for one in found),
        max((c for one in found if (c := one.temperature_c) is not None), default=None),
        max((w for one in found if (w := one.wear_percent) is not None), default=None),
        tuple(problem for one in found for problem in one.problems),
    )


def physical_disks(root: Path, sys: Path = Path("/sys/dev/block")) -> list[str]:
    """Kernel names of the disks under a folder, below partitions, LVM, RAID and encryption."""
    while not root.exists():
        root = root.parent
    device = root.stat().st_dev
    try:
        start = (sys / f"{os.major(device)}:{os.minor(device)}").resolve(strict=True)
    except OSError:
        return []
    waiting, found = [start], []
    while waiting:
        block = waiting.pop()
        if (block / "partition").exists():
            waiting.append(block.parent)
        elif slaves := list((block / "slaves").glob("*")):
            waiting += [slave.resolve() for slave in slaves]
        else:
            found.append(block.name)
    return sorted(set(found))


def _matching(names: Sequence[str], known: Mapping[str, Any]) -> list[str]:
    """smartctl names an NVMe drive by its controller: nvme0 for nvme0n1."""
    return [one for one in known if any(n == one or n.startswith(f"{one}n") for n in names)]


def failed_report(error: Exception) -> dict[str, Any]:
    """Result of the helper when the query failed."""
    return {"monotonic_s": time.monotonic(), "failure": str(error), "disks": {}}


def _parsed(text: str) -> Mapping[str, Any]:
    try:
        content = json.loads(text)
    except ValueError as error:
        raise HealthError("smartctl printed no JSON; version 7.0 or later is needed") from error
    if not isinstance(content, Mapping):
        raise HealthError("smartctl printed no JSON object")
    return content


def _object(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
