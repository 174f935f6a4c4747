"""Primitives that make bytes, names and folders survive a power cut.

What is written with them, and in which order, is decided by `daemon.mission.store.store`,
`daemon.mission.layout` and `daemon.mission.store.level2`.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
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
    """Replace a file atomically: at any instant it has its old or its new content."""
    with _part_of(path, mode) as (part, descriptor):
        write_all(descriptor, [data])
        os.fsync(descriptor)
        part.rename(path)
    sync_directory(path.parent)


@contextmanager
def new_file(path: Path, *, mode: int = 0o644, replaces: bool = True) -> Iterator[Path]:
    """A file that appears whole under its name when the block ends, or not at all.

    When the block fails or is interrupted, nothing of the new file is left, and an earlier file is
    unchanged.

    Args:
        path: the final name; the folder is created if it is missing.
        mode: permissions of the file.
        replaces: whether an earlier file of this name is replaced.

    Yields:
        An empty file in the same folder, to be written by name.

    Raises:
        FileExistsError: the name is taken, and `replaces` is false.
        OSError: the disk refused.

    Example:
        with new_file(folder / "report.html") as part:
            part.write_text(page, encoding="utf-8")
    """
    make_directories(path.parent)
    if not replaces and path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    with _part_of(path, mode) as (part, _):
        yield part
        sync_file(part)  # a library may have put a file of its own under this name
        if replaces:
            part.rename(path)
        else:
            _rename_to_free_name(part, path)
    sync_directory(path.parent)


@contextmanager
def new_files(folder: Path, *, last: str) -> Iterator[Path]:
    """A set of files that appears in a folder when the block ends, or not at all.

    A new folder appears whole. Where the folder exists, the files are moved into it one by one,
    each whole, and the one named `last` after all others: where it is, the set is complete.

    Yields:
        A folder next to the final one, to write the files into.

    Raises:
        OSError: the disk refused.
    """
    make_directories(folder.parent)
    with _part_of(folder) as (part, _):
        yield part
        names = sorted((p.name for p in part.iterdir()), key=lambda name: (name == last, name))
        for path in (*part.rglob("*"), part):
            sync_file(path)
        if not folder.exists():
            part.rename(folder)
        else:
            for name in names:
                if name == last:
                    sync_directory(folder)
                (part / name).rename(folder / name)
            sync_directory(folder)
    sync_directory(folder.parent)


def is_part_of(part: str, name: str) -> bool:
    """Whether `part` is the name of an unfinished file that is to be called `name`."""
    pattern = rf"\.{re.escape(name)}(\.[0-9a-f]{{8}})?{re.escape(PART_SUFFIX)}"
    return re.fullmatch(pattern, part) is not None


def remove_parts(path: Path) -> bool:
    """Remove what killed writers left of a file or a set; what a living writer holds stays.

    Returns:
        Whether anything was removed.
    """
    removed = False
    for part in list(path.parent.iterdir()):
        if is_part_of(part.name, path.name):
            with suppress(OSError):  # its writer lives, or has just finished
                descriptor = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    remove_tree(part)
                    removed = True
                finally:
                    os.close(descriptor)
    return removed


@contextmanager
def _part_of(path: Path, mode: int | None = None) -> Iterator[tuple[Path, int]]:
    """An empty part file of a name of its own, locked, and removed unless it was renamed.

    Without `mode` it is a folder.
    """
    remove_parts(path)
    part, descriptor = _begin_part(path, mode)
    try:
        yield part, descriptor
    finally:
        os.close(descriptor)
        remove_tree(part)


def _begin_part(path: Path, mode: int | None) -> tuple[Path, int]:
    while True:
        part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PART_SUFFIX}")
        if mode is None:
            part.mkdir()
        flags = (
            os.O_RDONLY | os.O_DIRECTORY if mode is None else os.O_WRONLY | os.O_CREAT | os.O_EXCL
        )
        try:
            descriptor = os.open(part, flags | os.O_CLOEXEC, mode or 0)
        except FileNotFoundError:
            continue  # `remove_parts` came between the two calls
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_ours = os.fstat(descriptor).st_nlink > 0
        except BlockingIOError:
            is_ours = False
        except OSError:
            is_ours = True  # a file system without locks: no process removes it either
        if is_ours:
            return part, descriptor
        os.close(descriptor)


def _rename_to_free_name(part: Path, path: Path) -> None:
    try:
        os.link(part, path)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
        # No hard links, as on FAT: another writer of the same name in this instant is not noticed.
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from error
        part.rename(path)


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
    """Remove a folder of files, or of folders of files; nothing happens where it is not there.

    Of a link only the link is removed, not what it leads to.
    """
    if path.is_symlink():
        path.unlink(missing_ok=True)
        return
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
    with suppress(FileNotFoundError):  # somebody else removed it at the same time
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
    """Free bytes for an unprivileged writer on the disk that holds `path`."""
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
