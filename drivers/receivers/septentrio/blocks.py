"""SBF blocks: where they are in a stream, and their fields as numbers or None.

What a block means for navigation is in `drivers.receivers.septentrio.decoder`.

Source: Septentrio mosaic-X5 reference guide, firmware 4.14, chapter 4, "SBF reference".
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from typing import Any, Final

from drivers.receivers.message_framer import MessageFramer
from drivers.timescales.gps_time import WEEK_NS

HEADER: Final = struct.Struct("<2sHHH")
STARTS: Final = b"$"
MAX_BLOCK: Final = 16_384
"""No block of the receivers we know is longer; a longer one is a damaged length."""
TOW_UNKNOWN: Final = 0xFFFFFFFF
WEEK_UNKNOWN: Final = 0xFFFF
WEEK_MS: Final = 604_800_000
FLOAT_UNKNOWN: Final = -2e10

NAMES: Final = {
    4001: "DOP", 4007: "PVTGeodetic", 4038: "ExtEventPVTGeodetic", 4226: "INSNavGeod",
    5906: "PosCovGeodetic", 5908: "VelCovGeodetic", 5914: "ReceiverTime", 5921: "EndOfPVT",
    5924: "ExtEvent", 5938: "AttEuler", 5943: "EndOfAtt",
}  # fmt: skip
_PVT: Final = struct.Struct("<BB3d5fdf4BHHIB")
_PVT_ACCURACY: Final = struct.Struct("<HH")
_PVT_ACCURACY_AT: Final = _PVT.size + 1 + 2 + 2
"""Behind NrBases and PPPInfo of revision 1 and the latency of revision 2."""
LAYOUTS: Final = {
    "DOP": struct.Struct("<Bx4H"),
    "PVTGeodetic": _PVT,
    "ExtEventPVTGeodetic": _PVT,
    "INSNavGeod": struct.Struct("<BBHH3dfHHBxH"),
    "PosCovGeodetic": struct.Struct("<BB3f"),
    "VelCovGeodetic": struct.Struct("<BB3f"),
    "ReceiverTime": struct.Struct("<7bB"),
    "EndOfPVT": struct.Struct(""),
    "ExtEvent": struct.Struct("<BBfd"),
    "AttEuler": struct.Struct("<BBHBx3f"),
    "EndOfAtt": struct.Struct(""),
}
INS_PART: Final = struct.Struct("<3f")
"""The optional parts of INSNavGeod, each of three numbers, in the order of its bits."""


@dataclass(frozen=True)
class SbfBlock:
    """One block: time stamp on the receiver's clock (None where unknown) and values.

    `values` are those of LAYOUTS, floats None if the receiver marks them "do not use"; `rest` is
    what follows them.
    """

    name: str
    revision: int
    rx_ns: int | None
    values: tuple[Any, ...]
    rest: bytes


def sbf_framer() -> MessageFramer:
    """A framer for blocks of any kind.

    Returns:
        A new framer.
    """
    return MessageFramer(STARTS, _size_of, _fits)


def crc(data: bytes) -> int:
    """CRC-16-CCITT, polynomial 0x1021, beginning with 0.

    Args:
        data: the bytes covered, from the block's ID on.

    Returns:
        16-bit checksum.

    Example:
        >>> hex(crc(b"123456789"))
        '0x31c3'
    """
    return binascii.crc_hqx(data, 0)


def block_of(frame: bytes) -> SbfBlock | None:
    """The parts of a block.

    Args:
        frame: a complete block, checked by the framer.

    Returns:
        Name, revision, time stamp and values; None for a block that is not in NAMES.

    Raises:
        struct.error: it is shorter than its kind.
        ValueError: its time of week, or a number in it, is invalid.
    """
    identity = int.from_bytes(frame[4:6], "little")
    name = NAMES.get(identity & 0x1FFF)
    if name is None:
        return None
    tow_ms, week = struct.unpack_from("<IH", frame, HEADER.size)
    layout = LAYOUTS[name]
    at = HEADER.size + 6
    values = tuple(number(value) for value in layout.unpack_from(frame, at))
    if tow_ms == TOW_UNKNOWN or week == WEEK_UNKNOWN:
        rx_ns = None
    elif tow_ms >= WEEK_MS:
        raise ValueError(f"time of week of {tow_ms} ms")
    else:
        rx_ns = week * WEEK_NS + tow_ms * 1_000_000
    return SbfBlock(name, identity >> 13, rx_ns, values, frame[at + layout.size :])


def number(value: int | float) -> int | float | None:
    """A value of a block.

    Args:
        value: as unpacked.

    Returns:
        The value; None for the float that means "do not use".

    Raises:
        ValueError: infinite or not a number.
    """
    if isinstance(value, float):
        if value == FLOAT_UNKNOWN:
            return None
        if not abs(value) < 1e18:
            raise ValueError("a number that is none")
    return value


def accuracies_m(block: SbfBlock) -> tuple[float, float] | None:
    """Horizontal and vertical standard deviation of a PVTGeodetic of revision 2.

    Args:
        block: a PVTGeodetic; it holds twice the values (2DRMS and 2-sigma) in units of 0.01 m.

    Returns:
        Standard deviations, m; None in a block of an earlier revision or if they are not known.

    Source: mosaic-X5 reference guide, PVTGeodetic, HAccuracy and VAccuracy.
    """
    at = _PVT_ACCURACY_AT
    if block.revision < 2 or len(block.rest) < at - _PVT.size + _PVT_ACCURACY.size:
        return None
    horizontal, vertical = _PVT_ACCURACY.unpack_from(block.rest, at - _PVT.size)
    if WEEK_UNKNOWN in (horizontal, vertical):
        return None
    return horizontal * 0.005, vertical * 0.005


def _size_of(buffer: bytes, at: int) -> int | None:
    head = buffer[at : at + HEADER.size]
    if len(head) > 1 and head[1:2] != b"@":
        return 0
    if len(head) < HEADER.size:
        return None
    size = head[6] | head[7] << 8
    return size if size % 4 == 0 and HEADER.size + 8 <= size <= MAX_BLOCK else 0


def _fits(frame: bytes) -> bool:
    return crc(frame[4:]) == int.from_bytes(frame[2:4], "little")
