"""What a flight needs before it may begin, and what is missing of it, each with its cure.

Pure: what is there is handed in. Who flies all the same is answered by
`daemon.onboard.service.commanding` and recorded (`override_message`, `override_note`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daemon.configuration.model import LimitsSection
from daemon.mission.log.log_records import Message, loose_bytes
from daemon.mission.records import RecordError, canonical_bytes, parse_record

TOPIC = "arming"
_LOOK_AT_IT = "check its power and cable"
FILE = "overrides.json"
"""In the mission: who flew although something was missing, when, and what."""


@dataclass(frozen=True)
class Readiness:
    """What is there.

    `absent` are devices in words; `exposures_wanted` what the plan still asks for, 1 without one.
    `position_age_s` is None before the first position. `probes_c` holds a reading and its age in
    seconds for each probe of the rig, None for one never read. `serials_untold` are heads that do
    not say which they are, though the calibration knows; `serials_differing` are sentences about
    parts that are stated to be others than the calibrated ones.
    """

    has_kernels: bool
    absent: Sequence[str]
    exposures_left: int
    exposures_wanted: int
    wants_time: bool
    has_time: bool
    position_age_s: float | None
    has_fix: bool
    probes_c: Mapping[str, tuple[float | None, float] | None] = field(default_factory=dict)
    serials_untold: Sequence[str] = ()
    serials_differing: Sequence[str] = ()


@dataclass(frozen=True)
class Lack:
    """Something a flight needs and does not have; `name` is its row in the event table."""

    name: str
    sentence: str
    cure: str
    may_be_overridden: bool = True

    def __str__(self) -> str:
        return f"{self.sentence} ({self.cure})"


def lacks(there: Readiness, limits: LimitsSection) -> tuple[Lack, ...]:
    """What is missing of what a flight needs; nothing is, where the service may be armed."""
    found = [
        *_kernels(there),
        *(Lack("arming-device", f"no {device}", _LOOK_AT_IT) for device in there.absent),
        *_disk(there),
        *_time(there, limits),
        *_temperatures(there, limits),
    ]
    if there.serials_untold:
        heads = ", ".join(there.serials_untold)
        cure = "compare their labels with the calibration"
        found.append(Lack("arming-serial", f"no serial number told by {heads}", cure))
    cure = "fit that part, or fly with a calibration of this one"
    found += [Lack("arming-serial", told, cure) for told in there.serials_differing]
    return tuple(found)


def override_message(by: str, missing: Sequence[Lack], reason: str = "") -> Message:
    """The override for the flight log."""
    return Message(TOPIC, time.monotonic_ns(), loose_bytes(_override(by, missing, reason)))


def override_note(mission: Path, by: str, missing: Sequence[Lack], *, reason: str = "") -> bytes:
    """The content of `FILE` with an override added to those that are there."""
    noted = [*overrides_of(mission), _override(by, missing, reason)]
    return canonical_bytes({"overrides": noted})


def overrides_of(mission: Path) -> list[dict[str, Any]]:
    """Who flew although something was missing; none where nobody did or the file is damaged."""
    try:
        listed = parse_record((mission / FILE).read_bytes(), FILE).get("overrides")
    except (OSError, RecordError):
        return []
    return [dict(one) for one in listed if isinstance(one, Mapping)] if listed else []


def _override(by: str, missing: Sequence[Lack], reason: str) -> dict[str, Any]:
    return {
        "by": by,
        **({"reason": reason} if reason else {}),
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "missing": [str(lack) for lack in missing],
    }


def _kernels(there: Readiness) -> list[Lack]:
    if there.has_kernels:
        return []
    # Nothing compiles in flight: nobody can take that upon them.
    cure = "wait; where this takes minutes, run syntopic kernels on the ground"
    return [Lack("arming-kernels", "kernels are not loaded", cure, may_be_overridden=False)]


def _disk(there: Readiness) -> list[Lack]:
    if there.exposures_left >= max(1, there.exposures_wanted):
        return []
    sentence = f"room for {there.exposures_left} of {there.exposures_wanted} exposures on the disk"
    return [Lack("arming-disk", sentence, "free the disk or change it")]


def _time(there: Readiness, limits: LimitsSection) -> list[Lack]:
    if not there.wants_time:
        return []
    found = []
    if not there.has_time:
        cure = "wait for the receiver's fix; check its antenna"
        found.append(Lack("arming-time", "GPS time is not known", cure))
    age_s = there.position_age_s
    if age_s is None or not there.has_fix:
        cure = "wait for the receiver's fix; check its antenna"
        found.append(Lack("arming-navigation", "no position", cure))
    elif age_s > limits.navigation_stale_s:
        sentence = f"the position is {age_s:.0f} s old"
        found.append(Lack("arming-navigation", sentence, "check the receiver and its line"))
    return found


def _temperatures(there: Readiness, limits: LimitsSection) -> list[Lack]:
    missing, stale = [], []
    for probe, reading in there.probes_c.items():
        if reading is None or reading[0] is None:
            missing.append(probe)
        elif reading[1] > limits.temperature_stale_s:
            stale.append(probe)
    found = []
    cure = "check the probes and their module"
    if missing:
        sentence = f"no temperature of probe {', '.join(missing)}"
        found.append(Lack("arming-temperature", sentence, cure))
    if stale:
        sentence = (
            f"temperature of probe {', '.join(stale)} older than {limits.temperature_stale_s:g} s"
        )
        found.append(Lack("arming-temperature", sentence, cure))
    return found
