"""One clock modelled by another: offset, rate and their uncertainty from pairs of readings.

The clock that is read is an oscillator whose rate wanders. The amount of wander, and the scale of
the stated sigmas, are estimated from the pairs. The model is independent of the source of the
pairs.

Source: docs/explanation/mathematics/time.md#clock-model; Rasmussen and Williams (2006), section
2.7.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PAIRS_MAX: Final = 40
"""Pairs kept: the newest all, older ones ever thinner."""
HISTORY_NS: Final = 1_800_000_000_000
RATE_SIGMA: Final = 20_000.0
"""Standard deviation of a crystal's rate before anything is known of it, ns per s (20 ppm)."""
RATE_LIMIT: Final = 500_000.0
"""No clock of a computer or camera is off by more, ns per s."""
WANDER: Final[Array] = np.logspace(-1.5, 4.5, 10)
"""Candidates for how fast the rate wanders, (ns/s)^2 per s: from 0.2 ppb (a good TCXO at constant
temperature) to 180 ppb (a crystal in a draught) after one second, as the square root of time."""
SCALES: Final[Array] = np.logspace(math.log10(0.35), math.log10(8.0), 7)
"""Candidates for the factor by which sigmas of readings are too large or too small."""
GRID_WANDER: Final[Array] = np.repeat(WANDER, len(SCALES))
GRID_SCALE: Final[Array] = np.tile(SCALES, len(WANDER))
NEGLIGIBLE: Final = 1e-3
WANDER_PRIOR_MEAN: Final = 0.7
WANDER_PRIOR_SIGMA: Final = 1.5
"""Crystals in a case that warms and cools wander by about 2 ppb after a second (log10 of its square
here), one in three by six times more or less."""
SCALE_SPREAD: Final = math.log(2.0)
"""Prior of the scale of stated sigmas: a factor of two."""
OUTLIER: Final = 4.0
"""A pair so many sigmas off the others loses weight, or is held back as it comes."""
GATE_SHARE: Final = 4
"""The fit that new pairs are compared with is repeated after this fraction of new pairs."""
STEP_PAIRS: Final = 3
"""So many pairs held back that agree with each other are no outliers: the clock has stepped."""
ITERATIONS_MAX: Final = 3
RECENT_PAIRS: Final = 24
SCATTER_PAIRS_MIN: Final = 8
SCATTER_LARGE: Final = 4.0
"""Where neighbours scatter by so many times their stated sigmas, these are multiplied: the grid of
scales ends at eight, and pairs would be held back as outliers of each other for ever."""
WANDER_ALLOWED: Final = 200.0
"""What the rate may have wandered between neighbours, ns per s^1.5."""
GRID_PRIOR: Final[Array] = (
    -0.5 * ((np.log10(GRID_WANDER) - WANDER_PRIOR_MEAN) / WANDER_PRIOR_SIGMA) ** 2
    - 0.5 * (np.log(GRID_SCALE) / SCALE_SPREAD) ** 2
)


@dataclass(frozen=True)
class Pair:
    """The same instant on the clock that is read and on the reference clock, with its sigma.

    `key` lets a pair be taken back.
    """

    from_ns: int
    to_ns: int
    sigma_ns: float
    key: Hashable = None


@dataclass(frozen=True)
class Estimate:
    """An instant on the other clock.

    `gap_ns` is how far the nearest pair lies: beyond the last one the clock coasts.
    """

    to_ns: int
    sigma_ns: float
    gap_ns: int


class ClockModel:
    """An oscillator against a reference, over the last half hour at most."""

    def __init__(self, *, memory: int = PAIRS_MAX) -> None:
        self._memory = memory
        self._pairs: list[Pair] = []
        self._rejected: list[Pair] = []
        self._recent: deque[Pair] = deque(maxlen=RECENT_PAIRS)
        self._factor = 1.0
        self._fit: _Fit | None = None
        self._gate: _Fit | None = None
        self._since_gate = 0
        self.outliers = 0
        self.steps = 0
        self.last_step_ns = 0

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def last(self) -> Pair | None:
        """The newest pair in use."""
        return self._pairs[-1] if self._pairs else None

    def add(self, pair: Pair) -> bool:
        """Take a pair in; False where it is held back because it fits nothing.

        Where several in succession are held back and agree, the clock has stepped: what was known
        is dropped, and they are the new beginning.
        """
        self._recent.append(pair)
        self._check_scatter()
        if pair in self._pairs:
            return True
        if len(self._pairs) >= 2 and not self._fits(pair):
            self._rejected.append(pair)
            self.outliers += 1
            if len(self._rejected) >= STEP_PAIRS and _are_consistent(
                self._rejected[-STEP_PAIRS:], self._factor
            ):
                self._step()
                return True
            del self._rejected[:-STEP_PAIRS]
            return False
        self._rejected.clear()
        self._insert(pair)
        self._since_gate += 1
        return True

    def clear(self) -> None:
        """Forget everything."""
        self._pairs.clear()
        self._rejected.clear()
        self._recent.clear()
        self._factor = 1.0
        self._fit = self._gate = None

    def at(self, from_ns: int, *, reading_sigma_ns: float = 0.0) -> Estimate | None:
        """The other clock at an instant; None before the first pair.

        With `reading_sigma_ns` the instant itself was read like the pairs were, with that stated
        sigma: what was learned of such sigmas is applied to it. From a pair on that is held back,
        what it is off by is part of the sigma: it may be the first one after a step.
        """
        if not self._pairs:
            return None
        fit = self._fitted()
        to_ns, sigma_ns = fit.at(from_ns, self._factor * reading_sigma_ns)
        if self._rejected and from_ns >= self._rejected[0].from_ns:
            last = self._rejected[-1]
            sigma_ns = math.hypot(sigma_ns, last.to_ns - fit.at(last.from_ns, 0.0)[0])
        gap_ns = min(abs(pair.from_ns - from_ns) for pair in self._pairs)
        return Estimate(to_ns, sigma_ns, gap_ns)

    def reading_scale(self) -> float:
        """By which factor sigmas of readings were found too small."""
        if not self._pairs:
            return 1.0
        return self._factor * self._fitted().reading_scale()

    def _fitted(self) -> _Fit:
        if self._fit is None:
            self._fit = _Fit(self._pairs, self._factor)
        return self._fit

    def _check_scatter(self) -> None:
        """Whether sigmas are stated far too small; then all recent pairs are used, with larger."""
        factor = _scatter_of(sorted(self._recent, key=lambda pair: pair.from_ns))
        factor = factor if factor > SCATTER_LARGE else 1.0
        if 0.5 < factor / self._factor < 2.0:
            return
        self._factor = factor
        self._fit = self._gate = None
        if factor > 1.0:
            self._rejected.clear()
            for pair in self._recent:
                if pair not in self._pairs:
                    self._insert(pair)

    def _fits(self, pair: Pair) -> bool:
        """Whether a pair may be one, by a fit that may be a few pairs old: it then coasts."""
        if self._gate is None or self._since_gate > len(self._pairs) // GATE_SHARE:
            self._gate = self._fit or _Fit(self._pairs, self._factor)
            self._since_gate = 0
        stated_ns = self._factor * pair.sigma_ns
        to_ns, sigma_ns = self._gate.at(pair.from_ns, stated_ns)
        return abs(pair.to_ns - to_ns) <= OUTLIER * 1.5 * max(sigma_ns, stated_ns)

    def _step(self) -> None:
        expected = self.at(self._rejected[-1].from_ns)
        assert expected is not None
        self.steps += 1
        self.last_step_ns = self._rejected[-1].to_ns - expected.to_ns
        self._pairs = sorted(self._rejected[-STEP_PAIRS:], key=lambda pair: pair.from_ns)
        self._rejected.clear()
        self._recent = deque(self._pairs, RECENT_PAIRS)
        self._fit = self._gate = None

    def _insert(self, pair: Pair) -> None:
        pairs = self._pairs
        position = len(pairs)
        while position and pairs[position - 1].from_ns > pair.from_ns:
            position -= 1
        pairs.insert(position, pair)
        newest_ns = pairs[-1].from_ns
        while newest_ns - pairs[0].from_ns > HISTORY_NS:
            del pairs[0]
        if len(pairs) > self._memory:
            del pairs[_least_informative(pairs)]
        self._fit = None


def _least_informative(pairs: list[Pair]) -> int:
    """The inner pair whose gap, were it gone, would be smallest for its age."""
    newest_ns = pairs[-1].from_ns
    best, minimum = 1, math.inf
    for index in range(1, len(pairs) - 1):
        gap = pairs[index + 1].from_ns - pairs[index - 1].from_ns
        ratio = gap / (newest_ns - pairs[index].from_ns + 1)
        if ratio < minimum:
            best, minimum = index, ratio
    return best


def _scatter_of(pairs: list[Pair]) -> float:
    """By how much neighbours scatter more than their sigmas say; 1 where there are few."""
    ratios = []
    for before, pair, after in zip(pairs, pairs[1:], pairs[2:], strict=False):
        span_ns = after.from_ns - before.from_ns
        if span_ns <= 0:
            continue
        share = (pair.from_ns - before.from_ns) / span_ns
        off, end = (
            (other.to_ns - before.to_ns) - (other.from_ns - before.from_ns)
            for other in (pair, after)
        )
        sigma = math.hypot(
            pair.sigma_ns,
            (1 - share) * before.sigma_ns,
            share * after.sigma_ns,
            WANDER_ALLOWED * (span_ns * 1e-9) ** 1.5,
            1.0,
        )
        ratios.append(abs(off - share * end) / sigma)
    # The median of a normal variable's size is 0.6745 sigma.
    return statistics.median(ratios) / 0.6745 if len(ratios) >= SCATTER_PAIRS_MIN else 1.0


def _are_consistent(pairs: list[Pair], factor: float) -> bool:
    """Whether pairs lie on one line of a rate a clock can have."""
    for before, after in pairwise(sorted(pairs, key=lambda pair: pair.from_ns)):
        span_s = (after.from_ns - before.from_ns) * 1e-9
        moved = (after.to_ns - before.to_ns) - (after.from_ns - before.from_ns)
        tolerance = 8.0 * factor * (before.sigma_ns + after.sigma_ns) + RATE_SIGMA * 5 * span_s
        if abs(moved) > min(tolerance, 1e8):
            return False
    return True


class _Fit:
    """The posterior of one set of pairs.

    Readings are z = offset + rate u + w(u) + noise, with w the twice integrated white noise of a
    wandering rate. Rate and wander have priors, the offset has none. Wander and the scale of the
    readings' sigmas are unknown: a grid of both is weighted by how well it explains the pairs, and
    estimates are averaged over it (no single choice would be honest when pairs are few). One
    eigen-decomposition serves the whole grid.
    """

    def __init__(self, pairs: list[Pair], factor: float) -> None:
        last = pairs[-1]
        self._from_ns, self._to_ns = last.from_ns, last.to_ns
        self._u = np.array([(p.from_ns - last.from_ns) * 1e-9 for p in pairs])
        z = [(p.to_ns - last.to_ns) - (p.from_ns - last.from_ns) for p in pairs]
        self._z = np.array(z, dtype=np.float64)
        stated = np.array([max(factor * p.sigma_ns, 1.0) for p in pairs])
        self._stated = stated
        self._sigma = stated
        self._start = float(self._u[0])
        self._solve()
        for _ in range(ITERATIONS_MAX):
            sigma = stated * self._growth()
            if bool(np.all(np.abs(sigma - self._sigma) <= 0.05 * self._sigma)):
                break
            # An estimate is right only with the solution of the sigmas it uses.
            self._sigma = sigma
            self._solve()

    def _solve(self) -> None:
        n = len(self._u)
        kernel = _wander_covariance(self._u - self._start, self._u - self._start)
        whitened = kernel / np.outer(self._sigma, self._sigma)
        values, vectors = np.linalg.eigh(whitened)
        self._vectors = vectors
        values = np.maximum(values, 0.0)
        # Axes: point of the grid, pair.
        spread = GRID_SCALE[:, None] ** 2 + GRID_WANDER[:, None] * values
        inverse = 1.0 / spread
        design = np.stack([np.ones(n), self._u], axis=1) / self._sigma[:, None]
        h = vectors.T @ design
        z = vectors.T @ (self._z / self._sigma)
        products = np.stack([h[:, 0] ** 2, h[:, 0] * h[:, 1], h[:, 1] ** 2], axis=1)
        normal = (inverse @ products)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        normal[:, 1, 1] += RATE_SIGMA**-2
        right = inverse @ (h * z[:, None])
        cofactor, determinant = _inverse_2x2(normal)
        line = np.einsum("gij,gj->gi", cofactor, right)
        residual = z - line @ h.T
        square = (inverse * residual) @ z
        log_likelihood = -0.5 * (square - np.log(inverse).sum(axis=1) + np.log(determinant))
        log_weight = log_likelihood + GRID_PRIOR
        weight = np.exp(log_weight - log_weight.max())
        # What explains the pairs a thousand times worse than the best is left out.
        retained = weight > NEGLIGIBLE
        self._weight = weight[retained] / weight[retained].sum()
        self._wander, self._scale = GRID_WANDER[retained], GRID_SCALE[retained]
        self._inverse, self._cofactor = inverse[retained], cofactor[retained]
        self._line, self._residual, self._h = line[retained], residual[retained], h
        self._weighted_residual = self._inverse * self._residual

    def _growth(self) -> Array:
        """By how much the stated sigma of each pair has to grow for it to be no outlier."""
        if len(self._u) < 4:
            return np.ones(len(self._u))
        best = int(np.argmax(self._weight))
        inverse, scale = self._inverse[best], self._scale[best]
        # What each pair is off from what the others say of it, and the variance of that.
        weighted_residual = self._vectors @ (inverse * self._residual[best])
        hat = self._vectors @ (inverse[:, None] * self._h)
        precision = np.einsum("ij,j,ij->i", self._vectors, inverse, self._vectors)
        precision -= np.einsum("ni,ij,nj->n", hat, self._cofactor[best], hat)
        precision = np.maximum(precision, 1e-12)
        off = np.abs(weighted_residual) / precision * self._sigma
        variance = self._sigma**2 * (1.0 / precision - scale**2)
        variance = np.maximum(variance, 0.0) + (scale * self._stated) ** 2
        growth: Array = np.clip(off / (OUTLIER * 0.75 * np.sqrt(variance)), 1.0, 1e6)
        return growth

    def at(self, from_ns: int, reading_sigma_ns: float) -> tuple[int, float]:
        u = (from_ns - self._from_ns) * 1e-9
        # The kernel counts from the oldest pair; before it, everything is mirrored (the line is
        # free, so that the origin does not matter).
        at = np.array([u - self._start])
        cross_covariance = _wander_covariance(at, self._u - self._start)[0] / self._sigma
        own_covariance = float(_wander_covariance(at, at)[0, 0])
        k = self._vectors.T @ cross_covariance
        covariance = self._wander[:, None] * k
        weighted = covariance * self._inverse
        g = np.array([1.0, u]) - weighted @ self._h
        mean = self._line @ np.array([1.0, u]) + (covariance * self._weighted_residual).sum(axis=1)
        variance = (
            self._wander * own_covariance
            - (weighted * covariance).sum(axis=1)
            + np.einsum("gi,gij,gj->g", g, self._cofactor, g)
        )
        variance = np.maximum(variance, 0.0) + (self._scale * reading_sigma_ns) ** 2
        centre = float(self._weight @ mean)
        total = float(self._weight @ (variance + (mean - centre) ** 2))
        to_ns = self._to_ns + (from_ns - self._from_ns) + round(centre)
        return to_ns, math.sqrt(max(total, 0.25))

    def reading_scale(self) -> float:
        return float(math.sqrt(self._weight @ self._scale**2))


def _inverse_2x2(matrices: Array) -> tuple[Array, Array]:
    """Inverse and determinant of symmetric 2 x 2 matrices, shape (..., 2, 2)."""
    a, b, d = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    determinant: Array = a * d - b * b
    inverse = np.stack([d, -b, -b, a], axis=-1) / determinant[..., None]
    return inverse.reshape(matrices.shape), determinant


def _wander_covariance(a: Array, b: Array) -> Array:
    """Covariance of the twice integrated white noise that starts at rest at zero, both sides."""
    x, y = np.abs(a)[:, None], np.abs(b)[None, :]
    low, high = np.minimum(x, y), np.maximum(x, y)
    same_side = np.sign(a)[:, None] * np.sign(b)[None, :] > 0
    covariance: Array = np.where(same_side, low * low * (3 * high - low) / 6.0, 0.0)
    return covariance
