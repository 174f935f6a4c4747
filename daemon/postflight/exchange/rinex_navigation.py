"""RINEX navigation files, 3.04, 4.00 and 4.02: GPS, QZSS, Galileo, GLONASS, BeiDou.

Source: IGS and RTCM SC-104, RINEX 3.04 (2018), tables A5 to A14; RINEX 4.00 (2021), "EPH LNAV",
"EPH INAV", "EPH FDMA", "EPH D1", "EPH D2".
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

from drivers.receivers.broadcast_ephemeris import BroadcastEphemeris
from drivers.receivers.gps_ephemeris import GpsEphemeris

_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_WEEK_S = 604_800.0
_SYSTEMS = {"G": "G: GPS", "E": "E: Galileo", "R": "R: GLONASS", "C": "C: BDS", "J": "J: QZSS"}


def navigation_text(
    ephemerides: Sequence[GpsEphemeris | BroadcastEphemeris],
    *,
    version: str,
    made: datetime,
    comments: Sequence[str],
) -> str:
    """A navigation file.

    Args:
        ephemerides: in any order; they are written by reference time of the clock.
        version: "3.04", "4.00" or "4.02".
        made: when the file was made, UTC.
        comments: each at most 60 characters.
    """
    records = [_of_gps(one) if isinstance(one, GpsEphemeris) else one for one in ephemerides]
    ordered = sorted(records, key=lambda one: (one.clock_time, one.satellite))
    systems = {one.satellite[0] for one in ordered}
    system = "M: Mixed" if len(systems) > 1 else _SYSTEMS[min(systems, default="G")]
    lines = [
        _line(f"{version:>9}{'':11}{'N: GNSS NAV DATA':<20}{system:<20}", "RINEX VERSION / TYPE"),
        _line(f"{'Syntopic':<20}{'':<20}{made:%Y%m%d %H%M%S} UTC", "PGM / RUN BY / DATE"),
        *(_line(comment, "COMMENT") for comment in comments),
        _line("", "END OF HEADER"),
    ]
    for one in ordered:
        if version.startswith("4."):
            lines.append(f"> EPH {one.satellite} {one.message}")
        values = (*one.values, *(one.status if version.startswith("4.") else ()))
        clock, rest = values[:3], values[3:]
        lines.append(f"{one.satellite} {one.clock_time:%Y %m %d %H %M %S}" + _numbers(clock))
        lines += ["    " + _numbers(rest[k : k + 4]) for k in range(0, len(rest), 4)]
    return "\n".join(lines) + "\n"


def _of_gps(one: GpsEphemeris) -> BroadcastEphemeris:
    return BroadcastEphemeris(
        f"{one.system}{one.satellite:02d}", "LNAV", _clock_time(one), one.values
    )


def _clock_time(one: GpsEphemeris) -> datetime:
    """The clock's reference time: within half a week of that of the orbit."""
    week = one.week + round((one.toe_s - one.toc_s) / _WEEK_S)
    return _GPS_EPOCH + timedelta(seconds=week * _WEEK_S + one.toc_s)


def _numbers(values: Sequence[float]) -> str:
    return "".join(f"{value:19.12E}" for value in values)


def _line(content: str, label: str) -> str:
    return f"{content:<60.60}{label:<20}".rstrip()
