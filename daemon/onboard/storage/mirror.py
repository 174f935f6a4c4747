"""The disks of a mirrored mission in the service: which are in use, and which is the leading one.

The writer process writes to the disks and drops them (`daemon.mission.mirror.mirrored`). With one
disk nothing here is active.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from daemon.configuration.model import Configuration
from daemon.mission.exposure import CaptureRecord, Exposure
from daemon.mission.layout import Mission
from daemon.mission.log.log_records import LoggedRecord
from daemon.mission.mirror.mirror_startup import FoundDisks
from daemon.mission.store import durable
from daemon.mission.store.disk_identity import Disk, same_file_system
from daemon.mission.store.disk_space import needed_nbytes
from daemon.mission.store.health import DiskHealth, read_health
from daemon.mission.verification.recovery import Complete
from daemon.onboard.preflight.prerequisites import exposure_nbytes
from daemon.onboard.service.message_dispatcher import Handlers
from daemon.onboard.service.messages import (
    AcceptDisk,
    DiskChanged,
    DiskStatus,
    DropDisk,
    EmitEvent,
    EndMission,
    ReleaseDisk,
    WriteSmallFile,
)
from daemon.onboard.storage.writer import MirrorPlan
from processing.quality.report import Flag
from processing.rig import Rig

HEALTH_EVERY_S = 10.0
SPARE_EXPOSURES = 10
"""Space that a returning disk must have, in exposures."""


class Mirror:
    """Follows the disks of a mission.

    Args:
        found: the disks, None where the mission has one.
        mission: the mission on the leading disk.
        configuration: limits for a full and for a stalled disk.
        rig: the camera; its frames fill the disks.
        send: sends a message to a process, by its name.
        emit: emits an event for every change of a disk.
        on_leading_changed: called with the mission when another disk becomes the leading one.
    """

    def __init__(
        self,
        found: FoundDisks | None,
        mission: Mission,
        configuration: Configuration,
        rig: Rig,
        send: Callable[[str, object], None],
        emit: EmitEvent,
        on_leading_changed: Callable[[Mission], None],
    ) -> None:
        self._found = found
        self._disks = () if found is None else found.disks
        self._limits = configuration.limits
        self._needed_nbytes = needed_nbytes(exposure_nbytes(configuration, rig))
        self._send = send
        self._emit = emit
        self._on_leading_changed = on_leading_changed
        self._mission = mission
        self._in_use: tuple[Disk, ...] = self._disks[:1]
        self._status: Sequence[Mapping[str, Any]] = ()
        self._full: set[str] = set()
        self._has_landed = False
        self._health: dict[str, DiskHealth] = {}
        self._next_health_check_s = 0.0

    @property
    def is_on(self) -> bool:
        """Whether the mission is mirrored."""
        return bool(self._disks)

    @property
    def plan(self) -> MirrorPlan | None:
        """What the writer needs to know; None where the mission has one disk."""
        if not self._disks:
            return None
        required_nbytes = self._limits.disk_reserve_bytes + SPARE_EXPOSURES * self._needed_nbytes
        return MirrorPlan(self._disks, self._limits.mirror_timeout_s, required_nbytes)

    @property
    def status(self) -> Sequence[Mapping[str, Any]]:
        """The disks as the page shows them, plain JSON types; none where there is one disk."""
        # A dropped disk is not queried: it may hang.
        left = {disk.label: self._left(_free_nbytes(disk.root)) for disk in self._in_use}
        listed = self._status
        if not self._disks and "root" in self._health:
            listed = [{"disk": "root", "path": str(self._mission.root), "state": "in use"}]
        return [
            {
                **one,
                **({"exposures_left": left[one["disk"]]} if one["disk"] in left else {}),
                **_health_json(self._health.get(one["disk"])),
            }
            for one in listed
        ]

    def free_bytes(self, path: Path) -> int:
        """What may still be put on every disk in use, for `daemon.mission.store.disk_space`."""
        if not self._disks:
            return durable.free_bytes(path)
        free = [_free_nbytes(disk.root) for disk in self._in_use]
        return min((nbytes for nbytes in free if nbytes is not None), default=0)

    def check(self) -> None:
        """See whether a disk is full, and how the disks are."""
        self._check_health()
        self._drop_full()

    def _check_health(self) -> None:
        """Emit an event when a disk in use reports problems, or is healthy again."""
        if time.monotonic() < self._next_health_check_s:
            return
        self._next_health_check_s = time.monotonic() + HEALTH_EVERY_S
        roots = {disk.label: disk.root for disk in self._in_use} or {"root": self._mission.root}
        for label, root in roots.items():
            try:
                found = read_health(root)
            except OSError:
                continue  # the disk itself is gone, which is reported elsewhere
            before = self._health.pop(label, DiskHealth())
            if found is not None:
                self._health[label] = found
            problems = () if found is None else found.problems
            if problems and problems != before.problems:
                problem_text = "; ".join(problems)
                sentence = f"disk {label} ({root}): {problem_text}"
                self._emit("disk-health", fault=True, disk=label, sentence=sentence)
            elif before.problems and not problems:
                sentence = f"disk {label} ({root}) is healthy again"
                self._emit("disk-health", fault=False, disk=label, sentence=sentence)

    def _drop_full(self) -> None:
        """Drop a disk without space for the next exposure if another has space."""
        left = {disk.label: self._left(_free_nbytes(disk.root)) for disk in self._in_use}
        full = {label for label, count in left.items() if count == 0}
        if full and any(left.values()):
            for label in full - self._full:
                self._send("writer", DropDisk(label, "it has no space for another exposure"))
        self._full = full

    @property
    def done(self) -> Sequence[str]:
        """What was brought together before recovery, in sentences."""
        return () if self._found is None else self._found.done

    def emit_disk_problems(self) -> None:
        """Emit an event for each disk that is unusable or gives no redundancy."""
        findings = [] if self._found is None else list(self._found.findings)
        for disk in self._disks[1:]:
            if same_file_system(disk.root, self._disks[0].root):
                findings.append(
                    f"disk {disk} is on the same file system as {self._disks[0]}: one fault "
                    "affects both; mount another disk there"
                )
        for finding in findings:
            self._emit("mirror", fault=True, sentence=finding)

    def naming_disks(self, complete: Complete) -> Complete:
        """Add the disks that hold the frames to the records that recovery seals."""
        found = self._found
        if found is None:
            return complete

        def named(capture: CaptureRecord, records: Sequence[LoggedRecord]) -> Exposure:
            exposure = complete(capture, records)
            disks = found.holding(capture.number) if exposure.frames else ()
            flag = Flag.NOT_MIRRORED if len(disks) == 1 else Flag(0)
            return replace(exposure, disks=disks, flags=exposure.flags | int(flag))

        return named

    async def save(self, name: str, data: bytes) -> None:
        """As `save_now`, without blocking the event loop."""
        if self._is_with_writer:
            self.save_now(name, data)
        else:
            await asyncio.to_thread(self.save_now, name, data)

    def save_now(self, name: str, data: bytes) -> None:
        """Save a small file below the root of every disk in use.

        Raises:
            OSError: the only disk refused.
        """
        if self._is_with_writer:
            self._send("writer", WriteSmallFile(name, data))
            return
        for root in [disk.root for disk in self._in_use] or [self._mission.root]:
            durable.replace_file(root / name, data)

    @property
    def _is_with_writer(self) -> bool:
        return bool(self._disks) and not self._has_landed

    def land(self, *, ends_mission: bool) -> None:
        """The writer is about to end; with `ends_mission` the mission is not resumed."""
        self._has_landed = True
        if self._disks and ends_mission:
            self._send("writer", EndMission())

    def release(self, label: str) -> str | None:
        """Release a disk, so that it can be unmounted; return the reason if that is refused."""
        refusal = self._refusal(label)
        if refusal is None and label not in [disk.label for disk in self._in_use]:
            refusal = f"disk {label} is not in use; it may be unmounted"
        if refusal is None and len(self._in_use) == 1:
            refusal = f"disk {label} is the only one in use; it cannot be released"
        if refusal is None:
            self._send("writer", ReleaseDisk(label))
        return refusal

    def accept(self, label: str) -> str | None:
        """Synchronize and use the disk mounted there; return the reason if that is refused."""
        refusal = self._refusal(label)
        if refusal is None and label in [disk.label for disk in self._in_use]:
            refusal = f"disk {label} is in use; release it first"
        if refusal is None:
            self._send("writer", AcceptDisk(label))
        return refusal

    def _refusal(self, label: str) -> str | None:
        if not self._disks:
            return "the mission has one disk; mission.mirror gives it a second one"
        labels = [disk.label for disk in self._disks]
        return None if label in labels else f"there is no disk {label!r}: {', '.join(labels)}"

    def _left(self, free_nbytes: int | None) -> int:
        """Exposures that fit above the reserve; 1 for a disk that cannot be queried."""
        if free_nbytes is None:
            return 1
        return max(0, (free_nbytes - self._limits.disk_reserve_bytes) // self._needed_nbytes)

    def _on_changed(self, changed: DiskChanged) -> None:
        self._in_use = changed.in_use
        self._emit(
            changed.name,
            fault=changed.name == "disk-dropped",
            disk=changed.disk.label,
            id=changed.disk.id,
            dropped=changed.dropped_count,
            in_use=[disk.label for disk in changed.in_use],
            sentence=changed.sentence,
        )
        leading = Mission(changed.in_use[0].root / self._mission.id, self._mission.id)
        if leading != self._mission:
            self._mission = leading
            self._on_leading_changed(leading)

    def _on_status(self, status: DiskStatus) -> None:
        self._status = status.disks

    @property
    def handlers(self) -> Handlers:
        """The messages about disks."""
        return {DiskChanged: self._on_changed, DiskStatus: self._on_status}


def _free_nbytes(root: Path) -> int | None:
    try:
        return durable.free_bytes(root)
    except OSError:
        return None


def _health_json(health: DiskHealth | None) -> dict[str, Any]:
    if health is None:
        return {}
    return {
        "temperature_c": health.temperature_c,
        "wear_percent": health.wear_percent,
        "healthy": not health.problems,
        "problems": list(health.problems),
    }
