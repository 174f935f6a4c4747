"""Which segments of which lines must be flown again, before leaving.

A point of a line is well where enough images that count see it, over the whole width of its strip:
as many as the overlap asks for, at the ends of the line as many as the plan itself gives. A segment
that is not well is named from the planned station before it to the one behind, since that is what
an aircraft can fly.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.plan.model import Plan, Plane, PlannedLine, Point, Specification

STEP_M = 2.0
"""How finely coverage is looked at along a line; a hole that is shorter is none."""

ACROSS_SAMPLES = 9
"""At how many places across the strip a point must be seen."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Taken:
    """An exposure as the advisor sees it.

    `corners` is its footprint, counter-clockwise or clockwise. `why_not` says why it does not
    count, such as "refly" or "tilted"; empty where it does.
    """

    number: int
    corners: tuple[Point, ...]
    why_not: str = ""


@dataclass(frozen=True)
class Segment:
    """A part of a line to be flown again, and why. Distances in metres from the line's start."""

    line: PlannedLine
    from_m: float
    to_m: float
    start: Point
    end: Point
    reasons: tuple[str, ...]

    @property
    def length_m(self) -> float:
        return self.to_m - self.from_m


@dataclass(frozen=True)
class Advice:
    """What to fly again, and how much of the plan is well."""

    segments: tuple[Segment, ...]
    planned_m: float
    well_m: float

    @property
    def is_complete(self) -> bool:
        return not self.segments


def advise(
    plan: Plan, taken: Sequence[Taken], *, image_along_m: float, image_across_m: float
) -> Advice:
    """Look at every line of a plan.

    Args:
        taken: exposures with footprints on the ground, in any order.
        image_along_m, image_across_m: what one image sees of level ground as planned.

    Returns:
        Segments by line, in the order they are flown.
    """
    plane = Plane(plan.lines[0].start)
    footprints = [(one, _flat(plane, one.corners)) for one in taken]
    base_m = image_along_m * (1.0 - plan.specification.forward_overlap)
    segments: list[Segment] = []
    planned_m = well_m = 0.0
    for line in plan.lines:
        found, length_m, good_m = _of_line(
            line, plane, footprints, plan.specification, base_m, image_along_m, image_across_m
        )
        segments += found
        planned_m += length_m
        well_m += good_m
    return Advice(tuple(segments), planned_m, well_m)


def _of_line(
    line: PlannedLine,
    plane: Plane,
    footprints: Sequence[tuple[Taken, Array]],
    specification: Specification,
    base_m: float,
    along_m: float,
    across_m: float,
) -> tuple[list[Segment], float, float]:
    start, end = np.array(plane.flat(line.start)), np.array(plane.flat(line.end))
    length_m = float(np.hypot(*(end - start)))
    if length_m == 0.0:
        return [], 0.0, 0.0
    ahead = (end - start) / length_m
    left = np.array([-ahead[1], ahead[0]])
    # Neighbours overlap by the sidelap; the strip of a line is what only it must see.
    half_strip_m = across_m * (1.0 - specification.sidelap) / 2.0
    along = np.arange(0.0, length_m + STEP_M / 2, STEP_M)
    across = np.linspace(-half_strip_m, half_strip_m, ACROSS_SAMPLES)
    points = start + along[:, None, None] * ahead + across[None, :, None] * left
    near = [
        (one, corners)
        for one, corners in footprints
        if _touches(corners, points, along_m + across_m)
    ]
    seen = np.zeros(points.shape[:2], dtype=np.int64)
    for one, corners in near:
        if not one.why_not:
            seen += inside(corners, points)
    stations = np.arange(0.0, length_m + base_m, base_m)
    planned = np.sum(np.abs(along[:, None] - stations) <= along_m / 2 - STEP_M, axis=1)
    needed = np.minimum(planned, specification.images_on_every_point)
    is_well: NDArray[np.bool_] = np.all(seen >= needed[:, None], axis=1)
    segments = []
    for first, last in _runs(np.logical_not(is_well)):
        from_m = math.floor(along[first] / base_m + 1e-9) * base_m
        to_m = min(math.ceil(along[last] / base_m - 1e-9) * base_m, length_m)
        to_m = max(to_m, min(from_m + base_m, length_m))
        reasons = sorted(
            {
                f"exposure {one.number}: {one.why_not}"
                for one, corners in near
                if one.why_not and inside(corners, points[first : last + 1]).any()
            }
        )
        segments.append(
            Segment(
                line=line,
                from_m=from_m,
                to_m=to_m,
                start=plane.place(*(start + from_m * ahead)),
                end=plane.place(*(start + to_m * ahead)),
                reasons=tuple(reasons) or ("not seen often enough",),
            )
        )
    return _joined(segments), length_m, float(is_well.mean()) * length_m


def _joined(segments: Sequence[Segment]) -> list[Segment]:
    """Segments that touch are one."""
    joined: list[Segment] = []
    for one in segments:
        if joined and one.from_m <= joined[-1].to_m:
            last = joined[-1]
            joined[-1] = Segment(
                last.line,
                last.from_m,
                max(last.to_m, one.to_m),
                last.start,
                one.end if one.to_m >= last.to_m else last.end,
                tuple(sorted({*last.reasons, *one.reasons})),
            )
        else:
            joined.append(one)
    return joined


def _flat(plane: Plane, corners: Iterable[Point]) -> Array:
    return np.array([plane.flat(corner) for corner in corners])


def _touches(corners: Array, points: Array, margin_m: float) -> bool:
    low, high = points.min(axis=(0, 1)) - margin_m, points.max(axis=(0, 1)) + margin_m
    return bool((corners.max(axis=0) >= low).all() and (corners.min(axis=0) <= high).all())


def inside(corners: Array, points: Array) -> NDArray[np.bool_]:
    """Which points lie inside a convex polygon, edges included; shape of points less the last."""
    to_next = np.roll(corners, -1, axis=0) - corners
    area = float(np.sum(corners[:, 0] * np.roll(corners[:, 1], -1)))
    area -= float(np.sum(corners[:, 1] * np.roll(corners[:, 0], -1)))
    inside = np.ones(points.shape[:-1], dtype=np.bool_)
    for corner, edge in zip(corners, to_next, strict=True):
        away = points - corner
        inside &= (edge[0] * away[..., 1] - edge[1] * away[..., 0]) * math.copysign(
            1, area
        ) >= -1e-6
    return inside


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[0::2], edges[1::2], strict=True)]
