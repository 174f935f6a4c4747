"""Manifest of a copy: `transfer.json` in the copy's folder.

It goes through three states, each written durably before anything that depends on it is done:

- copying: `files` names everything that may be found in the folder, nothing else is ours;
- complete: every file was read back from the disk, and the copy was verified;
- sealed: as complete, and the source may have been removed. A sealed copy is never written again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from daemon import DaemonError
from daemon.mission.canonical_json import sha256_hex
from daemon.mission.layout import Mission
from daemon.mission.store import durable
from daemon.mission.store.file_tree import FileTree

MANIFEST_FILE = "transfer.json"
MOVED_FILE = "transferred.json"
"""In the source: the mission was copied and sealed elsewhere, and this folder is being removed."""

LOCK_FILE = ".held"
_NOTES = (MANIFEST_FILE, MOVED_FILE)
EXCLUDED_FILES = frozenset(
    {
        LOCK_FILE,
        *_NOTES,
        *(f".{name}{durable.PART_SUFFIX}" for name in _NOTES),
        "mission.db-wal",
        "mission.db-shm",
    }
)
"""Locks, the notes of a transfer, and what is in the index once it was closed."""

State = Literal["copying", "complete", "sealed"]

_SHA256 = re.compile(r"[0-9a-f]{64}")


class TransferError(DaemonError):
    """The mission was not copied, or the source was not removed; the message states why."""


@dataclass(frozen=True)
class CopiedFile:
    """A file of the copy. `sha256` is None until it was verified: in the state "copying" only."""

    nbytes: int
    sha256: str | None


@dataclass(frozen=True)
class TransferManifest:
    """Content of `transfer.json`.

    `exposures` and `frames` are counted by the verification; `sealed_utc` is the time of sealing.
    """

    mission: str
    genesis_sha256: str
    state: State
    files: Mapping[str, CopiedFile] = field(default_factory=dict)
    exposures: int = 0
    frames: int = 0
    sealed_utc: str = ""

    @property
    def nbytes(self) -> int:
        """Size of all files."""
        return sum(file.nbytes for file in self.files.values())

    @property
    def sha256(self) -> str:
        """Hash of the note itself, by which the source names the copy it was moved to."""
        return sha256_hex(self.to_bytes())

    def to_bytes(self) -> bytes:
        """The note as it is on the disk."""
        content = {
            "mission": self.mission,
            "genesis": self.genesis_sha256,
            "state": self.state,
            "exposures": self.exposures,
            "frames": self.frames,
            "sealed_utc": self.sealed_utc,
            "files": {
                name: {"nbytes": file.nbytes, "sha256": file.sha256}
                for name, file in sorted(self.files.items())
            },
        }
        return json.dumps(content, indent=0).encode("ascii") + b"\n"

    def write(self, target: FileTree) -> None:
        """Replace the note of a copy; durable on return."""
        target.replace(MANIFEST_FILE, self.to_bytes())


def read_manifest(target: FileTree, mission: Mission | None = None) -> TransferManifest | None:
    """The note of a copy; None where the folder has none.

    Args:
        target: the folder of the copy.
        mission: refuse a copy of any other mission.

    Raises:
        TransferError: damaged, or of another mission.
    """
    try:
        data = target.read_small(MANIFEST_FILE)
    except FileNotFoundError:
        return None
    return parse_manifest(data, str(target.path), mission)


def parse_manifest(data: bytes, place: str, mission: Mission | None = None) -> TransferManifest:
    """The note of a copy from its bytes.

    Args:
        data: content of `transfer.json`.
        place: folder or address of the copy, for messages.
        mission: refuse a copy of any other mission.

    Raises:
        TransferError: damaged, or of another mission.
    """
    try:
        manifest = _note(json.loads(data))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise TransferError(
            f"{place}/{MANIFEST_FILE} is damaged ({type(error).__name__}), so what is in "
            f"{place} is not known to be a copy; move it away or choose another disk"
        ) from error
    if mission is not None and (manifest.mission, manifest.genesis_sha256) != (
        mission.id,
        mission.genesis_sha256(),
    ):
        raise TransferError(f"{place} holds another mission of the same name; choose another disk")
    return manifest


def _note(content: dict[str, Any]) -> TransferManifest:
    # Notes of version 1.0 have no state; they were written while copying.
    state = content.get("state", "copying")
    if state not in ("copying", "complete", "sealed"):
        raise ValueError(state)
    is_verified = "state" in content
    note = TransferManifest(
        mission=_text(content["mission"]),
        genesis_sha256=_text(content["genesis"]),
        state=state,
        files={
            _file_name(name): CopiedFile(
                _count(file["nbytes"]), _sha256(file["sha256"]) if is_verified else None
            )
            for name, file in content["files"].items()
        },
        exposures=_count(content.get("exposures", 0)),
        frames=_count(content.get("frames", 0)),
        sealed_utc=_text(content.get("sealed_utc", "")),
    )
    if state != "copying" and any(file.sha256 is None for file in note.files.values()):
        raise ValueError("a verified copy has a hash of every file")
    return note


def _file_name(name: str) -> str:
    if "\0" in name or any(part in ("", ".", "..") for part in name.split("/")):
        raise ValueError(name)
    return name


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(value)
    return value


def _count(value: object) -> int:
    if type(value) is not int or value < 0:
        raise TypeError(value)
    return value


def _sha256(value: object) -> str | None:
    if value is not None and not _SHA256.fullmatch(_text(value)):
        raise ValueError(value)
    return value if isinstance(value, str) else None
