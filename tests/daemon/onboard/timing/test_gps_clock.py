"""The host's clock estimates GPS time from marks, with its uncertainty."""

from __future__ import annotations

import random

import pytest

from daemon.onboard.timing.gps_clock import GpsClock

NS = 1_000_000_000
OFFSET_NS = 1_400_000_000_000_000_000


def test_before_the_first_input_there_is_no_time() -> None:
    assert GpsClock().gps_at(5) is None


def test_messages_alone_give_a_coarse_time_that_covers_their_lateness() -> None:
    clock = GpsClock()
    for k in range(10):
        mono_ns = k * 200_000_000
        clock.message_arrived(mono_ns + OFFSET_NS, mono_ns + 60_000_000)
    estimate = clock.gps_at(1_000_000_000)
    assert estimate is not None and estimate.is_coarse
    assert abs(estimate.gps_ns - (1_000_000_000 + OFFSET_NS)) < 2 * estimate.sigma_ns


def test_marks_give_time_within_its_stated_sigma_under_drift_and_jitter() -> None:
    rng = random.Random(3)
    clock = GpsClock()

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
    clock = GpsClock()
    for k in range(9):
        mono_ns = k * 2_000_000_000
        error_ns = 900_000_000 if k == 4 else 0
        clock.mark_matched(mono_ns + OFFSET_NS + error_ns, mono_ns, 10_000)
    estimate = clock.gps_at(18_000_000_000)
    assert estimate is not None
    assert abs(estimate.gps_ns - 18_000_000_000 - OFFSET_NS) < 1_000_000


def test_an_uncertain_first_pulse_does_not_turn_the_clock() -> None:
    clock = GpsClock()
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
    clock = GpsClock()
    clock.mark_matched(OFFSET_NS, 0, 10_000)
    soon, late = clock.gps_at(1_000_000_000), clock.gps_at(60_000_000_000)
    assert soon is not None and late is not None
    assert late.sigma_ns > soon.sigma_ns + 50_000


def test_edges_hold_the_clock_to_microseconds_and_one_late_interrupt_does_not_move_it() -> None:
    rng = random.Random(7)
    clock = GpsClock()
    for k in range(3):
        clock.message_arrived(OFFSET_NS + k * 200_000_000, k * 200_000_000 + 60_000_000)
    for second in range(1, 60):
        mono_ns = second * NS + round(12e-6 * second * NS) + round(rng.gauss(0, 800))
        if second == 50:
            mono_ns += 400_000
        clock.pps_edge(mono_ns, 2_000)
    at_ns = 60 * NS + round(12e-6 * 60 * NS)
    estimate = clock.gps_at(at_ns)
    assert estimate is not None and estimate.source == "pps"
    assert abs(estimate.gps_ns - OFFSET_NS - 60 * NS) < 3_000
    assert 1_000 < estimate.sigma_ns < 5_000


@pytest.mark.parametrize("stray_ms", [5, 300, 700, 900])
@pytest.mark.parametrize("count", [1, 3])
def test_stray_edges_between_the_seconds_do_not_move_the_clock(stray_ms: int, count: int) -> None:
    rng = random.Random(7)
    clock = GpsClock()
    for second in range(1, 60):
        edge_ns = second * NS + round(rng.gauss(0, 800))
        clock.pps_edge(edge_ns, 2_000)
        clock.message_arrived(OFFSET_NS + second * NS, second * NS + 60_000_000)
        if 30 <= second < 30 + count:
            clock.pps_edge(edge_ns + stray_ms * 1_000_000, 2_000)
        at_ns = second * NS + 950_000_000
        estimate = clock.gps_at(at_ns)
        if second >= 30:
            assert estimate is not None and estimate.source == "pps"
            assert abs(estimate.gps_ns - OFFSET_NS - at_ns) < 3_000
    assert estimate is not None and estimate.sigma_ns < 5_000


def test_edges_that_are_missing_for_minutes_are_still_the_right_seconds() -> None:
    clock = GpsClock()
    for k in range(3):
        clock.message_arrived(OFFSET_NS + k * 200_000_000, k * 200_000_000 + 60_000_000)
    for second in (*range(1, 20), 320, 321):
        clock.pps_edge(second * NS + round(30e-6 * second * NS), 2_000)
    estimate = clock.gps_at(322 * NS + round(30e-6 * 322 * NS))
    assert estimate is not None
    assert abs(estimate.gps_ns - OFFSET_NS - 322 * NS) < 1_000_000


def test_a_host_clock_that_steps_against_the_edges_is_followed_and_reported() -> None:
    clock = GpsClock()
    for k in range(3):
        clock.message_arrived(OFFSET_NS + k * 200_000_000, k * 200_000_000 + 60_000_000)
    for second in range(1, 40):
        clock.pps_edge(second * NS + (300_000 if second >= 30 else 0), 2_000)
    estimate = clock.gps_at(40 * NS + 300_000)
    assert estimate is not None
    assert abs(estimate.gps_ns - OFFSET_NS - 40 * NS) < 20_000
    assert [event.name for event in clock.events(40 * NS)] == ["clock-stepped"]


def test_a_message_that_was_held_up_moves_nothing_and_one_from_the_future_is_no_excuse() -> None:
    clock = GpsClock()
    for number in range(6):
        mono_ns = number * 2 * NS
        clock.mark_matched(OFFSET_NS + mono_ns, mono_ns, 50_000, key=number)
    before = clock.gps_at(12 * NS)
    for late_s in (3, 4, 5):
        clock.message_arrived(OFFSET_NS + 12 * NS - late_s * NS, 12 * NS)
        assert clock.is_suspect
    assert clock.gps_at(12 * NS) == before
    for k in range(5):
        at_ns = (13 + k) * NS
        clock.message_arrived(OFFSET_NS + at_ns + 5 * NS, at_ns + 60_000_000)
    after = clock.gps_at(18 * NS)
    assert after is not None and after.is_coarse
    assert abs(after.gps_ns - OFFSET_NS - 23 * NS) < 400_000_000
    assert "receiver-stepped" in [event.name for event in clock.events(18 * NS)]


def test_all_pulses_late_alike_are_seen_through_by_edges_and_marks() -> None:
    rng = random.Random(11)
    clock = GpsClock()
    for k in range(3):
        clock.message_arrived(OFFSET_NS + k * 200_000_000, k * 200_000_000 + 60_000_000)
    late_ns = 35_000
    for second in range(1, 41):
        clock.pps_edge(second * NS, 1_000)
        if second % 2:
            mono_ns = second * NS + 400_000_000 + late_ns + round(rng.gauss(0, 4_000))
            clock.pulse_given(80_000)
            clock.mark_matched(OFFSET_NS + second * NS + 400_000_000, mono_ns, 80_000, key=second)
    blind = clock.gps_at(41 * NS)
    pulse = clock.pulse_at(41 * NS + late_ns, 80_000)
    assert blind is not None and pulse is not None
    assert abs(pulse.gps_ns - OFFSET_NS - 41 * NS) < 2 * pulse.sigma_ns
    assert pulse.sigma_ns < 20_000, "far below half of the round trip, by what marks taught"


def test_two_edges_of_one_second_are_one() -> None:
    clock = GpsClock()
    for second in (1, 2, 3):
        clock.pps_edge(second * NS, 2_000)
        clock.pps_edge(second * NS + 90_000, 2_000)
    for k in range(3):
        clock.message_arrived(
            OFFSET_NS + 3 * NS + k * 200_000_000, 3 * NS + 60_000_000 + k * NS // 5
        )
    estimate = clock.gps_at(4 * NS)
    assert estimate is not None and abs(estimate.gps_ns - OFFSET_NS - 4 * NS) < 10_000


@pytest.mark.trust
def test_a_receiver_that_is_back_leaves_no_standing_warning_about_its_marks() -> None:
    """Whether its marks come is not known before the next exposure; then it is."""
    clock = GpsClock()
    for number in range(6):
        clock.mark_matched(OFFSET_NS + number * NS, number * NS, 50_000, key=number)

    def expose(times: int) -> None:
        for _ in range(times):
            clock.pulse_given(50_000)

    expose(3)
    (missing,) = clock.events(20 * NS)
    assert (missing.name, missing.is_fault) == ("mark-holdover", True)
    clock.receiver_recovered()
    (passed,) = clock.events(21 * NS)
    assert (passed.name, passed.is_fault) == ("mark-holdover", False)
    assert "the next exposure shows" in passed.sentence
    expose(3)
    assert [event.is_fault for event in clock.events(30 * NS)] == [True]
    clock.mark_matched(OFFSET_NS + 31 * NS, 31 * NS, 50_000, key=31)
    (back,) = clock.events(31 * NS)
    assert (back.is_fault, back.sentence) == (False, "event marks are back")
