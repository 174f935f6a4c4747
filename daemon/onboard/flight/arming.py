"""Prerequisites of arming: which ones are missing, and what to do about each.

Pure functions of `Readiness`. `daemon.onboard.service.command_execution` accepts overrides; they
are recorded by `override_message` and `overrides_content`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daemon.configuration.model import LimitsSection
from daemon.mission.canonical_json import RecordError, canonical_bytes, parse_record
from daemon.mission.log.log_records import Message, lenient_json_bytes

TOPIC = "arming"
_CHECK_DEVICE = "check its power and cable"
FILE = "overrides.json"
"""In the mission: the overrides, each with author, time and missing prerequisites."""


@dataclass(frozen=True)
class Readiness:
    """State of everything that arming requires.

    `absent` are the absent devices; `exposures_planned` are the planned exposures left, 1 without a
    plan. `position_age_s` is None before the first position. `probes_c` holds a reading and its age
    in seconds for each probe of the rig, None for one never read. `serials_unreported` are heads
    that report no serial number although the calibration has one; `serials_mismatched` are
    sentences about parts whose stated serial number is not the calibrated one.
    """

    has_kernels: bool
    absent: Sequence[str]
    exposures_left: int
    exposures_planned: int
    needs_time: bool
    has_time: bool
    position_age_s: float | None
    has_fix: bool
    probes_c: Mapping[str, tuple[float | None, float] | None] = field(default_factory=dict)
    serials_unreported: Sequence[str] = ()
    serials_mismatched: Sequence[str] = ()


@dataclass(frozen=True)
class MissingPrerequisite:
    """A missing prerequisite of arming; `name` is its entry in the event table."""

    name: str
    sentence: str
    action: str
    may_be_overridden: bool = True

    def __str__(self) -> str:
        return f"{self.sentence} ({self.action})"


def absent_parts(readiness: Readiness) -> list[str]:
    """Devices and data that have not come yet, as text."""
    absent = list(readiness.absent)
    if readiness.needs_time and readiness.position_age_s is None:
        absent.append("time and position")
    never_read = (probe for probe, reading in readiness.probes_c.items() if reading is None)
    return absent + [f"temperature of {probe}" for probe in never_read]


def missing_prerequisites(
    readiness: Readiness, limits: LimitsSection
) -> tuple[MissingPrerequisite, ...]:
    """The missing prerequisites; empty if the service may be armed."""
    found = [
        *_kernels(readiness),
        *(
            MissingPrerequisite("arming-device", f"no {device}", _CHECK_DEVICE)
            for device in readiness.absent
        ),
        *_disk(readiness),
        *_time(readiness, limits),
        *_temperatures(readiness, limits),
    ]
    if readiness.serials_unreported:
        heads = ", ".join(readiness.serials_unreported)
        action = "compare their labels with the calibration"
        found.append(MissingPrerequisite("arming-serial", f"no serial number from {heads}", action))
    action = "fit that part, or fly with a calibration of this one"
    found += [
        MissingPrerequisite("arming-serial", sentence, action)
        for sentence in readiness.serials_mismatched
    ]
    return tuple(found)


def override_message(by: str, missing: Sequence[MissingPrerequisite], reason: str = "") -> Message:
    """The override for the flight log."""
    return Message(TOPIC, time.monotonic_ns(), lenient_json_bytes(_override(by, missing, reason)))


def overrides_content(
    mission: Path, by: str, missing: Sequence[MissingPrerequisite], *, reason: str = ""
) -> bytes:
    """The content of `FILE` with an override added to those that are there."""
    overrides = [*overrides_of(mission), _override(by, missing, reason)]
    return canonical_bytes({"overrides": overrides})


def overrides_of(mission: Path) -> list[dict[str, Any]]:
    """The recorded overrides; empty if there are none or the file is damaged."""
    try:
        listed = parse_record((mission / FILE).read_bytes(), FILE).get("overrides")
    except (OSError, RecordError):
        return []
    return [dict(one) for one in listed if isinstance(one, Mapping)] if listed else []


def _override(by: str, missing: Sequence[MissingPrerequisite], reason: str) -> dict[str, Any]:
    return {
        "by": by,
        **({"reason": reason} if reason else {}),
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "missing": [str(item) for item in missing],
    }


def _kernels(readiness: Readiness) -> list[MissingPrerequisite]:
    if readiness.has_kernels:
        return []
    # Nothing compiles in flight, so this prerequisite cannot be overridden.
    action = "wait; where this takes minutes, run syntopic kernels on the ground"
    return [
        MissingPrerequisite(
            "arming-kernels", "kernels are not loaded", action, may_be_overridden=False
        )
    ]


def _disk(readiness: Readiness) -> list[MissingPrerequisite]:
    if readiness.exposures_left >= max(1, readiness.exposures_planned):
        return []
    left, planned = readiness.exposures_left, readiness.exposures_planned
    sentence = f"the disk has space for {left} of {planned} exposures"
    return [MissingPrerequisite("arming-disk", sentence, "free the disk or change it")]


def _time(readiness: Readiness, limits: LimitsSection) -> list[MissingPrerequisite]:
    if not readiness.needs_time:
        return []
    found = []
    if not readiness.has_time:
        action = "wait for the receiver's fix; check its antenna"
        found.append(MissingPrerequisite("arming-time", "GPS time is not known", action))
    age_s = readiness.position_age_s
    if age_s is None or not readiness.has_fix:
        action = "wait for the receiver's fix; check its antenna"
        found.append(MissingPrerequisite("arming-navigation", "no position", action))
    elif age_s > limits.navigation_stale_s:
        sentence = f"the position is {age_s:.0f} s old"
        found.append(
            MissingPrerequisite("arming-navigation", sentence, "check the receiver and its line")
        )
    return found


def _temperatures(readiness: Readiness, limits: LimitsSection) -> list[MissingPrerequisite]:
    missing, outdated = [], []
    for probe, reading in readiness.probes_c.items():
        if reading is None or reading[0] is None:
            missing.append(probe)
        elif reading[1] > limits.temperature_stale_s:
            outdated.append(probe)
    found = []
    action = "check the probes and their module"
    if missing:
        sentence = f"no temperature of probe {', '.join(missing)}"
        found.append(MissingPrerequisite("arming-temperature", sentence, action))
    if outdated:
        limit_s = limits.temperature_stale_s
        sentence = f"temperature of probe {', '.join(outdated)} older than {limit_s:g} s"
        found.append(MissingPrerequisite("arming-temperature", sentence, action))
    return found
