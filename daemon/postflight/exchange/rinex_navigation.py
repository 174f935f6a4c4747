"""RINEX navigation files, 3.04 and 4.00, of GPS ephemerides (LNAV).

Source: IGS and RTCM SC-104, RINEX 3.04 (2018), tables A5 and A6; RINEX 4.00 (2021), "EPH LNAV".
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

from drivers.receivers.gps_ephemeris import GpsEphemeris

_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_WEEK_S = 604_800.0


def navigation_text(
    ephemerides: Sequence[GpsEphemeris], *, version: str, made: datetime, comments: Sequence[str]
) -> str:
    """A navigation file.

    Args:
        ephemerides: in any order; they are written by reference time of the clock.
        version: "3.04" or "4.00".
        made: when the file was made, UTC.
        comments: each at most 60 characters.
    """
    ordered = sorted(ephemerides, key=lambda one: (_clock_time(one), one.satellite))
    lines = [
        _line(f"{version:>9}{'':11}{'N: GNSS NAV DATA':<20}{'G: GPS':<20}", "RINEX VERSION / TYPE"),
        _line(f"{'Syntopic':<20}{'':<20}{made:%Y%m%d %H%M%S} UTC", "PGM / RUN BY / DATE"),
        *(_line(comment, "COMMENT") for comment in comments),
        _line("", "END OF HEADER"),
    ]
    for one in ordered:
        if version == "4.00":
            lines.append(f"> EPH G{one.satellite:02d} LNAV")
        clock, rest = one.values[:3], one.values[3:]
        at = _clock_time(one)
        lines.append(f"G{one.satellite:02d} {at:%Y %m %d %H %M %S}" + _numbers(clock))
        lines += ["    " + _numbers(rest[k : k + 4]) for k in range(0, len(rest), 4)]
    return "\n".join(lines) + "\n"


def _clock_time(one: GpsEphemeris) -> datetime:
    """The clock's reference time: within half a week of that of the orbit."""
    week = one.week + round((one.toe_s - one.toc_s) / _WEEK_S)
    return _GPS_EPOCH + timedelta(seconds=week * _WEEK_S + one.toc_s)


def _numbers(values: Sequence[float]) -> str:
    return "".join(f"{value:19.12E}" for value in values)


def _line(content: str, label: str) -> str:
    return f"{content:<60.60}{label:<20}".rstrip()
