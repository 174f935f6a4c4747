"""Removing the source of a transfer, once the copy is sealed as the only truth.

The order is: seal in the copy, mark in the source, one rename that takes the source's name away,
then file by file. Every step is durable before the next, and each can be repeated. Nothing here
writes to the copy.
"""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

from daemon.mission.store import durable
from daemon.mission.store.file_tree import ByteProgress, FileTree, TreeError
from daemon.mission.transfer.transfer_manifest import (
    EXCLUDED_FILES,
    LOCK_FILE,
    MOVED_FILE,
    TransferError,
    TransferManifest,
)

REMOVING_SUFFIX = ".removing"


def removing_path(source: Path) -> Path:
    """Folder a source is moved to before its first file is removed."""
    return source.with_name(f".{source.name}{REMOVING_SUFFIX}")


def check_sealed(target: FileTree, manifest: TransferManifest, step: ByteProgress) -> None:
    """Read a sealed copy from the disk and compare every file with the seal.

    Raises:
        TransferError: a file is missing or differs.
    """
    for name, file in manifest.files.items():
        try:
            found = target.sha256(name, step, from_disk=True)
        except FileNotFoundError:
            found = "nothing"
        except OSError as error:
            raise TransferError(
                f"{target.path / name} cannot be read ({error.strerror}); the source is kept"
            ) from error
        if found != file.sha256:
            state = "is missing" if found == "nothing" else "was changed"
            raise TransferError(
                f"{target.path / name} {state} since the copy was sealed on {manifest.sealed_utc}; "
                "what the source still has is kept"
            )


def remove_sealed_source(source: FileTree, manifest: TransferManifest, target: Path | str) -> None:
    """Remove a source that is as it was copied.

    Args:
        source: the mission's folder; the caller has compared it with the manifest.
        manifest: of the copy, sealed.
        target: folder or address of the copy, for the mark.

    Raises:
        TransferError: the folder cannot be renamed, or holds what the copy does not.
    """
    mark = {
        "mission": manifest.mission,
        "copy": str(target),
        "sealed_utc": manifest.sealed_utc,
        "seal_sha256": manifest.sha256,
        "meaning": "The copy is complete and verified; this folder is being removed.",
    }
    source.replace(MOVED_FILE, json.dumps(mark, indent=1).encode("utf-8", "replace") + b"\n")
    removing = removing_path(source.path)
    if removing.exists():
        finish_removal(removing, manifest)
    try:
        source.path.rename(removing)
    except OSError as error:
        reason = "is a mount point" if error.errno == errno.EBUSY else error.strerror
        raise TransferError(
            f"{source.path} cannot be removed ({reason}). The copy in {target} is complete and "
            "sealed"
        ) from error
    durable.sync_directory(removing.parent)
    finish_removal(removing, manifest)


def finish_removal(removing: Path, manifest: TransferManifest) -> None:
    """Remove what is left of a source; the mark goes last.

    Raises:
        TransferError: the folder was not moved to this copy, or holds files that the copy does not.
    """
    with FileTree.open(removing) as tree:
        folders, files = tree.list_entries()
        _check_mark(tree, manifest, is_empty=not [f for f in files if f.name not in EXCLUDED_FILES])
        for file in files:
            if file.name not in EXCLUDED_FILES and file.name not in manifest.files:
                raise TransferError(
                    f"{removing / file.name} is not in the sealed copy; nothing more is removed. "
                    "Move that file away and run the transfer again"
                )
        for file in files:
            if file.name not in (LOCK_FILE, MOVED_FILE):
                tree.unlink(file.name)
        for folder in reversed(folders):
            tree.remove_folder(folder)
        # After a power cut, too, nothing may be left here without its mark.
        os.fsync(tree.descriptor)
        tree.unlink(LOCK_FILE)
        tree.unlink(MOVED_FILE)
    removing.rmdir()
    durable.sync_directory(removing.parent)


def copy_named_by(removing: Path) -> str:
    """The folder that the mark in a half removed source names; "another disk" if unreadable."""
    try:
        with FileTree.open(removing) as tree:
            return str(json.loads(tree.read_small(MOVED_FILE))["copy"])
    except (OSError, ValueError, KeyError, TypeError, TreeError):
        return "another disk"


def _check_mark(tree: FileTree, manifest: TransferManifest, *, is_empty: bool) -> None:
    try:
        found = json.loads(tree.read_small(MOVED_FILE))["seal_sha256"]
    except FileNotFoundError:
        if is_empty:
            return  # the mark is the last to go
        found = None
    except (ValueError, KeyError, TypeError):
        found = None
    if found != manifest.sha256:
        raise TransferError(
            f"{tree.path / MOVED_FILE} does not name this copy; nothing more is removed. Name the "
            f"disk that holds the copy in {copy_named_by(tree.path)}"
        )
