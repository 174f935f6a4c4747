"""Retakes: one exposure or a segment of a planned line that is to be flown again.

A retake is a short line of its own over the planned one, with the same places of exposure, so that
steering, guidance and coverage treat it as any other line.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection
from typing import Final

from daemon import DaemonError
from daemon.planning.model import LocalPlane, Plan, PlannedLine
from daemon.planning.steering import places_m

RETAKES_MAX: Final = 200
LEAD_SHARE: Final = 0.5
"""A retake begins this share of the exposure distance before its first place."""


class RetakeError(DaemonError, ValueError):
    """A retake that cannot be flown; the message contains the reason and the corrective action."""


def retake_line(
    plan: Plan,
    line_id: str,
    from_m: float,
    to_m: float,
    *,
    distance_m: float,
    taken: Collection[str] = (),
) -> PlannedLine:
    """The line of a retake.

    Args:
        plan: the plan that is flown.
        line_id: the planned line.
        from_m: first station to be exposed again, m from the start of the line.
        to_m: last one; equal to `from_m` for a single exposure.
        distance_m: distance of exposures on lines that do not state it, m.
        taken: ids of retakes that exist.

    Returns:
        A line with an unused id `LINE R1`, with one exposure at the nearest planned place, or at
        all planned places of the segment.

    Raises:
        RetakeError: no such line, a segment outside it, or too many retakes.
    """
    if len(taken) >= RETAKES_MAX:
        raise RetakeError(f"{RETAKES_MAX} retakes are planned already; fly these first")
    try:
        line = plan.line(line_id)
    except KeyError as error:
        raise RetakeError(str(error.args[0])) from error
    plane = LocalPlane(line.start)
    east_m, north_m = plane.flat(line.end)
    length_m = math.hypot(east_m, north_m)
    if length_m == 0.0:
        raise RetakeError(f"line {line_id} has no length and cannot be flown")
    places = places_m(line, length_m, distance_m)
    spacings_m = (b - a for a, b in itertools.pairwise(places) if b > a)
    step_m = min(spacings_m, default=line.distance_m or distance_m)
    first_m, last_m = sorted((from_m, to_m))
    if last_m < -step_m or first_m > length_m + step_m:
        raise RetakeError(
            f"{first_m:.0f} m to {last_m:.0f} m is not on line {line_id}, "
            f"which is {length_m:.0f} m long"
        )
    chosen = [place for place in places if first_m - 0.01 <= place <= last_m + 0.01]
    if not chosen:
        chosen = [min(places, key=lambda place: abs(place - (first_m + last_m) / 2))]
    begin_m = chosen[0] - LEAD_SHARE * step_m
    finish_m = chosen[-1] + LEAD_SHARE * step_m
    ahead = (east_m / length_m, north_m / length_m)
    free = (f"{line_id} R{number}" for number in itertools.count(1))
    return PlannedLine(
        id=next(one for one in free if one not in taken),
        start=plane.place(ahead[0] * begin_m, ahead[1] * begin_m),
        end=plane.place(ahead[0] * finish_m, ahead[1] * finish_m),
        strip=line.strip or line.id,
        at_m=tuple(place - begin_m for place in chosen),
    )
