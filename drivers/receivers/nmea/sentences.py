"""Sentences of NMEA 0183 taken apart: checksum, numbers, angles, times and dates.

What an epoch is made of is in `drivers.receivers.nmea.epoch`.

Source: NMEA 0183 as published in gpsd's "NMEA Revealed".
"""

from __future__ import annotations

import datetime
import math
import re
from typing import Final

from drivers.timescales.gps_time import GPS_EPOCH_DAY, SECOND_NS

# Quirk: receivers of high precision send sentences longer than the standard's 82 characters.
# Upstream: no report known (2026-11-23).
MAX_LENGTH: Final = 256
# Quirk: receivers without a fix send 99.99, 50.00 or 0 as dilution of precision.
# Upstream: wellenvogel/esp32-nmea2000#38 (99.99).
DOP_UNKNOWN_FROM: Final = 50.0
"""A larger dilution of precision means that it is unknown."""

_NUMBER: Final = re.compile(r"[-+]?[0-9]{0,15}(\.[0-9]{0,20})?")
_TIME: Final = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2})(?:\.([0-9]{0,9}))?")
_DATE: Final = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2})")
_LINE: Final = re.compile(rb"\$[ -\"&-~]*")
"""A sentence holds no other `$`, `#` or `%`."""
_BODY: Final = re.compile(rb"\$([^*]*)\*([0-9A-Fa-f]{2}) *[\r\n]{1,2}")
_BARE: Final = re.compile(rb"\$([A-OQ-Z][A-Z][A-Z]{3}|P[A-Z]{3,}),[^*]*[\r\n]{1,2}")


def size_of(buffer: bytes, at: int) -> int | None:
    """Size of a sentence; a line ends with CR LF, LF, or CR alone.

    Args:
        buffer: bytes of the stream.
        at: where the sentence begins with "$".

    Returns:
        As `drivers.receivers.message_framer.SizeOf`: bytes; 0 if there is none, None if it is not
        complete yet.
    """
    match = _LINE.match(buffer, at, at + MAX_LENGTH)
    end = match.end() if match else at
    if end - at >= MAX_LENGTH:
        return 0
    following = buffer[end : end + 2]
    if following in (b"", b"\r"):
        return None
    if following[:1] == b"\n":
        return end + 1 - at
    if following[:1] != b"\r":
        return 0
    return end + (2 if following == b"\r\n" else 1) - at


def is_sentence(line: bytes) -> bool:
    """Whether a complete line is a sentence.

    Args:
        line: the line with its end.

    Returns:
        True if the checksum is right, or if there is none and the address is a valid one.

    Source: NMEA 0183 as published in gpsd's "NMEA Revealed", checksums.
    """
    match = _BODY.fullmatch(line)
    if match is None:
        return _BARE.fullmatch(line) is not None
    total = 0
    for byte in match[1]:
        total ^= byte
    return total == int(match[2], 16)


def has_checksum(line: bytes) -> bool:
    """Whether a sentence ends with a checksum.

    Args:
        line: the sentence.

    Returns:
        True if it holds an asterisk.
    """
    return b"*" in line


def is_proprietary(line: bytes) -> bool:
    """Whether a sentence is a manufacturer's own; some send those without a checksum.

    Args:
        line: the sentence.

    Returns:
        True if its address begins with P.
    """
    return line.startswith(b"$P")


def fields_of(line: bytes) -> list[str]:
    """The fields of a sentence.

    Args:
        line: the sentence.

    Returns:
        Address and fields, without "$" and checksum.

    Raises:
        UnicodeDecodeError: it is not ASCII.
    """
    return line[1:].partition(b"*")[0].decode("ascii").strip().split(",")


def number(text: str) -> float:
    """The value of a decimal field.

    Args:
        text: an optional sign and digits with or without a decimal point.

    Returns:
        The number.

    Raises:
        ValueError: anything else, "nan" and "1e9" too.
    """
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{text!r} is no number")
    return float(text)


def number_or_none(text: str) -> float | None:
    """The value of a decimal field that may be empty.

    Args:
        text: the field.

    Returns:
        The number; None for an empty field.

    Raises:
        ValueError: it is neither empty nor a number.
    """
    text = text.strip()
    return number(text) if text else None


def dop_or_none(text: str) -> float | None:
    """A dilution of precision.

    Args:
        text: the field.

    Returns:
        The value; None if it is empty or one that means "unknown" (0, DOP_UNKNOWN_FROM or more).

    Raises:
        ValueError: it is neither empty nor a number.
    """
    value = number_or_none(text)
    return value if value is not None and 0 < value < DOP_UNKNOWN_FROM else None


def angle_deg(text: str, hemisphere: str, limit: float) -> float | None:
    """Latitude or longitude of two fields.

    Args:
        text: dddmm.mmm.
        hemisphere: N, S, E or W.
        limit: largest absolute value, degrees.

    Returns:
        Degrees, south and west negative; None if one of both fields is empty.

    Raises:
        ValueError: it is no angle within the limit.
    """
    if not text or not hemisphere:
        return None
    value = number(text)
    sign = {"N": 1, "E": 1, "S": -1, "W": -1}.get(hemisphere)
    degrees, minutes = divmod(value, 100)
    result = degrees + minutes / 60
    if sign is None or not 0 <= minutes < 60 or not 0 <= result <= limit:
        raise ValueError(f"{text!r} {hemisphere!r} is no angle")
    return math.copysign(result, sign)


def position_of(fields: list[str]) -> tuple[float, float] | None:
    """Latitude and longitude of four fields.

    Args:
        fields: latitude, N or S, longitude, E or W.

    Returns:
        Latitude and longitude, degrees, north and east positive; None if one field is empty.

    Raises:
        ValueError: a field is no angle, or its hemisphere is one of the other angle.
    """
    if fields[1] not in ("N", "S", "") or fields[3] not in ("E", "W", ""):
        raise ValueError("a hemisphere in the wrong place")
    latitude = angle_deg(fields[0], fields[1], 90)
    longitude = angle_deg(fields[2], fields[3], 180)
    return None if latitude is None or longitude is None else (latitude, longitude)


def resolution_deg(text: str) -> float:
    """The weight of the last digit of an angle.

    Args:
        text: dddmm.mmm.

    Returns:
        Degrees.

    Example:
        >>> round(resolution_deg("4717.1127") * 60, 6)
        0.0001
    """
    return 10.0 ** -len(text.partition(".")[2]) / 60


def time_of_day_ns(text: str) -> tuple[int, bool]:
    """UTC time of day, exact to its digits.

    Args:
        text: hhmmss or hhmmss.fff with up to 9 decimals.

    Returns:
        Nanoseconds since midnight, and whether the time is in a leap second (hh:mm:60).

    Raises:
        ValueError: it is no time of day.
    """
    match = _TIME.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is no time")
    hour, minute, second = (int(part) for part in match.groups()[:3])
    if hour > 23 or minute > 59 or second > 60:
        raise ValueError(f"{text!r} is no time of day")
    fraction = int(((match[4] or "") + "000000000")[:9])
    return (hour * 3600 + minute * 60 + second) * SECOND_NS + fraction, second == 60


def day_of(text: str) -> int:
    """The day of a date.

    Args:
        text: ddmmyy; a year from 80 on is in the last century.

    Returns:
        Days since the GPS epoch.

    Raises:
        ValueError: it is no date.
    """
    match = _DATE.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is no date")
    day, month, year = (int(part) for part in match.groups())
    return day_number(year + (1900 if year >= 80 else 2000), month, day)


def day_number(year: int, month: int, day: int) -> int:
    """The day of a date.

    Args:
        year: all four digits.
        month: 1 to 12.
        day: 1 to 31.

    Returns:
        Days since the GPS epoch, 1980-01-06.

    Raises:
        ValueError: there is no such date.
    """
    return datetime.date(year, month, day).toordinal() - GPS_EPOCH_DAY
