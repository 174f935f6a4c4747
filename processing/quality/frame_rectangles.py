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
        edges = _sharp_edges(along)
        for pair in _pairs(edges, along):
            sides = _closed(along, across, *pair)
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
        start = max(-(-first // self.pace), 0)
        return slice(start, max((last + 1 - BUNDLE_PX) // self.pace + 1, start))


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
    sizes, has_run = _sharp_changes(lines.means, SHARP, WINDOW, SHARP_BUNDLES)
    edges = [
        _Edge(
            at + lines.first,
            start * lines.pace,
            (stop - 1) * lines.pace + BUNDLE_PX - 1,
            1.0 - 2.0 * falls,
            size,
        )
        for falls, at, start, stop, size in _runs_of_sharp(
            sizes, has_run, SHARP, WINDOW, SHARP_BUNDLES
        )
    ]
    return sorted(edges, key=lambda edge: -edge.size)[:MAX_EDGES]


@compiled_kernel()
def _runs_of_sharp(
    sizes: Array, has_run: Array, least: float, window: int, enough: int
) -> list[tuple[int, int, int, int, float]]:
    """Runs of bundles with sharp changes of one sign, where windows with enough of them touch.

    Returns:
        Of each run whether it falls, its line, its first bundle and the one after its last, and
        its mean size times the square root of its length.
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
def _sharp_changes(means: Array, least: float, window: int, enough: int) -> tuple[Array, Array]:
    """Size of the change of each bundle, and where so many of neighbouring ones rise or fall.

    The change from one line to the next less half of those before and after it, which is a step as
    it is, is compared with its mean size over the block of lines it is in and those next to it.
    """
    bundles, lines = means.shape
    size = np.zeros((bundles, lines), np.float32)
    blocks = -(-lines // BLOCK)
    usual = np.zeros(blocks + 2, np.float32)
    for k in range(bundles):
        row, of_row = means[k], size[k]
        for i in range(1, lines - 2):
            of_row[i] = np.float32(1.5) * (row[i + 1] - row[i]) - np.float32(0.5) * (
                row[i + 2] - row[i - 1]
            )
        for b in range(blocks):
            total: Any = np.float32(0.0)
            for i in range(b * BLOCK, min(b * BLOCK + BLOCK, lines)):
                total += abs(of_row[i])
            usual[b + 1] = total / np.float32(min(BLOCK, lines - b * BLOCK))
        usual[0], usual[blocks + 1] = usual[1], usual[blocks]
        for b in range(blocks):
            # Of normally distributed changes, a standard deviation is 1.25 times their mean size.
            sigma = (usual[b] + usual[b + 1] + usual[b + 2]) * np.float32(1.2533 / 3.0)
            over = np.float32(1.0) / (sigma + np.float32(0.25))
            for i in range(b * BLOCK, min(b * BLOCK + BLOCK, lines)):
                of_row[i] *= over
    hits = np.zeros((2, lines), np.int32)
    places = np.zeros((2, lines), np.bool_)
    for k in range(bundles):
        for i in range(lines):
            hits[0, i] += size[k, i] > least
            hits[1, i] += size[k, i] < -least
            if k >= window:
                hits[0, i] -= size[k - window, i] > least
                hits[1, i] -= size[k - window, i] < -least
            places[0, i] |= hits[0, i] >= enough
            places[1, i] |= hits[1, i] >= enough
    return size, places


def _pairs(edges: Sequence[_Edge], lines: _Lines) -> Iterator[tuple[_Edge | None, _Edge | None]]:
    """Two sides opposite to each other, one of which may be the border of the frame."""
    at, first, last, sign = (
        np.array([getattr(edge, name) for edge in edges])
        for name in ("at", "first", "last", "sign")
    )
    shared = np.minimum.outer(last, last) - np.maximum.outer(first, first)
    spanned = np.maximum.outer(last, last) - np.minimum.outer(first, first)
    opposite = (shared >= MIN_OVERLAP * spanned) & (np.multiply.outer(sign, sign) < 0.0)
    for i, j in np.argwhere(opposite & (np.subtract.outer(at, at).T >= MIN_SIDE_PX)):
        yield edges[i], edges[j]
    for edge in edges:
        if lines.last - edge.at >= MIN_SIDE_PX:
            yield edge, None
        if edge.at - lines.first >= MIN_SIDE_PX:
            yield None, edge


def _closed(
    along: _Lines, across: _Lines, before: _Edge | None, after: _Edge | None
) -> tuple[Side, ...]:
    """The sides of the rectangle that two edges are sides of; empty where it is none."""
    pair = [edge for edge in (before, after) if edge is not None]
    sign = before.sign if before is not None else -pair[0].sign
    top = along.first if before is None else before.at + 1
    low = along.last if after is None else after.at
    first, last = max(e.first for e in pair), min(e.last for e in pair)
    reach = 2 * along.pace + BUNDLE_PX
    # A side that does not show has to be the border.
    sides = [_side(across, (top, low), (first - reach, first + reach), sign)]
    if sides[0] is None and first > reach:
        return ()
    sides.append(_side(across, (top, low), (last - reach, last + reach), -sign))
    if sides[1] is None and last < across.last - reach:
        return ()
    left = sides[0].at + 1 if sides[0] else across.first
    right = sides[1].at if sides[1] else across.last
    if not any(sides) or right - left < MIN_SIDE_PX:
        return ()
    if right - left > MAX_SPAN * along.length or low - top > MAX_SPAN * across.length:
        return ()
    for edge in pair:
        sides.append(_side(along, (left, right), (edge.at, edge.at), edge.sign))
        if sides[-1] is None:
            return ()
    seen = [side for side in sides if side is not None]
    steps = [abs(side.step) for side in seen]
    least = FOUR_SIDES_SIGMAS if len(seen) == 4 else FEWER_SIDES_SIGMAS
    if sum(s.sigmas for s in seen) < least or max(steps) > MAX_RATIO * min(steps):
        return ()
    return tuple(sorted(seen, key=lambda side: -side.sigmas))


def _side(
    lines: _Lines, extent: tuple[int, int], places: tuple[int, int], sign: float
) -> Side | None:
    """The sharpest edge of a sign at some lines, over the pixels of an extent; None without one."""
    low, high = (place - lines.first for place in places)
    bundles = lines.bundles(*extent)
    start, stop = max(low - AROUND, 0), min(high + AROUND, lines.means.shape[1])
    if bundles.stop <= bundles.start or stop - start < AROUND // 2:
        return None
    at, step, level, sigmas = _sharpest(
        lines.means, (bundles.start, bundles.stop), (start, stop), (low, high), sign
    )
    if sigmas < SIDE_SIGMAS:
        return None
    line, relative = lines.first + at, step / max(level, 1.0)
    return Side(lines.axis, line, extent[0], extent[1], step, relative, sigmas)


@compiled_kernel()
def _sharpest(
    means: Array,
    bundles: tuple[int, int],
    lines: tuple[int, int],
    places: tuple[int, int],
    sign: float,
) -> tuple[int, float, float, float]:
    """The sharpest edge of a sign between the lines of some places, of the mean of some bundles.

    Returns:
        The line before it, the step, the level at it, and the step over the standard deviation of
        the others among `lines`, which is 0 where no edge is as sharp as `MAX_SHAPE` demands.
    """
    start, stop = lines
    count = stop - start
    mean = np.zeros(count)
    for k in range(bundles[0], bundles[1]):
        for i in range(count):
            mean[i] += means[k, start + i]
    mean /= bundles[1] - bundles[0]
    change = mean[1:] - mean[:-1]
    curved = change[1:-1] - 0.5 * (change[:-2] + change[2:])
    size = (2.0 * curved[1:-1] - curved[:-2] - curved[2:]) / 3.0
    # `size[i]` is of the line `start + i + 2` and the next.
    first = max(places[0] - start - 2, 0)
    last = min(places[1] - start - 2, len(size) - 1)
    none = 0, 0.0, 0.0, 0.0
    if last < first:
        return none
    at = first
    for i in range(first, last + 1):
        if sign * size[i] > sign * size[at]:
            at = i
    # Most places are none; this is the quickest to see.
    shape = max(abs(curved[at] + 0.5 * curved[at + 1]), abs(curved[at + 2] + 0.5 * curved[at + 1]))
    if sign * size[at] <= 0.0 or shape > MAX_SHAPE * abs(curved[at + 1]):
        return none
    around = np.concatenate((size[: max(at - 2, 0)], size[at + 3 :]))
    if len(around) < AROUND // 2:
        return none
    sigma = _MAD_TO_SIGMA * np.median(np.abs(around - np.median(around)))
    level = 0.5 * (mean[at + 2] + mean[at + 3])
    return start + at + 2, size[at], level, sign * size[at] / max(sigma, 1e-3 * abs(size[at]))


def _curved(means: Array) -> Array:
    """Changes of the mean of bundles from line to line, less half of those before and after."""
    change = np.diff(means.mean(axis=0, dtype=np.float64))
    return np.asarray(change[1:-1] - 0.5 * (change[:-2] + change[2:]))


def _sizes(curved: Array) -> Array:
    """Steps that fit best to the curvature around each line."""
    return np.asarray((2.0 * curved[1:-1] - curved[:-2] - curved[2:]) / 3.0)
