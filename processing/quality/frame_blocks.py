"""Steps along part of a line of pixels that no other head shows: a block of the frame is changed.

A gain or an offset that holds in a rectangle of a frame ends along rows and columns. So do roofs
and fields now and then, but these are seen by other heads too.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, raw_from_vip_mm, vip_mm_from_raw
from processing.image.compiled_kernel import compiled_kernel
from processing.image.line_means import BUNDLE_PX, LineMeans
from processing.quality.figures.image import BlockFigures
from processing.quality.frame_rectangles import Side, changed_rectangles, sharp_step
from processing.quality.ground_steps import (
    MAX_SHARED,
    SAMPLES,
    Axis,
    GroundView,
    sides_of,
    signal_change,
)
from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import Rig, Sensor

Array = NDArray[Any]
EdgeLimits = tuple[float, float]
"""Of a frame, for edges along rows and along columns, Level-1 counts."""

RUN: Final = 5
"""Neighbouring bundles of pixels with the same step."""
MIN_STEP_DN: Final = 12.0
"""Of 12 bits, in each of them."""
OVER_TEXTURE: Final = 1.0
"""Over the RMS change from line to line of the frame."""
FOUND_OVER_LIMIT: Final = 4.5
"""Of the smallest step looked at: the offset from which on all planted blocks were found."""
MAX_BLUR: Final = 0.2
"""Of the step, in the lines before and after it: a lens leaves a quarter and more."""
NEAR_PX: Final = 3 * BUNDLE_PX
"""How far from a corner edges may seem to end."""
MAX_RATIO: Final = 3.0
"""Of the steps of two edges of one block, whose ground differs from side to side."""
MAX_FRAMES: Final = 3
ISOLATED_REACH: Final = 4.0
"""Such edges in more frames of one exposure may be roofs or rows of plants along the track: only
those count that are so far from the next one, in distances at which other heads are compared."""
CANDIDATES: Final = 6
"""Edges of a frame that are compared with other heads, the largest."""
MIN_HEADS: Final = 2
CLOSED: Final = 4
"""Sides of a rectangle of which none is the border of the frame."""
GROUND_SIDE: Final = 0.8
"""Of the step of one side, that the median head shows of an edge of the ground; 0.74 at most of
sides of planted blocks."""
MIN_LASTING: Final = 0.3
"""Of the step between two lines, that is still there where other heads are compared: a block has
another offset all over, a line of plants or vehicles only itself."""
_RELATIVE: Final = 0.02


@dataclass(frozen=True)
class BlockEdge:
    """An edge of a changed block: between line `at` and the next along `axis` of a frame.

    It runs from pixel `first` to `last` of these lines; the signal changes by `step_dn`, by
    `relative` of itself, where the head that shows most of it sees `shared`.
    """

    sensor: str
    axis: Axis
    at: int
    first: int
    last: int
    step_dn: float
    relative: float
    shared: float


def block_edges(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Array],
    means: Mapping[str, LineMeans],
    limits: Mapping[str, EdgeLimits],
) -> tuple[BlockEdge, ...]:
    """Search all frames for edges of changed blocks.

    Args:
        rig: the camera.
        placements: of the sensors, by name.
        frames: Level-1 words by sensor name, (h, w) uint16.
        means: of their lines, by sensor name.
        limits: by `edge_limits`.

    Returns:
        The largest edge of each frame that has one, the largest first.
    """
    view = GroundView(rig, placements, frames)
    every = {n: _candidates(rig.sensor(n), lines, limits[n]) for n, lines in means.items()}
    with_corners = sum(next(_cornered(of_frame), None) is not None for of_frame in every.values())
    found = []
    for name, of_frame in every.items():
        sensor, edges = rig.sensor(name), _cornered(of_frame)
        if with_corners > MAX_FRAMES:
            edges = _isolated(edges, of_frame, view.reach_px(name))
        for edge in itertools.islice(edges, CANDIDATES):
            block = _unshared(view, edge, sensor, means)
            if block is not None:
                found.append(block)
                break
    edged = {block.sensor for block in found}
    rectangles = [
        block
        for name, lines in means.items()
        if name not in edged
        for block in _rectangle(view, rig.sensor(name), lines)
    ]
    # Small offsets of many frames at once are rows of plants and roofs.
    if len(rectangles) <= MAX_FRAMES:
        found += rectangles
    return tuple(sorted(found, key=lambda block: -abs(block.relative)))


def edge_limits(rig: Rig, means: Mapping[str, LineMeans]) -> dict[str, EdgeLimits]:
    """The steps from which on edges along rows and columns of each frame are looked at.

    Args:
        rig: the camera.
        means: of the lines of the frames, by sensor name.

    Returns:
        Level-1 counts by sensor name, along rows and along columns.
    """
    found = {}
    for name, lines in means.items():
        least = MIN_STEP_DN * level1_counts_per_dn(rig.sensor(name).bits)
        by_row, by_column = (
            max(least, OVER_TEXTURE * _texture(by_line)) if len(by_line) else least
            for by_line in (lines.by_row, lines.by_column)
        )
        found[name] = (by_row, by_column)
    return found


def block_figures(
    rig: Rig, limits: Mapping[str, EdgeLimits], blocks: tuple[BlockEdge, ...]
) -> BlockFigures:
    """The largest edge, and which blocks would not be found, in figures of the quality report.

    Args:
        rig: the camera.
        limits: by `edge_limits`.
        blocks: by `block_edges`.

    Returns:
        Figures of the first edge, and the limit of the frame with the coarsest texture.
    """
    limits_dn = {
        name: FOUND_OVER_LIMIT * max(limit) / level1_counts_per_dn(rig.sensor(name).bits)
        for name, limit in limits.items()
    }
    coarsest = max(limits_dn, key=lambda name: limits_dn[name], default=None)
    limit_dn = None if coarsest is None else limits_dn[coarsest]
    if not blocks:
        return BlockFigures(block_limit_dn=limit_dn, block_limit_sensor=coarsest)
    worst = blocks[0]
    return BlockFigures(
        block_limit_dn=limit_dn,
        block_limit_sensor=coarsest,
        block_sensor=worst.sensor,
        block_step_dn=worst.step_dn,
        block_step=worst.relative,
        block_axis=worst.axis,
        block_at=worst.at,
        block_first=worst.first,
        block_last=worst.last,
    )


@dataclass(frozen=True)
class _Edge:
    axis: Axis
    at: int
    first: int
    last: int
    step: float
    relative: float


def _candidates(sensor: Sensor, lines: LineMeans, limits: tuple[float, float]) -> list[_Edge]:
    """Runs of bundles with the same step between two lines, the largest first."""
    edges: list[_Edge] = []
    axes: tuple[tuple[Axis, Array, int, int], ...] = (
        ("rows", lines.by_row, lines.first_row, sensor.width_px),
        ("columns", lines.by_column, 0, sensor.height_px),
    )
    for (axis, by_line, offset, length), limit in zip(axes, limits, strict=True):
        if len(by_line) < RUN:
            continue
        pace = length // len(by_line)
        for sign, has_run in zip((1.0, -1.0), _have_runs(by_line, limit, RUN), strict=True):
            places = np.flatnonzero(has_run)
            starts, stops, steps, blurs = _runs(by_line, places, sign, limit, RUN)
            for k in np.flatnonzero(blurs <= MAX_BLUR * np.abs(steps)):
                first = int(starts[k]) * pace
                last = min((int(stops[k]) - 1) * pace + BUNDLE_PX, length) - 1
                at, step = int(places[k]), float(steps[k])
                around = by_line[starts[k] : stops[k], at : at + 2]
                relative = step / max(float(np.median(around)), 1.0)
                edges.append(_Edge(axis, at + offset, first, last, step, relative))
    return sorted(edges, key=lambda e: -abs(e.step) * (e.last - e.first))


@compiled_kernel(fastmath={"reassoc", "contract"})
def _texture(means: Array) -> float:
    """RMS change from line to line."""
    bundles, lines = means.shape
    total = 0.0
    for k in range(bundles):
        row = means[k]
        squares: Any = np.float32(0.0)
        for i in range(lines - 1):
            change = row[i + 1] - row[i]
            squares += change * change
        total += squares
    return math.sqrt(total / (bundles * (lines - 1)))


@compiled_kernel()
def _have_runs(means: Array, limit: float, length: int) -> Array:
    """Between which lines so many neighbouring bundles rise by more than a limit, and fall."""
    bundles, lines = means.shape
    # Bytes, of which vectors hold many: there are fewer bundles than a byte counts.
    run = np.zeros((2, lines - 1), np.uint8)
    found = np.zeros((2, lines - 1), np.uint8)
    least, enough = np.float32(limit), np.uint8(length)
    for k in range(bundles):
        here, following = means[k, :-1], means[k, 1:]
        rises, falls = run[0], run[1]
        for i in range(len(here)):
            change = following[i] - here[i]
            rises[i] = (rises[i] + np.uint8(1)) * np.uint8(change > least)
            falls[i] = (falls[i] + np.uint8(1)) * np.uint8(change < -least)
        some_rise, some_fall = found[0], found[1]
        for i in range(len(here)):
            some_rise[i] |= rises[i] >= enough
            some_fall[i] |= falls[i] >= enough
    return np.asarray(found != 0)


@compiled_kernel()
def _runs(
    means: Array, places: Array, sign: float, limit: float, length: int
) -> tuple[Array, Array, Array, Array]:
    """The first run of changed bundles at each place that has one.

    Returns:
        First bundle and the one after the last, the median change, and the larger median change in
        the lines before and after: a lens spreads edges on the ground over lines.
    """
    bundles, lines = means.shape
    starts = np.zeros(len(places), np.int64)
    stops = np.zeros(len(places), np.int64)
    steps = np.zeros(len(places), np.float32)
    blurs = np.zeros(len(places), np.float32)
    for j in range(len(places)):
        at = places[j]
        start = stop = 0
        for k in range(bundles):
            if sign * (means[k, at + 1] - means[k, at]) > limit:
                stop = k + 1
            elif stop - start >= length:
                break
            else:
                start = stop = k + 1
        starts[j], stops[j] = start, stop
        for line in range(max(at - 1, 0), min(at + 2, lines - 1)):
            change = np.median(means[start:stop, line + 1] - means[start:stop, line])
            if line == at:
                steps[j] = change
            else:
                blurs[j] = max(blurs[j], abs(change))
    return starts, stops, steps, blurs


def _steps_there(sensor: Sensor, lines: LineMeans, edge: _Edge) -> bool:
    """Whether another frame steps alike at the same line, where it sees other ground."""
    by_line, at, length = lines.by_column, edge.at, sensor.height_px
    if edge.axis == "rows":
        by_line, at, length = lines.by_row, edge.at - lines.first_row, sensor.width_px
    if not len(by_line) or not 0 <= at < by_line.shape[1] - 1:
        return False
    pace = length // len(by_line)
    bundles = slice(edge.first // pace, max(edge.last // pace, edge.first // pace + 1))
    changes = by_line[bundles, at + 1] - by_line[bundles, at]
    return len(changes) > 0 and bool(
        np.median(changes) * np.sign(edge.step) > MAX_SHARED * abs(edge.step)
    )


def _cornered(edges: Sequence[_Edge]) -> Iterator[_Edge]:
    """The edges that meet another one in a corner, or have one of the other sign opposite."""
    is_row = np.array([edge.axis == "rows" for edge in edges], np.bool_)
    at, first, last = (
        np.array([getattr(edge, name) for edge in edges], np.int64)
        for name in ("at", "first", "last")
    )
    step = np.array([edge.step for edge in edges])
    for k, edge in enumerate(edges):
        # The edge itself has its own sign, and no corner with its own axis.
        opposite = (is_row == is_row[k]) & (step * edge.step < 0.0)
        shared = np.minimum(last, edge.last) - np.maximum(first, edge.first)
        opposite &= 2 * shared > np.maximum(last - first, edge.last - edge.first)
        corner = is_row != is_row[k]
        corner &= np.minimum(np.abs(edge.at - first), np.abs(edge.at - last)) < NEAR_PX
        corner &= np.minimum(np.abs(at - edge.first), np.abs(at - edge.last)) < NEAR_PX
        ratio = np.abs(edge.step / step)
        if np.any((opposite | corner) & (ratio > 1.0 / MAX_RATIO) & (ratio < MAX_RATIO)):
            yield edge


def _isolated(edges: Iterable[_Edge], every: Sequence[_Edge], reach_px: float) -> Iterator[_Edge]:
    """Those to which no other edge of the frame runs next: rows of plants are many."""
    places = {
        axis: np.array([other.at for other in every if other.axis == axis], np.int64)
        for axis in ("rows", "columns")
    }
    for edge in edges:
        away = np.abs(places[edge.axis] - edge.at)
        if not np.any((away > 0) & (away < ISOLATED_REACH * reach_px)):
            yield edge


def _shows_elsewhere(
    view: GroundView, edge: _Edge, name: str, means: Mapping[str, LineMeans]
) -> bool:
    """Whether another head has a sharp edge at the same place, whatever the ground next to it."""
    ends = np.array([[edge.first, edge.at + 0.5], [edge.last, edge.at + 0.5]])
    across = int(edge.axis == "rows")
    ground = vip_mm_from_raw(view.placements[name], ends if across else ends[:, ::-1])
    sign = math.copysign(1.0, edge.step)
    for other, lines in means.items():
        with np.errstate(invalid="ignore"):
            there = raw_from_vip_mm(view.placements[other], ground)
        if other == name or not np.isfinite(there).all():
            continue
        at, near = float(there[:, across].mean()), math.ceil(view.reach_px(other))
        first, last = sorted(int(end) for end in there[:, 1 - across])
        places = (math.floor(at) - near, math.floor(at) + near)
        steps = sharp_step(view.rig.sensor(other), lines, edge.axis, (first, last), places)
        if max(sign * step for step in steps) > MAX_SHARED * abs(edge.relative):
            return True
    return False


def _rectangle(view: GroundView, sensor: Sensor, lines: LineMeans) -> Iterator[BlockEdge]:
    """The clearest side of a rectangle of sharp sides that no other head shows, if there is one."""
    for sides in itertools.islice(changed_rectangles(sensor, lines), CANDIDATES):
        shared = _shared_by_others(view, sensor.name, sides)
        if shared is not None and shared <= MAX_SHARED:
            side, counts = sides[0], level1_counts_per_dn(sensor.bits)
            yield BlockEdge(
                sensor.name,
                side.axis,
                side.at,
                side.first,
                side.last,
                side.step / counts,
                side.relative,
                shared * abs(side.relative),
            )
            return


def _shared_by_others(view: GroundView, name: str, sides: Sequence[Side]) -> float | None:
    """The share of the sides' steps that other heads show; None where too few see them.

    What the frame itself shows there is the step and the ground; what of that another head shows
    is ground. Of a closed rectangle the median head counts, as ground has no such sides and differs
    from band to band; of one that the border closes, the head that shows most, and no side may be
    one that the median head shows.
    """
    away = view.reach_px(name)
    seen: dict[str, list[float]] = {}
    for side in sides:
        along = np.linspace(side.first + 2, side.last - 2, min(SAMPLES, side.last - side.first))
        places = sides_of(side.axis, side.at, along, away)
        own = signal_change(view.frames[name], view.placements[name], places, 1)
        ground = [vip_mm_from_raw(view.placements[name], place) for place in places]
        of_side = []
        for other, frame in view.frames.items():
            if other == name or own is None:
                continue
            placement = view.placements[other]
            with np.errstate(invalid="ignore"):
                before, after = (raw_from_vip_mm(placement, place) for place in ground)
            reach = 1 if view.is_pan(other) else 0
            change = signal_change(frame, placement, (before, after), reach)
            if change is not None:
                missing = (own - change) / side.relative
                seen.setdefault(other, []).append(missing)
                of_side.append(1.0 - missing)
        if len(sides) < CLOSED and of_side and np.median(of_side) > GROUND_SIDE:
            return float(np.median(of_side))
    if len(seen) < MIN_HEADS:
        return None
    shares = [1.0 - float(np.mean(missing)) for missing in seen.values()]
    return float(np.median(shares)) if len(sides) == CLOSED else max(shares)


def _unshared(
    view: GroundView, edge: _Edge, sensor: Sensor, means: Mapping[str, LineMeans]
) -> BlockEdge | None:
    """The edge as a block where no other head shows half of it; None where one does, or too few see
    it.

    An edge that all colour heads show at the same line is none of the ground where PAN shows less
    than half of it.
    """
    name, away = sensor.name, view.reach_px(sensor.name)
    along = np.linspace(edge.first + 2, edge.last - 2, min(SAMPLES, edge.last - edge.first))
    sides = sides_of(edge.axis, edge.at, along, away)
    own = signal_change(view.frames[name], view.placements[name], sides, 1)
    if own is None or own * np.sign(edge.step) <= _RELATIVE:
        return None
    if abs(own) < MIN_LASTING * abs(edge.relative):
        return None
    ground = [vip_mm_from_raw(view.placements[name], side) for side in sides]
    others: list[float] = []
    pan: list[float] = []
    for other, frame in view.frames.items():
        if other == name:
            continue
        with np.errstate(invalid="ignore"):
            before, after = (raw_from_vip_mm(view.placements[other], side) for side in ground)
        reach = 1 if view.is_pan(other) else 0
        seen = signal_change(frame, view.placements[other], (before, after), reach)
        if seen is not None:
            (pan if view.is_pan(other) else others).append(seen * np.sign(own))
    colours = sum(1 for cone in view.rig.cones if cone.role == "colour") - (not view.is_pan(name))
    if len(others) + len(pan) < MIN_HEADS:
        return None
    least = min(abs(own), *others) if others and len(others) == colours else 0.0
    by_all_colours = (
        not view.is_pan(name)
        and pan
        and np.median(pan) < MAX_SHARED * least
        and all(
            _steps_there(view.rig.sensor(other), lines, edge)
            for other, lines in means.items()
            if other != name and not view.is_pan(other)
        )
    )
    if max(others + pan) > MAX_SHARED * abs(own) and not by_all_colours:
        return None
    if not by_all_colours and _shows_elsewhere(view, edge, name, means):
        return None
    counts = level1_counts_per_dn(sensor.bits)
    return BlockEdge(
        name,
        edge.axis,
        edge.at,
        edge.first,
        edge.last,
        edge.step / counts,
        own,
        float(max(pan if by_all_colours else others + pan)),
    )
