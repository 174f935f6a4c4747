"""Positions of event marks that were computed with a solution of RTKLIB (`<name>_events.pos`).

RTKLIB EX puts them on the straight line between the two epochs around the mark, however far these
are apart, with the accuracies of the earlier one. Those are not used: positions are interpolated
between the epochs instead (`daemon.orientation.navigation`), which follows an acceleration and
ends two seconds from the next epoch. Positions that another program computed better are used.

Source: RTKLIB EX 2.5.0, postpos.c, fillsoltm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from daemon.mission.exposure import NavigationRecord
from daemon.orientation.geodesy import metres_per_degree
from daemon.orientation.trajectory import Trajectory, TrajectoryError
from drivers.contract import NavSample

EVENTS = "_events.pos"
STRAIGHT_M = 0.005
"""Rounding of positions in both files, in addition to that of times."""
CONTRADICTION_SIGMAS = 5.0
CONTRADICTION_M = 0.1


def positions_of_marks(
    path: Path, solution: Trajectory, events: Sequence[NavSample], *, resolution_s: float
) -> list[NavSample]:
    """Events whose positions are not those of a straight line between two epochs.

    They get the velocity of the solution at their instant.

    Args:
        path: of the events.
        solution: epochs of the solution, with velocities.
        events: positions of marks.
        resolution_s: of the times in both files.

    Raises:
        TrajectoryError: a position that contradicts the solution.
    """
    used = []
    for event in events:
        if _is_on_line(solution, event, resolution_s):
            continue
        there = solution.at(event.gps_ns)
        if there is not None:
            _refuse_contradiction(path, there, event)
            event = replace(event, velocity_ned_mps=there.velocity_ned_mps)
        used.append(event)
    return used


def _is_on_line(solution: Trajectory, event: NavSample, resolution_s: float) -> bool:
    index = int(np.searchsorted(solution.instants_ns, event.gps_ns, side="right"))
    if not 0 < index < len(solution.instants_ns):
        return False
    a, b = solution.sample(index - 1), solution.sample(index)
    share = (event.gps_ns - a.gps_ns) / (b.gps_ns - a.gps_ns)
    way_m = north_east_up_m(a, b)
    speed_mps = math.hypot(*way_m) / ((b.gps_ns - a.gps_ns) * 1e-9)
    found_m = north_east_up_m(a, event)
    apart_m = math.dist(found_m, [share * axis_m for axis_m in way_m])
    return apart_m <= STRAIGHT_M + 2.0 * speed_mps * resolution_s


def _refuse_contradiction(path: Path, there: NavigationRecord, event: NavSample) -> None:
    expected = (there.latitude_deg, there.longitude_deg, there.height_m or 0.0)
    north_m, east_m, up_m = _metres_between(expected, _place(event))
    for apart_m, sigmas in (
        (math.hypot(north_m, east_m), (event.horizontal_sigma_m, there.horizontal_sigma_m)),
        (abs(up_m), (event.vertical_sigma_m, there.vertical_sigma_m)),
    ):
        sigma_m = math.hypot(*(sigma or 0.0 for sigma in sigmas))
        if apart_m > CONTRADICTION_M + CONTRADICTION_SIGMAS * sigma_m:
            raise TrajectoryError(
                f"{path}: the mark at {event.gps_ns} ns of GPS time is {apart_m:.2f} m from the "
                f"positions of {path.name.removesuffix(EVENTS)}.pos. Both must be of one solution; "
                "compute them again, or remove the events"
            )


def north_east_up_m(a: NavSample, b: NavSample) -> tuple[float, float, float]:
    """From one sample to the other, metres; both have positions."""
    return _metres_between(_place(a), _place(b))


def _metres_between(
    a: tuple[float, float, float], b: tuple[float, float, float]
) -> tuple[float, float, float]:
    per_latitude, per_longitude = metres_per_degree(a[0], a[2])
    east_deg = math.remainder(b[1] - a[1], 360.0)
    return (b[0] - a[0]) * per_latitude, east_deg * per_longitude, b[2] - a[2]


def _place(sample: NavSample) -> tuple[float, float, float]:
    """Latitude, longitude, height; every sample of a file has them."""
    values = (sample.latitude_deg, sample.longitude_deg, sample.height_m)
    latitude, longitude, height = (0.0 if value is None else value for value in values)
    return latitude, longitude, height
