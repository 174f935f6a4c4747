"""Bring one copy of a mission up to date from the copy that leads.

Exposures, records, logs and what else belongs to the mission are copied; what differs on the copy
behind is moved to `.superseded`, never removed. Products (`L2`, `export`) are not mirrored.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

from daemon import DaemonError
from daemon.mission.layout import DISCARDED, Mission
from daemon.mission.mirror.generations import STATE_FILE, is_up_to_date_with, read_generations
from daemon.mission.store import durable
from daemon.mission.store.level0_folder import CAPTURE_FILE, EXPOSURE_FILE, hash_file, read_capture
from daemon.mission.verification.chain_file import CHAIN_FILE

BLOCK_BYTES = 4 << 20
SUPERSEDED = ".superseded"
"""Folder of files of which the leading copy has another one."""

_NOT_COPIED = frozenset({"L0", "L2", "export", "log", CHAIN_FILE, STATE_FILE})
"""Exposures, logs and chain file go their own way; products are not mirrored."""


class MirrorError(DaemonError):
    """Two copies that cannot be brought together; the message states why and what to do."""


class Resync:
    """Copies what is missing in one copy of a mission. `run` may be called again and again.

    Args:
        source: the copy that leads.
        target: the copy that is behind; its folder need not exist.
        first: number of the first exposure of which the target's frames are hashed again.
        step: called between blocks of bytes; what it raises ends the run.
    """

    def __init__(
        self, source: Mission, target: Mission, first: int, step: Callable[[], None]
    ) -> None:
        self._source = source
        self._target = target
        self._first = first
        self.step = step
        self._is_checked = False
        self._known: dict[int, bool] = {}
        self._logs: dict[str, int] = {}
        self.waiting = 0

    def run(self, open_log: str = "") -> int:
        """Copy what is missing now.

        Args:
            open_log: name of the log that is being written; copied as far as it is.

        Returns:
            How many exposures and files were copied or superseded.

        Raises:
            MirrorError: the target holds another mission, or went on without the source.
            OSError: a disk refused.
        """
        if not self._is_checked:
            self._refuse_conflict()
            self._is_checked = True
        for folder in ("L0", "L2", "log", "export"):
            durable.make_directories(self._target.path / folder)
        done = sum(self._small_file(name) for name in self._small_files(self._source.path))
        done += self._supersede_extra_exposures()
        todo = [n for n in self._source.numbers() if self._known.get(n) != self._is_sealed(n)]
        self.waiting = len(todo)
        for number in todo:
            done += self.copy_exposure(number)
            self.waiting -= 1
        for path in sorted(self._source.log_dir.iterdir()):
            if path.name == open_log:
                # It grows all the time; what is left is copied when the disk joins.
                self.copy_open_log(path.name, path.stat().st_size)
            elif path.is_file() and not path.name.startswith("."):
                done += self._closed_log(path)
        return done

    def copy_log(self, path: Path) -> None:
        """Put a log of the source in place of the target's."""
        target = self._target.log_dir / path.name
        self._supersede_file(target)
        self._copy(path, target)
        durable.sync_directory(target.parent)

    def copy_open_log(self, name: str, nbytes: int) -> None:
        """Copy a log that is being written, up to a size, from where the last call ended."""
        source, target = self._source.log_dir / name, self._target.log_dir / name
        known = self._logs.get(name)
        if known is None:
            self._supersede_file(target)
            known = 0
        with source.open("rb", buffering=0) as reading, target.open("ab", buffering=0) as writing:
            os.ftruncate(writing.fileno(), known)
            reading.seek(known)
            while known < nbytes and (data := reading.read(min(BLOCK_BYTES, nbytes - known))):
                self.step()
                known += durable.write_all(writing.fileno(), [data])
            os.fsync(writing.fileno())
        durable.sync_directory(target.parent)
        self._logs[name] = known

    def copy_chain_and_index(self) -> None:
        """Put the source's chain file and index, as they are now, in place of the target's.

        Nothing may be added to the source's meanwhile.

        Raises:
            OSError, MirrorError: a disk refused.
        """
        chain = self._source.chain_path.read_bytes()
        durable.replace_file(self._target.chain_path, chain)
        final = self._target.catalog_path
        part = final.with_name(f".{final.name}{durable.PART_SUFFIX}")
        part.unlink(missing_ok=True)
        address = f"{self._source.catalog_path.resolve().as_uri()}?mode=ro"
        try:
            with (
                closing(sqlite3.connect(address, uri=True)) as reading,
                closing(sqlite3.connect(part)) as writing,
            ):
                reading.backup(writing)
        except sqlite3.Error as error:
            raise MirrorError(f"the index cannot be copied to {final} ({error})") from error
        durable.sync_file(part)
        for suffix in ("-wal", "-shm"):
            final.with_name(final.name + suffix).unlink(missing_ok=True)
        part.rename(final)
        durable.sync_directory(final.parent)

    def _refuse_conflict(self) -> None:
        if not (self._target.path / "mission.json").exists():
            return
        if self._target.genesis_sha256() != self._source.genesis_sha256():
            raise MirrorError(
                f"{self._target.path} is another mission of the same name; move it away"
            )
        refuse_split(self._source, self._target)

    def _small_files(self, folder: Path) -> Iterator[str]:
        """Names, relative to the mission, of what is neither exposure nor log nor index."""
        for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
            name = Path(entry.path).relative_to(self._source.path).as_posix()
            if name in _NOT_COPIED or name.startswith("mission.db") or entry.name[0] == ".":
                continue
            if entry.is_dir(follow_symlinks=False):
                yield from self._small_files(Path(entry.path))
            else:
                yield name

    def _small_file(self, name: str) -> bool:
        source, target = self._source.path / name, self._target.path / name
        if target.is_file() and target.read_bytes() == source.read_bytes():
            return False
        durable.make_directories(target.parent)
        self._supersede_file(target)
        self._copy(source, target)
        durable.sync_directory(target.parent)
        return True

    def _closed_log(self, path: Path) -> bool:
        nbytes = path.stat().st_size
        if self._logs.get(path.name) == nbytes and path.suffix == ".mcap":
            return False
        target = self._target.log_dir / path.name
        is_same = (
            target.is_file()
            and target.stat().st_size == nbytes
            and self._hash(target) == self._hash(path)
        )
        if not is_same:
            self.copy_log(path)
        self._logs[path.name] = nbytes
        return not is_same

    def _supersede_extra_exposures(self) -> int:
        extra = sorted(set(self._target.numbers()) - set(self._source.numbers()))
        for number in extra:
            self._supersede(number)
        return len(extra)

    def _is_sealed(self, number: int) -> bool:
        return (self._source.level0(number) / EXPOSURE_FILE).exists()

    def is_ahead(self, number: int) -> bool:
        """Whether the source has an exposure, or its record, that the target has not."""
        target = self._target.level0(number)
        return not target.is_dir() or (
            self._is_sealed(number) and not (target / EXPOSURE_FILE).exists()
        )

    def copy_exposure(self, number: int) -> bool:
        """Make the target's exposure the same as the source's; whether that took anything."""
        source, target = self._source.level0(number), self._target.level0(number)
        is_sealed = self._is_sealed(number)
        did = False
        if target.is_dir() and not self._is_same(number):
            self._supersede(number)
        if not target.is_dir():
            self._copy_folder(source, target)
            did = True
        if is_sealed and not (target / EXPOSURE_FILE).exists():
            data = (source / EXPOSURE_FILE).read_bytes()
            durable.replace_file(target / EXPOSURE_FILE, data, mode=0o444)
            did = True
        self._known[number] = is_sealed
        return did

    def _is_same(self, number: int) -> bool:
        """Whether the target's exposure is the source's, its record perhaps not sealed yet."""
        source, target = self._source.level0(number), self._target.level0(number)
        if _bytes(source / CAPTURE_FILE) != _bytes(target / CAPTURE_FILE):
            return False
        record = _bytes(target / EXPOSURE_FILE)
        if record is not None and record != _bytes(source / EXPOSURE_FILE):
            return False
        capture = read_capture(source)
        for frame in capture.frames if capture else ():
            there = target / frame.file
            if not there.is_file() or there.stat().st_size != (source / frame.file).stat().st_size:
                return False
            if number >= self._first and self._hash(there) != frame.sha256:
                return False
        return True

    def _copy_folder(self, source: Path, target: Path) -> None:
        part = target.with_name(target.name + durable.PART_SUFFIX)
        durable.remove_tree(part)
        part.mkdir()
        capture = read_capture(source)
        hashes = {frame.file: frame.sha256 for frame in capture.frames} if capture else {}
        for entry in sorted(source.iterdir()):
            if entry.name == EXPOSURE_FILE or entry.name.startswith("."):
                continue
            found = self._copy(entry, part / entry.name)
            if hashes.get(entry.name, found) != found:
                raise MirrorError(
                    f"{entry}: differs from its record; run syntopic verify {self._source.path}"
                )
        durable.rename_directory(part, target)

    def _copy(self, source: Path, target: Path) -> str:
        """Copy a file, durable on return but for its name; its SHA-256."""
        part = target.with_name(f".{target.name}{durable.PART_SUFFIX}")
        part.unlink(missing_ok=True)
        digest = hashlib.sha256()
        mode = source.stat().st_mode & 0o777
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        descriptor = os.open(part, flags, mode)
        try:
            with source.open("rb", buffering=0) as reading:
                while data := reading.read(BLOCK_BYTES):
                    self.step()
                    digest.update(data)
                    durable.write_all(descriptor, [data])
                # The pipeline needs the page cache more than this does.
                os.posix_fadvise(reading.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
            os.fsync(descriptor)
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(descriptor)
        part.rename(target)
        return digest.hexdigest()

    def _hash(self, path: Path) -> str:
        return hash_file(path, lambda _: self.step())

    def _supersede_file(self, path: Path) -> None:
        if path.exists():
            superseded = self._target.path / SUPERSEDED
            durable.make_directories(superseded)
            path.rename(_free_name(superseded / path.name))

    def _supersede(self, number: int) -> None:
        folder = self._target.level0(number)
        superseded = self._target.level0_root / DISCARDED
        durable.make_directories(superseded)
        folder.rename(_free_name(superseded / folder.name))
        durable.sync_directory(superseded)
        durable.sync_directory(folder.parent)


def refuse_split(source: Mission, target: Mission) -> None:
    """Make sure that a copy knows all that another one knows.

    Raises:
        MirrorError: it does not, or both count the same generation with different content.
        RecordError: a history is damaged.
    """
    ours, theirs = read_generations(source.path), read_generations(target.path)
    if not is_up_to_date_with(ours, theirs):
        raise MirrorError(
            f"{source.path} and {target.path} each went on without the other since generation "
            f"{theirs[-1].number}; nothing is overwritten: move one of them away, keep both, and "
            "process each for itself"
        )
    if not theirs or ours[-1].token != theirs[-1].token:
        return
    for number in sorted(set(source.numbers()) & set(target.numbers())):
        for name in (CAPTURE_FILE, EXPOSURE_FILE):
            one = _bytes(source.level0(number) / name)
            other = _bytes(target.level0(number) / name)
            if one is not None and other is not None and one != other:
                raise MirrorError(
                    f"exposure {number}: {source.path} and {target.path} are both of generation "
                    f"{ours[-1].number} and hold different {name}; nothing is overwritten: run "
                    "syntopic verify on both, and move the one away that is not well"
                )


def _free_name(path: Path) -> Path:
    repetition = 1
    while (free := path.with_name(f"{path.name}-{repetition}")).exists():
        repetition += 1
    return free


def _bytes(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
