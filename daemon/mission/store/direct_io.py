"""Large files written past the page cache: pixels go from where they lie to the disk.

A copy of every pixel into the page cache costs more of a core than making a tenth of them. Frames
(`daemon.mission.store.store`) and rasters (`daemon.mission.store.level2`) are written so; all else
goes by `daemon.mission.store.durable`.
"""

from __future__ import annotations

import errno
import mmap
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from daemon.mission.store import durable

BLOCK = 4096
"""Addresses, places in the file and lengths are multiples of it, as disks ask."""

DIRECT_MIN_BYTES = 1 << 20
_BUFFER_BYTES = 4 << 20


def create_file(path: Path, parts: Sequence[bytes | memoryview], *, mode: int = 0o444) -> int:
    """Like `durable.create_file`, without the page cache where the file is large and the disk
    allows.

    Parts that lie in memory as they lie in the file, on a multiple of `BLOCK`, are never copied.

    Returns:
        The number of bytes written.

    Raises:
        OSError: the disk refused; what was begun is left for the caller to clear.
    """
    total = sum(memoryview(part).nbytes for part in parts)
    if total < DIRECT_MIN_BYTES:
        return durable.create_file(path, parts, mode=mode)
    descriptor = _open(path, mode)
    if descriptor is None:
        return durable.create_file(path, parts, mode=mode)
    try:
        os.posix_fallocate(descriptor, 0, total)  # a full disk fails before the first byte
        written = _write_all(descriptor, parts)
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
    else:
        return written
    finally:
        os.close(descriptor)
    # Blocks larger than ours, or a file system that only fails now.
    path.unlink()
    return durable.create_file(path, parts, mode=mode)


def _open(path: Path, mode: int) -> int | None:
    """A new file's descriptor, None where its file system has no way past the cache."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    try:
        return os.open(path, flags | os.O_DIRECT, mode)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
    # Some make the file before they refuse it.
    path.unlink(missing_ok=True)
    return None


def _write_all(descriptor: int, parts: Sequence[bytes | memoryview]) -> int:
    """One call writes all, as long as what has to be gathered fits into the buffer."""
    total = filled = taken = 0
    buffer = memoryview(mmap.mmap(-1, _BUFFER_BYTES))
    waiting: list[memoryview] = []
    for part in parts:
        left = memoryview(part).cast("B")
        total += len(left)
        if filled % BLOCK == 0 and _address(left) % BLOCK == 0 and len(left) >= BLOCK:
            aligned_nbytes = len(left) // BLOCK * BLOCK
            waiting += [buffer[taken:filled], left[:aligned_nbytes]]
            taken = filled
            left = left[aligned_nbytes:]
        while left:
            count = min(len(left), len(buffer) - filled)
            buffer[filled : filled + count] = left[:count]
            left = left[count:]
            filled += count
            if filled == len(buffer):
                durable.write_all(descriptor, [*waiting, buffer[taken:]])
                waiting.clear()
                filled = taken = 0
    durable.write_all(descriptor, [*waiting, buffer[taken : -(-filled // BLOCK) * BLOCK]])
    os.ftruncate(descriptor, total)
    return total


def _address(data: memoryview) -> int:
    return int(np.frombuffer(data, np.uint8).ctypes.data) if len(data) else 0
