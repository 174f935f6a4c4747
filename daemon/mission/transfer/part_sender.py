"""A file read and sent in parts, of which a store may have some: common to all kinds of stores."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPException
from typing import Final, Protocol, TypeAlias

from daemon import DaemonError
from daemon.mission.transfer.object_store import PART_BYTES, ByteProgress
from daemon.mission.transfer.s3_uploads import UnfinishedUploads

PARTS_IN_WORK: Final = 2
"""Of one file; each is in memory while it is sent."""
ERRORS: Final = (OSError, HTTPException, ValueError)
"""Of `PartUploads.send`."""

ReadPart: TypeAlias = Callable[[int, int], bytes]
"""The content of a file from an offset, so many bytes."""


class InterruptedUploadError(DaemonError):
    """The command ends; parts that were sent are continued by the next one."""


class PartUploads(Protocol):
    """Uploads in parts below a folder of a store."""

    def send(self, name: str, read: ReadPart, nbytes: int, sent: ByteProgress) -> None:
        """Send the parts that the store does not have, and complete the object.

        Args:
            name: of the object.
            read: its content; called by several threads.
            nbytes: its size.
            sent: called with the size of each part once the store has it.

        Raises:
            StoreRefusedError: the store refused.
            OSError, HTTPException: it did not answer in every attempt.
            InterruptedUploadError: `stop` was called.
            ValueError: not an answer of such a store.
        """

    def stop(self) -> None:
        """Begin no further part."""

    def end(self) -> UnfinishedUploads:
        """What happened to uploads of earlier runs."""


class PartSender:
    """Sends parts until it is stopped, and counts those that the store had."""

    def __init__(self) -> None:
        self.reused_nbytes = 0
        self._lock, self._stopping = threading.Lock(), threading.Event()

    def stop(self) -> None:
        """Begin no further part."""
        self._stopping.set()

    def send(
        self,
        read: ReadPart,
        nbytes: int,
        sent: ByteProgress,
        *,
        present: Callable[[int, bytes], str],
        put: Callable[[int, bytes], str],
    ) -> list[str]:
        """Tags of all parts of a file, in their order.

        Args:
            read: its content; called by several threads.
            nbytes: its size.
            sent: called with the size of each part once the store has it.
            present: the tag of a part that the store has, by number from 1 and content; else empty.
            put: sends a part and returns its tag.

        Raises:
            InterruptedUploadError: `stop` was called.
        """

        def part(number: int) -> str:
            if self._stopping.is_set():
                raise InterruptedUploadError("interrupted")
            offset = (number - 1) * PART_BYTES
            data = read(offset, min(PART_BYTES, nbytes - offset))
            if tag := present(number, data):
                with self._lock:
                    self.reused_nbytes += len(data)
            else:
                tag = put(number, data)
            sent(len(data))
            return tag

        pool = ThreadPoolExecutor(PARTS_IN_WORK)
        try:
            return list(pool.map(part, range(1, -(-nbytes // PART_BYTES) + 1)))
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
