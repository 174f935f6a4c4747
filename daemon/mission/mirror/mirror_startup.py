"""Before a flight on two disks: which of them are there, and whose copy of the mission leads.

What of an interrupted flight reached one disk only is brought together here; a disk that is behind
by more than that is brought up to date while flying (`daemon.mission.mirror.disk_rejoin`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from daemon import DaemonError
from daemon.configuration.model import Configuration
from daemon.mission.canonical_json import RecordError
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.log.log_seals import read_seals
from daemon.mission.mirror.generations import (
    is_up_to_date_with,
    next_generation,
    read_generations,
    write_generations,
)
from daemon.mission.mirror.resync import MirrorError, Resync, refuse_split
from daemon.mission.store import durable
from daemon.mission.store.disk_identity import Disk, give_disk_id, prove_writable, read_disk_id
from daemon.mission.store.level0_folder import CAPTURE_FILE

PROBE_TIMEOUT_S = 5.0
COPY_TAIL_TIMEOUT_S = 60.0
T = TypeVar("T")


@dataclass(frozen=True)
class FoundDisks:
    """The disks of a mirrored mission, and the mission that is being flown on them.

    `disks` are in their order, the leading one first; `absent` are the labels of those that cannot
    be used. `mission` is None where none is being flown. `findings` are sentences about
    disks that cannot be used, `done` about what was brought together.
    """

    disks: tuple[Disk, ...]
    mission: Mission | None = None
    absent: frozenset[str] = frozenset()
    findings: tuple[str, ...] = ()
    done: tuple[str, ...] = ()

    def holding(self, number: int) -> tuple[str, ...]:
        """Ids of the disks that hold an exposure as the leading one does."""
        assert self.mission is not None
        ours = _capture_of(self.disks[0], self.mission, number)
        return tuple(
            disk.id
            for disk in self.disks
            if disk.id and ours is not None and _capture_of(disk, self.mission, number) == ours
        )


def find_disks(roots: Mapping[str, Path], *, timeout_s: float = PROBE_TIMEOUT_S) -> FoundDisks:
    """Look at the disks, and for a mission that is being flown on any of them.

    Args:
        roots: folders of missions, by what the configuration calls them, the preferred one first.
        timeout_s: how long a disk may take to answer.

    Raises:
        OSError, MissionError: no disk can be used.
    """
    disks: dict[str, Disk] = {}
    flying: dict[str, Mission] = {}
    findings: list[str] = []
    refusals: list[OSError | DaemonError] = []
    preferred = next(iter(roots))
    for label, root in roots.items():
        try:
            probes = partial(_probe_disk, root, may_create=label == preferred)
            identity, current = _within(timeout_s, probes)
        except (OSError, DaemonError) as error:
            refusals.append(error)
            findings.append(f"disk {label} ({root}) cannot be used: {error}")
            continue
        disks[label] = Disk(label, root, identity)
        if current is not None:
            flying[label] = current
    if not disks:
        raise refusals[0]
    absent_disks = tuple(
        Disk(label, root, "") for label, root in roots.items() if label not in disks
    )
    absent = frozenset(disk.label for disk in absent_disks)
    for candidate in dict.fromkeys(mission.id for mission in flying.values()):
        copies = {
            label: Mission(disk.root / candidate, candidate)
            for label, disk in disks.items()
            if (disk.root / candidate / "L0").is_dir()
        }
        leading, finding = _leading(copies)
        if flying.get(leading) != copies[leading]:
            continue  # it was closed while the other disk was away
        if finding:
            findings.append(finding)
        order = (disks[leading], *(disk for label, disk in disks.items() if label != leading))
        mission = Mission.open(copies[leading].path)
        return FoundDisks((*order, *absent_disks), mission, absent, tuple(findings))
    return FoundDisks((*disks.values(), *absent_disks), None, absent, tuple(findings))


def resume_mirrored(found: FoundDisks) -> FoundDisks:
    """Bring together what an interrupted flight wrote to one disk only; before recovery.

    Args:
        found: disks on which a mission is being flown.

    Raises:
        OSError: the leading disk refused.
    """
    assert found.mission is not None
    findings, done = list(found.findings), []
    for disk in found.disks[1:]:
        other = Mission(disk.root / found.mission.id, found.mission.id)
        if disk.label not in found.absent and other.level0_root.is_dir():
            done += _copy_missing_tail(found.mission, other, findings)
    disks = (_named(found.disks[0]), *found.disks[1:])
    return replace(found, disks=disks, findings=tuple(findings), done=tuple(done))


def begin_mirrored(found: FoundDisks, create: Callable[[Path], Mission]) -> FoundDisks:
    """Begin a new mission on the first disk; the others join when they have it.

    Args:
        found: disks on which none is being flown.
        create: makes a new mission below a root.

    Raises:
        OSError, MissionError: the disk refused.
    """
    # A folder without an id is taken for a disk here and nowhere else: an empty mount point that
    # is found while flying is none.
    disks = tuple(disk if disk.label in found.absent else _named(disk) for disk in found.disks)
    mission = create(disks[0].root)
    write_generations(mission.path, next_generation((), [disks[0].id], 1))
    return replace(found, disks=disks, mission=mission)


def _probe_disk(root: Path, *, may_create: bool) -> tuple[str, Mission | None]:
    """The disk's id, and the mission that is being flown on it."""
    if not may_create and not root.is_dir():
        raise MirrorError("there is no such folder; mount the disk or create the folder")
    if may_create:
        durable.make_directories(root)
    prove_writable(root)
    return read_disk_id(root) or "", Mission.current(root)


def _named(disk: Disk) -> Disk:
    return replace(disk, id=give_disk_id(disk.root))


def _leading(copies: Mapping[str, Mission]) -> tuple[str, str]:
    """The label of the copy that leads, and the message where neither does."""
    labels = list(copies)
    first = labels[0]
    for label in labels[1:]:
        one, other = copies[first], copies[label]
        try:
            ours, theirs = read_generations(one.path), read_generations(other.path)
            if is_up_to_date_with(theirs, ours) and not is_up_to_date_with(ours, theirs):
                first = label
            else:
                refuse_split(one, other)
        except (MirrorError, RecordError) as error:
            return first, f"{error}; the flight goes on with {one.path} alone"
    return first, ""


def _capture_of(disk: Disk, mission: Mission, number: int) -> bytes | None:
    try:
        folder = Mission(disk.root / mission.id, mission.id).level0(number)
        return (folder / CAPTURE_FILE).read_bytes()
    except OSError:
        return None


def _copy_missing_tail(leading: Mission, other: Mission, findings: list[str]) -> list[str]:
    """Take over what only the other copy of the same generation has; returns messages."""
    try:
        ours, theirs = read_generations(leading.path), read_generations(other.path)
        if not ours or not theirs or ours[-1].token != theirs[-1].token:
            return []
        refuse_split(leading, other)
    except (OSError, DaemonError):
        return []  # it is reported, or is brought up to date as a whole
    try:
        return _within(COPY_TAIL_TIMEOUT_S, lambda: copy_missing_tail(leading, other))
    except (OSError, DaemonError) as error:
        findings.append(f"{other.path}: what only it has could not be read: {error}")
        return []


def copy_missing_tail(leading: Mission, other: Mission) -> list[str]:
    """Copy exposures, records and ends of logs that only the other copy has.

    Both are of the same generation: a flight that was interrupted may have written more to one.

    Returns:
        A sentence for each thing that was copied.

    Raises:
        OSError, DaemonError: a disk refused.
    """
    pulling = Resync(other, leading, 1, lambda: None)
    done = [
        f"exposure {number}: taken over from {other.path}"
        for number in other.numbers()
        if pulling.is_ahead(number) and pulling.copy_exposure(number)
    ]
    sealed = read_seals(leading)
    for log in logs_of(other.log_dir):
        here = leading.log_dir / log.name
        if log.name not in sealed and _readable_nbytes(here) < _readable_nbytes(log):
            pulling.copy_log(log)
            done.append(f"log/{log.name}: taken over from {other.path}, where more of it is left")
    return done


def _readable_nbytes(log: Path) -> int:
    if not log.exists():
        return -1
    reader = read(log)
    for _ in reader:
        pass
    return log.stat().st_size - reader.cut_nbytes


def _within(timeout_s: float, work: Callable[[], T]) -> T:
    """Do something that may hang in the kernel.

    Raises:
        MirrorError: it did not end in time.
    """
    results: list[T] = []
    errors: list[Exception] = []

    def run() -> None:
        try:
            results.append(work())
        except Exception as error:  # noqa: BLE001 - raised again below
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(timeout_s)
    if errors:
        raise errors[0]
    if not results:
        raise MirrorError(f"it did not answer within {timeout_s:g} s")
    return results[0]


def disks_of(configuration: Configuration) -> FoundDisks | None:
    """The disks of a mirrored configuration, and the mission being flown on them; else None.

    Raises:
        OSError, MissionError: no disk can be used.
    """
    mission = configuration.mission
    if mission.mirror is None:
        return None
    return find_disks({"root": mission.root, "mirror": mission.mirror})


def interrupted_mission(configuration: Configuration) -> Mission | None:
    """The mission that was being flown when the service ended; None after an orderly end.

    Raises:
        MissionError: the marker of the mission being flown is damaged.
        OSError: no disk of a mirrored configuration can be used.
    """
    found = disks_of(configuration)
    if found is not None:
        return found.mission
    root = configuration.mission.root
    return Mission.current(root) if root.is_dir() else None
