"""Leap seconds between GPS and UTC as data, for receivers that send only UTC.

The count of a receiver takes precedence over this table. Source: IERS Bulletin C.
"""

from __future__ import annotations

import bisect
import datetime
from typing import Final

from drivers.timescales.gps_time import GPS_EPOCH_DAY, SECOND_NS

SINCE: Final = (
    (1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7),
    (1993, 7), (1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7),
    (2015, 7), (2017, 1),
)  # fmt: skip
"""Year and month from whose first instant on one more leap second applies."""

_STARTS_NS: Final = tuple(
    (datetime.date(year, month, 1).toordinal() - GPS_EPOCH_DAY) * 86_400 * SECOND_NS
    for year, month in SINCE
)


def leap_seconds_at(utc_ns: int) -> int:
    """GPS - UTC at a UTC instant, by the table.

    Args:
        utc_ns: nanoseconds since the GPS epoch without leap seconds; within a leap second, the
            instant one second before.

    Returns:
        GPS - UTC, s; the present count for any time after the last entry.

    Source: IERS Bulletin C.
    """
    return bisect.bisect_right(_STARTS_NS, utc_ns)
