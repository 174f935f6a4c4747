"""Sentences of NMEA 0183 taken apart: checksum, numbers, angles, times and dates.

What an epoch is made of is in `drivers.nmea.decoder`.

Source: NMEA 0183 as published in gpsd's "NMEA Revealed".
"""

from __future__ import annotations

import datetime
import math
import re
from typing import Final

from drivers.gps_time import GPS_EPOCH_DAY, SECOND_NS
from drivers.message_framer import line_size

MAX_LENGTH: Final = 256
"""The standard says 82; receivers of high precision send more."""

_NUMBER: Final = re.compile(r"-?[0-9]{1,15}(\.[0-9]{0,20})?")
_TIME: Final = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2})(?:\.([0-9]{0,9}))?")
_DATE: Final = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2})")
_BODY: Final = re.compile(rb"\$([^*]*)\*([0-9A-Fa-f]{2})\r?\n")


def size_of(buffer: bytes, at: int) -> int | None:
    """See `drivers.message_framer.SizeOf`."""
    return line_size(buffer, at, MAX_LENGTH)


def checksum_fits(line: bytes) -> bool:
    """Whether a whole line is a sentence with the right checksum; one without is refused."""
    match = _BODY.fullmatch(line)
    if match is None:
        return False
    total = 0
    for byte in match[1]:
        total ^= byte
    return total == int(match[2], 16)


def fields_of(line: bytes) -> list[str]:
    """Address and fields of a checked line."""
    return line[1 : line.rindex(b"*")].decode("ascii").split(",")


def number(text: str) -> float:
    """A decimal number; ValueError for anything else, "nan" and "1e9" too."""
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{text!r} is no number")
    return float(text)


def number_or_none(text: str) -> float | None:
    """None for an empty field."""
    return number(text) if text else None


def angle_deg(text: str, hemisphere: str, limit: float) -> float | None:
    """Degrees of dddmm.mmm and N, S, E or W; None where both are empty."""
    if not text and not hemisphere:
        return None
    value = number(text)
    sign = {"N": 1, "E": 1, "S": -1, "W": -1}.get(hemisphere)
    degrees, minutes = divmod(value, 100)
    result = degrees + minutes / 60
    if sign is None or not 0 <= minutes < 60 or not 0 <= result <= limit:
        raise ValueError(f"{text!r} {hemisphere!r} is no angle")
    return math.copysign(result, sign)


def time_of_day_ns(text: str) -> tuple[int, bool]:
    """Nanoseconds of hhmmss.fff, exact, and whether it lies in a leap second (hh:mm:60)."""
    match = _TIME.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is no time")
    hour, minute, second = (int(part) for part in match.groups()[:3])
    if hour > 23 or minute > 59 or second > 60:
        raise ValueError(f"{text!r} is no time of day")
    fraction = int(((match[4] or "") + "000000000")[:9])
    return (hour * 3600 + minute * 60 + second) * SECOND_NS + fraction, second == 60


def day_of(text: str) -> int:
    """Days since the GPS epoch of ddmmyy; a year from 80 on lies in the last century."""
    match = _DATE.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is no date")
    day, month, year = (int(part) for part in match.groups())
    return day_number(year + (1900 if year >= 80 else 2000), month, day)


def day_number(year: int, month: int, day: int) -> int:
    """Days since the GPS epoch; ValueError where there is no such date."""
    return datetime.date(year, month, day).toordinal() - GPS_EPOCH_DAY
