"""One flight log on several disks: its bytes are made once and appended to a file on each.

A disk that refuses keeps its bytes waiting in memory, so that a log never has a hole.
"""

from __future__ import annotations

import errno
import os
import zlib
from collections.abc import Callable
from pathlib import Path

from daemon.mission.store import durable

WAITING_MAX_BYTES = 64_000_000
"""What waits for a disk that refuses; about twenty minutes of the fastest receivers."""


class LogFile:
    """The log's file on one disk. To be used by that disk's thread only.

    Raises:
        OSError: the disk refused to make or extend the file.
    """

    def __init__(self, path: Path, offset: int = 0) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | (0 if offset else os.O_EXCL)
        self._descriptor = os.open(path, flags, 0o644)
        os.ftruncate(self._descriptor, offset)
        os.lseek(self._descriptor, offset, os.SEEK_SET)
        durable.sync_directory(path.parent)
        self._waiting = bytearray()
        self.lost_bytes = 0

    def append(self, data: bytes) -> None:
        """Hand bytes to the kernel, after those that it refused earlier.

        Raises:
            OSError: the disk refused; the bytes wait, up to `WAITING_MAX_BYTES`.
        """
        if self.lost_bytes or len(self._waiting) + len(data) > WAITING_MAX_BYTES:
            # A later byte in an earlier one's place would make the whole log unreadable.
            self.lost_bytes += len(data)
            raise OSError(errno.ENOSPC, "the flight log ends here, too much is waiting for it")
        self._waiting += data
        while self._waiting:
            count = os.write(self._descriptor, self._waiting)
            del self._waiting[:count]

    def sync(self) -> None:
        """Put on the disk what was appended.

        Raises:
            OSError: the disk refused.
        """
        if not self.lost_bytes:
            self.append(b"")
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


class SharedStream:
    """What a `FlightLog` writes to: hands each piece to `append`, and never refuses.

    Args:
        append: takes the bytes for every disk.
        sync: has every disk sync its file.
    """

    def __init__(self, append: Callable[[bytes], None], sync: Callable[[], None]) -> None:
        self._append = append
        self._sync = sync
        self.offset = 0
        self.crc32 = 0
        self.is_closed = False

    def write(self, data: bytes) -> int:
        self._append(bytes(data))
        self.offset += len(data)
        self.crc32 = zlib.crc32(data, self.crc32)
        return len(data)

    def tell(self) -> int:
        return self.offset

    def flush(self) -> None:
        """Nothing is held back."""

    def sync(self) -> None:
        self._sync()

    def close(self) -> None:
        self.is_closed = True
