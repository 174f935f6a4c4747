"""A flight plan: lines with their ids, and the project's requirements on images.

Places are WGS 84 in degrees. A `Plane` lays a project flat, good to decimetres over some
kilometres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from daemon.orientation.geodesy import east_north_m, place_at


class Point(NamedTuple):
    """A place, degrees."""

    latitude_deg: float
    longitude_deg: float


@dataclass(frozen=True)
class PlannedLine:
    """A line to be flown from `start` to `end`; `strip` groups lines that continue each other.

    Exposures are due every `distance_m` from the start on, or at the places `at_m` (metres from
    the start, rising) where the plan names them; where it has neither, by the overlap.
    """

    id: str
    start: Point
    end: Point
    strip: str = ""
    distance_m: float | None = None
    at_m: tuple[float, ...] = ()


@dataclass(frozen=True)
class Specification:
    """Requirements of a project.

    Overlaps are shares of the image's extent along and across the line, as planned; the least that
    is taken is `overlap_tolerance` below them. An exposure that violates a requirement has to be
    flown again, and does not count for the advisor. `gsd_m` and `sun_deg` (elevation) are asked for
    only where they are given.
    """

    forward_overlap: float = 0.6
    sidelap: float = 0.3
    overlap_tolerance: float = 0.1
    gsd_m: float | None = None
    tilt_deg: float = 5.0
    crab_deg: float = 10.0
    sun_deg: float | None = None
    time_sigma_ns: float = 1e9

    @property
    def images_on_every_point(self) -> int:
        """How many images of a line must see each point of it: 2 at 60 %, 5 at 80 %."""
        return max(1, math.floor(1.0 / (1.0 - self.forward_overlap) + 1e-9))

    @property
    def lines_on_every_point(self) -> int:
        """From how many lines each point must be seen: 1 at 30 % sidelap, 2 at 60 %."""
        return max(1, math.floor(1.0 / (1.0 - self.sidelap) + 1e-9))


@dataclass(frozen=True)
class Plan:
    """Lines in the order they are to be flown."""

    name: str
    lines: tuple[PlannedLine, ...]
    specification: Specification = Specification()

    def line(self, line_id: str) -> PlannedLine:
        """The line of that id; KeyError names those there are."""
        for line in self.lines:
            if line.id == line_id:
                return line
        raise KeyError(
            f"no line {line_id!r}; there are {', '.join(line.id for line in self.lines)}"
        )


class LocalPlane:
    """Metres east and north of an origin on the ellipsoid (`daemon.orientation.geodesy`)."""

    def __init__(self, origin: Point) -> None:
        self.origin = origin
        self._origin = (origin.latitude_deg, origin.longitude_deg)

    def flat(self, point: Point) -> tuple[float, float]:
        return east_north_m(self._origin, (point.latitude_deg, point.longitude_deg))

    def place(self, east_m: float, north_m: float) -> Point:
        return Point(*place_at(self._origin, east_m, north_m))
