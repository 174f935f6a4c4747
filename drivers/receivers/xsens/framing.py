"""Xbus messages out of a stream of bytes, and the data of MTData2.

What data mean is in `drivers.receivers.xsens.decoder`.

Source: Xsens MT Low-Level Communication Protocol Documentation, document MT0101P.
"""

from __future__ import annotations

import math
import struct
from typing import Any, Final

from drivers.receivers.message_framer import MessageFramer

STARTS: Final = b"\xfa"
BUS_ID: Final = 0xFF
EXTENDED_LENGTH: Final = 0xFF
MAX_DATA: Final = 2048
MTDATA2: Final = 0x36
FLOAT_FORMATS: Final = ("float32", "fp1220", "fp1632", "float64")
"""By the lowest two bits of an identifier."""
NUMBER_NBYTES: Final = {"float32": 4, "fp1220": 4, "fp1632": 6, "float64": 8}
FRAMES: Final = {0x0: "ENU", 0x4: "NED", 0x8: "NWU"}
"""Coordinate system by the other two bits of the lowest digit."""
WHOLE: Final = {
    0x1010: ("UtcTime", struct.Struct(">IH6B")),
    0x1020: ("PacketCounter", struct.Struct(">H")),
    0x1060: ("SampleTimeFine", struct.Struct(">I")),
    0x4810: ("TriggerIn1", struct.Struct(">BBIH")),
    0x4820: ("TriggerIn2", struct.Struct(">BBIH")),
    0x4830: ("TriggerIn3", struct.Struct(">BBIH")),
    0x7010: ("GnssPvtData", struct.Struct(">IH6BIi4B4iII3iIiIIi7H")),
    0xE020: ("StatusWord", struct.Struct(">I")),
}
NUMBERS: Final = {
    0x2010: ("Quaternion", 4),
    0x2030: ("EulerAngles", 3),
    0x5020: ("AltitudeEllipsoid", 1),
    0x5040: ("LatLon", 2),
    0xD010: ("VelocityXYZ", 3),
}
"""Name and count of numbers, by identifier without its lowest digit."""


class Datum:
    """Values of one datum, the format of its numbers and its coordinate system."""

    __slots__ = ("frame", "number_format", "values")

    def __init__(self, values: tuple[Any, ...], number_format: str = "", frame: str = "") -> None:
        self.values = values
        self.number_format = number_format
        self.frame = frame


def xbus_framer() -> MessageFramer:
    """A framer for messages of any kind.

    Returns:
        A new framer with an empty buffer.
    """
    return MessageFramer(STARTS, _size_of, _fits)


def data_of(message: bytes) -> dict[str, Datum] | None:
    """Take a whole checked message apart.

    Args:
        message: the message with preamble and checksum.

    Returns:
        The data of an MTData2 that are of use here, by name; None for other messages.

    Raises:
        ValueError: a datum has another length than its kind, or a number is infinite or none.
    """
    if message[2] != MTDATA2:
        return None
    at = 6 if message[3] == EXTENDED_LENGTH else 4
    data: dict[str, Datum] = {}
    end = len(message) - 1
    while at < end:
        if at + 3 > end:
            raise ValueError("a datum that is cut")
        identifier, size = struct.unpack_from(">HB", message, at)
        content = message[at + 3 : at + 3 + size]
        at += 3 + size
        if at > end:
            raise ValueError("a datum longer than its message")
        _add(data, identifier, content)
    return data


def _add(data: dict[str, Datum], identifier: int, content: bytes) -> None:
    if identifier in WHOLE:
        name, layout = WHOLE[identifier]
        if len(content) != layout.size:
            raise ValueError(f"{name} of {len(content)} bytes")
        data[name] = Datum(layout.unpack(content))
    elif identifier & 0xFFF0 in NUMBERS:
        name, count = NUMBERS[identifier & 0xFFF0]
        number_format = FLOAT_FORMATS[identifier & 0x3]
        frame = FRAMES.get(identifier & 0xC)
        if frame is None or len(content) != count * NUMBER_NBYTES[number_format]:
            raise ValueError(f"{name} of {len(content)} bytes or an unknown coordinate system")
        values = _numbers(content, number_format)
        if not all(math.isfinite(value) for value in values):
            raise ValueError(f"{name} holds a number that is none")
        data[name] = Datum(values, number_format, frame)


def _numbers(content: bytes, number_format: str) -> tuple[float, ...]:
    if number_format == "float32":
        return struct.unpack(f">{len(content) // 4}f", content)
    if number_format == "float64":
        return struct.unpack(f">{len(content) // 8}d", content)
    if number_format == "fp1220":
        return tuple(n / (1 << 20) for n in struct.unpack(f">{len(content) // 4}i", content))
    # Fixed point 16.32: the 32 bits of the fraction first, then the signed whole number.
    parts = struct.iter_unpack(">Ih", content)
    return tuple(whole + fraction / (1 << 32) for fraction, whole in parts)


def _size_of(buffer: bytes, at: int) -> int | None:
    head = buffer[at : at + 6]
    if len(head) > 1 and head[1] != BUS_ID:
        return 0
    if len(head) < 4:
        return None
    if head[3] != EXTENDED_LENGTH:
        return 5 + head[3]
    if len(head) < 6:
        return None
    size = head[4] << 8 | head[5]
    return 7 + size if size <= MAX_DATA else 0


def _fits(message: bytes) -> bool:
    return sum(message[1:]) & 0xFF == 0
