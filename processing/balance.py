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

_BLOCK_PX: Final = 8
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
    """Mean Level-1 signal of 8 x 8 raw pixels around every weight node, by frame.

    Args:
        frames, valid, lattices, cell_px: as in `processing.resampling.resample`.
        out: (n, rows, columns) float32 at every `WEIGHT_STEP_PX`-th target pixel; overwritten.
            `NOT_COVERED` where the frame does not reach, `UNUSABLE` where the block holds
            saturated pixels or holes.
    """
    _node_means(frames, valid, lattices, cell_px, out)


def balance_gains(names: Sequence[str], means: Array) -> Balance:
    """Gains that make the overlaps agree, by weighted least squares over all pairs.

    Each overlap gives the median of its log ratios, which neither a car that moved between two
    exposures nor a saturated roof can pull. A sensor without overlap keeps the mean gain.

    Args:
        names: sensors in the order of `means`.
        means: (n, rows, columns) from `node_means`.
    """
    pairs = []
    for a, b in itertools.combinations(range(len(names)), 2):
        common = (means[a] > _MIN_SIGNAL) & (means[b] > _MIN_SIGNAL)
        count = int(np.count_nonzero(common))
        if count < _MIN_SAMPLES:
            continue
        ratios = np.log(means[a][common] / means[b][common])
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
    for i in prange(rows):
        li = min(i // nodes, lattices.shape[1] - 2)
        fy = (i - li * nodes) / nodes
        for s in range(count):
            for j in range(columns):
                out[s, i, j] = NOT_COVERED
                lj = min(j // nodes, lattices.shape[2] - 2)
                fx = (j - lj * nodes) / nodes
                if (
                    lattices[s, li, lj, 0] == OUTSIDE
                    or lattices[s, li, lj + 1, 0] == OUTSIDE
                    or lattices[s, li + 1, lj, 0] == OUTSIDE
                    or lattices[s, li + 1, lj + 1, 0] == OUTSIDE
                ):
                    continue
                c = (1.0 - fy) * (
                    (1.0 - fx) * lattices[s, li, lj, 0] + fx * lattices[s, li, lj + 1, 0]
                ) + fy * (
                    (1.0 - fx) * lattices[s, li + 1, lj, 0] + fx * lattices[s, li + 1, lj + 1, 0]
                )
                r = (1.0 - fy) * (
                    (1.0 - fx) * lattices[s, li, lj, 1] + fx * lattices[s, li, lj + 1, 1]
                ) + fy * (
                    (1.0 - fx) * lattices[s, li + 1, lj, 1] + fx * lattices[s, li + 1, lj + 1, 1]
                )
                if not (valid[s, 0] <= c <= valid[s, 1] and valid[s, 2] <= r <= valid[s, 3]):
                    continue
                first_c = np.int64(np.floor(c + 0.5)) - _BLOCK_PX // 2
                first_r = np.int64(np.floor(r + 0.5)) - _BLOCK_PX // 2
                total = np.int64(0)
                pixels = 0
                marred = False
                for y in range(
                    max(first_r, np.int64(valid[s, 2])),
                    min(first_r + _BLOCK_PX, np.int64(valid[s, 3]) + 1),
                ):
                    for x in range(
                        max(first_c, np.int64(valid[s, 0])),
                        min(first_c + _BLOCK_PX, np.int64(valid[s, 1]) + 1),
                    ):
                        word = frames[s, y, x]
                        marred |= (word == 0) | ((word & 1) == 1)
                        total += word
                        pixels += 1
                out[s, i, j] = UNUSABLE if marred or pixels == 0 else total / pixels
