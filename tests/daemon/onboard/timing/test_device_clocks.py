"""A device's clock from round trips: the shortest are used, and the sigma is correct."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.time_truth import Oscillator, inside
from daemon.onboard.timing.device_clocks import DeviceClockEstimator, DeviceClocks
from daemon.onboard.timing.timesync import TimesyncRequester
from drivers.contract import ClockReading
from drivers.receivers.mavlink.decoder import Timesync

NS = 1_000_000_000
SPAN_S = 90


def exchange(
    chance: np.random.Generator, true_s: float, oscillator: Oscillator, grid_ns: int
) -> ClockReading:
    """A question and its answer; either way may be held up, the answer's more often."""
    there_ns = 80_000 + chance.exponential(60_000)
    back_ns = 90_000 + chance.exponential(150_000)
    if chance.random() < 0.1:
        back_ns += chance.exponential(5_000_000)
    reported_ns = oscillator.reads(true_s + there_ns * 1e-9)
    half_ns = round((there_ns + back_ns) / 2)
    return ClockReading(
        "autopilot", int(reported_ns // grid_ns * grid_ns), round(true_s * NS) + half_ns, half_ns
    )


@pytest.mark.parametrize("grid_ns", [8, 1_000], ids=["8 ns latch", "1 us latch"])
def test_errors_of_a_hundred_device_clocks_lie_inside_their_sigmas(grid_ns: int) -> None:
    errors, sigmas = [], []
    for run in range(100):
        chance = np.random.default_rng([77, grid_ns, run])
        oscillator = Oscillator(chance, SPAN_S + 5.0)
        clock = DeviceClockEstimator()
        for second in range(SPAN_S):
            clock.read(exchange(chance, float(second), oscillator, grid_ns))
        at_s = SPAN_S + 1.5
        found = clock.at(round(oscillator.reads(at_s)))
        assert found is not None
        errors.append(found.mono_ns - at_s * NS)
        sigmas.append(found.sigma_ns)
    off, stated = np.array(errors), np.array(sigmas)
    assert inside(off, stated, 2.0) >= 0.925
    assert np.median(stated) < 60_000, "a tenth of what one round trip leaves open"


def test_the_clock_of_a_restarted_device_is_estimated_again() -> None:
    clocks = DeviceClocks()
    for second in range(30):
        clocks.read(ClockReading("SU00", 500 * NS + second * NS, second * NS, 50_000))
    for second in range(30, 36):
        clocks.read(ClockReading("SU00", (second - 30) * NS, second * NS, 50_000))
    found = clocks.at("SU00", 6 * NS)
    assert found is not None and abs(found.mono_ns - 36 * NS) < 4 * found.sigma_ns
    assert clocks.steps() == {"SU00": 1}
    assert clocks.at("never read", 0) is None


@pytest.mark.parametrize(("back_ns", "steps"), [(NS, 0), (NS + 1, 1)])
def test_a_reading_more_than_a_second_back_is_a_restart(back_ns: int, steps: int) -> None:
    clock = DeviceClockEstimator()
    clock.read(ClockReading("SU00", 500 * NS, NS, 50_000))
    clock.read(ClockReading("SU00", 500 * NS - back_ns, 2 * NS, 50_000))
    assert clock.restarts == steps


class Port:
    """An autopilot whose clock is 7 s ahead; it answers 300 us after it was asked."""

    name = "autopilot"

    def __init__(self) -> None:
        self.now_ns = 100 * NS
        self.on_answer = None
        self.requested_ns: list[int] = []

    def subscribe_timesync(self, on_answer):
        self.on_answer = on_answer

    def send_timesync(self, *, tc1_ns: int, ts1_ns: int) -> bool:
        assert tc1_ns == 0
        self.requested_ns.append(ts1_ns)
        return True


def test_timesync_answers_become_readings_and_what_was_not_asked_does_not() -> None:
    port = Port()
    readings: list[ClockReading] = []
    requester = TimesyncRequester(port, readings.append, mono_ns=lambda: port.now_ns)
    assert requester.request()
    ts1 = port.requested_ns[0]
    answer = Timesync(ts1 + 7 * NS + 100_000, ts1, ts1 + 300_000, 1, 1)
    requester.on_answer(Timesync(0, 55, ts1 + 1, 1, 1))
    requester.on_answer(Timesync(9, 55, ts1 + 1, 1, 1))
    requester.on_answer(answer)
    requester.on_answer(answer)
    assert readings == [ClockReading("autopilot", ts1 + 7 * NS + 100_000, ts1 + 150_000, 150_000)]
    requester.stop()
    assert port.on_answer is None
