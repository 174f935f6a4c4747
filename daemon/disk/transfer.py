"""Copying a mission to another disk: resumable, verified, never at the cost of the source.

A file counts as copied when its bytes, read back from the other disk, hash to what was read from
the source. What was copied is noted beside the copy (`transfer.json`), so that a transfer that was
interrupted goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from daemon.disk import durable
from daemon.disk.catalog import Catalog, CatalogError
from daemon.disk.level0_folder import hash_file
from daemon.disk.mission import Mission
from daemon.disk.verification import VerifyReport, verify
from daemon.errors import DaemonError

JOURNAL = "transfer.json"
JOURNAL_EVERY_BYTES = 500_000_000
"""How much may have to be copied again after a kill, about; after anything else, one file."""

BLOCK_BYTES = 4 << 20
LEFT_OUT = frozenset({".held", JOURNAL, "mission.db-wal", "mission.db-shm"})
"""Locks, and what is in the index once it was closed."""

Progress = Callable[[int, int], None]


class TransferError(DaemonError):
    """The mission was not copied; the sentence says what is in the way."""


@dataclass(frozen=True)
class TransferReport:
    """What was done.

    `copied` files came anew, `kept` were there and verified from an earlier attempt; the source is
    removed only after all of it was verified.
    """

    target: Path
    copied: int
    kept: int
    nbytes: int
    verified: VerifyReport
    source_removed: bool


@dataclass(frozen=True)
class _Entry:
    """A file of the source: relative name, size, modification time."""

    name: str
    nbytes: int
    modified_ns: int


def transfer(
    mission: Mission,
    disk: Path,
    *,
    remove_source: bool = False,
    progress: Progress = lambda done, total: None,
) -> TransferReport:
    """Copy a mission into the folder `disk`, under its own id.

    Args:
        remove_source: delete the source once the copy is complete and verified.
        progress: told bytes done and bytes in total; each byte is read twice, once here and once
            there.

    Raises:
        TransferError: no room, a mission that is being flown, something that is no plain file, a
            different mission of that name, or a copy that cannot be verified.
        MissionError: another process holds the mission.
        OSError: a disk refused; what was copied so far is kept for the next attempt.
    """
    target = disk.resolve() / mission.id
    source = mission.path.resolve()
    if target == source or target.is_relative_to(source):
        raise TransferError(f"{disk}: that is where the mission is; name a folder of another disk")
    with mission.held():
        _settle_index(mission)
        entries = list(_entries(source))
        total = sum(entry.nbytes for entry in entries)
        durable.make_directories(target)
        journal = _read_journal(target, mission)
        here = {entry.name: entry for entry in entries if not _is_copied(entry, journal, target)}
        _refuse_without_room(target, sum(entry.nbytes for entry in here.values()))
        _write_journal(target, mission, journal)
        done = 2 * (total - sum(entry.nbytes for entry in here.values()))
        since_noted = 0

        def step(count: int) -> None:
            nonlocal done
            done += count
            progress(done, 2 * total)

        step(0)
        try:
            for entry in here.values():
                journal[entry.name] = {
                    "nbytes": entry.nbytes,
                    "modified_ns": str(entry.modified_ns),
                    "sha256": _copy(source / entry.name, target / entry.name, step),
                }
                since_noted += entry.nbytes
                if since_noted >= JOURNAL_EVERY_BYTES:
                    _write_journal(target, mission, journal)
                    since_noted = 0
        except BaseException:
            # A disk that refused, or Ctrl-C: what is there is not to be copied again.
            with suppress(OSError):
                _write_journal(target, mission, journal)
            raise
        _remove_strangers(target, {entry.name for entry in entries})
        _write_journal(target, mission, journal)
        verified = verify(Mission.open(target))
        if not verified.is_well:
            raise TransferError(
                f"the copy in {target} is not well: {verified.problems[0]} "
                f"({len(verified.problems)} in all). If the source says the same (syntopic verify "
                f"{source}), the copy is faithful; the source is kept"
            )
        if remove_source:
            _remove(source, entries)
    return TransferReport(
        target, len(here), len(entries) - len(here), total, verified, remove_source
    )


def _settle_index(mission: Mission) -> None:
    """Fold the write-ahead log into the index, so that one file holds it."""
    if not mission.catalog_path.exists():
        return
    try:
        Catalog.open(mission.catalog_path).close()
    except CatalogError as error:
        raise TransferError(f"{error}; run syntopic repair first") from error


def _entries(root: Path, below: str = "") -> Iterator[_Entry]:
    for item in sorted(os.scandir(root / below), key=lambda item: item.name):
        name = f"{below}/{item.name}" if below else item.name
        if name in LEFT_OUT:
            continue
        status = item.stat(follow_symlinks=False)
        if stat.S_ISDIR(status.st_mode):
            yield from _entries(root, name)
        elif stat.S_ISREG(status.st_mode):
            yield _Entry(name, status.st_size, status.st_mtime_ns)
        else:
            raise TransferError(
                f"{root / name} is no plain file; a mission holds files and folders, no links"
            )


def _is_copied(entry: _Entry, journal: Mapping[str, Mapping[str, object]], target: Path) -> bool:
    """Whether an earlier attempt copied and verified the file as it is now."""
    noted = journal.get(entry.name)
    if noted is None or noted.get("nbytes") != entry.nbytes:
        return False
    if noted.get("modified_ns") != str(entry.modified_ns):
        return False
    try:
        there = (target / entry.name).lstat()
    except FileNotFoundError:
        return False
    return stat.S_ISREG(there.st_mode) and there.st_size == entry.nbytes


def _copy(source: Path, target: Path, step: Callable[[int], None]) -> str:
    """Copy a file and read it back; returns its SHA-256."""
    durable.make_directories(target.parent)
    part = target.with_name(f".{target.name}{durable.PART_SUFFIX}")
    part.unlink(missing_ok=True)
    digest = hashlib.sha256()
    buffer = memoryview(bytearray(BLOCK_BYTES))
    with source.open("rb", buffering=0) as reading, part.open("wb", buffering=0) as writing:
        while count := reading.readinto(buffer):
            digest.update(buffer[:count])
            written = 0
            while written < count:
                written += writing.write(buffer[written:count]) or 0
            step(count)
        os.fsync(writing.fileno())
        # Read back what the disk has, not what memory still knows.
        os.posix_fadvise(writing.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    found = hash_file(part, step)
    if found != digest.hexdigest():
        part.unlink()
        raise TransferError(
            f"{target}: read back differently from what was written; the disk is not to be trusted"
        )
    status = source.stat()
    part.chmod(stat.S_IMODE(status.st_mode))
    os.utime(part, ns=(status.st_atime_ns, status.st_mtime_ns))
    part.rename(target)
    durable.sync_directory(target.parent)
    return found


def _read_journal(target: Path, mission: Mission) -> dict[str, dict[str, object]]:
    try:
        noted = json.loads((target / JOURNAL).read_text("utf-8"))
        if noted["mission"] == mission.id and noted["genesis"] == mission.genesis_sha256():
            return dict(noted["files"])
    except FileNotFoundError:
        if any(target.iterdir()):
            raise TransferError(
                f"{target} exists and no transfer began it; move it away or choose another disk"
            ) from None
        return {}
    except (ValueError, KeyError, TypeError):
        return {}  # a damaged note costs copying again
    raise TransferError(f"{target} holds another mission of the same name; choose another disk")


def _write_journal(
    target: Path, mission: Mission, journal: Mapping[str, Mapping[str, object]]
) -> None:
    content = {"mission": mission.id, "genesis": mission.genesis_sha256(), "files": journal}
    durable.replace_file(target / JOURNAL, json.dumps(content, indent=0).encode())


def _refuse_without_room(target: Path, nbytes: int) -> None:
    free = durable.free_bytes(target)
    if free < nbytes:
        raise TransferError(
            f"{target}: {nbytes / 1e9:.1f} GB are to be copied and {free / 1e9:.1f} GB are free"
        )


def _remove_strangers(target: Path, names: set[str]) -> None:
    """What an earlier attempt copied and the source has not any more, and unfinished files."""
    for entry in list(_entries(target)):
        if entry.name not in names:
            (target / entry.name).unlink()


def _remove(source: Path, entries: list[_Entry]) -> None:
    """Delete the source, unless it changed since it was read."""
    if list(_entries(source)) != entries:
        raise TransferError(f"{source} changed while it was copied; it is kept, transfer it again")
    durable.remove_tree(source)
