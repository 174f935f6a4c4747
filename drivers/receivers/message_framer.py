"""Whole messages out of a stream of bytes, for protocols with a sync, a length and a checksum.

Each protocol defines length and checksum of a candidate. The result does not depend on
how the bytes were cut into pieces on arrival.
"""

from __future__ import annotations

import re
from collections.abc import Callable

SizeOf = Callable[[bytes, int], int | None]
"""Size of the message that would begin there; 0 if none can, None if that is not known yet."""


class MessageFramer:
    """Cuts whole, checksummed messages out of a stream.

    `starts` are the bytes a message can begin with, `fits` checks whether a complete message's
    checksum is right. A damaged message costs itself only: the search goes on behind its first
    byte, and a candidate that holds another whole message is given up at once rather than waited
    for. `size_of` bounds what is ever kept.
    """

    def __init__(self, starts: bytes, size_of: SizeOf, fits: Callable[[bytes], bool]) -> None:
        self._start = re.compile(b"[" + re.escape(starts) + b"]")
        self._size_of = size_of
        self._fits = fits
        self._buffer = b""
        self.frames = 0
        self.bad_frames = 0
        self.bad_bytes = 0

    @property
    def pending(self) -> int:
        """Bytes of a message that is not whole yet."""
        return len(self._buffer)

    def reset(self) -> None:
        """Forget a half received message; its bytes are counted as bad."""
        self.bad_bytes += len(self._buffer)
        self._buffer = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Add bytes of the stream.

        Args:
            data: bytes as received, cut anywhere.

        Returns:
            The messages that became complete with them, sync and checksum included.
        """
        buffer = self._buffer + data
        found = []
        at = 0
        while True:
            match = self._start.search(buffer, at)
            start = match.start() if match else len(buffer)
            self.bad_bytes += start - at
            at = start
            if match is None:
                break
            size = self._complete_message(buffer, at)
            if size is None:
                break
            if size == 0:
                self.bad_bytes += 1
                at += 1
                continue
            found.append(buffer[at : at + size])
            self.frames += 1
            at += size
        self._buffer = buffer[at:]
        return found

    def _complete_message(self, buffer: bytes, at: int) -> int | None:
        size = self._size_of(buffer, at)
        if size == 0:
            return 0
        # Where the size is not known yet, all that came may belong to the message.
        end = len(buffer) if size is None else at + size
        if size is not None and end <= len(buffer) and not self._fits(buffer[at:end]):
            self.bad_frames += 1
            return 0
        # A message inside means that this start was not one, or that its length is damaged.
        for inner in self._start.finditer(buffer, at + 1, min(end, len(buffer))):
            begin = inner.start()
            inside = self._size_of(buffer, begin) or 0
            within = inside > 0 and begin + inside <= min(end, len(buffer))
            if within and self._fits(buffer[begin : begin + inside]):
                self.bad_frames += 1
                return 0
        return size if end <= len(buffer) else None


def line_size(buffer: bytes, at: int, limit: int) -> int | None:
    """Size of a printable line with its line feed.

    Args:
        buffer: bytes of the stream.
        at: where the line begins with its mark.
        limit: largest size, bytes.

    Returns:
        As SizeOf: bytes; 0 if there is no such line, None if it is not complete yet.
    """
    match = _LINE.match(buffer, at, at + limit)
    end = match.end() if match else at
    if end - at >= limit:
        return 0
    if end == len(buffer):
        return None
    if buffer[end : end + 1] == b"\n":
        return end + 1 - at
    if buffer[end : end + 1] == b"\r":
        if end + 1 == len(buffer):
            return None
        return end + 2 - at if buffer[end + 1 : end + 2] == b"\n" else 0
    return 0


_LINE = re.compile(rb"[#$%!][ -\"&-~]*")
"""A line begins with its mark and holds no other `#`, `$` or `%` (0x23 to 0x25)."""
