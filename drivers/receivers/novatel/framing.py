"""NovAtel logs out of a stream of bytes: long and short headers, binary and ASCII.

What a log means is in `drivers.receivers.novatel.decoder`.

Source: NovAtel OEM7 Commands and Logs Reference Manual, OM-20000169, chapter 1.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass
from typing import Final

from drivers.receivers.ascii_numbers import parse_decimal, parse_integer
from drivers.receivers.message_framer import MessageFramer, line_size

STARTS: Final = b"\xaa#%"
MAX_BODY: Final = 8192
MAX_LINE: Final = 2048
LONG_HEADER: Final = 28
SHORT_HEADER: Final = 12
CRC_NBYTES: Final = 4
_ASCII: Final = re.compile(rb"[#%]([^*]*)\*([0-9a-fA-F]{8})\r?\n")


@dataclass(frozen=True)
class NovatelLog:
    """One log: its number (binary) or name (ASCII), header time, and body.

    `time_status` is the number of the manual or the ASCII word, None in short headers.
    """

    identity: int | str
    week: int
    tow_ns: int
    time_status: int | str | None
    body: bytes | list[str]


def crc32(data: bytes) -> int:
    """NovAtel's CRC: that of zlib without its complements.

    Args:
        data: the bytes covered.

    Returns:
        32-bit checksum.

    Source: OM-20000169, chapter 1, 32-Bit CRC.
    """
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def novatel_framer() -> MessageFramer:
    """A framer for all four kinds of header.

    Returns:
        A new framer.
    """
    return MessageFramer(STARTS, _size_of, _fits)


def log_of(frame: bytes) -> NovatelLog:
    """The parts of a log.

    Args:
        frame: a complete frame, checked by the framer.

    Returns:
        Identity, header time, time status and body.

    Raises:
        ValueError: an ASCII header has too few words or a word that is no number.
    """
    if frame[0] == 0xAA:
        identity = struct.unpack_from("<H", frame, 4)[0]
        if frame[2] == 0x13:
            week, ms = struct.unpack_from("<Hi", frame, 6)
            return NovatelLog(identity, week, ms * 1_000_000, None, frame[SHORT_HEADER:-CRC_NBYTES])
        week, ms = struct.unpack_from("<Hi", frame, 14)
        return NovatelLog(identity, week, ms * 1_000_000, frame[13], frame[frame[3] : -CRC_NBYTES])
    head, _, body = frame[1 : frame.rindex(b"*")].decode("ascii").partition(";")
    fields = head.split(",")
    name = fields[0].removesuffix("A")
    if frame[:1] == b"%":
        return NovatelLog(name, parse_integer(fields[1]), _tow_ns(fields[2]), None, body.split(","))
    if len(fields) < 10:
        raise ValueError("a header of fewer than ten words")
    return NovatelLog(
        name, parse_integer(fields[5]), _tow_ns(fields[6]), fields[4], body.split(",")
    )


def _tow_ns(text: str) -> int:
    return round(parse_decimal(text) * 1e9)


def _size_of(buffer: bytes, at: int) -> int | None:
    if buffer[at] != 0xAA:
        return line_size(buffer, at, MAX_LINE)
    head = buffer[at : at + 10]
    if (len(head) > 1 and head[1] != 0x44) or (len(head) > 2 and head[2] not in (0x12, 0x13)):
        return 0
    if len(head) < 10:
        return None
    if head[2] == 0x13:
        return SHORT_HEADER + head[3] + CRC_NBYTES
    body = head[8] | head[9] << 8
    if head[3] < LONG_HEADER or body > MAX_BODY:
        return 0
    return head[3] + body + CRC_NBYTES


def _fits(frame: bytes) -> bool:
    if frame[0] == 0xAA:
        return crc32(frame[:-CRC_NBYTES]) == int.from_bytes(frame[-CRC_NBYTES:], "little")
    match = _ASCII.fullmatch(frame)
    return match is not None and crc32(match[1]) == int(match[2], 16)
