"""Whether a trajectory of a file is that of the flight: compared with the navigation of exposures.

A post-processed trajectory differs from what receivers reported in flight by metres. Farther ones
are refused with the cause that explains the difference: another time system, exchanged coordinates,
heights above the geoid.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from daemon.mission.exposure import Exposure, NavigationRecord
from daemon.orientation.geodesy import ELLIPSOID
from daemon.orientation.trajectory import Trajectory, TrajectoryError

COMPARED_MAX = 200
DIFFERENCE_M = 20.0
"""Of a single point position without correction data, in addition to its stated accuracy."""
SIGMAS = 5.0
UNSTATED_SIGMA_M = 10.0
TIME_SHIFT_MAX_S = 60

_Place = tuple[float, float, float | None]
"""Latitude, longitude, height."""


@dataclass(frozen=True)
class _Difference:
    """Medians over the exposures: across the ground, and in height where both have one, metres."""

    horizontal_m: float
    height_m: float | None
    compared: int


def refuse_other_trajectory(trajectory: Trajectory, exposures: Iterable[Exposure]) -> None:
    """Refuse a file whose positions are not those of the flight.

    Args:
        trajectory: of the file.
        exposures: those without navigation are left out.

    Raises:
        TrajectoryError: positions or heights are far from those that were recorded; the message
            states how far, and the cause if one explains it.
    """
    flown = _spread([one.navigation for one in exposures if one.navigation is not None])
    found = _difference(trajectory, flown)
    if found is None:
        return
    limit_m = DIFFERENCE_M + SIGMAS * _sigma(one.horizontal_sigma_m for one in flown)
    height_limit_m = DIFFERENCE_M + SIGMAS * _sigma(one.vertical_sigma_m for one in flown)
    if found.horizontal_m > limit_m:
        raise TrajectoryError(
            f"{trajectory.name}: its positions are {_length(found.horizontal_m)} from those that "
            f"were recorded in flight (median of {found.compared} exposures)"
            f"{_cause(trajectory, flown, limit_m)}"
        )
    if found.height_m is not None and abs(found.height_m) > height_limit_m:
        raise TrajectoryError(
            f"{trajectory.name}: its heights are {found.height_m:+.1f} m from those that were "
            f"recorded in flight (median of {found.compared} exposures). Heights above the "
            "ellipsoid are read; are these above the geoid, or in feet?"
        )


def _spread(flown: Sequence[NavigationRecord]) -> list[NavigationRecord]:
    step = max(1, math.ceil(len(flown) / COMPARED_MAX))
    return list(flown[::step])


def _sigma(stated: Iterable[float | None]) -> float:
    return statistics.median(UNSTATED_SIGMA_M if one is None else one for one in stated)


def _length(metres: float) -> str:
    return f"{metres:.1f} m" if metres < 1000.0 else f"{metres / 1000.0:.1f} km"


def _difference(
    trajectory: Trajectory,
    flown: Sequence[NavigationRecord],
    *,
    change: Callable[[_Place], _Place] = lambda place: place,
    shift_ns: int = 0,
) -> _Difference | None:
    """Of the file from the flight, with its places changed, its times shifted.

    None where no exposure is in the time of the file.
    """
    horizontal, heights = [], []
    for one in flown:
        there = trajectory.at(one.gps_ns + shift_ns)
        if there is None:
            continue
        latitude, longitude, height = change(
            (there.latitude_deg, there.longitude_deg, there.height_m)
        )
        if abs(latitude) > 90.0:
            continue
        _, _, apart_m = ELLIPSOID.inv(longitude, latitude, one.longitude_deg, one.latitude_deg)
        horizontal.append(float(apart_m))
        if height is not None and one.height_m is not None and one.height_reference == "ellipsoid":
            heights.append(height - one.height_m)
    if not horizontal:
        return None
    height_m = statistics.median(heights) if heights else None
    return _Difference(statistics.median(horizontal), height_m, len(horizontal))


def _cause(trajectory: Trajectory, flown: Sequence[NavigationRecord], limit_m: float) -> str:
    """What makes the positions agree, as the end of a sentence and a further one."""
    for change, sentence in _CHANGES:
        found = _difference(trajectory, flown, change=change)
        if found is not None and found.horizontal_m <= limit_m:
            return f". They agree if {sentence}"
    shifts = {
        seconds: found.horizontal_m
        for seconds in range(-TIME_SHIFT_MAX_S, TIME_SHIFT_MAX_S + 1)
        if (found := _difference(trajectory, flown, shift_ns=seconds * 1_000_000_000)) is not None
        and 2 * found.compared >= len(flown)
    }
    best = min(shifts, key=lambda seconds: shifts[seconds], default=0)
    if not shifts or shifts[best] > limit_m:
        return ". It is of another flight or in another coordinate system"
    late = "early" if best < 0 else "late"
    leap_seconds = next((one.leap_seconds for one in flown if one.leap_seconds), None)
    is_utc = leap_seconds is not None and best == -leap_seconds
    named = ", the leap seconds of UTC: GPS time is read" if is_utc else ""
    return f". They agree if its times are {abs(best)} s too {late}{named}"


_CHANGES: tuple[tuple[Callable[[_Place], _Place], str], ...] = (
    (lambda p: (p[1], p[0], p[2]), "latitude and longitude are exchanged"),
    (lambda p: (-p[0], p[1], p[2]), "the latitude has the other sign"),
    (lambda p: (p[0], -p[1], p[2]), "the longitude has the other sign"),
    (lambda p: (-p[0], -p[1], p[2]), "latitude and longitude have the other sign"),
    (
        lambda p: (math.degrees(p[0]), math.degrees(p[1]), p[2]),
        "latitude and longitude are in radians; degrees are read",
    ),
)
