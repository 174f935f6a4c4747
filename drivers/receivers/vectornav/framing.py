"""VectorNav binary output messages out of a stream of bytes, and their fields.

A message lists its groups and the fields of each in its header; its length follows from them. What
fields mean is in `drivers.receivers.vectornav.decoder`.

Source: VectorNav VN-200 user manual UM004, VN-300 user manual UM005, section "User configurable
binary output messages".
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Iterator
from typing import Any, Final

from drivers import DriverError
from drivers.receivers.message_framer import MessageFramer

STARTS: Final = b"\xfa"
CRC_NBYTES: Final = 2
MAX_MESSAGE: Final = 4096
EXTENDED: Final = 0x80
"""Of the byte of groups: a second one follows. No field of those groups is of use here."""
GROUPS: Final = ("common", "time", "imu", "gnss1", "attitude", "ins", "gnss2")
SATELLITE_INFO: Final = -8
RAW_MEASUREMENTS: Final = -28
"""Sizes of fields with a count of items in them; the number is the size of an item."""
_GNSS: Final = (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28, SATELLITE_INFO, RAW_MEASUREMENTS)
SIZES: Final = {
    "common": (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    "time": (8, 8, 8, 2, 8, 8, 8, 4, 4, 1),
    "imu": (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40),
    "gnss1": _GNSS,
    "attitude": (2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24, 12),
    "ins": (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4, 68, 64),
    "gnss2": _GNSS,
}
"""Bytes of the fields of each group, by their bit; a field beyond them is not known."""
NAMES: Final = {
    ("common", 1): "TimeGps", ("common", 2): "TimeSyncIn", ("common", 3): "YawPitchRoll",
    ("common", 4): "Quaternion", ("common", 6): "Position", ("common", 7): "Velocity",
    ("common", 12): "InsStatus", ("common", 13): "SyncInCnt",
    ("time", 1): "TimeGps", ("time", 4): "TimeSyncIn", ("time", 7): "SyncInCnt",
    ("time", 9): "TimeStatus",
    ("gnss1", 3): "NumSats", ("gnss1", 4): "Fix", ("gnss1", 12): "TimeInfo",
    ("attitude", 1): "YawPitchRoll", ("attitude", 2): "Quaternion",
    ("ins", 0): "InsStatus", ("ins", 1): "Position", ("ins", 4): "Velocity",
    ("ins", 9): "PosU", ("ins", 10): "VelU",
}  # fmt: skip
_FORMATS: Final = {
    "TimeGps": struct.Struct("<Q"),
    "TimeSyncIn": struct.Struct("<Q"),
    "SyncInCnt": struct.Struct("<I"),
    "TimeStatus": struct.Struct("<B"),
    "TimeInfo": struct.Struct("<Bb"),
    "YawPitchRoll": struct.Struct("<3f"),
    "Quaternion": struct.Struct("<4f"),
    "Position": struct.Struct("<3d"),
    "Velocity": struct.Struct("<3f"),
    "InsStatus": struct.Struct("<H"),
    "NumSats": struct.Struct("<B"),
    "Fix": struct.Struct("<B"),
    "PosU": struct.Struct("<f"),
    "VelU": struct.Struct("<f"),
}


def vectornav_framer() -> MessageFramer:
    """A framer for binary outputs of any fields.

    Returns:
        A new framer with an empty buffer.
    """
    return MessageFramer(STARTS, _size_of, _fits)


def crc(data: bytes) -> int:
    """CRC-16-CCITT, polynomial 0x1021, beginning with 0; 0 over data that ends with its CRC.

    Args:
        data: bytes that the checksum covers.

    Returns:
        The checksum, 16 bits.

    Example:
        >>> hex(crc(b"123456789"))
        '0x31c3'
    """
    return binascii.crc_hqx(data, 0)


def fields_of(message: bytes) -> dict[str, tuple[Any, ...]]:
    """Take a whole checked message apart.

    Args:
        message: the message with sync and CRC.

    Returns:
        The values of the fields of use here, by name.

    Raises:
        ValueError: a number is infinite or not a number, or a field is in two groups and differs.
    """
    found: dict[str, tuple[Any, ...]] = {}
    for group, bit, at, _ in _fields(message, 0):
        name = NAMES.get((group, bit))
        if name is None:
            continue
        values = _FORMATS[name].unpack_from(message, at)
        if any(isinstance(value, float) and not math.isfinite(value) for value in values):
            raise ValueError(f"{name} holds a number that is none")
        if found.setdefault(name, values) != values:
            raise ValueError(f"{name} differs in two groups")
    return found


class _IncompleteError(DriverError):
    """The bytes from which the length follows have not come yet."""


class _UnknownFieldError(DriverError):
    """No message begins here, or one with a field of unknown length."""


def _fields(buffer: bytes, at: int) -> Iterator[tuple[str, int, int, int]]:
    """Group, bit, place and size of every field of the message that begins at `at`."""
    if len(buffer) < at + 2:
        raise _IncompleteError
    groups = buffer[at + 1]
    if not groups or groups & EXTENDED:
        raise _UnknownFieldError
    present = [group for bit, group in enumerate(GROUPS) if groups >> bit & 1]
    place = at + 2 + 2 * len(present)
    if len(buffer) < place:
        raise _IncompleteError
    masks = struct.unpack_from(f"<{len(present)}H", buffer, at + 2)
    for group, mask in zip(present, masks, strict=True):
        sizes = SIZES[group]
        if mask >> len(sizes):
            raise _UnknownFieldError
        for bit, size in enumerate(sizes):
            if not mask >> bit & 1:
                continue
            if size < 0:
                # The count of items stands first, behind time and week for raw measurements.
                count_at = place + (10 if size == RAW_MEASUREMENTS else 0)
                if len(buffer) <= count_at:
                    raise _IncompleteError
                size = count_at - place + 2 - size * buffer[count_at]
            yield group, bit, place, size
            place += size


def _size_of(buffer: bytes, at: int) -> int | None:
    end = at
    try:
        for _, _, place, size in _fields(buffer, at):
            end = place + size
    except _IncompleteError:
        return None
    except _UnknownFieldError:
        return 0
    size = end + CRC_NBYTES - at
    return size if CRC_NBYTES < size <= MAX_MESSAGE else 0


def _fits(message: bytes) -> bool:
    return crc(message[1:]) == 0
