"""Copying a mission to another disk: resumable, verified, never at the cost of the last copy.

Every file is hashed in the source and read back from the copy's disk in each run, whatever an
earlier run noted. The states of a copy are in `daemon.mission.transfer.transfer_manifest`; removing
the source is in `daemon.mission.transfer.transfer_removal`.
"""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from daemon.mission.catalog.catalog import Catalog, CatalogError
from daemon.mission.layout import Mission, MissionError
from daemon.mission.store import durable
from daemon.mission.store.file_tree import ByteProgress, FileEntry, FileTree
from daemon.mission.transfer.transfer_manifest import (
    EXCLUDED_FILES,
    MANIFEST_FILE,
    CopiedFile,
    TransferError,
    TransferManifest,
    read_manifest,
)
from daemon.mission.transfer.transfer_removal import (
    REMOVING_SUFFIX,
    check_sealed,
    copy_named_by,
    finish_removal,
    remove_sealed_source,
    removing_path,
)
from daemon.mission.verification.verification import VerifyReport, verify

Progress = Callable[[int, int], None]


def no_progress(_done: int, _total: int) -> None:
    """For callers that show none."""


@dataclass(frozen=True)
class TransferReport:
    """Result of a transfer.

    `copied` files were written, `kept` were identical in the copy of an earlier run. `sealed_utc`
    is empty where the copy is not sealed.
    """

    target: Path
    copied: int
    already_present: int
    nbytes: int
    verified: VerifyReport
    source_removed: bool
    sealed_utc: str = ""


def transfer(
    mission: Mission,
    disk: Path,
    *,
    remove_source: bool = False,
    progress: Progress = no_progress,
) -> TransferReport:
    """Copy a mission into the folder `disk`, under its own id.

    Args:
        mission: the source.
        disk: a folder of another disk; it is created if it is missing.
        remove_source: seal the copy and remove the source once the copy is complete and verified.
        progress: called with bytes done and bytes in total; each byte is read in the source and in
            the copy.

    Raises:
        TransferError: no room, a target that is not empty and not ours, a source without what
            the copy has, or a copy that cannot be verified.
        TreeError: links or devices in source or target, or a disk that returns other bytes.
        MissionError: another process holds the mission or the copy.
        OSError: a disk refused; what was copied so far is kept for the next run.
    """
    source_path = mission.path.resolve()
    target_path = disk.resolve() / mission.id
    if mission.id.endswith(REMOVING_SUFFIX):
        raise TransferError(
            f"{source_path} is what is left of a mission that was transferred to "
            f"{copy_named_by(source_path)}; name the mission as it was called before"
        )
    if target_path == source_path or target_path.is_relative_to(source_path):
        raise TransferError(f"{disk} is where the mission is; name a folder of another disk")
    with ExitStack() as stack:
        stack.enter_context(mission.held())
        source = stack.enter_context(FileTree.open(source_path))
        durable.make_directories(target_path.parent)
        target = stack.enter_context(_locked_target(target_path, source))
        manifest = read_manifest(target, mission)
        checkpoint_index(mission)
        if manifest is not None and manifest.state == "sealed":
            copying = _Copying(source, target, manifest.files, progress)
            return copying.confirm_sealed(manifest, remove=remove_source)
        copying = _Copying(source, target, manifest.files if manifest else {}, progress)
        return copying.run(mission, remove=remove_source)


def finish_transfer(
    source_path: Path, disk: Path, *, progress: Progress = no_progress
) -> TransferReport | None:
    """Go on where a transfer was interrupted after the source lost its name.

    Args:
        source_path: where the mission was.
        disk: the folder it was transferred to.
        progress: as for `transfer`.

    Returns:
        None where nothing suggests that this mission was ever transferred.

    Raises:
        TransferError: the copy is not sealed, or not as it was sealed.
    """
    source_path = source_path.resolve()
    target_path = disk.resolve() / source_path.name
    removing = removing_path(source_path)
    is_left = removing.is_dir()
    if not target_path.is_dir():
        if is_left:
            raise TransferError(
                f"{source_path} was transferred to {copy_named_by(removing)}; name that disk"
            )
        return None
    with ExitStack() as stack:
        target = stack.enter_context(_locked_target(target_path, None))
        manifest = read_manifest(target)
        if manifest is None or manifest.state != "sealed" or manifest.mission != source_path.name:
            if is_left:
                raise TransferError(
                    f"{target_path} is not the sealed copy; {source_path} was transferred to "
                    f"{copy_named_by(removing)}: name that disk"
                )
            return None
        if is_left:
            stack.enter_context(Mission(removing, manifest.mission).held())
        step = counter(manifest.nbytes, progress)
        check_sealed(target, manifest, step)
        if is_left:
            finish_removal(removing, manifest)
    return _sealed_report(target_path, manifest, source_removed=True)


class _Copying:
    """One run over one source and one target, both held."""

    def __init__(
        self,
        source: FileTree,
        target: FileTree,
        noted: Mapping[str, CopiedFile],
        progress: Progress,
    ) -> None:
        self._source = source
        self._target = target
        self._noted = noted
        self._folders, files = source.list_entries()
        self._entries = [entry for entry in files if entry.name not in EXCLUDED_FILES]
        self._nbytes = sum(entry.nbytes for entry in self._entries)
        self._step = counter(2 * self._nbytes, progress)

    def run(self, mission: Mission, *, remove: bool) -> TransferReport:
        """Copy, verify, and seal and remove the source where that is wanted."""
        removed = self._removed_from_source()
        self._require_free_space()
        manifest = TransferManifest(mission.id, mission.genesis_sha256(), "copying")
        expected = {e.name: CopiedFile(e.nbytes, self._verified(e.name)) for e in self._entries}
        retained = {name: self._noted[name] for name in removed}
        replace(manifest, files={**retained, **expected}).write(self._target)
        for folder in self._folders:
            self._target.make_folder(folder)
        files: dict[str, CopiedFile] = {}
        already_present = 0
        for entry in self._entries:
            sha256, was_present = self._copy(entry)
            already_present += was_present
            files[entry.name] = CopiedFile(entry.nbytes, sha256)
        for name in removed:
            self._target.unlink(name)
        self._target.sync_folders(self._folders)
        _sync_above(self._target.path)
        verified = verify(Mission.open(self._target.path))
        if not verified.is_intact:
            raise TransferError(
                f"the copy in {self._target.path} has an error: {verified.problems[0]} "
                f"({len(verified.problems)} in all). If `syntopic verify {self._source.path}` "
                "reports the same, the copy is faithful; the source is kept"
            )
        manifest = replace(
            manifest,
            state="complete",
            files=files,
            exposures=verified.exposures,
            frames=verified.frames,
        )
        manifest.write(self._target)
        if remove:
            manifest = replace(manifest, state="sealed", sealed_utc=f"{datetime.now(UTC):%FT%TZ}")
            self._refuse_changed_source(self._entries)
            manifest.write(self._target)
            remove_sealed_source(self._source, manifest, self._target.path)
        return TransferReport(
            self._target.path,
            len(files) - already_present,
            already_present,
            self._nbytes,
            verified,
            remove,
            manifest.sealed_utc,
        )

    def confirm_sealed(self, manifest: TransferManifest, *, remove: bool) -> TransferReport:
        """The copy was sealed by an earlier run: it is read again and never written."""
        found = {entry.name: entry.nbytes for entry in self._entries}
        differing = sorted(
            name
            for name in {*found, *manifest.files}
            if name not in manifest.files or found.get(name) != manifest.files[name].nbytes
        )
        for name in manifest.files:
            if not differing and self._hash_source(name) != manifest.files[name].sha256:
                differing.append(name)
        if differing:
            raise TransferError(
                f"{self._source.path / differing[0]} differs from the copy that was sealed on "
                f"{manifest.sealed_utc} ({len(differing)} such files); source and copy are kept. "
                "Transfer the mission into another folder, or remove the one that is not wanted"
            )
        check_sealed(self._target, manifest, self._step)
        if remove:
            self._refuse_changed_source(self._entries)
            remove_sealed_source(self._source, manifest, self._target.path)
        return _sealed_report(self._target.path, manifest, source_removed=remove)

    def _copy(self, entry: FileEntry) -> tuple[str, bool]:
        """Copy one file; returns its SHA-256, and whether the copy had it already."""
        size = self._target.size(entry.name)
        if size is not None:
            there = self._target.sha256(entry.name, self._step, from_disk=True)
            if size == entry.nbytes:
                here = self._hash_source(entry.name)
                if here == there:
                    return here, True
            if is_captured(entry.name) and there == self._verified(entry.name):
                raise TransferError(
                    f"{self._source.path / entry.name} differs from the copy that was verified "
                    f"earlier in {self._target.path}; both are kept. Run `syntopic verify "
                    f"{self._source.path}`, or transfer the mission into another folder"
                )
        return self._target.copy_from(self._source, entry, self._step), False

    def _removed_from_source(self) -> list[str]:
        """Files of the copy, products and exports only, that the source does not have any more.

        Unfinished files of an interrupted run are removed.

        Raises:
            TransferError: the target holds files that no transfer put there, or captured data that
                the source has lost.
        """
        ours = {entry.name for entry in self._entries}
        removed = []
        unfinished = []
        for file in self._target.list_entries()[1]:
            if file.name in ours or file.name in EXCLUDED_FILES:
                continue
            final_name = _name_of_part(file.name)
            if final_name in self._noted:
                unfinished.append(file.name)
            elif file.name not in self._noted:
                raise TransferError(
                    f"{self._target.path / file.name} is not part of this mission; move it away or "
                    "choose another disk"
                )
            elif is_captured(file.name):
                raise TransferError(
                    f"{self._source.path} has lost {file.name}, which the copy in "
                    f"{self._target.path} has; the copy is left as it is. Transfer the mission "
                    "into another folder if that file is not wanted"
                )
            else:
                removed.append(file.name)
        for name in unfinished:
            self._target.unlink(name)
        return removed

    def _require_free_space(self) -> None:
        needed = sum(e.nbytes for e in self._entries if self._target.size(e.name) != e.nbytes)
        free = durable.free_bytes(self._target.path)
        if free < needed:
            raise TransferError(
                f"{self._target.path}: {needed / 1e9:.1f} GB are to be copied and "
                f"{free / 1e9:.1f} GB are free"
            )

    def _refuse_changed_source(self, entries: list[FileEntry]) -> None:
        found = [
            entry for entry in self._source.list_entries()[1] if entry.name not in EXCLUDED_FILES
        ]
        if found != entries:
            raise TransferError(
                f"{self._source.path} changed while it was copied; it is kept. "
                "Run the transfer again"
            )

    def _verified(self, name: str) -> str | None:
        noted = self._noted.get(name)
        return noted.sha256 if noted else None

    def _hash_source(self, name: str) -> str:
        return self._source.sha256(name, self._step, from_disk=False)


@contextmanager
def _locked_target(path: Path, source: FileTree | None) -> Iterator[FileTree]:
    """Open the folder of the copy, create it if missing, and keep others out.

    Raises:
        TransferError: the folder is the source, or not empty and not from a transfer.
        MissionError: another process writes there.
    """
    if source is not None and not path.is_symlink():
        durable.make_directories(path)
    with FileTree.open(path) as target:
        if source is not None and target.is_same(source):
            raise TransferError(f"{path} is where the mission is; name a folder of another disk")
        try:
            fcntl.flock(target.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise MissionError(f"another transfer writes to {path}; wait for its end") from error
        folders, files = target.list_entries()
        has_manifest = any(file.name == MANIFEST_FILE for file in files)
        if not has_manifest and (folders or any(file.name not in EXCLUDED_FILES for file in files)):
            raise TransferError(
                f"{path} is not empty and was not made by a transfer; move it away or choose "
                "another disk"
            )
        with Mission(path, path.name).held():
            yield target


def checkpoint_index(mission: Mission) -> None:
    """Fold the write-ahead log into the index, so that one file holds it."""
    if not mission.catalog_path.exists():
        return
    try:
        Catalog.open(mission.catalog_path).close()
    except CatalogError as error:
        raise TransferError(f"{error}; run syntopic repair first") from error


def _sync_above(path: Path) -> None:
    """Make the names of the folders above durable, also of those that an earlier run created."""
    device = path.stat().st_dev
    for folder in path.parents:
        if folder.stat().st_dev != device:
            return
        with suppress(PermissionError):  # a folder that we may not read was not created by us
            durable.sync_directory(folder)


def is_captured(name: str) -> bool:
    """Whether a file holds what cannot be made again: frames, records, logs, the configuration."""
    first, _, below = name.partition("/")
    if first == "log":
        return below.endswith(".mcap")
    return first in ("L0", "mission.json", "rig.toml", "service.toml") or first.startswith("plan.")


def _name_of_part(name: str) -> str | None:
    """The name that an unfinished file was to get; None for any other file."""
    folder, _, last = name.rpartition("/")
    if not (last.startswith(".") and last.endswith(durable.PART_SUFFIX)):
        return None
    final_name = last[1 : -len(durable.PART_SUFFIX)]
    return f"{folder}/{final_name}" if folder else final_name


def counter(total: int, progress: Progress) -> ByteProgress:
    done = 0

    def step(count: int) -> None:
        nonlocal done
        done += count
        progress(done, max(total, done))

    progress(0, total)
    return step


def _sealed_report(
    target: Path, manifest: TransferManifest, *, source_removed: bool
) -> TransferReport:
    verified = VerifyReport(manifest.exposures, manifest.frames, manifest.nbytes, ())
    return TransferReport(
        target,
        0,
        len(manifest.files),
        manifest.nbytes,
        verified,
        source_removed,
        manifest.sealed_utc,
    )
