"""Calibration maps that the processes of one machine have in memory once.

Every process reads the calibrations itself. Then it looks for a file with the same maps, writes one
where there is none, and takes its own maps from that file: pages of a mapped file are in memory
once. Maps are taken only where they equal its own bit by bit, so that neither a file that is half
written nor an exchanged one changes a product. The lock of a file ends with its process; a file
that no process holds is removed by the next one.
"""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import mmap
import os
import random
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.radiometry.corrector import Corrector

Array = NDArray[Any]

LEAST_NBYTES: Final = 16_000_000
"""Smaller maps are not worth a file."""
FREE_FACTOR: Final = 2
"""Free space of the disk for temporary files, in sizes of the maps, below which none is written."""
WAIT_S: Final = 60.0
"""How long another process may write the file."""
_MAPS: Final = ("bias", "dark", "response")
_ALIGNMENT: Final = 64
_SUFFIX: Final = ".maps"
_held: list[int] = []
"""Descriptors with locks; they end with the process."""


def share_maps(correctors: dict[str, Corrector]) -> bool:
    """Replace maps by equal ones that other processes of this user and machine have as well.

    Args:
        correctors: by sensor name; replaced in place.

    Returns:
        Whether they are shared now. Where the disk permits no file, they are as they were.
    """
    nbytes = sum(_aligned(one.nbytes) for _, _, one in _maps(correctors))
    if nbytes < LEAST_NBYTES:
        return False
    try:
        folder = _folder()
        _remove_unused(folder)
        descriptor = _opened(folder / f"{_digest(correctors)}{_SUFFIX}", correctors, nbytes)
        if descriptor is None:
            return False
        # Writable for kernels that are compiled for writable maps; a write would copy the page.
        memory = mmap.mmap(
            descriptor, nbytes, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ | mmap.PROT_WRITE
        )
    except (OSError, ValueError):
        return False
    shared = _taken(correctors, memory)
    if shared is None:
        os.close(descriptor)
        return False
    _held.append(descriptor)
    correctors.update(shared)
    with suppress(OSError, AttributeError):  # freed maps go back to the system (glibc)
        ctypes.CDLL(None).malloc_trim(0)
    return True


def has_room(nbytes: int) -> bool:
    """Whether a file for maps of this size would be written now.

    Args:
        nbytes: of all maps.
    """
    try:
        disk = os.statvfs(tempfile.gettempdir())
    except OSError:
        return False
    return nbytes >= LEAST_NBYTES and disk.f_bavail * disk.f_frsize >= FREE_FACTOR * nbytes


def _maps(correctors: dict[str, Corrector]) -> Iterator[tuple[str, str, Array]]:
    for name, corrector in sorted(correctors.items()):
        for key in _MAPS:
            found = getattr(corrector, key)
            if found is not None:
                yield name, key, found


def _aligned(nbytes: int) -> int:
    return -(-nbytes // _ALIGNMENT) * _ALIGNMENT


def _digest(correctors: dict[str, Corrector]) -> str:
    digest = hashlib.sha256()
    for name, key, one in _maps(correctors):
        digest.update(f"{name} {key} {one.dtype} {one.shape}\0".encode())
        digest.update(np.ascontiguousarray(one).data)
    return digest.hexdigest()


def _folder() -> Path:
    """The folder of this user.

    Raises:
        OSError: it cannot be made, or others may write there.
    """
    folder = Path(tempfile.gettempdir()) / f"syntopic-maps-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise OSError(f"{folder} is not a folder of this user alone")
    return folder


def _remove_unused(folder: Path) -> None:
    for path in folder.glob(f"*{_SUFFIX}"):
        with suppress(OSError):
            descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
            finally:
                os.close(descriptor)


def _opened(path: Path, correctors: dict[str, Corrector], nbytes: int) -> int | None:
    """A descriptor of the whole file with a shared lock; None where it cannot be had.

    Raises:
        OSError: the disk refused.
    """
    limit_s = time.monotonic() + WAIT_S
    while time.monotonic() < limit_s:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            if _is_whole(descriptor, correctors, nbytes):
                kept, descriptor = descriptor, -1
                return kept
        except BlockingIOError:
            time.sleep(random.uniform(0.02, 0.2))  # another process writes, or tries to
        finally:
            if descriptor >= 0:
                os.close(descriptor)
    return None


def _is_whole(descriptor: int, correctors: dict[str, Corrector], nbytes: int) -> bool:
    """Lock the file, and write it where it is not whole; whether it has a name and the lock.

    Raises:
        BlockingIOError: another process has it.
        OSError: the disk refused, or is nearly full.
    """
    fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    if os.fstat(descriptor).st_size != nbytes:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        disk = os.fstatvfs(descriptor)
        if disk.f_bavail * disk.f_frsize < FREE_FACTOR * nbytes:
            raise OSError("the disk for temporary files is nearly full")
        os.ftruncate(descriptor, 0)
        # The size is complete with the last byte alone.
        with open(descriptor, "wb", closefd=False) as file:
            for _, _, one in _maps(correctors):
                file.write(np.ascontiguousarray(one).data)
                file.write(bytes(_aligned(one.nbytes) - one.nbytes))
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    return os.fstat(descriptor).st_nlink > 0


def _taken(correctors: dict[str, Corrector], memory: mmap.mmap) -> dict[str, Corrector] | None:
    """Correctors with maps of a file; None where one differs."""
    given: dict[str, dict[str, Any]] = {}
    offset = 0
    for name, key, one in _maps(correctors):
        found = np.frombuffer(memory, one.dtype, one.size, offset).reshape(one.shape)
        if not np.array_equal(found, one):
            return None
        given.setdefault(name, {})[key] = found
        offset += _aligned(one.nbytes)
    return {name: replace(correctors[name], **maps) for name, maps in given.items()}
