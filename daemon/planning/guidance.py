"""Guidance along planned lines: deviations, distances, times and turns from one navigation sample.

Pure: a sample, a line and limits in, figures out. Which line is flown is decided in
`daemon.planning.steering`; the service sends the figures to page and pilot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

from daemon.planning.model import LocalPlane, PlannedLine, Point, Specification
from drivers.contract import NavSample

MIN_SPEED_MPS: Final = 1.0
"""Below this speed there is no track over ground, and no time to anything."""
AHEAD_MAX_S: Final = 10.0
"""A deviation is predicted for the next exposure, at most so far ahead."""
APPROACH_S: Final = 30.0
"""Before the start of a line by less than this the limits hold already."""
TURNING_RAD: Final = math.radians(5.0)
"""Banked by more, an aircraft turns onto a line: its track is not that of the next exposure."""

Side = Literal["left", "right"]
Stage = Literal["approach", "line", "passed"]
Exceeded = Literal["across", "height"]


@dataclass(frozen=True)
class GuidanceLimits:
    """Deviations that the plan tolerates, in metres.

    `across_m` holds to both sides, `below_m` and `above_m` are distances from the planned height;
    None where the plan sets no limit.
    """

    across_m: float
    below_m: float | None = None
    above_m: float | None = None


@dataclass(frozen=True)
class Turn:
    """The turn from a line onto the next: its side, the change of course, and the way to its
    start."""

    line: str
    side: Side
    angle_deg: float
    to_start_m: float


@dataclass(frozen=True)
class Guidance:
    """Where the aircraft is relative to a line; figures that cannot be computed are None.

    `across_m` is positive to the right of the line in flight direction, `across_ahead_m` the same
    at the next exposure if the track stays (now, while the aircraft turns onto the line).
    `height_deviation_m` is positive above the planned height. `to_start_m` and `to_end_m` are
    measured along the line, negative behind. `bearing_deg` and `start_distance_m` lead straight to
    the start of the line. `crab_deg` is heading minus track.
    """

    line: str
    strip: str
    is_reversed: bool
    stage: Stage
    course_deg: float
    length_m: float
    along_m: float
    across_m: float
    across_ahead_m: float
    height_deviation_m: float | None
    to_start_m: float
    to_end_m: float
    to_start_s: float | None
    to_end_s: float | None
    bearing_deg: float
    start_distance_m: float
    speed_mps: float | None
    track_deg: float | None
    heading_deg: float | None
    crab_deg: float | None
    next_exposure_m: float | None
    next_exposure_s: float | None
    exposures_left: int
    turn: Turn | None
    exceeded: tuple[Exceeded, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain JSON types, rounded to what a display shows."""
        content = asdict(self)
        rounded = {k: round(v, 2) if isinstance(v, float) else v for k, v in content.items()}
        if self.turn is not None:
            rounded["turn"] = {
                k: round(v, 1) if isinstance(v, float) else v for k, v in asdict(self.turn).items()
            }
        return rounded | {"exceeded": list(self.exceeded)}


def limits_of(
    specification: Specification,
    *,
    image_across_m: float,
    height_above_ground_m: float,
    gsd_m: float,
    corridor_m: float,
    height_tolerance_m: float | None = None,
) -> GuidanceLimits:
    """Deviations that cost an exposure: position in no line, overlap too small, pixel too large.

    A line displaced by d reduces the sidelap by d over the image width; it may lose the overlap
    tolerance. At a height lower by e the image shrinks, and an overlap p becomes
    1 - (1 - p) / (1 - e / h).

    Args:
        specification: requirements of the plan.
        image_across_m: width of the image on the ground, m.
        height_above_ground_m: planned height above ground, m.
        gsd_m: ground sampling distance at that height, m.
        corridor_m: distance from a line beyond which a position belongs to none, m.
        height_tolerance_m: configured limit in both directions, m; it replaces the computed ones.

    Returns:
        The limits.

    Example:
        >>> limits = limits_of(Specification(), image_across_m=1000.0, height_above_ground_m=800.0,
        ...                    gsd_m=0.05, corridor_m=250.0)
        >>> limits.across_m, round(limits.below_m, 1), limits.above_m
        (100.0, 100.0, None)
    """
    tolerance = specification.overlap_tolerance
    across_m = min(corridor_m, tolerance * image_across_m) if tolerance > 0 else corridor_m
    if height_tolerance_m is not None:
        return GuidanceLimits(across_m, height_tolerance_m, height_tolerance_m)
    below_m = None
    if tolerance > 0:
        overlap = min(specification.forward_overlap, specification.sidelap)
        below_m = height_above_ground_m * tolerance / (1.0 - overlap + tolerance)
    above_m = None
    if specification.gsd_m is not None and gsd_m > 0:
        above_m = max(0.0, height_above_ground_m * (specification.gsd_m / gsd_m - 1.0))
    return GuidanceLimits(across_m, below_m, above_m)


def guide(
    line: PlannedLine,
    sample: NavSample,
    *,
    is_reversed: bool,
    places_m: Sequence[float],
    planned_height_m: float | None,
    limits: GuidanceLimits,
    next_line: tuple[PlannedLine, bool] | None = None,
) -> Guidance | None:
    """Compute the guidance along a line.

    Args:
        line: the line that is flown or comes next.
        sample: position, velocity and attitude.
        is_reversed: whether it is flown from its end to its start.
        places_m: planned exposures along the line in flight direction, rising, m.
        planned_height_m: planned height above the ellipsoid, m; None if it is not known.
        limits: deviations that the plan tolerates.
        next_line: the line after this one and whether it is flown reversed.

    Returns:
        The guidance; None without a position, or for a line without length.

    Source: the plane about the line's start is azimuthal equidistant, so that the line is straight
        and distances along it are exact; across, the error is below d^3 / (6 R^2), 3 cm at 20 km.
    """
    start, end = (line.end, line.start) if is_reversed else (line.start, line.end)
    plane = LocalPlane(start)
    east_m, north_m = plane.flat(end)
    length_m = math.hypot(east_m, north_m)
    if sample.position is None or length_m == 0.0:
        return None
    ahead = (east_m / length_m, north_m / length_m)
    at = plane.flat(Point(*sample.position))
    along_m = ahead[0] * at[0] + ahead[1] * at[1]
    across_m = ahead[1] * at[0] - ahead[0] * at[1]
    velocity = sample.velocity_ned_mps
    along_mps, across_mps, speed_mps, track_deg = 0.0, 0.0, None, None
    if velocity is not None:
        north, east = velocity[:2]
        speed_mps = math.hypot(north, east)
        along_mps = ahead[0] * east + ahead[1] * north
        across_mps = ahead[1] * east - ahead[0] * north
        track_deg = _bearing_deg(east, north) if speed_mps >= MIN_SPEED_MPS else None
    heading_deg = None if sample.heading_rad is None else math.degrees(sample.heading_rad) % 360.0
    moves = along_mps >= MIN_SPEED_MPS
    to_place_m = next((place - along_m for place in places_m if place >= along_m), None)
    to_place_s = to_place_m / along_mps if moves and to_place_m is not None else None
    ahead_s = min(to_place_s if to_place_s is not None else 0.0, AHEAD_MAX_S)
    if along_m < 0 and abs(sample.roll_rad or 0.0) > TURNING_RAD:
        ahead_s = 0.0
    across_ahead_m = across_m + across_mps * ahead_s
    height_deviation_m = None
    if sample.height_m is not None and planned_height_m is not None:
        height_deviation_m = sample.height_m - planned_height_m
    stage: Stage = "approach" if along_m < 0 else "line" if along_m <= length_m else "passed"
    to_start_s = -along_m / along_mps if moves else None
    is_near = stage == "line" or (
        stage == "approach" and to_start_s is not None and to_start_s <= APPROACH_S
    )
    return Guidance(
        line=line.id,
        strip=line.strip or line.id,
        is_reversed=is_reversed,
        stage=stage,
        course_deg=_bearing_deg(east_m, north_m),
        length_m=length_m,
        along_m=along_m,
        across_m=across_m,
        across_ahead_m=across_ahead_m,
        height_deviation_m=height_deviation_m,
        to_start_m=-along_m,
        to_end_m=length_m - along_m,
        to_start_s=to_start_s,
        to_end_s=(length_m - along_m) / along_mps if moves else None,
        bearing_deg=_bearing_deg(-at[0], -at[1]),
        start_distance_m=math.hypot(*at),
        speed_mps=speed_mps,
        track_deg=track_deg,
        heading_deg=heading_deg,
        crab_deg=None
        if heading_deg is None or track_deg is None
        else turn_deg(track_deg, heading_deg),
        next_exposure_m=to_place_m,
        next_exposure_s=to_place_s,
        exposures_left=sum(place >= along_m for place in places_m),
        turn=None
        if next_line is None
        else turn_onto(next_line, plane, (east_m, north_m), _bearing_deg(east_m, north_m)),
        exceeded=exceeded(across_m, across_ahead_m, height_deviation_m, limits) if is_near else (),
    )


def exceeded(
    across_m: float,
    across_ahead_m: float,
    height_deviation_m: float | None,
    limits: GuidanceLimits,
) -> tuple[Exceeded, ...]:
    """The limits that are exceeded now, or will be at the next exposure.

    Args:
        across_m: distance from the line, m.
        across_ahead_m: the same at the next exposure, m.
        height_deviation_m: height above the planned one, m; None if it is not known.
        limits: the limits.

    Returns:
        Names of the exceeded limits.

    Example:
        >>> exceeded(20.0, 60.0, -5.0, GuidanceLimits(50.0, below_m=10.0))
        ('across',)
    """
    found: list[Exceeded] = []
    if max(abs(across_m), abs(across_ahead_m)) > limits.across_m:
        found.append("across")
    if height_deviation_m is not None:
        is_low = limits.below_m is not None and height_deviation_m < -limits.below_m
        is_high = limits.above_m is not None and height_deviation_m > limits.above_m
        if is_low or is_high:
            found.append("height")
    return tuple(found)


def turn_onto(
    next_line: tuple[PlannedLine, bool],
    plane: LocalPlane,
    end_m: tuple[float, float],
    course_deg: float,
) -> Turn:
    """The turn from the end of a line onto the next one.

    Args:
        next_line: the next line, and whether it is flown reversed.
        plane: a plane near both lines.
        end_m: end of this line in the plane: east and north, m.
        course_deg: course on this line, deg.

    Returns:
        The side on which the next line begins; straight on, the side of the change of course.
    """
    line, is_reversed = next_line
    start, end = (line.end, line.start) if is_reversed else (line.start, line.end)
    begin_m, finish_m = plane.flat(start), plane.flat(end)
    to_m = (begin_m[0] - end_m[0], begin_m[1] - end_m[1])
    angle_deg = turn_deg(
        course_deg, _bearing_deg(finish_m[0] - begin_m[0], finish_m[1] - begin_m[1])
    )
    course = math.radians(course_deg)
    right_m = math.cos(course) * to_m[0] - math.sin(course) * to_m[1]
    side: Side = "right" if (right_m if abs(right_m) > 1.0 else angle_deg) > 0 else "left"
    return Turn(line.id, side, abs(angle_deg), math.hypot(*to_m))


def turn_deg(from_deg: float, to_deg: float) -> float:
    """The change of direction from one bearing to another, -180 to 180 deg, positive to the right.

    Args:
        from_deg: first bearing, deg.
        to_deg: second bearing, deg.

    Returns:
        The angle, deg.

    Example:
        >>> turn_deg(350.0, 10.0), turn_deg(10.0, 350.0)
        (20.0, -20.0)
    """
    return (to_deg - from_deg + 180.0) % 360.0 - 180.0


def _bearing_deg(east: float, north: float) -> float:
    return math.degrees(math.atan2(east, north)) % 360.0
