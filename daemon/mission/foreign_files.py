"""Files of others: opened only where they may lie, only if they are plain, and only up to a size.

Their readers interpret the bytes. No name found in a mission, a project or
a series reaches a library that would follow it to a network, a pipe or another folder.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from daemon import DaemonError

_LOCAL_FILE_SYSTEMS = frozenset(
    [
        "bcachefs",
        "btrfs",
        "exfat",
        "ext2",
        "ext3",
        "ext4",
        "f2fs",
        "fuseblk",
        "iso9660",
        "jfs",
        "ntfs",
        "ntfs3",
        "overlay",
        "ramfs",
        "rootfs",
        "squashfs",
        "tmpfs",
        "udf",
        "vfat",
        "xfs",
        "zfs",
    ]
)


class ForeignFileError(DaemonError, ValueError):
    """A file that is not opened; the message names it, the finding and the remedy."""


def within(folder: Path, name: str, key: str) -> Path:
    """The path of a file that a document names, if it is in the document's folder.

    Args:
        folder: the folder of the document.
        name: the file as the document names it.
        key: its place in the document, for the error message.

    Raises:
        ForeignFileError: an absolute name, one that leaves the folder upwards or by a link, a URL,
            or one with control characters.
    """
    pure = PurePosixPath(name)
    if not name.isprintable() or "://" in name or pure.is_absolute() or ".." in pure.parts:
        raise ForeignFileError(
            f"{key} is {name[:200]!r}; a name within {folder} is needed: put a copy of the file "
            "there and name it so"
        )
    path = folder / pure
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ForeignFileError(
            f"{key} is {name[:200]!r}, a link that leaves {folder}; put a copy of the file there"
        )
    return path


def is_on_local_disk(path: Path) -> bool:
    """Whether an absolute path can be followed without a link, a network or a device.

    Mount points are compared first: a name below an automount or a network file system is not even
    checked, since that alone would open a connection.
    """
    if not path.is_absolute() or ".." in path.parts or not str(path).isprintable():
        return False
    for mount_point, kind in _mounts():
        if path.is_relative_to(mount_point) and kind not in _LOCAL_FILE_SYSTEMS:
            return False
    return not any(place.is_symlink() for place in (path, *path.parents))


def _mounts() -> Iterator[tuple[str, str]]:
    """Mount points and their kinds of file system (proc(5), mountinfo)."""
    for line in Path("/proc/self/mountinfo").read_text("utf-8", "surrogateescape").splitlines():
        fields = line.split(" ")
        point = re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), fields[4])
        yield point, fields[fields.index("-") + 1]


@contextmanager
def open_regular_file(path: Path, max_nbytes: int) -> Iterator[int]:
    """A descriptor of a regular file, open for reading until the block ends.

    What was checked is what is read, even if the path is exchanged meanwhile. Nothing waits: a pipe
    is refused, not opened for its first writer.

    Raises:
        ForeignFileError: no such file, a pipe, a device, a folder, or larger than `max_nbytes`.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ForeignFileError(
            f"{path}: cannot be read ({reason}); give a readable file"
        ) from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise ForeignFileError(
                f"{path}: is no file but a pipe, a device or a folder; give a file"
            )
        if status.st_size > max_nbytes:
            raise ForeignFileError(
                f"{path}: {status.st_size} bytes; at most {max_nbytes} are read from such a file"
            )
        yield descriptor
    finally:
        os.close(descriptor)


def read_regular_file(path: Path, max_nbytes: int) -> bytes:
    """The bytes of a regular file.

    Raises:
        ForeignFileError: as `open_regular_file`, or the disk refused.
    """
    with open_regular_file(path, max_nbytes) as descriptor:
        nbytes = os.fstat(descriptor).st_size
        try:
            with os.fdopen(os.dup(descriptor), "rb") as file:
                data = file.read(nbytes + 1)  # this much is allocated beforehand
        except OSError as error:
            raise ForeignFileError(f"{path}: cannot be read ({error.strerror})") from error
    if len(data) > nbytes:
        raise ForeignFileError(f"{path}: grew while it was read; try again when it is complete")
    return data
