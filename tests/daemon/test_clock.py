"""The host's clock learns GPS time from marks, and says how well it knows it."""

from __future__ import annotations

import random

from daemon.clock import HostClock

OFFSET_NS = 1_400_000_000_000_000_000


def test_before_anything_was_heard_no_time_is_told() -> None:
    assert HostClock().gps_at(5) is None


def test_messages_alone_give_a_coarse_time_that_covers_their_lateness() -> None:
    clock = HostClock()
    for k in range(10):
        mono_ns = k * 200_000_000
        clock.message_arrived(mono_ns + OFFSET_NS, mono_ns + 60_000_000)
    estimate = clock.gps_at(1_000_000_000)
    assert estimate is not None and estimate.is_coarse
    assert abs(estimate.gps_ns - (1_000_000_000 + OFFSET_NS)) < 2 * estimate.sigma_ns


def test_marks_give_time_within_its_stated_sigma_under_drift_and_jitter() -> None:
    rng = random.Random(3)
    clock = HostClock()

    def gps(mono_ns: int) -> int:
        return mono_ns + OFFSET_NS + round(20e-6 * mono_ns)

    for k in range(12):
        mono_ns = k * 3_500_000_000
        clock.mark_matched(gps(mono_ns), mono_ns + round(rng.gauss(0, 50_000)), 50_000)
    later = 12 * 3_500_000_000
    estimate = clock.gps_at(later)
    assert estimate is not None and not estimate.is_coarse
    assert abs(estimate.gps_ns - gps(later)) < 4 * estimate.sigma_ns
    assert estimate.sigma_ns < 200_000


def test_one_wrong_pair_does_not_turn_the_clock() -> None:
    clock = HostClock()
    for k in range(9):
        mono_ns = k * 2_000_000_000
        error_ns = 900_000_000 if k == 4 else 0
        clock.mark_matched(mono_ns + OFFSET_NS + error_ns, mono_ns, 10_000)
    estimate = clock.gps_at(18_000_000_000)
    assert estimate is not None
    assert abs(estimate.gps_ns - 18_000_000_000 - OFFSET_NS) < 1_000_000


def test_an_uncertain_first_pulse_does_not_turn_the_clock() -> None:
    clock = HostClock()
    readings = ((0, 23_800_000, 23_800_000), (7, 0, 45_000), (14, -1_100_000, 1_200_000))
    for half_seconds, error_ns, half_width_ns in readings:
        mono_ns = half_seconds * 500_000_000
        clock.pulse_given(half_width_ns)
        clock.mark_matched(mono_ns + OFFSET_NS + error_ns, mono_ns, half_width_ns)
    estimate = clock.gps_at(10_500_000_000)
    assert estimate is not None
    assert abs(estimate.gps_ns - 10_500_000_000 - OFFSET_NS) < 3 * estimate.sigma_ns
    assert estimate.sigma_ns < 500_000


def test_coasting_makes_the_time_less_certain() -> None:
    clock = HostClock()
    clock.mark_matched(OFFSET_NS, 0, 10_000)
    soon, late = clock.gps_at(1_000_000_000), clock.gps_at(60_000_000_000)
    assert soon is not None and late is not None
    assert late.sigma_ns > soon.sigma_ns + 50_000
