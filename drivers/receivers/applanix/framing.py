"""Applanix groups out of a stream of bytes, and their fields.

What a group means is in `drivers.receivers.applanix.decoder`.

Source: Applanix POS AV and POS MV V5 user interface control documents, PUBS-ICD-004089, section 3.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, Final

from drivers.receivers.message_framer import MessageFramer

STARTS: Final = b"$"
SYNCS: Final = (b"$GRP", b"$MSG")
END: Final = b"$#"
HEADER_NBYTES: Final = 8
MIN_LENGTH: Final = 4
MAX_LENGTH: Final = 4096
GROUP: Final = b"$GRP"
TIMES: Final = struct.Struct("<3dBB")
"""Time 1, time 2, distance, and the kinds of each, in front of the data of every group."""
GNSS_HEAD: Final = struct.Struct("<bBH")
GNSS_TAIL: Final = struct.Struct("<3fHIdffHI")
NAMES: Final = {
    1: "Navigation", 2: "Performance", 3: "PrimaryGnss", 7: "Pps",
    5: "Event1", 6: "Event2", 30: "Event3", 31: "Event4", 32: "Event5", 33: "Event6",
}  # fmt: skip
LAYOUTS: Final = {
    "Navigation": struct.Struct("<3d3f4d8fB"),
    "Performance": struct.Struct("<12f"),
    "Pps": struct.Struct("<IB"),
}
_EVENT: Final = struct.Struct("<I")


@dataclass(frozen=True)
class Group:
    """One group: its name, its two times in seconds, the kind of each time, and its values."""

    name: str
    times_s: tuple[float, float]
    time_kinds: tuple[int, int]
    values: tuple[Any, ...]


def applanix_framer() -> MessageFramer:
    """A framer for groups and messages of any number.

    Returns:
        A new framer with an empty buffer.
    """
    return MessageFramer(STARTS, _size_of, _fits)


def group_of(frame: bytes) -> Group | None:
    """Take a whole checked frame apart.

    Args:
        frame: the frame from its sync to its end.

    Returns:
        The group; None for one of no use here.

    Raises:
        struct.error: it is shorter than its kind.
        ValueError: a number in it is infinite or not a number.
    """
    name = NAMES.get(int.from_bytes(frame[4:6], "little")) if frame[:4] == GROUP else None
    if name is None:
        return None
    first_s, second_s, _, kinds, _ = TIMES.unpack_from(frame, HEADER_NBYTES)
    body = frame[HEADER_NBYTES + TIMES.size : -MIN_LENGTH]
    if name == "PrimaryGnss":
        status, satellites, channels_nbytes = GNSS_HEAD.unpack_from(body)
        tail = GNSS_TAIL.unpack_from(body, GNSS_HEAD.size + channels_nbytes)
        values: tuple[Any, ...] = (status, satellites, tail[4], tail[5])
    else:
        values = LAYOUTS.get(name, _EVENT).unpack_from(body)
    if not all(math.isfinite(value) for value in (first_s, second_s, *values)):
        raise ValueError(f"{name} holds a number that is none")
    return Group(name, (first_s, second_s), (kinds & 0x0F, kinds >> 4), values)


def _size_of(buffer: bytes, at: int) -> int | None:
    head = buffer[at : at + HEADER_NBYTES]
    if not any(sync.startswith(head[:4]) for sync in SYNCS):
        return 0
    if len(head) < HEADER_NBYTES:
        return None
    length = head[6] | head[7] << 8
    is_possible = MIN_LENGTH <= length <= MAX_LENGTH and length % 4 == 0
    return HEADER_NBYTES + length if is_possible else 0


def _fits(frame: bytes) -> bool:
    words = struct.unpack(f"<{len(frame) // 2}H", frame)
    return frame.endswith(END) and sum(words) & 0xFFFF == 0
