"""The disk under a folder: an id in a file at its root, and whether it takes bytes.

An empty mount point looks like an empty disk; the id distinguishes them.
"""

from __future__ import annotations

import uuid
from dataclasses import dataclass
from pathlib import Path

from daemon.mission.canonical_json import RecordError, canonical_bytes, parse_record, plain_name
from daemon.mission.store import durable

ID_FILE = "syntopic-disk.json"
_PROBE_FILE = ".syntopic-probe"


@dataclass(frozen=True)
class Disk:
    """One of the disks of a mission: its key in the configuration, its folder and its id."""

    label: str
    root: Path
    id: str

    def __str__(self) -> str:
        return f"{self.label} ({self.root})"


def read_disk_id(root: Path) -> str | None:
    """The id of the disk under a folder, or None where it has none or it is damaged.

    Raises:
        OSError: the disk cannot be read.
    """
    try:
        found = parse_record((root / ID_FILE).read_bytes(), ID_FILE).get("id")
    except (FileNotFoundError, RecordError):
        return None
    return found if isinstance(found, str) and plain_name(found) else None


def give_disk_id(root: Path) -> str:
    """The id of the disk under a folder; one that has none gets one, durably.

    Raises:
        OSError: the disk refused.
    """
    durable.make_directories(root)
    known = read_disk_id(root)
    if known is not None:
        return known
    new = uuid.uuid4().hex
    durable.replace_file(root / ID_FILE, canonical_bytes({"id": new}), mode=0o444)
    return new


def prove_writable(root: Path) -> None:
    """Write a byte, sync it and take it away.

    Raises:
        OSError: the disk refused.
    """
    probe = root / _PROBE_FILE
    probe.unlink(missing_ok=True)
    durable.create_file(probe, [b"\n"])
    probe.unlink()


def same_file_system(one: Path, other: Path) -> bool:
    """Whether two folders, or the nearest ones above them that exist, lie on one file system."""
    return _device(one) == _device(other)


def _device(path: Path) -> int:
    while not path.exists():
        path = path.parent
    return path.stat().st_dev
