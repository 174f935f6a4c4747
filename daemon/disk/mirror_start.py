"""Before a flight on two disks: which of them are there, and whose copy of the mission leads.

What of an interrupted flight reached one disk only is brought together here; a disk that is behind
by more than that is brought up to date while flying (`daemon.disk.returning`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from daemon.disk import durable
from daemon.disk.disk_identity import Disk, give_disk_id, prove_writable, read_disk_id
from daemon.disk.flight_log import logs_of, read
from daemon.disk.generations import leads, next_generation, read_generations, write_generations
from daemon.disk.level0_folder import CAPTURE_FILE
from daemon.disk.log_seals import read_seals
from daemon.disk.mission import Mission
from daemon.disk.records import RecordError
from daemon.disk.resync import MirrorError, Resync, refuse_split
from daemon.errors import DaemonError

LOOK_TIMEOUT_S = 5.0
PULL_TIMEOUT_S = 60.0
T = TypeVar("T")


@dataclass(frozen=True)
class OpenedMission:
    """A mission to be flown.

    `disks` are those of a mirrored mission, the leading one first, none where there is no mirror;
    `findings` are sentences about disks that cannot be used, or not yet.
    """

    mission: Mission
    is_resumed: bool
    disks: tuple[Disk, ...] = ()
    findings: tuple[str, ...] = ()

    def holding(self, number: int) -> tuple[str, ...]:
        """Ids of the disks that hold an exposure as the leading one does."""
        ours = self.mission.level0(number) / CAPTURE_FILE
        found = []
        for disk in self.disks:
            theirs = Mission(disk.root / self.mission.id, self.mission.id).level0(number)
            with suppress(OSError):
                if disk.id and (theirs / CAPTURE_FILE).read_bytes() == ours.read_bytes():
                    found.append(disk.id)
        return tuple(found)


def open_mirrored(
    roots: Mapping[str, Path],
    create: Callable[[Path], Mission],
    *,
    timeout_s: float = LOOK_TIMEOUT_S,
) -> OpenedMission:
    """Find the mission being flown on any of the disks, else create one.

    Args:
        roots: folders of missions, by what the configuration calls them, the preferred one first.
        create: makes a new mission below a root.
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
            looked = _within(timeout_s, lambda r=root, p=label == preferred: _look(r, p))  # type: ignore[misc]
        except (OSError, DaemonError) as error:
            refusals.append(error)
            findings.append(f"disk {label} ({root}) cannot be used: {error}")
            continue
        disks[label] = Disk(label, root, looked[0])
        if looked[1] is not None:
            flying[label] = looked[1]
    if not disks:
        raise refusals[0]
    absent = tuple(Disk(label, root, "") for label, root in roots.items() if label not in disks)
    for candidate in dict.fromkeys(mission.id for mission in flying.values()):
        copies = {
            label: Mission(disk.root / candidate, candidate)
            for label, disk in disks.items()
            if (disk.root / candidate / "L0").is_dir()
        }
        leading, finding = _leading(copies)
        if finding:
            findings.append(finding)
        if flying.get(leading) != copies[leading]:
            continue  # it was closed while the other disk was away
        if not finding:
            for label in copies:
                if label != leading:
                    findings += _pull_tail(copies[leading], copies[label])
        disks[leading] = _named(disks[leading])
        order = (disks[leading], *(disk for label, disk in disks.items() if label != leading))
        mission = Mission.open(copies[leading].path)
        return OpenedMission(mission, True, (*order, *absent), tuple(findings))
    # A folder without an id is taken for a disk here and nowhere else: an empty mount point that is
    # found while flying is none.
    order = tuple(_named(disk) for disk in disks.values())
    mission = create(order[0].root)
    write_generations(mission.path, next_generation((), [order[0].id], 1))
    return OpenedMission(mission, False, (*order, *absent), tuple(findings))


def _look(root: Path, may_create: bool) -> tuple[str, Mission | None]:
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
    """The label of the copy that leads, and what is to be said where neither does."""
    labels = list(copies)
    first = labels[0]
    for label in labels[1:]:
        one, other = copies[first], copies[label]
        try:
            ours, theirs = read_generations(one.path), read_generations(other.path)
            if leads(theirs, ours) and not leads(ours, theirs):
                first = label
            else:
                refuse_split(one, other)
        except (MirrorError, RecordError) as error:
            return first, f"{error}; the flight goes on with {one.path} alone"
    return first, ""


def _pull_tail(leading: Mission, other: Mission) -> list[str]:
    """Take over what only the other copy of the same generation has; sentences say what."""
    ours, theirs = read_generations(leading.path), read_generations(other.path)
    if not ours or not theirs or ours[-1].token != theirs[-1].token:
        return []
    try:
        return _within(PULL_TIMEOUT_S, lambda: pull_tail(leading, other))
    except (OSError, DaemonError) as error:
        return [f"{other.path}: what only it has could not be read: {error}"]


def pull_tail(leading: Mission, other: Mission) -> list[str]:
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
