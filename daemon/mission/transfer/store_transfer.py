"""Copying a mission to an object store: resumable, verified, never at the cost of the last copy.

Every object is read back and compared by hash in each run, whatever an earlier run noted. The
manifest `transfer.json` has the states of `daemon.mission.transfer.transfer_manifest`; in a store
it is the last object that is written. A run continues at the file where an earlier one ended.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from daemon.mission.layout import Mission
from daemon.mission.store.file_tree import FileEntry, FileTree
from daemon.mission.transfer.azure_parts import AzureFolder, AzurePartUploads
from daemon.mission.transfer.object_store import PART_BYTES, ObjectStore, StoredObject
from daemon.mission.transfer.part_sender import ERRORS, PartUploads
from daemon.mission.transfer.s3_parts import S3PartUploads
from daemon.mission.transfer.s3_uploads import UnfinishedUploads, list_unfinished
from daemon.mission.transfer.store_products import is_processed
from daemon.mission.transfer.store_verification import check_store_copy, read_store_manifest
from daemon.mission.transfer.transfer import (
    Progress,
    checkpoint_index,
    counter,
    is_captured,
    no_progress,
)
from daemon.mission.transfer.transfer_manifest import (
    EXCLUDED_FILES,
    MANIFEST_FILE,
    CopiedFile,
    TransferError,
    TransferManifest,
)
from daemon.mission.transfer.transfer_removal import (
    finish_removal,
    remove_sealed_source,
    removing_path,
)
from daemon.mission.verification.verification import VerifyReport, verify

WORKERS = 4
"""Files in work at a time; each holds at most three parts in memory."""
NO_ACCOUNT_KEY = (
    "AZURE_STORAGE_ACCOUNT_KEY is not set. A file in work at a kill is sent again from its start."
)


@dataclass(frozen=True)
class StoreTransferReport:
    """Result of a transfer to a store; counts as in `daemon.mission.transfer.transfer`.

    `uploads` are those that earlier runs did not finish.
    """

    target: str
    copied: int
    already_present: int
    nbytes: int
    verified: VerifyReport
    source_removed: bool
    sealed_utc: str = ""
    uploads: UnfinishedUploads = field(default_factory=UnfinishedUploads)


def transfer_to_store(
    mission: Mission,
    folder: ObjectStore,
    *,
    remove_source: bool = False,
    progress: Progress = no_progress,
) -> StoreTransferReport:
    """Copy a mission into a folder of a store, under its own id.

    Args:
        mission: the source; it must be intact.
        folder: the copy becomes a folder in it.
        remove_source: seal the copy and remove the source once the copy is complete and verified.
        progress: called with bytes done and in total; each byte is sent and read back.

    Raises:
        TransferError: the source is damaged, the folder holds other objects, or captured data
            differ between source and copy.
        ObjectStoreError: the store refused; what was copied so far is kept for the next run.
        MissionError: another process holds the mission.
    """
    target = folder.below(mission.id)
    with ExitStack() as stack:
        stack.enter_context(mission.held())
        source = stack.enter_context(FileTree.open(mission.path.resolve()))
        manifest = read_store_manifest(target, mission)
        checkpoint_index(mission)
        verified = verify(mission)
        if not verified.is_intact:
            raise TransferError(
                f"{mission.path} has an error: {verified.problems[0]} ({len(verified.problems)} in "
                f"all). Run `syntopic verify {mission.path}`; the source is kept"
            )
        copying = _StoreCopying(source, target, manifest, verified, progress)
        if manifest is not None and manifest.state == "sealed":
            return copying.confirm_sealed(manifest, remove=remove_source)
        return copying.run(mission, remove=remove_source)


def finish_store_transfer(
    source_path: Path, folder: ObjectStore, *, progress: Progress = no_progress
) -> StoreTransferReport | None:
    """Go on where a transfer was interrupted after the source lost its name.

    Args:
        source_path: where the mission was.
        folder: it was transferred to.
        progress: as for `transfer_to_store`.

    Returns:
        None where nothing suggests that this mission was ever transferred.

    Raises:
        TransferError: the copy is not sealed, or not as it was sealed.
        ObjectStoreError: the store refused.
    """
    source_path = source_path.resolve()
    target = folder.below(source_path.name)
    removing = removing_path(source_path)
    manifest = read_store_manifest(target)
    if manifest is None or manifest.state != "sealed" or manifest.mission != source_path.name:
        if removing.is_dir():
            raise TransferError(
                f"{target.url} is not the sealed copy of {source_path}; name the folder that "
                f"{removing}/transferred.json names"
            )
        return None
    check_store_copy(target, manifest, counter(manifest.nbytes, progress))
    if removing.is_dir():
        with Mission(removing, manifest.mission).held():
            finish_removal(removing, manifest)
    counted = VerifyReport(manifest.exposures, manifest.frames, manifest.nbytes, ())
    return StoreTransferReport(
        target.url, 0, len(manifest.files), manifest.nbytes, counted, True, manifest.sealed_utc
    )


class _StoreCopying:
    """One run over one source, which is held, and one folder of a store."""

    def __init__(
        self,
        source: FileTree,
        target: ObjectStore,
        manifest: TransferManifest | None,
        verified: VerifyReport,
        progress: Progress,
    ) -> None:
        self._source, self._target, self._verified = source, target, verified
        self._noted = manifest.files if manifest else {}
        self._entries = self._source_entries()
        self._nbytes = sum(entry.nbytes for entry in self._entries)
        self._step = counter(3 * self._nbytes, progress)
        self._parts: PartUploads | None = None

    def run(self, mission: Mission, *, remove: bool) -> StoreTransferReport:
        """Copy, read back, and seal and remove the source where that is wanted."""
        present = {one.name: one for one in self._target.list_with(self._noted)}
        removed = self._removed_from_source(present, has_manifest=MANIFEST_FILE in present)
        manifest = TransferManifest(mission.id, mission.genesis_sha256(), "copying")
        retained = {name: self._noted[name] for name in removed}
        expected = {e.name: self._noted.get(e.name) for e in self._entries}
        note = replace(
            manifest,
            files={
                **retained,
                **{
                    e.name: CopiedFile(e.nbytes, before.sha256 if before else None)
                    for e in self._entries
                    for before in (expected[e.name],)
                },
            },
        )
        self._target.replace_small(MANIFEST_FILE, note.to_bytes())
        problem = self._begin_uploads(set(note.files))
        done = self._copy_all(present)
        uploads = self._parts.end() if self._parts else UnfinishedUploads(problem=problem)
        for name in removed:
            self._target.delete(name)
        self._refuse_changed_source()
        manifest = replace(
            manifest,
            state="complete",
            files={e.name: CopiedFile(e.nbytes, done[e.name][0]) for e in self._entries},
            exposures=self._verified.exposures,
            frames=self._verified.frames,
        )
        self._target.replace_small(MANIFEST_FILE, manifest.to_bytes())
        if remove:
            manifest = replace(manifest, state="sealed", sealed_utc=f"{datetime.now(UTC):%FT%TZ}")
            self._target.replace_small(MANIFEST_FILE, manifest.to_bytes())
            self._remove_source(manifest)
        present_before = sum(was_present for _, was_present in done.values())
        return StoreTransferReport(
            self._target.url, len(done) - present_before, present_before, self._nbytes,
            self._verified, remove, manifest.sealed_utc, uploads,
        )  # fmt: skip

    def confirm_sealed(self, manifest: TransferManifest, *, remove: bool) -> StoreTransferReport:
        """The copy was sealed by an earlier run: it is read again and never written."""
        here = {entry.name: entry.nbytes for entry in self._entries}
        differing = sorted(
            name
            for name in {*here, *manifest.files}
            if name not in manifest.files
            or here.get(name) != manifest.files[name].nbytes
            or self._source.sha256(name, self._step, from_disk=False) != manifest.files[name].sha256
        )
        if differing:
            raise TransferError(
                f"{self._source.path / differing[0]} differs from the copy that was sealed on "
                f"{manifest.sealed_utc} ({len(differing)} such files); source and copy are kept. "
                "Transfer the mission into another folder"
            )
        check_store_copy(self._target, manifest, self._step)
        if remove:
            self._remove_source(manifest)
        return StoreTransferReport(
            self._target.url, 0, len(manifest.files), manifest.nbytes, self._verified, remove,
            manifest.sealed_utc,
        )  # fmt: skip

    def _begin_uploads(self, own: set[str]) -> str:
        """Look for uploads in parts of earlier runs; a sentence where that is not possible.

        Args:
            own: names of the files of the transfer.
        """
        url, large = self._target.url, {e.name for e in self._entries if e.nbytes > PART_BYTES}
        if url.startswith("az://"):
            folder = AzureFolder.of(url)
            self._parts = AzurePartUploads(folder) if folder else None
            return NO_ACCOUNT_KEY if large and folder is None else ""
        listing = list_unfinished(url, lambda name: name in own or is_processed(name))
        if listing.folder is not None:
            self._parts = S3PartUploads(listing.folder, listing, large)
        return listing.problem

    def _copy_all(self, present: dict[str, StoredObject]) -> dict[str, tuple[str, bool]]:
        pool = ThreadPoolExecutor(WORKERS)
        work = {
            entry.name: pool.submit(self._copy, entry, present.get(entry.name))
            for entry in self._entries
        }
        try:
            done, _ = wait(work.values(), return_when=FIRST_EXCEPTION)
        finally:
            if self._parts:
                self._parts.stop()
            pool.shutdown(wait=True, cancel_futures=True)
        for one in done:
            one.result()  # the error that ended the work, if there was one
        return {name: one.result() for name, one in work.items()}

    def _copy(self, entry: FileEntry, there: StoredObject | None) -> tuple[str, bool]:
        """Copy one file; returns its SHA-256, and whether the copy had it already."""
        here = self._source.sha256(entry.name, self._step, from_disk=False)
        if there is not None:
            found = self._target.sha256(there, self._step)
            if found == here:
                return here, True
            before = self._noted.get(entry.name)
            if is_captured(entry.name) and before is not None and found == before.sha256:
                raise TransferError(
                    f"{self._source.path / entry.name} differs from the copy that was verified "
                    f"earlier in {self._target.url}; both are kept. Run `syntopic verify "
                    f"{self._source.path}`, or transfer the mission into another folder"
                )
        if self._parts and entry.nbytes > PART_BYTES:
            self._put_in_parts(self._parts, entry, here)
        else:
            self._target.put(entry.name, lambda: self._blocks(entry), entry.nbytes, here)
        written = self._target.find(entry.name)
        if (
            written is None
            or written.nbytes != entry.nbytes
            or self._target.sha256(written, self._step) != here
        ):
            raise TransferError(
                f"{self._target.url}/{entry.name} read back differently from what was sent; the "
                "source is kept. Run the transfer again"
            )
        return here, False

    def _put_in_parts(self, parts: PartUploads, entry: FileEntry, sha256: str) -> None:
        with self._source.reading(entry.name) as descriptor:

            def read(offset: int, nbytes: int) -> bytes:
                try:
                    return os.pread(descriptor, nbytes, offset)
                except OSError as error:
                    raise TransferError(
                        f"{self._source.path / entry.name} cannot be read: {error.strerror}; the "
                        "source is kept. Check its disk"
                    ) from error

            def send() -> None:
                parts.send(entry.name, read, entry.nbytes, self._step)

            self._target.put_by(send, entry.name, entry.nbytes, sha256, errors=ERRORS)

    def _blocks(self, entry: FileEntry) -> Iterator[bytes]:
        with self._source.reading(entry.name) as descriptor:
            while block := os.read(descriptor, PART_BYTES):
                yield block
                self._step(len(block))

    def _removed_from_source(
        self, present: dict[str, StoredObject], *, has_manifest: bool
    ) -> list[str]:
        """Products and exports of the copy that the source does not have any more.

        Raises:
            TransferError: objects that no transfer wrote, or captured data that the source lost.
        """
        ours = {entry.name for entry in self._entries}
        removed = []
        for name in present:
            if name in ours and (has_manifest or name in self._noted):
                continue
            if name in EXCLUDED_FILES or is_processed(name):
                continue
            if name not in self._noted:
                raise TransferError(
                    f"{self._target.url}/{name} was not written by a transfer of this mission; "
                    "move it away or choose another folder"
                )
            if is_captured(name):
                raise TransferError(
                    f"{self._source.path} has lost {name}, which the copy in {self._target.url} "
                    "has; the copy is left as it is"
                )
            removed.append(name)
        return removed

    def _remove_source(self, manifest: TransferManifest) -> None:
        self._refuse_changed_source()
        remove_sealed_source(self._source, manifest, self._target.url)

    def _source_entries(self) -> list[FileEntry]:
        return [e for e in self._source.list_entries()[1] if e.name not in EXCLUDED_FILES]

    def _refuse_changed_source(self) -> None:
        if self._source_entries() != self._entries:
            raise TransferError(
                f"{self._source.path} changed while it was copied; it is kept. "
                "Run the transfer again"
            )
