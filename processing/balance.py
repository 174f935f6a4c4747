"""Balancing the PAN heads: one gain per sensor from what the overlaps show (DESIGN 5.1).

Also samples the heads at common nodes of the virtual image, which the seams use too. Offsets are
the dark calibration's and stay untouched.

Source: seeds/dmc-calibration.txt, 6.2.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from processing.lattice import OUTSIDE
from processing.resampling import WEIGHT_STEP_PX

Array = NDArray[Any]

NOT_COVERED: Final = -2.0
UNUSABLE: Final = -1.0
"""Covered, but saturated or without data somewhere in the block."""
ALONE: Final = -3.0
"""Covered by this frame and no other: not measured, since there is nothing to compare it with."""

_BLOCK_PX: Final = 8
_COARSE: Final = 8
_MIN_SAMPLES: Final = 30
_MIN_SIGNAL: Final = 80.0
"""Level-1 counts (10 DN of 12 bits): below, the ratio of two means says little."""


@dataclass(frozen=True)
class PairBalance:
    """One overlap: median of log(a / b), its standard deviation, and the samples behind it."""

    sensor_a: str
    sensor_b: str
    log_ratio: float
    sigma: float
    samples: int


@dataclass(frozen=True)
class Balance:
    """Gains by sensor (the mean of their logarithms is zero) and what every overlap said."""

    gains: Mapping[str, float]
    pairs: tuple[PairBalance, ...]

    @property
    def spread(self) -> float:
        """Largest gain over smallest, less one."""
        values = list(self.gains.values())
        return max(values) / min(values) - 1.0 if values else 0.0


def node_means(frames: Array, valid: Array, lattices: Array, cell_px: int, out: Array) -> None:
    """Mean Level-1 signal of 8 x 8 raw pixels around every weight node that frames share.

    Args:
        frames, valid, lattices, cell_px: as in `processing.resampling.resample`.
        out: (n, rows, columns) float32 at every `WEIGHT_STEP_PX`-th target pixel; overwritten.
            `NOT_COVERED` where the frame does not reach, `ALONE` where only this one does,
            `UNUSABLE` where the block holds saturated pixels or holes.
    """
    _node_means(frames, valid, lattices, cell_px, out)


def covered_box(means: Array) -> tuple[slice, slice]:
    """Rows and columns of nodes that hold all a frame covers, with a little around it.

    A frame covers one coherent part of the image; every eighth node finds it.
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
    """Gains that make the overlaps agree, by weighted least squares over all pairs.

    Each overlap gives the median of its log ratios, which neither a car that moved between two
    exposures nor a saturated roof can pull. A sensor without overlap keeps the mean gain.

    Args:
        names: sensors in the order of `means`.
        means: (n, rows, columns) from `node_means`.
    """
    pairs = []
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
        ratios = np.log(of_a[common] / of_b[common])
        median = float(np.median(ratios))
        spread = 1.4826 * float(np.median(np.abs(ratios - median)))
        # 1.2533: the median's standard deviation against the mean's, for normal errors.
        sigma = 1.2533 * max(spread, 1e-4) / np.sqrt(count)
        pairs.append(PairBalance(names[a], names[b], median, float(sigma), count))
    gains = np.exp(_log_gains(names, pairs)).tolist()
    return Balance(dict(zip(names, gains, strict=True)), tuple(pairs))


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


@njit(cache=True, parallel=True, nogil=True)
def _node_means(frames, valid, lattices, cell, out):  # type: ignore[no-untyped-def]
    count, rows, columns = out.shape
    nodes = cell // WEIGHT_STEP_PX
    cells = lattices.shape[2] - 1
    for i in prange(rows):
        li = min(i // nodes, lattices.shape[1] - 2)
        f = (i - li * nodes) / nodes
        covering = np.zeros(columns, np.int64)
        places = np.empty((count, columns, 2), np.int64)
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
                # The last cell has the nodes at its right end, too.
                for k in range(nodes + (1 if lj == cells - 1 else 0)):
                    c = c0 + dc * k
                    r = r0 + dr * k
                    if valid[s, 0] <= c <= valid[s, 1] and valid[s, 2] <= r <= valid[s, 3]:
                        j = lj * nodes + k
                        line[j] = ALONE
                        covering[j] += 1
                        places[s, j, 0] = np.int64(np.floor(c + 0.5)) - _BLOCK_PX // 2
                        places[s, j, 1] = np.int64(np.floor(r + 0.5)) - _BLOCK_PX // 2
        for s in range(count):
            for j in range(columns):
                if covering[j] > 1 and out[s, i, j] == ALONE:
                    out[s, i, j] = _block_mean(frames[s], valid[s], places[s, j])


@njit(cache=True, nogil=True)
def _block_mean(frame, valid, corner):  # type: ignore[no-untyped-def]
    """Mean of a block within the usable area; `UNUSABLE` where a pixel is saturated or a hole."""
    total = np.int64(0)
    pixels = 0
    marred = False
    for y in range(
        max(corner[1], np.int64(valid[2])), min(corner[1] + _BLOCK_PX, np.int64(valid[3]) + 1)
    ):
        for x in range(
            max(corner[0], np.int64(valid[0])), min(corner[0] + _BLOCK_PX, np.int64(valid[1]) + 1)
        ):
            word = frame[y, x]
            marred |= (word == 0) | ((word & 1) == 1)
            total += word
            pixels += 1
    return UNUSABLE if marred or pixels == 0 else total / pixels
