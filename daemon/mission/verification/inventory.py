"""Every file in a mission folder, whatever its name and kind; and why some have no hash.

Walking only: what the files should contain is compared in
`daemon.mission.verification.verification`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from daemon.mission.layout import DISCARDED
from daemon.mission.store import durable

UNFINISHED = "being written, or left unfinished by a service that was killed (syntopic repair)"
_FOREIGN_FILE = "not written by Syntopic"

_REASONS: tuple[tuple[str, str], ...] = (
    ("mission.db", "index, built again from the records; its rows are compared with them"),
    (".held", "lock, without content"),
    ("transfer.json", "notes of a transfer"),
    ("disks.json", "which disks hold the mission; written again when a disk is dropped or joins"),
    (".superseded/", "set aside when two copies of the mission were brought together"),
    (f"L0/{DISCARDED}/", "set aside by recovery; it was never stored"),
    ("L2/", "products without a manifest, made again from Level-0 (syntopic process)"),
    ("L3/", "products, made again from Level-2 (syntopic pansharpen)"),
    ("manifests/", "hashes of products, written again with them (syntopic process)"),
    ("export/", "derived from the mission for other programs"),
)
"""Beginning of a path, and why such a file has no hash."""


@dataclass(frozen=True)
class UncoveredFiles:
    """Files whose content no hash covers, by their paths in the mission, and why."""

    reason: str
    files: tuple[str, ...]


@dataclass
class Inventory:
    """Plain files with their size in bytes and folders, by path in the mission.

    `odd` are links, pipes and devices, `unreadable` folders with the reason; neither is followed.
    """

    files: dict[str, int] = field(default_factory=dict)
    folders: list[str] = field(default_factory=list)
    special_files: list[str] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)
    _names: dict[str, list[str]] = field(default_factory=dict)

    def below(self, folder: str) -> list[str]:
        """Names of plain files and folders directly in a folder, in order."""
        return self._names.get(folder, [])

    def add(self, folder: str, name: str) -> None:
        """Note the name of a plain file or folder."""
        self._names.setdefault(folder, []).append(name)


def take_inventory(root: Path) -> Inventory:
    """Walk a mission folder. What vanishes meanwhile is left out."""
    found = Inventory()
    waiting = [""]
    while waiting:
        folder = waiting.pop()
        try:
            entries = sorted(os.scandir(root / folder), key=lambda entry: entry.name)
        except FileNotFoundError:
            continue
        except OSError as error:
            found.unreadable[folder] = error.strerror or type(error).__name__
            continue
        for entry in entries:
            path = f"{folder}/{entry.name}" if folder else entry.name
            try:
                if entry.is_dir(follow_symlinks=False):
                    found.folders.append(path)
                    waiting.append(path)
                elif entry.is_file(follow_symlinks=False):
                    found.files[path] = entry.stat(follow_symlinks=False).st_size
                else:
                    found.special_files.append(path)
                    continue
            except OSError:
                continue
            found.add(folder, entry.name)
    return found


def is_unfinished(path: str) -> bool:
    """Whether a path is, or is in, something that does not have its final name yet."""
    return any(part.endswith((durable.PART_SUFFIX, ".replaced")) for part in path.split("/"))


def group(reasons: Mapping[str, str]) -> tuple[UncoveredFiles, ...]:
    """Files by the reason why they are not covered, in the order of their paths."""
    by_reason: dict[str, list[str]] = {}
    for path in sorted(reasons):
        by_reason.setdefault(reasons[path], []).append(path)
    return tuple(UncoveredFiles(reason, tuple(files)) for reason, files in by_reason.items())


def reasons_for(paths: Iterable[str]) -> dict[str, str]:
    """Why each of these files, which no hash covers, has none."""
    return {path: _reason(path) for path in paths}


def _reason(path: str) -> str:
    if is_unfinished(path):
        return UNFINISHED
    return next((reason for start, reason in _REASONS if path.startswith(start)), _FOREIGN_FILE)
