"""sbgECom frames out of a stream of bytes, and their fields.

What a log means is in `drivers.receivers.sbg.decoder`.

Source: SBG Systems, sbgECom binary protocol and messages reference, version 5.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, Final

from drivers.receivers.message_framer import MessageFramer

STARTS: Final = b"\xff"
SYNC_2: Final = 0x5A
END: Final = 0x33
HEADER_NBYTES: Final = 6
TRAILER_NBYTES: Final = 3
MAX_PAYLOAD: Final = 4086
LOG_CLASS: Final = 0
NAMES: Final = {
    2: "UTC_TIME", 6: "EKF_EULER", 7: "EKF_QUAT", 8: "EKF_NAV", 14: "GPS1_POS", 17: "GPS2_POS",
    24: "EVENT_A", 25: "EVENT_B", 26: "EVENT_C", 27: "EVENT_D", 28: "EVENT_E",
}  # fmt: skip
_EVENT: Final = struct.Struct("<I5H")
_GPS_POS: Final = struct.Struct("<3I3d4fB")
LAYOUTS: Final = {
    "UTC_TIME": struct.Struct("<IHH5biI"),
    "EKF_EULER": struct.Struct("<I6fI"),
    "EKF_QUAT": struct.Struct("<I7fI"),
    "EKF_NAV": struct.Struct("<I6f3d4fI"),
    "GPS1_POS": _GPS_POS,
    "GPS2_POS": _GPS_POS,
}
"""The first value of each is the time stamp; later firmware appends fields."""


@dataclass(frozen=True)
class SbgLog:
    """One log: its name, its time stamp in us since power-on (32 bits, wraps), and its values."""

    name: str
    stamp_us: int
    values: tuple[Any, ...]


def sbg_framer() -> MessageFramer:
    """A framer for frames of any class.

    Returns:
        A new framer with an empty buffer.
    """
    return MessageFramer(STARTS, _size_of, _fits)


def crc(data: bytes) -> int:
    """CRC-16 with the reflected polynomial 0x8408, beginning with 0.

    Args:
        data: bytes that the checksum covers.

    Returns:
        The checksum, 16 bits.

    Example:
        >>> hex(crc(b"123456789"))
        '0x2189'
    """
    value = 0
    for byte in data:
        value = (value >> 8) ^ _TABLE[(value ^ byte) & 0xFF]
    return value


def log_of(frame: bytes) -> SbgLog | None:
    """Take a whole checked frame apart.

    Args:
        frame: the frame with sync, CRC and end.

    Returns:
        The log; None for one of no use here.

    Raises:
        struct.error: it is shorter than its kind.
        ValueError: a number in it is infinite or not a number.
    """
    name = NAMES.get(frame[2]) if frame[3] == LOG_CLASS else None
    if name is None:
        return None
    payload = frame[HEADER_NBYTES:-TRAILER_NBYTES]
    stamp_us, *values = LAYOUTS.get(name, _EVENT).unpack_from(payload)
    if any(isinstance(value, float) and not math.isfinite(value) for value in values):
        raise ValueError(f"{name} holds a number that is none")
    return SbgLog(name, stamp_us, tuple(values))


def _size_of(buffer: bytes, at: int) -> int | None:
    head = buffer[at : at + HEADER_NBYTES]
    if len(head) > 1 and head[1] != SYNC_2:
        return 0
    if len(head) < HEADER_NBYTES:
        return None
    payload = head[4] | head[5] << 8
    return HEADER_NBYTES + payload + TRAILER_NBYTES if payload <= MAX_PAYLOAD else 0


def _fits(frame: bytes) -> bool:
    return frame[-1] == END and crc(frame[2:-TRAILER_NBYTES]) == frame[-3] | frame[-2] << 8


def _entry(byte: int) -> int:
    for _ in range(8):
        byte = (byte >> 1) ^ 0x8408 if byte & 1 else byte >> 1
    return byte


_TABLE: Final = tuple(_entry(byte) for byte in range(256))
