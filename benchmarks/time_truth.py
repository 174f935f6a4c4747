"""The time chain as physics has it: oscillators, latches, round trips. No code of the estimator.

Everything is drawn for every run: how good the host's crystal is, how warm it gets, how long
interrupts and the ways to the trigger unit take. A run gets what hardware would report.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

STEP_S = 0.1
US = 1_000.0


class Oscillator:
    """Phase of a crystal against true time, ns.

    Rate offset (up to tens of ppm), ageing, random-walk frequency, white frequency noise, and a
    temperature that wanders (Ornstein-Uhlenbeck, lagged by the mass of the case) times the
    crystal's sensitivity. After IEEE Std 1139 and what crystal data sheets give: 0.03 to 0.5 ppm/K.
    """

    def __init__(
        self, rng: np.random.Generator, span_s: float, *, temperature_factor: float = 1.0
    ) -> None:
        n = math.ceil(span_s / STEP_S) + 2
        wander = 10 ** rng.uniform(-10.5, -8.8)
        sensitivity = 10 ** rng.uniform(-7.5, -6.3)
        warmth_k, slow_s = rng.uniform(0.3, 2.0), rng.uniform(200.0, 900.0)
        case_s = rng.uniform(20.0, 90.0)
        decay = math.exp(-STEP_S / slow_s)
        increments = rng.normal(0.0, warmth_k * math.sqrt(1 - decay**2), n)
        increments[0] = rng.normal(0.0, warmth_k)
        air_k = lfilter([1.0], [1.0, -decay], increments)
        lag = math.exp(-STEP_S / case_s)
        case, _ = lfilter([1.0 - lag], [1.0, -lag], air_k, zi=[air_k[0] * lag])
        rate = rng.normal(0.0, 15e-6) + rng.normal(0.0, 1e-12) * np.arange(n) * STEP_S
        rate = rate + np.cumsum(rng.normal(0.0, wander * math.sqrt(STEP_S), n))
        rate = (
            rate
            + temperature_factor * sensitivity * case
            + rng.normal(0.0, 1e-10 / math.sqrt(STEP_S), n)
        )
        self._phase_ns = np.concatenate([[0.0], np.cumsum(rate) * STEP_S * 1e9])

    def reads(self, true_s: float) -> float:
        """Reading of the clock at a true time, ns since the start."""
        at = true_s / STEP_S
        return true_s * 1e9 + float(np.interp(at, np.arange(len(self._phase_ns)), self._phase_ns))


@dataclass(frozen=True)
class Fired:
    """A pulse: when it truly was, and the host's readings before and after the round trip."""

    true_s: float
    before_ns: int
    after_ns: int


class Host:
    """A computer: interrupts that wait, processes that are scheduled late.

    `harshness` multiplies what temperature does to its crystal.
    """

    def __init__(
        self, rng: np.random.Generator, span_s: float, *, temperature_factor: float = 1.0
    ) -> None:
        self._rng = rng
        self.clock = Oscillator(rng, span_s, temperature_factor=temperature_factor)
        self._interrupt_ns = rng.uniform(1.0, 8.0) * US
        self._interrupt_jitter_ns = rng.uniform(0.3, 3.0) * US
        self._way_there_ns = 40 * US * math.exp(rng.normal(0.0, 0.35))
        self._way_back_ns = 40 * US * math.exp(rng.normal(0.0, 0.35))
        self._send_ns = rng.uniform(5.0, 40.0) * US
        self._wake_ns = rng.uniform(10.0, 80.0) * US

    def edge(self, true_s: float) -> int:
        """The kernel's stamp of a PPS edge."""
        late_ns = self._interrupt_ns + self._rng.gamma(2.0, self._interrupt_jitter_ns / 2)
        if self._rng.random() < 0.01:
            late_ns += self._rng.exponential(40 * US)
        return round(self.clock.reads(true_s) + late_ns)

    def fire(self, true_s: float) -> Fired:
        """Ask the trigger unit for a pulse at about that time."""
        there_ns = self._way_there_ns + self._rng.exponential(self._send_ns)
        back_ns = self._way_back_ns + self._rng.exponential(self._wake_ns)
        if self._rng.random() < 0.02:
            back_ns += self._rng.exponential(2000 * US)
        fired_s = true_s + there_ns * 1e-9
        before_ns = round(self.clock.reads(true_s))
        after_ns = round(self.clock.reads(fired_s + back_ns * 1e-9))
        return Fired(fired_s, before_ns, after_ns)


def receiver_stamp(
    rng: np.random.Generator, true_s: float, accuracy_ns: float, resolution_ns: float
) -> int:
    """A receiver's reading of an edge: noise, and the grid of its counter."""
    noisy_ns = true_s * 1e9 + rng.normal(0.0, accuracy_ns)
    return round(math.floor(noisy_ns / resolution_ns + 0.5) * resolution_ns)


def delay_error_ns(rng: np.random.Generator, sigma_ns: float) -> float:
    """A delay as a timer gives it: half of the variance its grid, half jitter of the output."""
    grid_ns = sigma_ns / math.sqrt(2) * math.sqrt(12)
    return float(rng.uniform(-grid_ns / 2, grid_ns / 2) + rng.normal(0.0, sigma_ns / 2**0.5))


def inside(errors_ns: NDArray[np.float64], sigmas_ns: NDArray[np.float64], times: float) -> float:
    """Share of errors within so many stated sigmas."""
    return float(np.mean(np.abs(errors_ns) <= times * sigmas_ns))
