"""Elevation and azimuth of the sun to some hundredths of a degree: enough for a specification.

Refraction and the observer's height are left out.
"""

from __future__ import annotations

import math

J2000_UNIX_S = 946_728_000.0
"""2000-01-01T12:00:00 UTC."""

DAY_S = 86_400.0


def sun_elevation_rad(unix_s: float, latitude_rad: float, longitude_rad: float) -> float:
    """Elevation of the sun's centre above the horizon.

    Args:
        unix_s: UTC, seconds since 1970.
        latitude_rad: of the place, north positive.
        longitude_rad: of the place, east positive.

    Returns:
        Elevation, rad, within +-pi/2; below zero at night.

    Source: The Astronomical Almanac, "low precision formulas for the Sun" (0.01 deg from 1950 to
    2050), and Greenwich mean sidereal time of the IAU 1982 model to first order.

    Example:
        At the equator about noon of the equinox 2024-03-20 the sun is nearly overhead.

        >>> round(math.degrees(sun_elevation_rad(1_710_936_445.0, 0.0, 0.0)), 1)
        89.8
    """
    declination, hour_angle = _declination_and_hour_angle(unix_s, longitude_rad)
    return math.asin(
        math.sin(latitude_rad) * math.sin(declination)
        + math.cos(latitude_rad) * math.cos(declination) * math.cos(hour_angle)
    )


def sun_azimuth_rad(unix_s: float, latitude_rad: float, longitude_rad: float) -> float:
    """Direction of the sun's centre, clockwise from true north.

    Args:
        unix_s: UTC, seconds since 1970.
        latitude_rad: of the place, north positive.
        longitude_rad: of the place, east positive.

    Returns:
        Azimuth, rad, from 0 to 2 pi; without meaning where the sun is in the zenith.

    Source: as `sun_elevation_rad`.

    Example:
        Three hours after sunrise of the equinox the sun stands between east and south at 47 N.

        >>> round(math.degrees(sun_azimuth_rad(1_710_925_645.0, math.radians(47.0), 0.0)))
        126
    """
    declination, hour_angle = _declination_and_hour_angle(unix_s, longitude_rad)
    east = -math.cos(declination) * math.sin(hour_angle)
    north = math.cos(latitude_rad) * math.sin(declination) - math.sin(latitude_rad) * math.cos(
        declination
    ) * math.cos(hour_angle)
    return math.atan2(east, north) % math.tau


def _declination_and_hour_angle(unix_s: float, longitude_rad: float) -> tuple[float, float]:
    days = (unix_s - J2000_UNIX_S) / DAY_S
    anomaly = math.radians(357.528 + 0.985_600_3 * days)
    longitude = math.radians(280.460 + 0.985_647_4 * days) + math.radians(
        1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly)
    )
    obliquity = math.radians(23.439 - 0.000_000_4 * days)
    ascension = math.atan2(math.cos(obliquity) * math.sin(longitude), math.cos(longitude))
    declination = math.asin(math.sin(obliquity) * math.sin(longitude))
    sidereal = math.radians(280.460_618_37 + 360.985_647_366_29 * days)
    hour_angle = sidereal + longitude_rad - ascension
    return declination, hour_angle
