"""The posterior of a clock against the same one computed densely, matrix by matrix."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.onboard.timing.clock_model import (
    GRID_PRIOR,
    GRID_SCALE,
    GRID_WANDER,
    NEGLIGIBLE,
    OUTLIER,
    RATE_SIGMA,
    ClockModel,
    Pair,
    _are_consistent,
    _Fit,
)

Array = NDArray[np.float64]
NS = 1_000_000_000
AT_S = np.array([0.0, 1.0, 2.5, 3.0, 4.5, 6.0])
OFF_NS = np.array([0.0, 1_030.0, 2_390.0, 3_050.0, 4_400.0, 6_120.0])
SIGMA_NS = np.array([40.0, 60.0, 50.0, 40.0, 80.0, 50.0])


def covariance(a: Array, b: Array) -> Array:
    """Of twice integrated white noise: the integral of (a - t)(b - t) up to the lesser of both."""
    x, y = a[:, None], b[None, :]
    end = np.clip(np.minimum(x, y), 0.0, None)
    value: Array = x * y * end - (x + y) * end**2 / 2 + end**3 / 3
    return value


def dense(at_s: float) -> tuple[float, float]:
    """Offset and its sigma, ns: generalised least squares for each candidate, then averaged."""
    u, start = AT_S - AT_S[-1], AT_S[0] - AT_S[-1]
    z = OFF_NS - OFF_NS[-1]
    here = at_s - AT_S[-1]
    design, row = np.stack([np.ones(len(u)), u], axis=1), np.array([1.0, here])
    means, variances, weights = [], [], []
    for wander, scale, prior in zip(GRID_WANDER, GRID_SCALE, GRID_PRIOR, strict=True):
        readings = wander * covariance(u - start, u - start) + np.diag((scale * SIGMA_NS) ** 2)
        inverse = np.linalg.inv(readings)
        normal = design.T @ inverse @ design + np.diag([0.0, RATE_SIGMA**-2])
        line = np.linalg.solve(normal, design.T @ inverse @ z)
        residual = z - design @ line
        square = float(z @ inverse @ residual)
        log_determinants = np.linalg.slogdet(readings)[1] + np.linalg.slogdet(normal)[1]
        weights.append(prior - 0.5 * (square + log_determinants))
        across = wander * covariance(np.array([here - start]), u - start)[0]
        itself = wander * covariance(np.array([here - start]), np.array([here - start]))[0, 0]
        gap = row - across @ inverse @ design
        means.append(row @ line + across @ inverse @ residual)
        variances.append(itself - across @ inverse @ across + gap @ np.linalg.solve(normal, gap))
    share = np.exp(np.array(weights) - max(weights))
    share[share <= NEGLIGIBLE] = 0.0
    share /= share.sum()
    mean = float(share @ np.array(means))
    variance = float(share @ (np.array(variances) + (np.array(means) - mean) ** 2))
    return OFF_NS[-1] + mean, math.sqrt(variance)


@pytest.mark.parametrize("at_s", [0.4, 2.75, 5.9, 6.0, 9.0, 60.0])
def test_offset_and_sigma_are_those_of_the_dense_solution(at_s: float) -> None:
    model = ClockModel()
    for second, off_ns, sigma_ns in zip(AT_S, OFF_NS, SIGMA_NS, strict=True):
        assert model.add(Pair(round(second * NS), round(second * NS + off_ns), sigma_ns))
    found = model.at(round(at_s * NS))
    assert found is not None
    off_ns, sigma_ns = dense(at_s)
    assert found.to_ns - at_s * NS == pytest.approx(off_ns, abs=0.6)
    assert found.sigma_ns == pytest.approx(sigma_ns, rel=1e-5)


def test_an_outlier_loses_weight_by_how_far_it_is_off_what_the_others_say() -> None:
    u = np.arange(-15.0, 1.0)
    off_ns = np.round(np.random.default_rng(1).normal(0.0, 50.0, len(u)))
    off_ns[7] += 5_000.0
    fit = _Fit(
        [Pair(round(a * NS), round(a * NS + b), 50.0) for a, b in zip(u, off_ns, strict=True)], 1.0
    )
    # As stated, before any sigma grows.
    fit._sigma = fit._stated
    fit._solve()
    best = int(np.argmax(fit._weight))
    wander, scale = fit._wander[best], fit._scale[best]
    expected = []
    for index in range(len(u)):
        rest = np.arange(len(u)) != index
        z, start = off_ns - off_ns[-1], u[0]
        readings = wander * covariance(u[rest] - start, u[rest] - start)
        readings += np.diag(np.full(rest.sum(), (scale * 50.0) ** 2))
        inverse = np.linalg.inv(readings)
        design, row = np.stack([np.ones(rest.sum()), u[rest]], axis=1), np.array([1.0, u[index]])
        normal = design.T @ inverse @ design + np.diag([0.0, RATE_SIGMA**-2])
        line = np.linalg.solve(normal, design.T @ inverse @ z[rest])
        here = u[index : index + 1] - start
        across = wander * covariance(here, u[rest] - start)[0]
        gap = row - across @ inverse @ design
        variance = wander * covariance(here, here)[0, 0] - across @ inverse @ across
        variance += gap @ np.linalg.solve(normal, gap) + (scale * 50.0) ** 2
        mean = row @ line + across @ inverse @ (z[rest] - design @ line)
        expected.append(abs(z[index] - mean) / (OUTLIER * 0.75 * math.sqrt(variance)))
    assert max(expected) > 2.0
    assert fit._growth() == pytest.approx(np.maximum(expected, 1.0), rel=1e-4)


def pairs_with_outliers(seed: int) -> list[Pair]:
    """Of a clock without offset: sigma 50 ns, a quarter of them 0.1 to 100 us away."""
    random = np.random.default_rng(seed)
    count = int(random.integers(4, 12))
    u_s = np.sort(random.uniform(0.0, 20.0, count))
    off_ns = random.normal(0.0, 50.0, count)
    odd = random.choice(count, max(1, count // 4), replace=False)
    off_ns[odd] += random.choice([-1.0, 1.0], len(odd)) * 10 ** random.uniform(2.0, 5.0, len(odd))
    return [Pair(round(a * NS), round(a * NS + b), 50.0) for a, b in zip(u_s, off_ns, strict=True)]


@pytest.mark.parametrize("seed", [11, 112, 116, 185, 242, 248])
def test_sigmas_that_grow_in_the_last_round_are_solved_with(seed: int) -> None:
    pairs = pairs_with_outliers(seed)
    fit = _Fit(pairs, 1.0)
    assert np.any(fit._sigma > fit._stated)
    span_ns = pairs[-1].from_ns
    at_ns = [span_ns // 2, span_ns, span_ns + 10 * NS]
    found = [fit.at(one, 0.0) for one in at_ns]
    for one, (to_ns, sigma_ns) in zip(at_ns, found, strict=True):
        assert abs(to_ns - one) < 5.0 * sigma_ns
    fit._solve()
    assert found == [fit.at(one, 0.0) for one in at_ns]


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_pairs_are_one_line_within_eight_of_their_sigmas_times_the_scatter(factor: float) -> None:
    limit_ns = round(8.0 * factor * (50.0 + 30.0) + 5 * RATE_SIGMA * 2.0)
    for off_ns, agree in ((limit_ns, True), (-limit_ns, True), (limit_ns + 1, False)):
        pairs = [Pair(0, 0, 50.0), Pair(2 * NS, 2 * NS + off_ns, 30.0)]
        assert _are_consistent(pairs, factor) is agree
