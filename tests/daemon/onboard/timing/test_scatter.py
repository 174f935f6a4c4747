"""Clocks whose readings scatter by more than they state, late only or in steps: sigmas stay true.

Truth is a simulated oscillator; what is stated to the clock is wrong on purpose.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.time_truth import Oscillator
from daemon.onboard.timing.clock_model import ClockModel, Pair
from daemon.onboard.timing.device_clocks import DeviceClockEstimator
from daemon.onboard.timing.gps_clock import GpsClock
from drivers.contract import ClockReading

NS = 1_000_000_000
US, MS = 1e3, 1e6
RUNS, SPAN_S, FROM_S = 8, 80, 16
GPS_NS = 1_479_300_000 * NS

Jitter = Callable[[np.random.Generator], float]


def heavy(median_ns: float, at_95_percent_ns: float) -> Jitter:
    """Errors to either side, their size log-normal."""
    spread = np.log(at_95_percent_ns / median_ns) / 1.645
    return lambda chance: float(
        chance.choice((-1, 1)) * median_ns * np.exp(spread * chance.normal())
    )


def even(sigma_ns: float) -> Jitter:
    return lambda chance: float(chance.normal() * sigma_ns)


def assert_true(errors: list[float], sigmas: list[float], *, cautious: float = 0.1) -> None:
    """Chi-square of the errors against what was stated: about one a piece, and few far outside."""
    ratio = np.array(errors) / np.array(sigmas)
    assert np.mean(np.abs(ratio) <= 2) >= 0.88, ratio
    assert cautious <= np.mean(ratio**2) <= 2.0, np.mean(ratio**2)


@pytest.mark.trust
@pytest.mark.parametrize(
    ("stated_ns", "jitter"),
    [
        (5 * US, even(5 * US)),
        (5 * US, even(100 * US)),
        (5 * US, even(2 * MS)),
        (5 * US, heavy(2 * MS, 24 * MS)),
        (1 * MS, heavy(2 * MS, 24 * MS)),
    ],
    ids=["as stated", "20 times", "400 times", "heavy tails, 5 us stated", "heavy tails"],
)
def test_readings_that_scatter_more_than_they_state_give_a_sigma_that_is_true(
    stated_ns: float, jitter: Jitter
) -> None:
    errors, sigmas = [], []
    for run in range(RUNS):
        chance = np.random.default_rng([1, run])
        oscillator, model = Oscillator(chance, SPAN_S + 5.0), ClockModel()
        for second in range(1, SPAN_S):
            model.add(
                Pair(
                    round(oscillator.reads(second)), round(second * NS + jitter(chance)), stated_ns
                )
            )
            if second > FROM_S and second % 8 == 0:
                found = model.at(round(oscillator.reads(second + 0.5)))
                assert found is not None
                errors.append(found.to_ns - (second + 0.5) * NS)
                sigmas.append(found.sigma_ns)
        assert model.steps <= 1
    assert_true(errors, sigmas)


@pytest.mark.trust
@pytest.mark.parametrize("jitter", [heavy(2 * MS, 24 * MS), even(2 * MS)], ids=["heavy", "even"])
def test_a_device_whose_clock_jitters_behind_short_round_trips_is_not_called_exact(
    jitter: Jitter,
) -> None:
    errors, sigmas = [], []
    for run in range(RUNS):
        chance = np.random.default_rng([3, run])
        oscillator, clock = Oscillator(chance, 130.0), DeviceClockEstimator()
        for second in range(1, 120):
            device_ns = round(oscillator.reads(second) + jitter(chance))
            clock.read(ClockReading("fc", device_ns, second * NS, 100_000))
            if second > 60 and second % 8 == 0:
                found = clock.at(round(oscillator.reads(second + 0.5)))
                assert found is not None
                errors.append(found.mono_ns - (second + 0.5) * NS)
                sigmas.append(float(found.sigma_ns))
    assert_true(errors, sigmas)


@pytest.mark.trust
def test_after_a_step_the_sigma_holds_what_the_doubtful_readings_are_off_by() -> None:
    model, off_ns, worst = ClockModel(), 0, []
    for second in range(1, 60):
        off_ns = 5_000_000 if second >= 40 else 0
        model.add(Pair(second * NS, second * NS + off_ns, 5 * US))
        found = model.at(second * NS + NS // 2)
        assert found is not None
        worst.append(abs(found.to_ns - (second * NS + NS // 2 + off_ns)) / found.sigma_ns)
        if second in (40, 41):
            assert found.sigma_ns > 4 * MS
    assert max(worst) < 3.0
    assert model.steps == 1
    before = model.at(45 * NS)
    assert before is not None and before.sigma_ns < 100 * US


@pytest.mark.trust
def test_edges_that_scatter_may_all_be_late_by_as_much() -> None:
    errors, sigmas = [], []
    late = heavy(20 * US, 240 * US)
    for run in range(RUNS):
        chance = np.random.default_rng([2, run])
        oscillator, clock = Oscillator(chance, SPAN_S + 5.0), GpsClock()
        for second in range(1, SPAN_S):
            clock.pps_edge(round(oscillator.reads(second) + abs(late(chance))), 5_000)
            for part in range(3):
                at_s = second + 0.3 * part
                arrived_ns = round(oscillator.reads(at_s) + chance.uniform(50, 80) * MS)
                clock.message_arrived(round(GPS_NS + at_s * NS), arrived_ns)
            if second > FROM_S and second % 8 == 0:
                found = clock.gps_at(round(oscillator.reads(second + 0.5)))
                assert found is not None and found.source == "pps"
                errors.append(found.gps_ns - GPS_NS - (second + 0.5) * NS)
                sigmas.append(float(found.sigma_ns))
    assert_true(errors, sigmas)


def test_a_clock_without_readings_scales_nothing_and_knows_no_instant() -> None:
    assert ClockModel().reading_scale() == 1.0
