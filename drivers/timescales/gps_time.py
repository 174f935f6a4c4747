"""GPS time from weeks, times of week, dates and leap seconds, in integer nanoseconds.

All receiver decoders compute time with this module. The table of leap seconds is in
`drivers.timescales.leap_seconds`.
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
"""A mark farther from the last navigation epoch has a wrong week or a restarted clock."""
RECENT_NS: Final = 10 * SECOND_NS
ITOW_SLACK_NS: Final = 1_000_000
"""iTOW is rounded to milliseconds; a larger difference belongs to another epoch."""


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
    """A UTC date and time as a count without leap seconds.

    Args:
        fields: date and time; `second` 60 counts as the first second of the next minute.

    Returns:
        Nanoseconds since the GPS epoch, each day with 86 400 s; None if no such date exists.
    """
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
    """GPS time and leap seconds of a UTC instant whose GPS time of week is known.

    The difference of both, modulo one week, is the number of leap seconds that the receiver uses.
    So the result is also correct while the receiver uses its firmware's default, in a leap second,
    and if UTC and GPS are in different weeks.

    Args:
        utc: result of `utc_ns`, ns.
        itow_ms: GPS time of week of the same instant, ms.

    Returns:
        GPS time, ns since the GPS epoch, and GPS - UTC, s; None if both times differ from whole
        seconds by more than ITOW_SLACK_NS, or the difference is not 0 to MAX_LEAP_SECONDS.

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
    """The instant of a time of week that is nearest to another instant, also across a week's end.

    Args:
        itow_ms: GPS time of week, ms.
        near_gps_ns: the other instant, ns since the GPS epoch.

    Returns:
        GPS time within half a week of `near_gps_ns`, ns since the GPS epoch.

    Example:
        >>> gps_near(604_799_900, 2400 * WEEK_NS + 50_000_000) - 2400 * WEEK_NS
        -100000000
    """
    offset = (itow_ms * 1_000_000 - near_gps_ns + WEEK_NS // 2) % WEEK_NS - WEEK_NS // 2
    return near_gps_ns + offset
