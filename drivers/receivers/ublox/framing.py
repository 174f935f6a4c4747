"""UBX frames out of a stream of bytes: which bytes are a message, and which are not.

What a message means is in `drivers.receivers.ublox.decoder`. The result does not depend on how the
bytes were cut into pieces on arrival.

Source: u-blox M8 receiver description, UBX-13003221, section 32.2.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Final

SYNC: Final = b"\xb5\x62"
OVERHEAD: Final = 8
"""Sync, class, identity, length and checksum around a payload."""
MAX_PAYLOAD: Final = 8192
"""No message of the receivers we know is longer; a longer one is a damaged length."""
CLASSES: Final = frozenset(
    (0x01, 0x02, 0x04, 0x05, 0x06, 0x09, 0x0A, 0x0B, 0x0D, 0x10, 0x13, 0x21, 0x27, 0x28, 0x29)
)
PRINTABLE: Final = bytes((9, 10, 13, *range(32, 127)))
"""NMEA sentences and the like are not ours, but not damage either."""


class UbxFramer:
    """Cuts whole, checksummed UBX frames out of a stream.

    A damaged frame costs itself only: the search goes on behind its sync, and a candidate that
    holds another whole frame is given up at once rather than waited for. `lengths` names messages
    whose payload has one length only: (class, identity) to bytes.

    Every byte is in exactly one of `frame_bytes`, `other_bytes` (printable), `bad_bytes` or still
    `pending`.
    """

    def __init__(self, lengths: dict[tuple[int, int], int] | None = None) -> None:
        self._lengths = dict(lengths or {})
        self._buffer = b""
        self.frames = 0
        self.bad_frames = 0
        self.frame_bytes = 0
        self.other_bytes = 0
        self.bad_bytes = 0

    @property
    def pending(self) -> int:
        """Bytes of a frame that is not whole yet."""
        return len(self._buffer)

    def reset(self) -> None:
        """Forget a half received frame; its bytes are counted as bad."""
        self._skip(self._buffer)
        self._buffer = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Add bytes of the stream.

        Args:
            data: bytes as received, cut anywhere.

        Returns:
            The frames that became complete with them, sync and checksum included.
        """
        buffer = self._buffer + data
        found = []
        at = 0
        while True:
            sync = buffer.find(SYNC, at)
            if sync < 0:
                end = len(buffer) - buffer.endswith(SYNC[:1])
                self._skip(buffer[at:end])
                at = max(at, end)
                break
            self._skip(buffer[at:sync])
            at = sync
            size = self._frame_size(buffer, at, complete_only=False)
            if size is None:
                break
            if size == 0:
                self._skip(buffer[at : at + 2])
                at += 2
                continue
            found.append(buffer[at : at + size])
            self.frames += 1
            self.frame_bytes += size
            at += size
        self._buffer = buffer[at:]
        return found

    def _frame_size(self, buffer: bytes, at: int, *, complete_only: bool) -> int | None:
        """Size of the frame at a sync; 0 if there is none, None if that is not known yet."""
        head = buffer[at : at + 6]
        if len(head) > 2 and head[2] not in CLASSES:
            return 0
        if len(head) < 6:
            return None
        payload = head[4] | head[5] << 8
        if payload != self._lengths.get((head[2], head[3]), payload) or payload > MAX_PAYLOAD:
            return 0
        end = at + OVERHEAD + payload
        if end <= len(buffer) and not _checksum_fits(buffer[at + 2 : end]):
            self.bad_frames += not complete_only
            return 0
        if complete_only:
            return end - at if end <= len(buffer) else 0
        # A frame inside the payload means that this sync was not one, or its length is damaged.
        inner = buffer.find(SYNC, at + 2, end)
        while inner >= 0:
            if self._frame_size(buffer[:end], inner, complete_only=True):
                self.bad_frames += 1
                return 0
            inner = buffer.find(SYNC, inner + 1, end)
        return end - at if end <= len(buffer) else None

    def _skip(self, data: bytes) -> None:
        bad = len(data.translate(None, PRINTABLE))
        self.bad_bytes += bad
        self.other_bytes += len(data) - bad


def _checksum_fits(body: bytes) -> bool:
    """Whether the last two bytes are the Fletcher checksum of those before."""
    covered = body[:-2]
    a = sum(covered) & 0xFF
    b = sum(accumulate(covered)) & 0xFF
    return (a, b) == (body[-2], body[-1])
