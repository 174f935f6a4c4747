"""Memory for frames that several processes share and a kill leaves nothing of.

Each head has a ring of slots in one memfd; a ring given to a process as an argument travels there
as its file descriptor. Who may touch a slot is decided by messages, not here.
"""

from __future__ import annotations

import mmap
import os
from multiprocessing import reduction
from typing import Any

import numpy as np
from numpy.typing import NDArray


class FrameRing:
    """`slot_count` slots of `slot_nbytes` bytes each, page-aligned."""

    def __init__(self, head: str, slot_count: int, slot_nbytes: int, descriptor: int) -> None:
        self.head = head
        self._slot_count = slot_count
        self._slot_nbytes = slot_nbytes
        self._stride = -(-slot_nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
        self._descriptor = descriptor
        self._map = mmap.mmap(descriptor, self._stride * slot_count, mmap.MAP_SHARED)
        self._bytes: NDArray[np.uint8] = np.frombuffer(self._map, np.uint8)

    @classmethod
    def create(cls, head: str, slot_count: int, slot_nbytes: int) -> FrameRing:
        """Allocate a ring; its pages are reserved now, so that a flight never runs out of them."""
        descriptor = os.memfd_create(f"syntopic-{head}", os.MFD_CLOEXEC)
        stride = -(-slot_nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
        os.posix_fallocate(descriptor, 0, stride * slot_count)
        return cls(head, slot_count, slot_nbytes, descriptor)

    def __reduce__(self) -> tuple[Any, ...]:
        """Travels to a child that is being spawned as its file descriptor, and is mapped there."""
        descriptor = reduction.DupFd(self._descriptor)
        return (_attach, (self.head, self._slot_count, self._slot_nbytes, descriptor))

    @property
    def slot_count(self) -> int:
        return self._slot_count

    @property
    def slot_nbytes(self) -> int:
        return self._slot_nbytes

    def address(self, slot: int) -> int:
        """Address of a slot in this process."""
        return int(self._bytes.ctypes.data) + self._offset(slot)

    def frame(self, slot: int, height_px: int, width_px: int) -> NDArray[np.uint16]:
        """The pixels of a slot, shape (height, width), without copying."""
        start = self._offset(slot)
        nbytes = height_px * width_px * 2
        if nbytes > self._slot_nbytes:
            raise ValueError(
                f"{self.head}: a frame of {width_px} x {height_px} px needs {nbytes} bytes, "
                f"a slot has {self._slot_nbytes}"
            )
        pixels = self._bytes[start : start + nbytes].view(np.uint16)
        return pixels.reshape(height_px, width_px)

    def _offset(self, slot: int) -> int:
        if not 0 <= slot < self._slot_count:
            raise ValueError(f"{self.head}: slot {slot} of a ring of {self._slot_count}")
        return slot * self._stride


def _attach(head: str, slot_count: int, slot_nbytes: int, descriptor: Any) -> FrameRing:
    return FrameRing(head, slot_count, slot_nbytes, descriptor.detach())
