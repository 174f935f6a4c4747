"""Rectangles of a frame with another offset, by sides that are sharper than a lens can draw them.

Between two lines of pixels an offset changes at once, a lens spreads edges of the ground over
several. Curvature across the lines keeps the one and takes most of the other away, so that smaller
offsets are found than by the change of signal alone. All sides inside of the frame have to show.

Source: docs/explanation/mathematics/quality.md#rectangles-with-another-offset.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.image.line_means import BUNDLE_PX, LineMeans
from processing.quality.ground_steps import Axis
from processing.rig import Sensor

Array = NDArray[Any]

WINDOW: Final = 5
SHARP_BUNDLES: Final = 4
"""So many of neighbouring bundles have a change of one sign that is sharp."""
SHARP: Final = 1.6
"""Over the standard deviation of the curvature around."""
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
BLOCK: Final = 32
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

    @property
    def last(self) -> int:
        return self.first + int(self.means.shape[1]) - 1

    def bundles(self, first: int, last: int) -> slice:
        """Those that lie between two pixels of the line."""
        return slice(*_bundles_between(first, last, self.pace, len(self.means)))


@dataclass(frozen=True)
class _Edge:
    at: int
    first: int
    last: int
    sign: float
    size: float


def _sharp_edges(lines: _Lines) -> list[_Edge]:
    """Runs of bundles with a sharp change of one sign between two lines, at most `MAX_EDGES`."""
    if len(lines.means) < WINDOW or lines.means.shape[1] < BLOCK:
        return []
    over, has_run = _sharp_lines(lines.means, SHARP, WINDOW, SHARP_BUNDLES)
    places = np.flatnonzero(has_run[0] | has_run[1])
    sizes = _sizes_at(lines.means, over, places)
    edges = [
        _Edge(
            int(places[k]) + lines.first,
            start * lines.pace,
            (stop - 1) * lines.pace + BUNDLE_PX - 1,
            1.0 - 2.0 * falls,
            size,
        )
        for falls, k, start, stop, size in _runs_of_sharp(
            sizes, np.ascontiguousarray(has_run[:, places]), SHARP, WINDOW, SHARP_BUNDLES
        )
    ]
    return sorted(edges, key=lambda edge: -edge.size)[:MAX_EDGES]


@compiled_kernel()
def _runs_of_sharp(
    sizes: Array, has_run: Array, least: float, window: int, enough: int
) -> list[tuple[int, int, int, int, float]]:
    """Runs of bundles with sharp changes of one sign, where windows with enough of them touch.

    Returns:
        Of each run whether it falls, the number of its line, its first bundle and the one after its
        last, and its mean size times the square root of its length.
    """
    bundles = len(sizes)
    runs = []
    for k in range(2):
        sign = np.float32(1.0 - 2.0 * k)
        for at in np.flatnonzero(has_run[k]):
            begin = end = -1
            for j in range(bundles - window + 2):
                hits = 0
                if j <= bundles - window:
                    for i in range(j, j + window):
                        hits += sign * sizes[i, at] > least
                is_near = hits >= enough
                if begin >= 0 and (j > bundles - window or (is_near and j - end > window)):
                    start, stop = begin, end + window
                    while not sign * sizes[start, at] > least:
                        start += 1
                    while not sign * sizes[stop - 1, at] > least:
                        stop -= 1
                    total = 0.0
                    for i in range(start, stop):
                        total += sign * sizes[i, at]
                    runs.append((k, int(at), start, stop, total / math.sqrt(stop - start)))
                    begin = -1
                if is_near:
                    if begin < 0:
                        begin = j
                    end = j
    return runs


@compiled_kernel(fastmath={"reassoc", "contract"})
def _sharp_lines(means: Array, least: float, window: int, enough: int) -> tuple[Array, Array]:
    """One over the usual change (bundles, blocks), and where enough neighbouring bundles change.

    The change from one line to the next less half of those before and after it, which is a step as
    it is, is compared with its mean size over the block of lines it is in and those next to it.
    The lines are marked by whether so many of `window` bundles rise, and fall, (2, lines).
    """
    bundles, lines = means.shape
    blocks = -(-lines // BLOCK)
    over = np.empty((bundles, blocks), np.float32)
    usual = np.zeros(blocks + 2, np.float32)
    size = np.zeros(lines, np.float32)
    # Bytes, of which vectors hold many.
    rises = np.zeros((window, lines), np.uint8)
    falls = np.zeros((window, lines), np.uint8)
    hits = np.zeros((2, lines), np.uint8)
    places = np.zeros((2, lines), np.uint8)
    limit, some = np.float32(least), np.uint8(enough)
    for k in range(bundles):
        _curve(means[k], size)
        for b in range(blocks):
            # Parts begin at 0: places that might be negative are not added up in vectors.
            part = size[b * BLOCK : b * BLOCK + BLOCK]
            total: Any = np.float32(0.0)
            for i in range(len(part)):
                total += abs(part[i])
            usual[b + 1] = total / np.float32(len(part))
        usual[0], usual[blocks + 1] = usual[1], usual[blocks]
        rise, fall = rises[k % window], falls[k % window]
        up, down = hits[0], hits[1]
        for i in range(lines):
            up[i] -= rise[i]
            down[i] -= fall[i]
        for b in range(blocks):
            # Of normally distributed changes, a standard deviation is 1.25 times their mean size.
            sigma = (usual[b] + usual[b + 1] + usual[b + 2]) * np.float32(1.2533 / 3.0)
            over[k, b] = np.float32(1.0) / (sigma + np.float32(0.25))
            allowed = limit * (sigma + np.float32(0.25))
            part = size[b * BLOCK : b * BLOCK + BLOCK]
            rise_there, fall_there = rise[b * BLOCK :], fall[b * BLOCK :]
            for i in range(len(part)):
                rise_there[i] = part[i] > allowed
                fall_there[i] = part[i] < -allowed
        some_rise, some_fall = places[0], places[1]
        for i in range(lines):
            up[i] += rise[i]
            down[i] += fall[i]
            some_rise[i] |= up[i] >= some
            some_fall[i] |= down[i] >= some
    return over, places != 0


@compiled_kernel()
def _curve(row: Array, size: Array) -> None:
    """Change to the next line less half of those before and after it, 0 at the ends."""
    before, here, after, last = row[:-3], row[1:-2], row[2:-1], row[3:]
    inner = size[1:-2]
    for i in range(len(inner)):
        sharp = np.float32(1.5) * (after[i] - here[i])
        inner[i] = sharp - np.float32(0.5) * (last[i] - before[i])


@compiled_kernel()
def _sizes_at(means: Array, over: Array, places: Array) -> Array:
    """The changes of all bundles at some lines over the usual one, (bundles, places)."""
    bundles, lines = means.shape
    sizes = np.zeros((bundles, len(places)), np.float32)
    for j in range(len(places)):
        i = places[j]
        if i < 1 or i > lines - 3:
            continue
        for k in range(bundles):
            change = np.float32(1.5) * (means[k, i + 1] - means[k, i])
            change -= np.float32(0.5) * (means[k, i + 2] - means[k, i - 1])
            sizes[k, j] = change * over[k, i // BLOCK]
    return sizes


@dataclass(frozen=True)
class _Pair:
    """Two sides opposite to each other, one of which may be the border of the frame, and what
    joins them: sides across between line `top` and `low`, None at the border of the frame."""

    opposite: tuple[_Edge, ...]
    sign: float
    top: int
    low: int
    joining: tuple[Side | None, Side | None]


def _joined_pairs(along: _Lines, across: _Lines) -> Iterator[_Pair]:
    """Edges opposite to each other whose ends other edges or the border join."""
    edges = _sharp_edges(along)
    if not edges:
        return
    pairs = _opposite(edges, along)
    at, first, last, sign = _columns_of(edges)
    before, after = pairs.T
    top = np.where(before < 0, along.first, at[before] + 1)
    low = np.where(after < 0, along.last, at[after])
    sign = np.where(before < 0, -sign[after], sign[before])
    # The border has the ends of the edge opposite to it.
    one, other = np.where(before < 0, after, before), np.where(after < 0, before, after)
    ends = np.maximum(first[one], first[other]), np.minimum(last[one], last[other])
    found = _sharpest_at_ends(
        across.means,
        np.stack((top, low), axis=1),
        across.pace,
        np.stack(ends, axis=1) - across.first,
        sign,
        2 * along.pace + BUNDLE_PX,
    )
    for k in np.flatnonzero(found[:, 0, 0] >= 0.0):
        extent = int(top[k]), int(low[k])
        yield _Pair(
            tuple(edges[i] for i in pairs[k] if i >= 0),
            float(sign[k]),
            *extent,
            (_as_side(across, extent, found[k, 0]), _as_side(across, extent, found[k, 1])),
        )


def _columns_of(edges: Sequence[_Edge]) -> tuple[Array, Array, Array, Array]:
    at, first, last = (
        np.array([getattr(edge, name) for edge in edges], np.int64)
        for name in ("at", "first", "last")
    )
    return at, first, last, np.array([edge.sign for edge in edges])


def _opposite(edges: Sequence[_Edge], lines: _Lines) -> Array:
    """Numbers of two edges opposite to each other, (n, 2); -1 is the border of the frame."""
    at, first, last, sign = _columns_of(edges)
    shared = np.minimum.outer(last, last) - np.maximum.outer(first, first)
    spanned = np.maximum.outer(last, last) - np.minimum.outer(first, first)
    opposite = (shared >= MIN_OVERLAP * spanned) & (np.multiply.outer(sign, sign) < 0.0)
    both = np.argwhere(opposite & (np.subtract.outer(at, at).T >= MIN_SIDE_PX))
    number = np.arange(len(edges))
    border = np.full(len(edges), -1)
    to_end = np.stack((number, border), axis=1)[lines.last - at >= MIN_SIDE_PX]
    to_begin = np.stack((border, number), axis=1)[at - lines.first >= MIN_SIDE_PX]
    return np.concatenate((both, to_end, to_begin))


@compiled_kernel()
def _sharpest_at_ends(
    means: Array, extents: Array, pace: int, ends: Array, sign: Array, reach: int
) -> Array:
    """What `_sharpest` finds around both ends (n, 2) of each pair of edges, (n, 2, 4).

    The first number is negative where a pair is not joined: a side that does not show has to be the
    border.
    """
    found = np.zeros((len(ends), 2, 4))
    last = means.shape[1] - 1
    for i in range(len(ends)):
        bundles = _bundles_between(extents[i, 0], extents[i, 1], pace, len(means))
        for k in range(2):
            place, sharpest = ends[i, k], found[i, k]
            (sharpest[0], sharpest[1], sharpest[2], sharpest[3]) = _sharpest(
                means, bundles, (place - reach, place + reach), sign[i] if k == 0 else -sign[i]
            )
            is_border = place <= reach if k == 0 else place >= last - reach
            if sharpest[3] < SIDE_SIGMAS and not is_border:
                found[i, 0, 0] = -1.0
                break
    return found


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
    for edge in pair.opposite:
        side = _side(along, (left, right), edge.at, edge.sign)
        if side is None:
            return ()
        seen.append(side)
    steps = [abs(side.step) for side in seen]
    least = FOUR_SIDES_SIGMAS if len(seen) == 4 else FEWER_SIDES_SIGMAS
    if sum(s.sigmas for s in seen) < least or max(steps) > MAX_RATIO * min(steps):
        return ()
    return tuple(sorted(seen, key=lambda side: -side.sigmas))


def _side(lines: _Lines, extent: tuple[int, int], at: int, sign: float) -> Side | None:
    """The edge of a sign at a line, over the pixels of an extent; None where it is not sharp."""
    bundles, place = lines.bundles(*extent), at - lines.first
    found = _sharpest(lines.means, (bundles.start, bundles.stop), (place, place), sign)
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
    means: Array, bundles: tuple[int, int], places: tuple[int, int], sign: float
) -> tuple[float, float, float, float]:
    """The sharpest edge of a sign between the lines of some places, of the mean of some bundles.

    Returns:
        The line before it, the step, the level at it, and the step over the standard deviation of
        the others up to `AROUND` lines away, which is 0 where no edge is as sharp as `MAX_SHAPE`
        demands or clear enough for a side.
    """
    none = 0.0, 0.0, 0.0, 0.0
    start = max(places[0] - AROUND, 0)
    count = min(places[1] + AROUND, means.shape[1]) - start
    # `size[i]` is of the line `start + i + 2` and the next.
    first, last = max(places[0] - start - 2, 0), min(places[1] - start - 2, count - 6)
    if bundles[1] <= bundles[0] or count < AROUND // 2 or last < first:
        return none
    mean = np.zeros(count)
    for k in range(bundles[0], bundles[1]):
        row = means[k, start : start + count]
        for i in range(count):
            mean[i] += row[i]
    share = 1.0 / (bundles[1] - bundles[0])
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
