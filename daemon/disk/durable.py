"""Primitives that make bytes, names and folders survive a power cut.

What is written with them, and in which order, is decided by `daemon.disk.store`,
`daemon.disk.mission` and `daemon.disk.level2`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

PART_SUFFIX = ".part"
"""Ends the name of whatever is not whole yet."""


def create_file(path: Path, parts: Sequence[bytes | memoryview], *, mode: int = 0o444) -> int:
    """Create a file that must not exist yet, write `parts` into it in one go, and fsync it.

    Pixels are handed to the kernel where they lie, never copied here.

    Returns:
        The number of bytes written.

    Raises:
        OSError: the disk refused; what was begun is left for the caller to clear.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        written = write_all(descriptor, parts)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    return written


def replace_file(path: Path, data: bytes, *, mode: int = 0o644) -> None:
    """Put a whole new content under a name: old or new is there at any instant, never a mixture."""
    part = path.with_name(f".{path.name}{PART_SUFFIX}")
    part.unlink(missing_ok=True)
    create_file(part, [data], mode=mode)
    part.rename(path)
    sync_directory(path.parent)


def rename_directory(part: Path, final: Path) -> None:
    """Give a finished folder its name: fsync the folder, rename it, fsync the parent.

    The files inside are durable already (`create_file`).
    """
    sync_directory(part)
    part.rename(final)
    sync_directory(final.parent)


def make_directories(path: Path) -> None:
    """Create a folder and what is missing above it; every new name is durable on return."""
    missing = []
    folder = path
    while not folder.is_dir():
        missing.append(folder)
        folder = folder.parent
    for new in reversed(missing):
        new.mkdir(exist_ok=True)
        sync_directory(new.parent)


def remove_tree(path: Path) -> None:
    """Remove a folder of files, or of folders of files; nothing happens where it is not there."""
    try:
        children = list(path.iterdir())
    except FileNotFoundError:
        return
    except NotADirectoryError:
        path.unlink(missing_ok=True)
        return
    for child in children:
        if child.is_dir() and not child.is_symlink():
            remove_tree(child)
        else:
            child.unlink(missing_ok=True)
    path.rmdir()


def sync_directory(path: Path) -> None:
    """Make the names in a folder durable."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_file(path: Path) -> None:
    """Make the bytes durable that somebody else wrote into a file and may not have synced."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def free_bytes(path: Path) -> int:
    """What an unprivileged writer may still put on the disk that holds `path`."""
    status = os.statvfs(path)
    return status.f_bavail * status.f_frsize


def write_all(descriptor: int, parts: Sequence[bytes | memoryview]) -> int:
    """Write parts one after another, however few bytes the disk takes at a time; their number."""
    waiting = [memoryview(part).cast("B") for part in parts if len(part)]
    total = 0
    while waiting:
        count = os.writev(descriptor, waiting)
        total += count
        while waiting and count >= len(waiting[0]):
            count -= len(waiting.pop(0))
        if count:
            waiting[0] = waiting[0][count:]
    return total
