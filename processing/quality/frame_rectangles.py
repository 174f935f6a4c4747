"""Rectangles of a frame with another offset, by sides that are sharper than a lens can draw them.

Between two lines of pixels an offset changes at once, a lens spreads edges of the ground over
several. Curvature across the lines keeps the one and takes most of the other away, so that smaller
offsets are found than by the change of signal alone. All sides inside of the frame have to show.

Source: docs/explanation/mathematics/quality.md#rectangles-with-another-offset.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.image.line_means import BUNDLE_PX, LineMeans
from processing.quality.ground_steps import Axis
from processing.quality.sharp_changes import (
    BLOCK,
    SHARP,
    SHARP_BUNDLES,
    WINDOW,
    runs_of_sharp,
    sharp_lines,
    sizes_at,
)
from processing.rig import Sensor

Array = NDArray[Any]

MAX_EDGES: Final = 60
"""Edges of a frame along one axis that are compared with each other, the largest."""
MIN_SIDE_PX: Final = 48
MIN_OVERLAP: Final = 0.6
"""Of the ends of two sides opposite to each other."""
SIDE_SIGMAS: Final = 5.0
FOUR_SIDES_SIGMAS: Final = 25.0
FEWER_SIDES_SIGMAS: Final = 40.0
"""Of each side, and of the sum of all: of four, and of fewer where others are the border."""
MAX_SHAPE: Final = 0.35
"""How far curvature next to an edge may be from -0.5 of that at it; of a line of the ground it is
-1, of an edge that a lens drew about 0."""
MAX_SPAN: Final = 0.8
"""Of a line, for one side: what spans more is a step along the whole line or none."""
MAX_RATIO: Final = 2.0
"""Of the steps of two sides."""
AROUND: Final = 60
"""Lines on each side with which an edge is compared."""
_MARGIN: Final = 1.25
_MAD_TO_SIGMA: Final = 1.4826


@dataclass(frozen=True)
class Side:
    """A side of a rectangle: between line `at` and the next along `axis`, pixel `first` to `last`.

    The signal changes by `step` counts, by `relative` of itself, `sigmas` times as much as around.
    """

    axis: Axis
    at: int
    first: int
    last: int
    step: float
    relative: float
    sigmas: float


def changed_rectangles(sensor: Sensor, lines: LineMeans) -> Iterator[tuple[Side, ...]]:
    """Search a frame for rectangles with another offset.

    Args:
        sensor: of the frame.
        lines: means of bundles of its pixels.

    Yields:
        The two to four sides of each rectangle that lie inside of the frame, the clearest first;
        nothing of frames with fewer than five bundles a line.

    Source: docs/explanation/mathematics/quality.md#rectangles-with-another-offset.
    """
    by_row = _Lines("rows", lines.by_row, lines.first_row, sensor.width_px)
    by_column = _Lines("columns", lines.by_column, 0, sensor.height_px)
    for along, across in ((by_row, by_column), (by_column, by_row)):
        for pair in _joined_pairs(along, across):
            sides = _closed(along, across, pair)
            if sides:
                yield sides


def sharp_step(
    sensor: Sensor, lines: LineMeans, axis: Axis, extent: tuple[int, int], places: tuple[int, int]
) -> tuple[float, float]:
    """The largest sharp fall and rise between two of some neighbouring lines.

    Args:
        sensor: of the frame.
        lines: means of bundles of its pixels.
        axis: the lines are rows or columns.
        extent: first and last pixel of the lines.
        places: first and last line.

    Returns:
        Both of the signal itself; zeros where the frame does not show these pixels.
    """
    of_axis = _Lines("rows", lines.by_row, lines.first_row, sensor.width_px)
    if axis == "columns":
        of_axis = _Lines("columns", lines.by_column, 0, sensor.height_px)
    first = max(places[0] - of_axis.first - 2, 0)
    part = of_axis.means[of_axis.bundles(*extent), first : places[1] - of_axis.first + 4]
    if not len(part) or part.shape[1] < 6:
        return 0.0, 0.0
    size = _sizes(_curved(part)) / max(float(part.mean()), 1.0)
    return min(float(size.min()), 0.0), max(float(size.max()), 0.0)


@dataclass(frozen=True)
class _Lines:
    """Means of bundles (bundles, lines) along one axis, whose lines are `length` pixels long."""

    axis: Axis
    means: Array
    first: int
    length: int

    @property
    def pace(self) -> int:
        return self.length // max(len(self.means), 1)

    @cached_property
    def totals(self) -> Array:
        """Sums of pixels of the bundles before each, and of all, (bundles + 1, lines) int32."""
        return np.asarray(_running_totals(self.means))

    @property
    def last(self) -> int:
        return self.first + int(self.means.shape[1]) - 1

    def bundles(self, first: int, last: int) -> slice:
        """Those that lie between two pixels of the line."""
        return slice(*_bundles_between(first, last, self.pace, len(self.means)))


def _sharp_edges(lines: _Lines) -> Array:
    """Runs of bundles with a sharp change of one sign between two lines, at most `MAX_EDGES`.

    Returns:
        Of each the line before it, its first and last pixel, and its sign, (n, 4) int64; the
        clearest first.
    """
    if len(lines.means) < WINDOW or lines.means.shape[1] < BLOCK:
        return np.empty((0, 4), np.int64)
    over, has_run = sharp_lines(lines.means, SHARP, WINDOW, SHARP_BUNDLES)
    places = np.flatnonzero(has_run[0] | has_run[1])
    runs, size = runs_of_sharp(
        sizes_at(lines.means, over, places), has_run[:, places], SHARP, WINDOW, SHARP_BUNDLES
    )
    sign, number, start, stop = runs[np.argsort(-size, kind="stable")[:MAX_EDGES]].T
    first, end = start * lines.pace, (stop - 1) * lines.pace + BUNDLE_PX
    return np.stack((places[number] + lines.first, first, end - 1, sign), axis=1)


@dataclass(frozen=True)
class _Pair:
    """Two sides opposite to each other, one of which may be the border of the frame, and what
    joins them: sides across between line `top` and `low`, None at the border of the frame.

    `opposite` has line and sign of those that are not the border.
    """

    opposite: tuple[tuple[int, int], ...]
    sign: int
    top: int
    low: int
    joining: tuple[Side | None, Side | None]


def _joined_pairs(along: _Lines, across: _Lines) -> Iterator[_Pair]:
    """Edges opposite to each other whose ends other edges or the border join."""
    edges = _sharp_edges(along)
    if not len(edges):
        return
    pairs = _opposite(edges, along.first, along.last)
    reach = 2 * along.pace + BUNDLE_PX
    found = _sharpest_at_ends(across.totals, pairs, across.pace, across.first, reach)
    for k in np.flatnonzero(found[:, 0, 0] >= 0.0):
        before, after, top, low, sign = (int(number) for number in pairs[k, :5])
        yield _Pair(
            tuple((int(edges[i, 0]), int(edges[i, 3])) for i in (before, after) if i >= 0),
            sign,
            top,
            low,
            (_as_side(across, (top, low), found[k, 0]), _as_side(across, (top, low), found[k, 1])),
        )


@compiled_kernel()
def _opposite(edges: Array, first_line: int, last_line: int) -> Array:
    """Two edges opposite to each other; -1 is the border of the frame, between these lines.

    Returns:
        Numbers of both, first and last line and sign of what is between them, and its first and
        last pixel, (n, 7) int64.
    """
    count, found = len(edges), 0
    pairs = np.empty((count * (count + 2), 7), np.int64)
    # Those with the border come last.
    for borders in range(3):
        for i in range(-1 if borders == 2 else 0, 0 if borders == 2 else count):
            for j in range(-1 if borders == 1 else 0, 0 if borders == 1 else count):
                # The border has the ends of the edge opposite to it.
                one, other = edges[i if i >= 0 else j], edges[j if j >= 0 else i]
                top = first_line if i < 0 else one[0] + 1
                low = last_line if j < 0 else other[0]
                first, last = max(one[1], other[1]), min(one[2], other[2])
                spanned = max(one[2], other[2]) - min(one[1], other[1])
                are_opposite = borders > 0 or one[3] * other[3] < 0
                are_apart = low + 1 - top >= MIN_SIDE_PX
                if are_opposite and are_apart and last - first >= MIN_OVERLAP * spanned:
                    sign = -other[3] if i < 0 else one[3]
                    pairs[found] = np.array([i, j, top, low, sign, first, last])
                    found += 1
    return pairs[:found]


@compiled_kernel()
def _sharpest_at_ends(totals: Array, pairs: Array, pace: int, first_line: int, reach: int) -> Array:
    """What `_sharpest` finds around both ends of each pair of edges, (n, 2, 4).

    The first number is negative where a pair is not joined: a side that does not show has to be the
    border.
    """
    found = np.zeros((len(pairs), 2, 4))
    last = totals.shape[1] - 1
    for i in range(len(pairs)):
        bundles = _bundles_between(pairs[i, 2], pairs[i, 3], pace, len(totals) - 1)
        for k in range(2):
            place, sharpest = pairs[i, 5 + k] - first_line, found[i, k]
            sign = pairs[i, 4] if k == 0 else -pairs[i, 4]
            (sharpest[0], sharpest[1], sharpest[2], sharpest[3]) = _sharpest(
                totals, bundles, (place - reach, place + reach), sign
            )
            is_border = place <= reach if k == 0 else place >= last - reach
            if sharpest[3] < SIDE_SIGMAS and not is_border:
                found[i, 0, 0] = -1.0
                break
    return found


@compiled_kernel()
def _running_totals(means: Array) -> Array:
    """Sums of pixels of the first bundles of each line: of none, one, and so on up to all."""
    # Sums of bundles of words are whole numbers, and those of all bundles fit in 32 bits.
    totals = np.zeros((len(means) + 1, means.shape[1]), np.int32)
    for k in range(len(means)):
        before, row, until = totals[k], means[k], totals[k + 1]
        for i in range(len(row)):
            until[i] = before[i] + np.int32(row[i] * np.float32(BUNDLE_PX))
    return totals


@compiled_kernel()
def _bundles_between(first: int, last: int, pace: int, bundles: int) -> tuple[int, int]:
    """The first bundle that lies between two pixels of a line, and the one after the last."""
    start = max((first + pace - 1) // pace, 0)
    return start, max(min((last + 1 - BUNDLE_PX) // pace + 1, bundles), start)


def _closed(along: _Lines, across: _Lines, pair: _Pair) -> tuple[Side, ...]:
    """The sides of the rectangle that a pair of edges is of; empty where it is none."""
    begin, end = pair.joining
    left = begin.at + 1 if begin else across.first
    right = end.at if end else across.last
    if not (begin or end) or right - left < MIN_SIDE_PX:
        return ()
    if right - left > MAX_SPAN * along.length or pair.low - pair.top > MAX_SPAN * across.length:
        return ()
    seen = [side for side in pair.joining if side is not None]
    for at, sign in pair.opposite:
        side = _side(along, (left, right), at, sign)
        if side is None:
            return ()
        seen.append(side)
    steps = [abs(side.step) for side in seen]
    least = FOUR_SIDES_SIGMAS if len(seen) == 4 else FEWER_SIDES_SIGMAS
    if sum(s.sigmas for s in seen) < least or max(steps) > MAX_RATIO * min(steps):
        return ()
    return tuple(sorted(seen, key=lambda side: -side.sigmas))


def _side(lines: _Lines, extent: tuple[int, int], at: int, sign: int) -> Side | None:
    """The edge of a sign at a line, over the pixels of an extent; None where it is not sharp."""
    bundles, place = lines.bundles(*extent), at - lines.first
    found = _sharpest(lines.totals, (bundles.start, bundles.stop), (place, place), sign)
    return _as_side(lines, extent, np.array(found))


def _as_side(lines: _Lines, extent: tuple[int, int], found: Array) -> Side | None:
    """What `_sharpest` found; None where it is no side."""
    at, step, level, sigmas = (float(number) for number in found)
    if sigmas < SIDE_SIGMAS:
        return None
    relative = step / max(level, 1.0)
    return Side(lines.axis, lines.first + int(at), *extent, step, relative, sigmas)


@compiled_kernel(fastmath={"reassoc", "contract"})
def _sharpest(
    totals: Array, bundles: tuple[int, int], places: tuple[int, int], sign: float
) -> tuple[float, float, float, float]:
    """The sharpest edge of a sign between the lines of some places, of the mean of some bundles.

    Returns:
        The line before it, the step, the level at it, and the step over the standard deviation of
        the others up to `AROUND` lines away, which is 0 where no edge is as sharp as `MAX_SHAPE`
        demands or clear enough for a side.
    """
    none = 0.0, 0.0, 0.0, 0.0
    start = max(places[0] - AROUND, 0)
    count = min(places[1] + AROUND, totals.shape[1]) - start
    # `size[i]` is of the line `start + i + 2` and the next.
    first, last = max(places[0] - start - 2, 0), min(places[1] - start - 2, count - 6)
    if bundles[1] <= bundles[0] or count < AROUND // 2 or last < first:
        return none
    before_all, until_all = totals[bundles[0], start:], totals[bundles[1], start:]
    mean = np.empty(count)
    for i in range(count):
        mean[i] = until_all[i] - before_all[i]
    share = 1.0 / (BUNDLE_PX * (bundles[1] - bundles[0]))
    size = np.empty(count - 5)
    for i in range(count - 5):
        # (2 c[1] - c[0] - c[2]) / 3 of the curvatures c = d[1] - (d[0] + d[2]) / 2 of changes d.
        size[i] = (share / 6.0) * (
            (mean[i + 5] - mean[i])
            - 5.0 * (mean[i + 4] - mean[i + 1])
            + 10.0 * (mean[i + 3] - mean[i + 2])
        )
    at = first
    for i in range(first, last + 1):
        if sign * size[i] > sign * size[at]:
            at = i
    # Most places are none; this is the quickest to see.
    before, here, after = _curvatures(mean[at : at + 6], share)
    shape = max(abs(before + 0.5 * here), abs(after + 0.5 * here))
    if sign * size[at] <= 0.0 or shape > MAX_SHAPE * abs(here):
        return none
    around = np.concatenate((size[: max(at - 2, 0)], size[at + 3 :]))
    if len(around) < AROUND // 2:
        return none
    # The median of what is around is near zero: counting shows whether its spread may be small.
    small, limit = 0, _MARGIN * abs(size[at]) / (SIDE_SIGMAS * _MAD_TO_SIGMA)
    for i in range(len(around)):
        small += abs(around[i]) <= limit
    if 2 * small < len(around):
        return none
    sigma = _MAD_TO_SIGMA * np.median(np.abs(around - np.median(around)))
    level = 0.5 * share * (mean[at + 2] + mean[at + 3])
    sigmas = sign * size[at] / max(sigma, 1e-3 * abs(size[at]))
    return float(start + at + 2), size[at], level, sigmas


@compiled_kernel()
def _curvatures(mean: Array, share: float) -> tuple[float, float, float]:
    """Of the third of five changes between six lines, and of those before and after it."""
    change = share * (mean[1:] - mean[:-1])
    curved = change[1:-1] - 0.5 * (change[:-2] + change[2:])
    return curved[0], curved[1], curved[2]


def _curved(means: Array) -> Array:
    """Changes of the mean of bundles from line to line, less half of those before and after."""
    change = np.diff(means.mean(axis=0, dtype=np.float64))
    return np.asarray(change[1:-1] - 0.5 * (change[:-2] + change[2:]))


def _sizes(curved: Array) -> Array:
    """Steps that fit best to the curvature around each line."""
    return np.asarray((2.0 * curved[1:-1] - curved[:-2] - curved[2:]) / 3.0)
