"""GPS time out of weeks, times of week, dates and leap seconds, in whole nanoseconds.

What every decoder of a receiver reckons with; messages are taken apart in the decoders. How many
leap seconds there were at a date is in `drivers.timescales.leap_seconds`.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from typing import Final

SECOND_NS: Final = 1_000_000_000
DAY_NS: Final = 86_400 * SECOND_NS
WEEK_NS: Final = 7 * DAY_NS
GPS_EPOCH_DAY: Final = datetime.date(1980, 1, 6).toordinal()
MAX_LEAP_SECONDS: Final = 99
FAR_NS: Final = 3600 * SECOND_NS
"""A mark further from the last navigation epoch has a wrong week or a restarted clock."""
RECENT_NS: Final = 10 * SECOND_NS
ITOW_SLACK_NS: Final = 1_000_000
"""iTOW is rounded to milliseconds; what lies further from it is of another epoch."""


@dataclass(frozen=True)
class UtcFields:
    """Date and time as NAV-PVT gives them: `nano` may be negative, `second` may be 60."""

    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    nano: int


def utc_ns(fields: UtcFields) -> int | None:
    """Nanoseconds since the GPS epoch without leap seconds; None where no such date exists."""
    in_day = fields.hour < 24 and fields.minute < 60 and fields.second <= 60
    if not in_day or abs(fields.nano) > SECOND_NS:
        return None
    try:
        day = datetime.date(fields.year, fields.month, fields.day).toordinal() - GPS_EPOCH_DAY
    except ValueError:
        return None
    seconds = day * 86_400 + fields.hour * 3600 + fields.minute * 60 + fields.second
    return seconds * SECOND_NS + fields.nano


def gps_from_utc(utc: int, itow_ms: int) -> tuple[int, int] | None:
    """GPS time of a UTC instant whose GPS time of week is known too, and the leap seconds between.

    The difference of both, modulo one week, is the leap seconds the receiver itself counts with:
    so the result is right also while the receiver still uses its firmware's default, in the leap
    second itself, and where UTC and GPS lie in different weeks. None where they contradict.

    Example:
        >>> gps_from_utc(utc_ns(UtcFields(2024, 1, 30, 15, 31, 52, -422154)), 228730000)
        (1390663929999577846, 18)
    """
    difference = (itow_ms * 1_000_000 - utc + WEEK_NS // 2) % WEEK_NS - WEEK_NS // 2
    leap = (difference + SECOND_NS // 2) // SECOND_NS
    if abs(difference - leap * SECOND_NS) > ITOW_SLACK_NS or not 0 <= leap <= MAX_LEAP_SECONDS:
        return None
    return utc + leap * SECOND_NS, leap


def gps_near(itow_ms: int, near_gps_ns: int) -> int:
    """The instant of that time of week which lies nearest to another; across the week's end too.

    Example:
        >>> gps_near(604_799_900, 2400 * WEEK_NS + 50_000_000) - 2400 * WEEK_NS
        -100000000
    """
    offset = (itow_ms * 1_000_000 - near_gps_ns + WEEK_NS // 2) % WEEK_NS - WEEK_NS // 2
    return near_gps_ns + offset
