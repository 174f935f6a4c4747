"""What is left of a flight: lines, distance, and light.

The disk is part of the status. The time to the end is computed by the page from the distance and
the present speed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

from daemon.onboard.monitoring.coverage import Coverage
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.planning.light_window import DEFAULT_ELEVATION_DEG, light_window
from drivers.timescales.leap_seconds import leap_seconds_at

GPS_EPOCH_UNIX_S = 315_964_800.0


def remaining_json(
    state: FlightState, coverage: Coverage, unix_s: float | None = None
) -> dict[str, Any]:
    """Lines and light that are left, for the page.

    Args:
        state: the state of the flight; its last position is the place of the light.
        coverage: the plan of the mission and what is flown of it.
        unix_s: UTC in s since 1970; by default that of the receiver, else of this computer.

    Returns:
        `lines` (`planned`, `left`, `current`, `left_m`, `planned_m`) or None without a plan, and
        `light` (`now_unix_s`, `elevation_deg`, `limit_deg`, `is_light`, `from_unix_s`,
        `until_unix_s`) or None without a position.
    """
    at_s = _now_unix_s(state) if unix_s is None else unix_s
    place = _place(state, coverage)
    limit_deg = coverage.sun_limit_deg or DEFAULT_ELEVATION_DEG
    light = None
    if place is not None:
        window = light_window(at_s, *place, limit_deg)
        light = {
            "now_unix_s": round(at_s),
            "elevation_deg": round(window.elevation_deg, 2),
            "limit_deg": limit_deg,
            "is_light": window.is_light,
            "from_unix_s": window.from_unix_s and round(window.from_unix_s),
            "until_unix_s": window.until_unix_s and round(window.until_unix_s),
        }
    return {"lines": coverage.lines_left(), "light": light}


def _now_unix_s(state: FlightState) -> float:
    """UTC by the receiver; else by this computer."""
    gps_ns = state.brief()["status"].get("gps_ns")
    if isinstance(gps_ns, str) and gps_ns.isdecimal():
        return GPS_EPOCH_UNIX_S + int(gps_ns) * 1e-9 - leap_seconds_at(int(gps_ns))
    return time.time()


def _place(state: FlightState, coverage: Coverage) -> tuple[float, float] | None:
    """Latitude and longitude in degrees: the last position, else the begin of the plan."""
    position = state.brief()["status"].get("position")
    if isinstance(position, Mapping):
        place = float(position["latitude_deg"]), float(position["longitude_deg"])
        if all(map(math.isfinite, place)):
            return place
    return coverage.first_place()
