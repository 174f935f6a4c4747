"""A disk of its own for tests: ext4 in a file, on a loop device. Needs root.

It is pulled, fails, fills and stalls as the kernel lets a real file system do.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import struct
import subprocess
from pathlib import Path

SHUTDOWN = 0x8004587D
"""EXT4_IOC_SHUTDOWN, fs/ext4/ext4.h."""
SHUTDOWN_WITHOUT_LOG = 2
FREEZE, THAW = 0xC0045877, 0xC0045878
"""FIFREEZE and FITHAW, linux/fs.h."""


def why_not() -> str | None:
    """Why no loop device is to be had here, or None."""
    if os.geteuid() != 0:
        return "loop devices need root"
    if shutil.which("mkfs.ext4") is None:
        return "mkfs.ext4 is missing: apt-get install e2fsprogs"
    return None if Path("/dev/loop-control").exists() else "this kernel has no loop devices"


class LoopDisk:
    """A file system of so many bytes, mounted at `root`."""

    def __init__(self, folder: Path, name: str, nbytes: int) -> None:
        self.root = folder / name
        self._image = folder / f"{name}.ext4"
        self._filler = self.root / "filler"
        self.root.mkdir()
        with self._image.open("wb") as file:
            file.truncate(nbytes)
        subprocess.run(["mkfs.ext4", "-q", "-F", self._image], check=True)
        self._mount()

    def pull(self) -> None:
        """From now on everything fails, what was not synced is lost, and the folder is empty."""
        self.fail()
        self._unmount()

    def fail(self) -> None:
        """From now on every call ends with an error of input or output."""
        self._ioctl(SHUTDOWN, struct.pack("I", SHUTDOWN_WITHOUT_LOG))

    def freeze(self) -> None:
        """From now on every write waits in the kernel."""
        self._ioctl(FREEZE, b"\0\0\0\0")

    def fill(self) -> None:
        """To the last block."""
        descriptor = os.open(self._filler, os.O_WRONLY | os.O_CREAT, 0o644)
        try:
            for nbytes in (1 << 24, 1 << 12):
                try:
                    while True:
                        os.write(descriptor, bytes(nbytes))
                except OSError:
                    continue
        finally:
            os.close(descriptor)

    def thaw(self) -> None:
        """What waits in the kernel goes on."""
        self._ioctl(THAW, b"\0\0\0\0")

    def free(self) -> None:
        """There is room again."""
        self._filler.unlink()

    def mount_again(self) -> None:
        """The disk is plugged in again; the file system recovers from its journal."""
        if os.path.ismount(self.root):
            self._unmount()
        self._mount()

    def end(self) -> None:
        if os.path.ismount(self.root):
            self._unmount()

    def _mount(self) -> None:
        subprocess.run(["mount", "-o", "loop", self._image, self.root], check=True)

    def _unmount(self) -> None:
        subprocess.run(["umount", "-l", self.root], check=True)

    def _ioctl(self, request: int, argument: bytes) -> None:
        descriptor = os.open(self.root, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.ioctl(descriptor, request, argument)
        finally:
            os.close(descriptor)
