"""Balancing the PAN heads from the histograms of their overlaps.

A gain for each sensor, and an offset where the contrast of an overlap determines it. Also
samples the heads at common nodes of the virtual image, which the seams use too.

Source: docs/explanation/mathematics/radiometry.md#balance-between-heads; Heier et al. (2002), 6.2.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.image.head_response import SAMPLES_MAX, OverlapCells, overlap_cells
from processing.image.lattice import OUTSIDE
from processing.image.resampling import WEIGHT_STEP_PX

Array = NDArray[Any]

NOT_COVERED: Final = -2.0
UNUSABLE: Final = -1.0
"""Covered, but saturated or without data somewhere in the block."""
SINGLE_COVERAGE: Final = -3.0
"""Covered by this frame and no other: not measured, since there is nothing to compare it with."""

OUTLIER_LIMIT: Final = 0.08
"""A calibrated head's gain is within a percent of the others'; so far off, its exposure is not."""
_BLOCK_PX: Final = 8
_COARSE: Final = 8
_MIN_SAMPLES: Final = 30
_MIN_SIGNAL: Final = 80.0
"""Level-1 counts (10 DN of 12 bits): below, the ratio of two means is too uncertain."""
_SPAN: Final = 4.0
"""Ratio of light to dark from which an overlap separates an offset from a gain."""
_LEVELS: Final = 12
_PAIR_DIFFERENCE_SIGMA: Final = 2e-4
"""What parallax and reflection leave between two cones at one level, of its signal."""
_GAIN_SIGMA: Final = 0.05
_OFFSET_SIGMA: Final = 24.0
_NO_OFFSET_SIGMA: Final = 1e-3
"""Level-1 counts: a priori sigma of an offset; black drifts by a few DN."""


@dataclass(frozen=True)
class PairBalance:
    """One overlap: median of log(a / b), its standard deviation, and the samples behind it.

    `span` is how many times brighter the overlap's light is than its dark (98th over 2nd
    percentile).
    """

    sensor_a: str
    sensor_b: str
    log_ratio: float
    sigma: float
    samples: int
    span: float = 1.0


@dataclass(frozen=True)
class GainOutlier:
    """A sensor that shows `signal` times that of the rest; others explain the overlaps as well."""

    sensor: str
    signal: float
    alternatives: tuple[str, ...] = ()


@dataclass(frozen=True)
class Balance:
    """Gains by sensor (the mean of their logarithms is zero) and the measurement of every overlap.

    Balanced signal is gain * signal + offset; `offsets` are in Level-1 counts and zero where no
    overlap of a sensor spans enough light and dark to separate them from its gain. `cells` show
    whether a sensor responds to light as its neighbours do (`processing.image.head_response`).
    """

    gains: Mapping[str, float]
    pairs: tuple[PairBalance, ...]
    offsets: Mapping[str, float] = field(default_factory=dict)
    cells: tuple[OverlapCells, ...] = ()

    def outlier_without(self, changed: Collection[str]) -> GainOutlier | None:
        """The sensor whose gain is farthest from the median.

        Sensors whose signal changes within their frames have no one gain, and pass their error on
        to their neighbours: gains follow from the overlaps of the others alone.

        Args:
            changed: these sensors, by name.

        Returns:
            The sensor; None where no gain is more than `OUTLIER_LIMIT` off.
        """
        gains, pairs = self.gains, self.pairs
        if not gains.keys().isdisjoint(changed):
            names = [name for name in gains if name not in changed]
            pairs = tuple(p for p in pairs if {p.sensor_a, p.sensor_b}.isdisjoint(changed))
            tied = {name for pair in pairs for name in (pair.sensor_a, pair.sensor_b)}
            names = [name for name in names if name in tied]
            gains = dict(zip(names, np.exp(_log_gains(names, pairs)).tolist(), strict=True))
        if len(gains) < 2:
            return None
        logs = {name: float(np.log(gain)) for name, gain in gains.items()}
        middle = float(np.median(list(logs.values())))
        farthest = max(logs, key=lambda n: abs(logs[n] - middle))
        if abs(logs[farthest] - middle) <= np.log1p(OUTLIER_LIMIT):
            return None
        causes = _explanations(pairs) or [farthest]
        name = farthest if farthest in causes else causes[0]
        others = tuple(sorted(cause for cause in causes if cause != name))
        return GainOutlier(name, float(np.exp(middle - logs[name])), others)

    @property
    def spread(self) -> float:
        """Largest gain over smallest, less one."""
        values = list(self.gains.values())
        return max(values) / min(values) - 1.0 if values else 0.0


def node_means(frames: Array, valid: Array, lattices: Array, cell_px: int, out: Array) -> None:
    """Mean Level-1 signal of 8 x 8 raw pixels around every weight node that frames share.

    Args:
        frames: (n, rows, columns) uint16, Level-1 words.
        valid: as in `processing.image.resampling.resample`, (n, 4).
        lattices: raw column and row at the lattice nodes, (n, rows, columns, 2).
        cell_px: lattice spacing, target pixels.
        out: (n, rows, columns) float32 at every `WEIGHT_STEP_PX`-th target pixel; overwritten.
            `NOT_COVERED` where the frame does not reach, `SINGLE_COVERAGE` where only this one
            does, `UNUSABLE` where the block holds saturated pixels or holes.
    """
    _node_means(frames, valid, lattices, cell_px, out)


def covered_box(means: Array) -> tuple[slice, slice]:
    """Rows and columns of nodes that hold all a frame covers, with a little around it.

    A frame covers one coherent part of the image; every eighth node finds it.

    Args:
        means: of one frame, (rows, columns) from `node_means`.

    Returns:
        Slices of rows and of columns, empty where the frame covers no node.
    """
    rows, columns = means.shape
    coarse = means[::_COARSE, ::_COARSE] != np.float32(NOT_COVERED)
    i, j = np.flatnonzero(coarse.any(axis=1)), np.flatnonzero(coarse.any(axis=0))
    if len(i) == 0:
        covered = means != np.float32(NOT_COVERED)
        if not covered.any():
            return slice(0, 0), slice(0, 0)
        return slice(0, rows), slice(0, columns)
    return (
        slice(max((i[0] - 1) * _COARSE, 0), min((i[-1] + 1) * _COARSE, rows)),
        slice(max((j[0] - 1) * _COARSE, 0), min((j[-1] + 1) * _COARSE, columns)),
    )


def balance_gains(names: Sequence[str], means: Array) -> Balance:
    """Gains, and offsets where they are determinable, that make the overlaps agree.

    First each overlap gives the median of its log ratios, which neither a car that moved between
    two exposures nor a saturated roof can pull; gains follow by weighted least squares over all
    pairs. Where the histogram of an overlap spans a factor of four, medians level by level separate
    gain from offset, and both are adjusted once more. A sensor without overlap keeps the mean gain.

    Args:
        names: sensors in the order of `means`.
        means: (n, rows, columns) from `node_means`.

    Returns:
        Gains and offsets of all sensors, and the overlaps with enough samples.

    Source: docs/explanation/mathematics/radiometry.md#balance-between-heads.
    """
    pairs, samples, cells = [], [], []
    boxes = [covered_box(one) for one in means]
    for a, b in itertools.combinations(range(len(names)), 2):
        both = tuple(
            slice(max(p.start, q.start), max(min(p.stop, q.stop), 0))
            for p, q in zip(boxes[a], boxes[b], strict=True)
        )
        of_a, of_b = means[a][both], means[b][both]
        common = (of_a > _MIN_SIGNAL) & (of_b > _MIN_SIGNAL)
        count = int(np.count_nonzero(common))
        if count < _MIN_SAMPLES:
            continue
        light_a, light_b = of_a[common], of_b[common]
        ratios = np.log(light_a / light_b)
        median = float(np.median(ratios))
        spread = 1.4826 * float(np.median(np.abs(ratios - median)))
        # 1.2533: the median's standard deviation against the mean's, for normal errors.
        sigma = 1.2533 * max(spread, 1e-4) / np.sqrt(count)
        low, high = np.percentile(light_a, (2.0, 98.0))
        span = float(high / low)
        pairs.append(PairBalance(names[a], names[b], median, float(sigma), count, span))
        chosen = slice(None, None, max(1, count // SAMPLES_MAX))
        row, column = np.divmod(np.flatnonzero(common)[chosen], common.shape[1])
        places = np.stack([column + both[1].start, row + both[0].start], axis=1)
        shares = places / (means.shape[2], means.shape[1])
        cells.append(overlap_cells(names[a], names[b], light_a[chosen], light_b[chosen], shares))
        samples.append((a, b, light_a, light_b))
    logs = _log_gains(names, pairs)
    offsets = np.zeros(len(names))
    wide = {k for pair, s in zip(pairs, samples, strict=True) for k in s[:2] if pair.span >= _SPAN}
    if wide:
        steps = [
            step
            for a, b, light_a, light_b in samples
            for step in _levels(a, b, light_a * np.exp(logs[a]), light_b * np.exp(logs[b]))
        ]
        change, offsets = _gains_and_offsets(len(names), steps, wide)
        logs = logs + change
    # One head that is far off does not draw the level of the others with it.
    off = logs - np.median(logs)
    if len(logs) > 2 and np.count_nonzero(np.abs(off) > np.log1p(OUTLIER_LIMIT)) == 1:
        tied = {name for pair in pairs for name in (pair.sensor_a, pair.sensor_b)}
        logs = np.where([name in tied for name in names], off, 0.0)
    gains = np.exp(logs).tolist()
    return Balance(
        dict(zip(names, gains, strict=True)),
        tuple(pairs),
        dict(zip(names, offsets.tolist(), strict=True)),
        tuple(cells),
    )


@dataclass(frozen=True)
class _Level:
    """One level of an overlap's histogram: median difference a - b there, and its sigma."""

    a: int
    b: int
    signal: float
    difference: float
    sigma: float


def _levels(a: int, b: int, light_a: Array, light_b: Array) -> list[_Level]:
    """The overlap cut into levels of equal numbers of samples, from dark to light."""
    middle = 0.5 * (light_a + light_b)
    order = np.argsort(middle)
    signals, differences = middle[order], (light_a - light_b)[order]
    count = min(_LEVELS, max(1, len(order) // _MIN_SAMPLES))
    size, longer = divmod(len(order), count)
    split = longer * (size + 1)
    found = []
    # As `numpy.array_split`: the first levels have one sample more.
    for rows, part in ((longer, slice(split)), (count - longer, slice(split, None))):
        if not rows:
            continue
        of_level, off = signals[part].reshape(rows, -1), differences[part].reshape(rows, -1)
        medians = np.median(off, axis=1)
        spreads = 1.4826 * np.median(np.abs(off - medians[:, None]), axis=1)
        for signal, median, spread in zip(
            np.median(of_level, axis=1).tolist(), medians.tolist(), spreads.tolist(), strict=True
        ):
            sigma = 1.2533 * max(spread, 1.0) / np.sqrt(off.shape[1])
            sigma = float(np.hypot(sigma, _PAIR_DIFFERENCE_SIGMA * signal))
            found.append(_Level(a, b, signal, median, sigma))
    return found


def _gains_and_offsets(
    count: int, levels: Sequence[_Level], free: Collection[int]
) -> tuple[Array, Array]:
    """Relative changes of gain, and offsets of the sensors `free` to have one, (count,) each.

    Offsets that the overlaps do not determine stay near zero: drift of black is small.
    """
    rows, values = [], []
    for level in levels:
        row = np.zeros(2 * count)
        row[level.a], row[level.b] = level.signal, -level.signal
        row[count + level.a], row[count + level.b] = 1.0, -1.0
        rows.append(row / level.sigma)
        values.append(-level.difference / level.sigma)
    for k in range(count):
        gain, offset = np.zeros(2 * count), np.zeros(2 * count)
        gain[k] = 1.0 / _GAIN_SIGMA
        offset[count + k] = 1.0 / (_OFFSET_SIGMA if k in free else _NO_OFFSET_SIGMA)
        rows += [gain, offset]
        values += [0.0, 0.0]
    common = np.zeros((2, 2 * count))
    common[0, :count] = common[1, count:] = 1e6 / max(count, 1)
    design = np.concatenate([np.array(rows), common])
    solution, *_ = np.linalg.lstsq(design, np.array([*values, 0.0, 0.0]), rcond=None)
    return np.asarray(solution[:count]), np.asarray(solution[count:])


def _log_gains(names: Sequence[str], pairs: Sequence[PairBalance]) -> Array:
    count = len(names)
    # The constraint rows: mean log gain zero (strong), each gain near one (weak, for a sensor that
    # no overlap ties to the rest; 1e3 times weaker than one part in a thousand).
    rows = [np.full(count, 1e6 / max(count, 1))]
    values = [0.0]
    for k in range(count):
        row = np.zeros(count)
        row[k] = 1.0
        rows.append(row)
        values.append(0.0)
    place = {name: k for k, name in enumerate(names)}
    for pair in pairs:
        row = np.zeros(count)
        row[place[pair.sensor_a]] = 1.0
        row[place[pair.sensor_b]] = -1.0
        # Parallax and reflection differ between cones whatever the number of samples.
        weight = 1.0 / np.hypot(pair.sigma, 1e-3)
        rows.append(row * weight)
        values.append(-pair.log_ratio * weight)
    solution, *_ = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)
    return np.asarray(solution)


def _explanations(pairs: Sequence[PairBalance]) -> list[str]:
    """Sensors of one of which another gain explains what overlaps differ by, the best first.

    Whose gain is wrong is off in all of its overlaps alike. Where the rest is explained as well by
    another gain of its neighbour, or by neither, both may be wrong.
    """
    worst = max((abs(pair.log_ratio) for pair in pairs), default=0.0)
    causes: dict[str, float] = {}
    for pair in pairs:
        if abs(pair.log_ratio) > 0.5 * worst:
            for name in (pair.sensor_a, pair.sensor_b):
                of_a = [p.log_ratio for p in pairs if p.sensor_a == name]
                own = np.array(of_a + [-p.log_ratio for p in pairs if p.sensor_b == name])
                causes[name] = float(np.sum(np.abs(own) - np.abs(own - np.median(own))))
    most = max(causes.values(), default=0.0)
    likely = [name for name in causes if causes[name] >= most - 0.5 * worst]
    return sorted(likely, key=lambda name: -causes[name])


@compiled_kernel(parallel=True)
def _node_means(frames, valid, lattices, cell, out):
    count, rows, columns = out.shape
    nodes = cell // WEIGHT_STEP_PX
    cells = lattices.shape[2] - 1
    for i in prange(rows):
        li = min(i // nodes, lattices.shape[1] - 2)
        f = (i - li * nodes) / nodes
        corner = np.empty(2, np.int64)
        covering = np.zeros(columns, np.int32)
        # Column and row of a frame at the first node of a cell, and their change per node.
        lines = np.empty((count, cells, 4))
        reached = np.zeros((count, cells), np.bool_)
        for s in range(count):
            line = out[s, i]
            line[:] = NOT_COVERED
            for lj in range(cells):
                upper_left = lattices[s, li, lj]
                upper_right = lattices[s, li, lj + 1]
                lower_left = lattices[s, li + 1, lj]
                lower_right = lattices[s, li + 1, lj + 1]
                if (
                    upper_left[0] == OUTSIDE
                    or upper_right[0] == OUTSIDE
                    or lower_left[0] == OUTSIDE
                    or lower_right[0] == OUTSIDE
                ):
                    continue
                c0 = upper_left[0] + f * (lower_left[0] - upper_left[0])
                r0 = upper_left[1] + f * (lower_left[1] - upper_left[1])
                dc = (upper_right[0] + f * (lower_right[0] - upper_right[0]) - c0) / nodes
                dr = (upper_right[1] + f * (lower_right[1] - upper_right[1]) - r0) / nodes
                reached[s, lj] = True
                lines[s, lj, 0], lines[s, lj, 1] = c0, r0
                lines[s, lj, 2], lines[s, lj, 3] = dc, dr
                # The last cell has the nodes at its right end, too.
                for k in range(nodes + (1 if lj == cells - 1 else 0)):
                    c = c0 + dc * k
                    r = r0 + dr * k
                    if valid[s, 0] <= c <= valid[s, 1] and valid[s, 2] <= r <= valid[s, 3]:
                        line[lj * nodes + k] = SINGLE_COVERAGE
                        covering[lj * nodes + k] += 1
        for s in range(count):
            for lj in range(cells):
                if not reached[s, lj]:
                    continue
                c0, r0, dc, dr = (
                    lines[s, lj, 0],
                    lines[s, lj, 1],
                    lines[s, lj, 2],
                    lines[s, lj, 3],
                )
                for k in range(nodes + (1 if lj == cells - 1 else 0)):
                    j = lj * nodes + k
                    if covering[j] > 1 and out[s, i, j] == SINGLE_COVERAGE:
                        corner[0] = np.int64(np.floor(c0 + dc * k + 0.5)) - _BLOCK_PX // 2
                        corner[1] = np.int64(np.floor(r0 + dr * k + 0.5)) - _BLOCK_PX // 2
                        out[s, i, j] = _block_mean(frames[s], valid[s], corner)


@compiled_kernel()
def _block_mean(frame, valid, corner):
    """Mean of a block within the usable area; `UNUSABLE` where a pixel is saturated or a hole."""
    column, row = corner[0], corner[1]
    if (
        column >= valid[0]
        and row >= valid[2]
        and column + _BLOCK_PX <= valid[1] + 1.0
        and row + _BLOCK_PX <= valid[3] + 1.0
    ):
        return _whole_block_mean(frame, row, column)
    total = np.int64(0)
    pixels = 0
    unusable = False
    for y in range(
        max(corner[1], np.int64(valid[2])), min(corner[1] + _BLOCK_PX, np.int64(valid[3]) + 1)
    ):
        for x in range(
            max(corner[0], np.int64(valid[0])), min(corner[0] + _BLOCK_PX, np.int64(valid[1]) + 1)
        ):
            value = frame[y, x]
            unusable |= (value == 0) | ((value & 1) == 1)
            total += value
            pixels += 1
    return UNUSABLE if unusable or pixels == 0 else total / pixels


@compiled_kernel()
def _whole_block_mean(frame, row, column):
    """As `_block_mean` where all pixels of the block are usable: counts known to the compiler."""
    total = np.int32(0)
    odd_bits = np.int32(0)
    least = np.int32(65535)
    for y in range(row, row + _BLOCK_PX):
        line = frame[y, column : column + _BLOCK_PX]
        for x in range(_BLOCK_PX):
            value = np.int32(line[x])
            total += value
            odd_bits |= value
            least = min(least, value)
    unusable = least == 0 or (odd_bits & 1) == 1
    return UNUSABLE if unusable else np.float64(total) / (_BLOCK_PX * _BLOCK_PX)
