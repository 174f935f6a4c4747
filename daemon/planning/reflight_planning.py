"""Find the segments of lines that must be flown again, before leaving.

A point of a line is well where enough images hold valid pixels of it in every band, over the whole
width of its strip: as many as the overlaps ask for, at the ends of the line and of the block as
many as the plan itself gives. A part that is not well is named by the planned stations from which
enough images see it, since that is what an aircraft can fly.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from daemon.planning.image_counts import (
    STEP_M,
    Array,
    Counts,
    ExposureFootprint,
    Flags,
    FlightFootprints,
    LineStrip,
    Relief,
    StripCoverage,
    count_images,
    project_footprints,
    strip_of,
)
from daemon.planning.model import LocalPlane, Plan, PlannedLine, Point
from processing.quality.valid_area import boxes_of

__all__ = ["STEP_M", "ExposureFootprint", "Hole", "ReflightPlan", "Segment", "reflights"]

Kind = Literal["hole", "to fly"]
RINGS_MAX = 200
"""Of a hole; one that needs more is drawn in coarser steps."""


@dataclass(frozen=True)
class Hole:
    """Ground that too few images see, in at least one band.

    `rings` are its corners, piece by piece. `images` is the least number of images that see a point
    of it, `needed` how many must see that point. `bands` are those with too few images there; empty
    where all do.
    """

    area_m2: float
    rings: tuple[tuple[Point, ...], ...]
    images: int
    needed: int
    bands: tuple[str, ...] = ()


@dataclass(frozen=True)
class Segment:
    """A part of a line to be flown again, and why. Distances in metres from the line's start.

    `kind` is "to fly" where it is only to be flown yet. Without `hole` nothing is known to be seen.
    """

    line: PlannedLine
    from_m: float
    to_m: float
    start: Point
    end: Point
    reasons: tuple[str, ...]
    kind: Kind = "hole"
    holes: tuple[Hole, ...] = ()

    @property
    def length_m(self) -> float:
        return self.to_m - self.from_m

    @property
    def area_m2(self) -> float:
        return sum(hole.area_m2 for hole in self.holes)


@dataclass(frozen=True)
class ReflightPlan:
    """Segments to fly again, and the covered length of the plan.

    `hole_m2` is the ground that too few images see and no planned exposure will.
    """

    segments: tuple[Segment, ...]
    planned_m: float
    covered_m: float
    hole_m2: float = 0.0

    @property
    def is_complete(self) -> bool:
        return not self.segments


@dataclass(frozen=True)
class LineReflights:
    """Result for one line, and the images it is based on."""

    segments: tuple[Segment, ...]
    planned_m: float
    covered_m: float
    based_on: tuple[object, ...] = ()


@dataclass(frozen=True)
class _ReflightInputs:
    """Inputs common to all lines."""

    plan: Plan
    plane: LocalPlane
    taken: Sequence[ExposureFootprint]
    flown: FlightFootprints
    along_m: float
    across_m: float
    relief: Relief | None = None
    unflown: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def base_m(self) -> float:
        return self.along_m * (1.0 - self.plan.specification.forward_overlap)


def reflights(
    plan: Plan,
    taken: Sequence[ExposureFootprint],
    *,
    image_along_m: float,
    image_across_m: float,
    relief: Relief | None = None,
    unflown: Mapping[str, tuple[float, float]] | None = None,
    known: dict[str, LineReflights] | None = None,
) -> ReflightPlan:
    """Look at every line of a plan.

    Args:
        taken: exposures with footprints on the ground, in any order.
        image_along_m, image_across_m: what one image sees of level ground as planned.
        relief: the terrain over the level ground of the footprints, where it is known.
        unflown: by line, intervals of distance from its start (metres) that are still to be flown.
            Ground that the planned exposures there will see is no hole.
        known: what was found before, by line, with the same plan and relief; a line for which
            nothing has changed is not looked at again. It is updated.

    Returns:
        Segments by line, in the order they are flown.
    """
    plane = LocalPlane(plan.lines[0].start)
    block = _ReflightInputs(
        plan,
        plane,
        taken,
        project_footprints(plane, taken),
        image_along_m,
        image_across_m,
        relief,
        unflown or {},
    )
    segments: list[Segment] = []
    planned_m = covered_m = 0.0
    for line in plan.lines:
        before = None if known is None else known.get(line.id)
        found = _of_line(line, block, before)
        if known is not None:
            known[line.id] = found
        segments += found.segments
        planned_m += found.planned_m
        covered_m += found.covered_m
    hole_m2 = sum(one.area_m2 for one in segments)
    return ReflightPlan(tuple(segments), planned_m, covered_m, hole_m2)


def _of_line(
    line: PlannedLine, block: _ReflightInputs, before: LineReflights | None
) -> LineReflights:
    specification, along_m = block.plan.specification, block.along_m
    # Neighbours overlap by the sidelap; the strip of a line is what only it must see.
    half_strip_m = block.across_m * (1.0 - specification.sidelap) / 2.0
    strip = strip_of(
        line,
        block.plane,
        half_width_m=half_strip_m,
        image_along_m=along_m,
        relief=block.relief,
    )
    if strip is None:
        return LineReflights((), 0.0, 0.0)
    unplaced = tuple(one.number for one in block.taken if not one.corners)
    based_on = (*block.flown.near(strip), block.unflown.get(line.id), unplaced)
    if before is not None and _are_same(before.based_on, based_on):
        return before
    seen = list(block.flown.seen(strip))
    inside, in_gaps = count_images(strip, [one for one in seen if not one.taken.exclusion_reason])
    needed = _needed(strip, block)
    upcoming = _upcoming_images(strip, block, line)
    band_deficit = {band: needed - (inside - gaps) for band, gaps in in_gaps.items()}
    worst = np.maximum.reduce([needed - inside, *band_deficit.values()])
    is_covered: Flags = np.all(worst <= 0, axis=1)
    is_hole = worst > upcoming[:, None]
    found = _LineCoverage(
        line, strip, block, seen, needed, inside, band_deficit, worst - upcoming[:, None]
    )
    runs = [slice(first, last + 1) for first, last in _runs(is_hole.any(axis=1))]
    segments = found.segments(runs)
    if line.id in block.unflown and not np.all(is_covered[upcoming > 0]):
        from_m, to_m = block.unflown[line.id]
        segments.append(found.unflown(from_m, to_m))
    segments.sort(key=lambda one: one.from_m)
    covered_m = float(is_covered.mean()) * strip.length_m
    return LineReflights(tuple(segments), strip.length_m, covered_m, based_on)


def _are_same(before: tuple[object, ...], now: tuple[object, ...]) -> bool:
    return len(before) == len(now) and all(
        a is b or (isinstance(a, tuple) and a == b) for a, b in zip(before, now, strict=True)
    )


def _needed(strip: LineStrip, block: _ReflightInputs) -> Counts:
    """How many images must see each point, (n, m): what the overlaps ask for, where the plan gives
    it."""
    specification, plan = block.plan.specification, block.plan
    lines_needed = specification.lines_on_every_point
    stations = np.arange(0.0, strip.length_m + block.base_m, block.base_m)
    counts = _images_at(strip.along, stations, block.along_m)
    needed = np.minimum(counts, specification.images_on_every_point)[:, None]
    if lines_needed == 1:
        return np.broadcast_to(needed, (len(strip.along), len(strip.across)))
    by_line = []
    for line in plan.lines:
        other = strip_of(line, block.plane, half_width_m=1.0, image_along_m=block.along_m)
        if other is None:
            continue
        relative = strip.points - other.start
        stations = np.arange(0.0, other.length_m + block.base_m, block.base_m)
        counts = _images_at(relative @ other.ahead, stations, block.along_m)
        counts[np.abs(relative @ other.left) > block.across_m / 2 - _margin_m(block.across_m)] = 0
        by_line.append(np.minimum(counts, specification.images_on_every_point))
    maximum = np.sort(np.array(by_line), axis=0)[::-1][:lines_needed]
    return np.asarray(maximum.sum(axis=0))


def _upcoming_images(strip: LineStrip, block: _ReflightInputs, line: PlannedLine) -> Counts:
    """Number of planned images that will still see each point along a line, (n,)."""
    if line.id not in block.unflown:
        return np.zeros(len(strip.along), np.int16)
    from_m, to_m = block.unflown[line.id]
    stations = np.arange(0.0, strip.length_m + block.base_m, block.base_m)
    stations = stations[(stations >= from_m - 1e-6) & (stations <= to_m + block.base_m)]
    return _images_at(strip.along, stations, block.along_m, margin_m=0.0)


def _images_at(
    along: Array,
    stations: Array,
    image_along_m: float,
    margin_m: float | None = None,
) -> Counts:
    """Number of images at the stations that see the places along a line, of any shape.

    The margin at the border of an image is that of `_margin_m` where none is given.
    """
    reach_m = image_along_m / 2 - (_margin_m(image_along_m) if margin_m is None else margin_m)
    high = np.searchsorted(stations, along + reach_m, side="right")
    low = np.searchsorted(stations, along - reach_m, side="left")
    return np.asarray(high - low, np.int16)


def _margin_m(image_m: float) -> float:
    """How near to the border of a planned image the ground need not be seen, m."""
    return min(STEP_M, image_m / 250.0)


@dataclass(frozen=True)
class _LineCoverage:
    """Coverage of a line; `band_deficit` and `deficit` are missing images at points (n, m)."""

    line: PlannedLine
    strip: LineStrip
    block: _ReflightInputs
    seen: Sequence[StripCoverage]
    needed: Counts
    inside: Counts
    band_deficit: Mapping[str, Counts]
    deficit: Counts

    def segments(self, runs: Sequence[slice]) -> list[Segment]:
        """The stations from which runs of rows are seen often enough, and what is wrong there.

        Parts that touch are one segment.
        """
        joined: list[tuple[float, float, list[slice]]] = []
        for rows in runs:
            from_m, to_m = self._stations(rows)
            if joined and from_m <= joined[-1][1]:
                before = joined.pop()
                from_m, to_m = min(from_m, before[0]), max(to_m, before[1])
                joined.append((from_m, to_m, [*before[2], rows]))
            else:
                joined.append((from_m, to_m, [rows]))
        found = []
        for from_m, to_m, parts in joined:
            holes = tuple(self._hole(rows) for rows in parts)
            found.append(self._segment(from_m, to_m, self._reasons(parts, holes), holes=holes))
        return found

    def unflown(self, from_m: float, to_m: float) -> Segment:
        return self._segment(from_m, to_m, ("not flown yet",), kind="to fly")

    def _segment(
        self,
        from_m: float,
        to_m: float,
        reasons: tuple[str, ...],
        *,
        kind: Kind = "hole",
        holes: tuple[Hole, ...] = (),
    ) -> Segment:
        place = self.block.plane.place
        start, end = self.strip.place(from_m, 0.0), self.strip.place(to_m, 0.0)
        return Segment(
            *(self.line, from_m, to_m, place(*start), place(*end), reasons), kind=kind, holes=holes
        )

    def _stations(self, rows: slice) -> tuple[float, float]:
        """From the first to the last station needed, metres; at least one base apart.

        A point with k missing images gets them from the k stations nearest to it.
        """
        base_m, length_m = self.block.base_m, self.strip.length_m
        at = self.strip.along[rows] / base_m
        images = np.maximum(self.deficit[rows].max(axis=1), 1)
        last_station = math.ceil(length_m / base_m - 1e-9)
        low = np.ceil(at - images / 2 - 1e-9)
        low = np.clip(low, 0, np.maximum(last_station + 1 - images, 0))
        high = low + images - 1
        first = min(float(low.min()), math.floor(at[0] + 1e-9))
        last = max(float(high.max()), math.ceil(at[-1] - 1e-9))
        from_m = max(first, 0.0) * base_m
        to_m = min(last * base_m, length_m)
        return from_m, max(to_m, min(from_m + base_m, length_m))

    def _hole(self, rows: slice) -> Hole:
        cells = self.deficit[rows] > 0
        strip, place = self.strip, self.block.plane.place
        half_along, half_across = strip.cell_m[0] / 2, strip.cell_m[1] / 2
        rings = []
        for left, top, right, bottom in boxes_of(cells, RINGS_MAX):
            a0 = max(strip.along[rows][top] - half_along, 0.0)
            a1 = min(strip.along[rows][bottom - 1] + half_along, strip.length_m)
            b0, b1 = strip.across[left] - half_across, strip.across[right - 1] + half_across
            b0, b1 = max(b0, strip.across[0]), min(b1, strip.across[-1])
            corners = ((a0, b0), (a1, b0), (a1, b1), (a0, b1))
            rings.append(tuple(place(*strip.place(a, b)) for a, b in corners))
        area_m2 = float(
            _within(strip.along[rows], half_along, 0.0, strip.length_m)
            @ cells
            @ _within(strip.across, half_across, strip.across[0], strip.across[-1])
        )
        worst = np.unravel_index(np.argmax(np.where(cells, self.deficit[rows], -1)), cells.shape)
        deficit = np.maximum.reduce([self.needed - self.inside, *self.band_deficit.values()])[rows]
        needed = int(self.needed[rows][worst])
        everywhere = (self.needed - self.inside)[rows][cells]
        bands = () if (everywhere > 0).all() else self._bands(rows, cells)
        return Hole(area_m2, tuple(rings), max(0, needed - int(deficit[worst])), needed, bands)

    def _bands(self, rows: slice, cells: Flags) -> tuple[str, ...]:
        return tuple(
            sorted(
                band
                for band, band_deficit in self.band_deficit.items()
                if (band_deficit[rows][cells] > 0).any()
            )
        )

    def _reasons(self, parts: Sequence[slice], holes: Sequence[Hole]) -> tuple[str, ...]:
        cells = np.zeros(self.deficit.shape, np.bool_)
        for rows in parts:
            cells[rows] = self.deficit[rows] > 0
        causes: dict[str, list[int]] = {}
        touching = []
        for one in self.seen:
            here = cells[one.where]
            if not (one.inside & here).any():
                continue
            touching.append(one.taken.number)
            if one.taken.exclusion_reason:
                causes.setdefault(one.taken.exclusion_reason, []).append(one.taken.number)
            elif any((gaps & here).any() for gaps in one.gaps.values()):
                causes.setdefault(one.taken.gap_cause, []).append(one.taken.number)
        if touching:
            between = range(min(touching) - 1, max(touching) + 2)
            for taken in self.block.taken:
                if not taken.corners and taken.number in between:
                    causes.setdefault(taken.exclusion_reason, []).append(taken.number)
        reasons = sorted(f"{_exposures(numbers)}: {why}" for why, numbers in causes.items())
        if reasons:
            return tuple(reasons)
        worst = min(holes, key=lambda hole: hole.images - hole.needed)
        return (f"seen by {worst.images} of the {worst.needed} images needed",)


def _within(centres_m: Array, half_m: float, low_m: float, high_m: float) -> Array:
    """Share of cells between two limits, such as the ends of a line, metres."""
    inside: Array = np.minimum(centres_m + half_m, high_m) - np.maximum(centres_m - half_m, low_m)
    return np.maximum(inside, 0.0)


def _exposures(numbers: Iterable[int]) -> str:
    """Numbers in words, runs of them as ranges."""
    ordered = sorted(set(numbers))
    runs: list[list[int]] = []
    for number in ordered:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    texts = [f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]
    return f"exposure{'s' if len(ordered) > 1 else ''} {', '.join(texts)}"


def _runs(flags: Flags) -> list[tuple[int, int]]:
    """First and last index of every run of true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[0::2], edges[1::2], strict=True)]
