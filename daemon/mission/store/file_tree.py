"""The files below one folder, reached by directory descriptors, so that no link is ever followed.

`daemon.mission.transfer.transfer` copies from one such tree into another. A link, pipe or device
anywhere in a tree is an error: it would lead out of the folder that the user named.
"""

from __future__ import annotations

import errno
import hashlib
import mmap
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from daemon import DaemonError
from daemon.mission.store import durable

BLOCK_BYTES = 4 << 20

_FOLDER_FLAGS = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
# Without O_NONBLOCK a pipe put in the place of a file would block the open for ever.
_FILE_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_NEW_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC

ByteProgress = Callable[[int], None]


class TreeError(DaemonError):
    """Something in a tree is neither a plain file nor a folder, or changed while it was read."""


@dataclass(frozen=True)
class FileEntry:
    """A file of a tree: its name relative to the root, with '/' between folders."""

    name: str
    nbytes: int
    modified_ns: int


class FileTree:
    """An open folder. `path` only serves messages; every access starts at `descriptor`."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self.descriptor = descriptor

    @classmethod
    @contextmanager
    def open(cls, path: Path) -> Iterator[FileTree]:
        """Open a folder that exists.

        Raises:
            TreeError: the last component of `path` is a link or not a folder.
        """
        try:
            descriptor = os.open(path, _FOLDER_FLAGS)
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.ENOTDIR):
                raise
            raise TreeError(f"{path} is a link or not a folder; name the folder itself") from error
        try:
            yield cls(path, descriptor)
        finally:
            os.close(descriptor)

    def is_same(self, other: FileTree) -> bool:
        """Whether both are one folder, reached by different paths or mounts."""
        return os.path.sameopenfile(self.descriptor, other.descriptor)

    def list_entries(self) -> tuple[list[str], list[FileEntry]]:
        """All folders and all files, each folder before what it holds, sorted by name.

        Raises:
            TreeError: a link, pipe, socket or device.
        """
        folders: list[str] = []
        files: list[FileEntry] = []
        self._list_entries("", folders, files)
        return folders, files

    def size(self, name: str) -> int | None:
        """The size of a file in bytes; None where there is none.

        Raises:
            TreeError: the name belongs to something else.
        """
        folder, _, last = name.rpartition("/")
        try:
            with self._folder(folder) as parent:
                status = os.stat(last, dir_fd=parent, follow_symlinks=False)
        except FileNotFoundError:
            return None
        if not stat.S_ISREG(status.st_mode):
            raise self._not_plain(name)
        return status.st_size

    def read_small(self, name: str) -> bytes:
        """The content of a file that fits into memory."""
        with self.reading(name) as descriptor, os.fdopen(os.dup(descriptor), "rb") as file:
            return file.read()

    def sha256(self, name: str, step: ByteProgress, *, from_disk: bool) -> str:
        """Hash a file.

        Args:
            name: of the file.
            step: called with the number of bytes read, block by block.
            from_disk: drop the file from the page cache and read it with O_DIRECT, so that the
                bytes come from the device. Where the file system refuses O_DIRECT, dropping the
                cache (`POSIX_FADV_DONTNEED` after fsync) is all that can be done.
        """
        with self.reading(name, direct=from_disk) as descriptor:
            if from_disk:
                with suppress(OSError):  # a read-only medium has nothing to be synced
                    os.fsync(descriptor)
                os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            try:
                return _sha256(descriptor, step)
            except OSError as error:
                if not from_disk or error.errno != errno.EINVAL:
                    raise
        return self.sha256(name, step, from_disk=False)

    def make_folder(self, name: str) -> None:
        """Create a folder and what is missing above it; every new name is durable on return."""
        parts = name.split("/")
        for depth in range(len(parts)):
            with self._folder("/".join(parts[:depth])) as parent, suppress(FileExistsError):
                os.mkdir(parts[depth], dir_fd=parent)
                os.fsync(parent)

    def copy_from(self, source: FileTree, entry: FileEntry, step: ByteProgress) -> str:
        """Copy a file of another tree under the same name; it is complete or absent.

        The copy is durable and was read back from the disk when it gets its name.

        Returns:
            The SHA-256 of the bytes read from the source.

        Raises:
            TreeError: the source changed while it was read, or the copy reads back differently.
        """
        folder, _, last = entry.name.rpartition("/")
        part = f".{last}{durable.PART_SUFFIX}"
        part_name = f"{folder}/{part}" if folder else part
        with self._folder(folder) as parent:
            try:
                sha256 = self._write_part(parent, part, source, entry, step)
                if self.sha256(part_name, step, from_disk=True) != sha256:
                    raise TreeError(
                        f"{self.path / entry.name} read back differently from what was written; "
                        "do not use this disk"
                    )
                os.rename(part, last, src_dir_fd=parent, dst_dir_fd=parent)
            except BaseException:
                with suppress(OSError):
                    os.unlink(part, dir_fd=parent)
                raise
            os.fsync(parent)
        return sha256

    def replace(self, name: str, data: bytes) -> None:
        """Replace a file in the root atomically: it always has its old or its new content."""
        part = f".{name}{durable.PART_SUFFIX}"
        with suppress(FileNotFoundError):
            os.unlink(part, dir_fd=self.descriptor)
        descriptor = os.open(part, _NEW_FLAGS, 0o644, dir_fd=self.descriptor)
        try:
            durable.write_all(descriptor, [data])
            os.fsync(descriptor)
            os.rename(part, name, src_dir_fd=self.descriptor, dst_dir_fd=self.descriptor)
        except BaseException:
            with suppress(OSError):
                os.unlink(part, dir_fd=self.descriptor)
            raise
        finally:
            os.close(descriptor)
        os.fsync(self.descriptor)

    def unlink(self, name: str) -> None:
        """Remove a file; nothing happens where it is not there."""
        folder, _, last = name.rpartition("/")
        with suppress(FileNotFoundError), self._folder(folder) as parent:
            os.unlink(last, dir_fd=parent)

    def remove_folder(self, name: str) -> None:
        """Remove an empty folder.

        Raises:
            OSError: it is not empty.
        """
        folder, _, last = name.rpartition("/")
        with self._folder(folder) as parent:
            os.rmdir(last, dir_fd=parent)

    def sync_folders(self, folders: list[str]) -> None:
        """Make the names in the root and in these folders durable."""
        for name in ("", *folders):
            with self._folder(name) as descriptor:
                os.fsync(descriptor)

    @contextmanager
    def reading(self, name: str, *, direct: bool = False) -> Iterator[int]:
        """A descriptor of a plain file; with O_DIRECT, where requested and possible."""
        folder, _, last = name.rpartition("/")
        with self._folder(folder) as parent:
            try:
                descriptor = _open_file(parent, last, direct=direct)
            except OSError as error:
                if error.errno == errno.ELOOP:
                    raise self._not_plain(name) from error
                raise
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise self._not_plain(name)
            yield descriptor
        finally:
            os.close(descriptor)

    def _write_part(
        self, parent: int, part: str, source: FileTree, entry: FileEntry, step: ByteProgress
    ) -> str:
        with suppress(FileNotFoundError):
            os.unlink(part, dir_fd=parent)
        digest = hashlib.sha256()
        buffer = memoryview(bytearray(BLOCK_BYTES))
        with source.reading(entry.name) as reading:
            status = os.fstat(reading)
            writing = os.open(part, _NEW_FLAGS, 0o600, dir_fd=parent)
            try:
                while count := os.readv(reading, [buffer]):
                    digest.update(buffer[:count])
                    durable.write_all(writing, [buffer[:count]])
                    step(count)
                after = os.fstat(reading)
                if (after.st_size, after.st_mtime_ns) != (entry.nbytes, entry.modified_ns):
                    raise TreeError(
                        f"{source.path / entry.name} changed while it was copied; "
                        "end what writes there and start again"
                    )
                os.fchmod(writing, stat.S_IMODE(status.st_mode))
                os.utime(writing, ns=(status.st_atime_ns, status.st_mtime_ns))
                os.fsync(writing)
            finally:
                os.close(writing)
        return digest.hexdigest()

    def _list_entries(self, below: str, folders: list[str], files: list[FileEntry]) -> None:
        with self._folder(below) as descriptor:
            items = sorted(os.scandir(descriptor), key=lambda item: item.name)
            statuses = [item.stat(follow_symlinks=False) for item in items]
        for item, status in zip(items, statuses, strict=True):
            name = f"{below}/{item.name}" if below else item.name
            if stat.S_ISDIR(status.st_mode):
                folders.append(name)
                self._list_entries(name, folders, files)
            elif stat.S_ISREG(status.st_mode):
                files.append(FileEntry(name, status.st_size, status.st_mtime_ns))
            else:
                raise self._not_plain(name)

    @contextmanager
    def _folder(self, name: str) -> Iterator[int]:
        """A descriptor of a folder, opened component by component; "" is the root."""
        descriptor = os.dup(self.descriptor)
        try:
            for component in name.split("/") if name else ():
                try:
                    below = os.open(component, _FOLDER_FLAGS, dir_fd=descriptor)
                except OSError as error:
                    if error.errno in (errno.ELOOP, errno.ENOTDIR):
                        raise self._not_plain(name) from error
                    raise
                os.close(descriptor)
                descriptor = below
            yield descriptor
        finally:
            os.close(descriptor)

    def _not_plain(self, name: str) -> TreeError:
        return TreeError(
            f"{self.path / name} is not a plain file or folder; a mission holds no links, pipes "
            "or devices: remove it, or put there what it leads to"
        )


def _open_file(parent: int, name: str, *, direct: bool) -> int:
    if direct:
        try:
            return os.open(name, _FILE_FLAGS | os.O_DIRECT, dir_fd=parent)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):
                raise
    return os.open(name, _FILE_FLAGS, dir_fd=parent)


def _sha256(descriptor: int, step: ByteProgress) -> str:
    """Hash up to the size that the file has now, in blocks whose address and offset are aligned."""
    digest = hashlib.sha256()
    left = os.fstat(descriptor).st_size
    with mmap.mmap(-1, BLOCK_BYTES) as buffer, memoryview(buffer) as view:
        while left > 0:
            count = os.readv(descriptor, [view])
            if not count:
                break  # cut while it was read: the hash will differ
            with view[:count] as data:
                digest.update(data)
            left -= count
            step(count)
    return digest.hexdigest()
