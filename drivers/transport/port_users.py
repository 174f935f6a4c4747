"""Programs that have a serial port open, as far as this user may see them.

If two programs read a port, each receives a part of the bytes. The kernel shows open files only to
the owner of the process and to root. It shows locks to every user.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

PROC: Final = Path("/proc")
LOCK_FOLDERS: Final = (Path("/run/lock"), Path("/var/lock"))
"""Folder of lock files such as `LCK..ttyUSB0` (Filesystem Hierarchy 3.0, 5.9)."""

PTS_MAJORS: Final = range(136, 144)
"""Device numbers of pseudo-terminals (Linux: Documentation/admin-guide/devices.txt)."""

_HINTS: Final = {
    "ModemManager": "run: systemctl stop ModemManager",
    "gpsd": "run: systemctl stop gpsd.socket gpsd, or use driver gpsd",
    "agetty": "disable the login on this port: systemctl disable --now serial-getty@NAME",
    "syntopic": "end that service, or query it: syntopic check CONFIG",
}


@dataclass(frozen=True)
class PortHolder:
    """A process that has a port open."""

    pid: int
    name: str

    def __str__(self) -> str:
        return f"{self.name} (process {self.pid})"


def holders(path: str) -> list[PortHolder]:
    """Processes that use a port, including this one, as far as this user may see them.

    These are the processes that locked it; if it is not locked, those that have it open; if none is
    visible, the one that a lock file names.

    Args:
        path: the port; links such as those in /dev/serial/by-id are followed.

    Returns:
        The processes; empty if none is visible or `path` is no character device.
    """
    return _seen(path, lockers_first=True)


def other_holders(path: str) -> list[PortHolder]:
    """Other processes that have a port open, locked or not; for a port that this one has locked.

    Args:
        path: the port, as for `holders`.

    Returns:
        The processes. Empty for a pseudo-terminal: the program that created it may keep both of its
        ends open.
    """
    if is_pseudo_terminal(path):
        return []
    return [holder for holder in _seen(path, lockers_first=False) if holder.pid != os.getpid()]


def is_pseudo_terminal(path: str) -> bool:
    """Whether a port is a pseudo-terminal, such as an emulated receiver's.

    Args:
        path: the port; links are followed.

    Returns:
        By the device number; False if there is no such port.
    """
    with suppress(OSError):
        return os.major(Path(path).stat().st_rdev) in PTS_MAJORS
    return False


def port_in_use_sentence(path: str, found: list[PortHolder]) -> str:
    """The users of a port, and the remedy.

    Args:
        path: the port.
        found: the result of `holders` or `other_holders`.

    Returns:
        The end of a sentence, without a full stop.
    """
    others = [holder for holder in found if holder.pid != os.getpid()]
    if others:
        hints = [_HINTS[holder.name] for holder in others if holder.name in _HINTS]
        name = Path(path).resolve().name
        hint = hints[0].replace("NAME", name) if hints else "end that program"
        return f"it is in use by {' and '.join(str(holder) for holder in others)}; {hint}"
    if found:
        return "this program has it open already; configure a separate port for each device"
    return f"it is in use by a program that this user cannot see; run: sudo fuser -v {path}"


def _seen(path: str, *, lockers_first: bool) -> list[PortHolder]:
    try:
        port = Path(path).stat()
    except OSError:
        return []
    if not stat.S_ISCHR(port.st_mode):
        return []
    found = _flock_owners(port) if lockers_first else []
    found = found or [pid for pid in _processes() if _has_open(pid, port.st_rdev)]
    return [PortHolder(pid, _name(pid)) for pid in found or _lock_file_owners(path)]


def _processes() -> Iterator[int]:
    for entry in os.scandir(PROC):
        if entry.name.isdigit():
            yield int(entry.name)


def _has_open(pid: int, device: int) -> bool:
    try:
        descriptors = list((PROC / str(pid) / "fd").iterdir())
    except OSError:
        return False  # ended meanwhile, or of another user
    for descriptor in descriptors:
        with suppress(OSError):
            status = descriptor.stat()
            if stat.S_ISCHR(status.st_mode) and status.st_rdev == device:
                return True
    return False


def _flock_owners(port: os.stat_result) -> list[int]:
    """Source: proc_locks(5): number, FLOCK, ADVISORY, WRITE, process, major:minor:inode, ..."""
    place = f"{os.major(port.st_dev):02x}:{os.minor(port.st_dev):02x}:{port.st_ino}"
    try:
        lines = (PROC / "locks").read_text("ascii").splitlines()
    except OSError:
        return []
    lock_fields = [line.split() for line in lines]
    return [int(w[4]) for w in lock_fields if len(w) > 5 and w[1] == "FLOCK" and w[5] == place]


def _lock_file_owners(path: str) -> list[int]:
    names = {Path(path).name, Path(path).resolve().name}
    for file in (folder / f"LCK..{name}" for folder in LOCK_FOLDERS for name in sorted(names)):
        with suppress(OSError, ValueError):
            pid = int(file.read_text("ascii").split()[0])
            if (PROC / str(pid)).is_dir():
                return [pid]
    return []


def _name(pid: int) -> str:
    """The program's name; for an interpreter that runs this product, the script's name."""
    try:
        arguments = (PROC / str(pid) / "cmdline").read_bytes().split(b"\0")
        name = (PROC / str(pid) / "comm").read_text("utf-8", "replace").strip()
    except OSError:
        return "a program"
    ours = any(Path(os.fsdecode(argument)).name == "syntopic" for argument in arguments[:2])
    return "syntopic" if ours else name
