"""The time in which the sun stands high enough for images, from place and time.

The elevation is that of `processing.geometry.sun`; this module finds when it crosses a limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from processing.geometry.sun import sun_elevation_rad

DEFAULT_ELEVATION_DEG = 25.0
"""Limit where the plan states none: shadows are then twice as long as what casts them."""

STEP_S = 600.0
HORIZON_S = 86_400.0
PRECISION_S = 1.0


@dataclass(frozen=True)
class LightWindow:
    """Light at a place: elevations in degrees, times in s of UTC since 1970.

    `until_unix_s` is when the sun next sinks below the limit, if it is above it; otherwise
    `from_unix_s` is when it next rises above it. Both are None if it does neither within a day.
    """

    elevation_deg: float
    limit_deg: float
    from_unix_s: float | None
    until_unix_s: float | None

    @property
    def is_light(self) -> bool:
        return self.elevation_deg >= self.limit_deg


def light_window(
    unix_s: float, latitude_deg: float, longitude_deg: float, limit_deg: float
) -> LightWindow:
    """The sun now, and when it next crosses the limit.

    Args:
        unix_s: UTC, seconds since 1970.
        latitude_deg: of the place, north positive.
        longitude_deg: of the place, east positive.
        limit_deg: least elevation of the sun, degrees.

    Returns:
        Elevation and next crossing. The crossing is within some seconds of the almanac's; near
        the poles and at noon, where the sun barely moves in elevation, within some minutes.

    Source: The Astronomical Almanac, "low precision formulas for the Sun", by
    `processing.geometry.sun.sun_elevation_rad`; the crossing by bisection.

    Example:
        At the equator at the equinox the sun stands at 30 degrees two hours after sunrise and
        two hours before sunset.

        >>> window = light_window(1_710_936_445.0, 0.0, 0.0, 30.0)
        >>> window.is_light, round((window.until_unix_s - 1_710_936_445.0) / 3600, 1)
        (True, 4.0)
    """
    latitude_rad, longitude_rad = math.radians(latitude_deg), math.radians(longitude_deg)
    limit_rad = math.radians(limit_deg)

    def above_rad(at_s: float) -> float:
        return sun_elevation_rad(at_s, latitude_rad, longitude_rad) - limit_rad

    now_rad = above_rad(unix_s)
    crossing_s = _next_crossing_s(above_rad, unix_s, now_rad >= 0.0)
    elevation_deg = math.degrees(now_rad + limit_rad)
    is_light = now_rad >= 0.0
    return LightWindow(
        elevation_deg,
        limit_deg,
        None if is_light else crossing_s,
        crossing_s if is_light else None,
    )


def _next_crossing_s(
    above_rad: Callable[[float], float], from_s: float, is_above: bool
) -> float | None:
    """When the sign next changes; None if it does not within a day."""
    for step in range(1, int(HORIZON_S / STEP_S) + 1):
        late_s = from_s + step * STEP_S
        if (above_rad(late_s) >= 0.0) == is_above:
            continue
        early_s = late_s - STEP_S
        while late_s - early_s > PRECISION_S:
            middle_s = (early_s + late_s) / 2
            if (above_rad(middle_s) >= 0.0) == is_above:
                early_s = middle_s
            else:
                late_s = middle_s
        return late_s
    return None
