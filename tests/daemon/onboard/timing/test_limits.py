"""Clock and matching at the boundary of each limit: on it, and one nanosecond beyond."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from daemon.onboard.timing.gps_clock import GpsClock, RoundTrips, _PulseLateness
from daemon.onboard.timing.mark_matching import (
    MarkMatcher,
    _agree,
    _Channel,
    _is_same,
    _PendingMark,
)
from daemon.onboard.timing.matching import Cause, Matcher, start_of_exposure_mono_ns
from drivers.contract import EventMark, Frame
from tests.daemon.onboard.timing.test_matching import frame, mark, matcher, pulse

NS = 1_000_000_000
MS = 1_000_000
GPS_NS = 1_400_000_000 * NS


def named_clock(edges: int = 3) -> GpsClock:
    """Edges at whole seconds from 0 on, named by messages 60 ms late."""
    clock = GpsClock()
    for second in range(edges):
        clock.pps_edge(second * NS, 1_000)
    for _ in range(3):
        clock.message_arrived(GPS_NS + (edges - 1) * NS, (edges - 1) * NS + 60 * MS)
    return clock


def marked_clock() -> GpsClock:
    """Six marks at whole seconds from 0 to 5."""
    clock = GpsClock()
    for number in range(6):
        clock.mark_matched(GPS_NS + number * NS, number * NS, 50_000, key=number)
    return clock


def test_messages_alone_leave_350_ms_plus_minus_700_over_the_root_of_12() -> None:
    clock = GpsClock()
    assert clock.is_coarse
    clock.message_arrived(GPS_NS, 10 * MS)  # the least late one, forgotten behind fifty others
    for number in range(1, 50):
        clock.message_arrived(GPS_NS + number * NS, number * NS + 60 * MS)
    estimate = clock.gps_at(100 * NS)
    assert estimate is not None
    assert estimate.gps_ns == GPS_NS + 100 * NS - 10 * MS + 350 * MS
    clock.message_arrived(GPS_NS + 50 * NS, 50 * NS + 60 * MS)
    estimate = clock.gps_at(100 * NS)
    assert estimate is not None
    assert estimate.gps_ns == GPS_NS + 100 * NS - 60 * MS + 350 * MS
    assert (estimate.sigma_ns, estimate.is_coarse, estimate.source) == (
        202_072_594,
        True,
        "messages",
    )
    assert (estimate.coasting_ns, estimate.in_holdover) == (0, False)
    assert clock.sigma_of(0, "messages") == 202_072_594
    assert clock.sigma_of(0, "pps") == clock.sigma_of(0, "marks") == 0


@pytest.mark.parametrize(
    ("late_ns", "is_allowed"),
    [(-5 * MS, True), (-5 * MS - 1, False), (900 * MS, True), (900 * MS + 1, False)],
)
def test_a_message_may_be_5_ms_early_and_900_ms_late(late_ns: int, is_allowed: bool) -> None:
    clock = GpsClock()
    assert clock.messages_allow(late_ns)
    clock.message_arrived(GPS_NS, 7 * NS)
    assert clock.messages_allow(GPS_NS - 7 * NS + late_ns) is is_allowed


def test_round_trips_state_jitter_excess_and_what_they_hide() -> None:
    trips = RoundTrips()
    assert (trips.median_ns, trips.systematic_ns) == (0.0, 0.0)
    assert trips.sigma_ns(300) == pytest.approx(300 / math.sqrt(3))
    assert trips.sigma_ns(0) == 1.0
    trips.add(0)
    assert trips.median_ns == 1.0
    for _ in range(31):
        trips.add(100)
    assert trips.systematic_ns == pytest.approx(1 / 2 / math.sqrt(3))
    trips.add(100)  # the 33rd: the first is forgotten
    assert trips.median_ns == 100.0
    assert trips.systematic_ns == pytest.approx(28.8675, abs=1e-3)
    assert trips.sigma_ns(60) == pytest.approx(34.6410, abs=1e-3)
    assert trips.sigma_ns(170) == pytest.approx(57.7350, abs=1e-3)
    assert trips.sigma_ns(200) == pytest.approx(math.hypot(57.7350, 30.0), abs=1e-3)


def test_lateness_weighs_what_is_seen_against_what_is_stated() -> None:
    lateness = _PulseLateness()
    assert lateness.estimate(3.0, 4.0) == (0.0, 5.0)
    assert lateness.estimate(0.0, 0.0) == (0.0, 1.0)
    lateness.add("a", 100.0, 10.0)
    # One reading of sigma 10 against a prior of sigma 30: a share of 0.9.
    assert lateness.estimate(30.0, 10.0) == pytest.approx((90.0, math.sqrt(190.0)))
    lateness.clear()
    assert lateness.estimate(3.0, 4.0) == (0.0, 5.0)


def test_of_residuals_the_last_64_count() -> None:
    lateness = _PulseLateness()
    for number in range(64):
        lateness.add(number, 0.0 if number else 64.0, 1.0)
    mean, _ = lateness.estimate(1e9, 1.0)
    # The first is 64 sigma off and weighs 4 / 64 of another.
    assert mean == pytest.approx(64 * (4 / 64) / (63 + 4 / 64))
    lateness.add(64, 0.0, 1.0)
    assert lateness.estimate(1e9, 1.0)[0] == 0.0
    lateness.clear()
    assert lateness.estimate(3.0, 4.0) == (0.0, 5.0)


def test_residuals_that_scatter_widen_the_limit_and_the_sigma() -> None:
    lateness = _PulseLateness()
    for number, residual_ns in enumerate((-30.0, -20.0, 0.0, 20.0, 300.0)):
        lateness.add(number, residual_ns, 10.0)
    # Median 0, absolute deviations 30, 20, 0, 20, 300: 2 sigma, so that up to 4 * 2 * 1.4826
    # sigma count in full, and the last weighs 118.6 / 300.
    weight = 118.608 / 300
    mean = (-30.0 + weight * 300.0) / (4 + weight)
    square = sum(
        w * (r - mean) ** 2 / 100.0
        for w, r in ((1, -30.0), (1, -20.0), (1, 0.0), (1, 20.0), (weight, 300.0))
    )
    scale2 = (4.0 + square) / 8.0
    sigma = math.sqrt(scale2 * 100.0 / (4 + weight) + scale2 * 49.0)
    assert lateness.estimate(1e9, 7.0) == pytest.approx((mean, sigma), rel=1e-6)


@pytest.mark.parametrize(
    ("late_ns", "is_named"), [(0, True), (1, True), (700 * MS, True), (700 * MS + 1, False)]
)
def test_an_edge_is_named_by_three_messages_up_to_700_ms_late(late_ns: int, is_named: bool) -> None:
    clock = GpsClock()
    clock.pps_edge(0, 1_000)
    for _ in range(2):
        clock.message_arrived(GPS_NS, late_ns)
        assert clock.is_coarse
    clock.message_arrived(GPS_NS, late_ns)
    assert clock.is_coarse is not is_named
    estimate = clock.gps_at(0)
    assert estimate is not None
    if is_named:
        assert (estimate.gps_ns, estimate.source) == (GPS_NS, "pps")


@pytest.mark.parametrize(
    ("off_ns", "is_named"),
    [(99_999_999, True), (-99_999_999, True), (100_000_000, False), (-100_000_000, False)],
)
def test_a_mark_names_the_edges_from_less_than_100_ms(off_ns: int, is_named: bool) -> None:
    clock = GpsClock()
    clock.pps_edge(0, 1_000)
    clock.mark_matched(GPS_NS + off_ns, 0, 50_000)
    assert (clock.sigma_of(0, "pps") > 0) is is_named


@pytest.mark.parametrize(
    ("beyond_ns", "is_suspect"), [(0, False), (1, True)], ids=["on it", "beyond"]
)
def test_a_message_is_doubted_beyond_its_limits_and_five_sigmas(
    beyond_ns: int, is_suspect: bool
) -> None:
    for side in (-1, 1):
        clock = marked_clock()
        expected = clock.gps_at(6 * NS)
        assert expected is not None
        limit_ns = (5 * MS if side > 0 else 900 * MS) + 5 * expected.sigma_ns + beyond_ns
        clock.message_arrived(expected.gps_ns + side * limit_ns, 6 * NS)
        assert clock.is_suspect is is_suspect


def test_the_fifth_message_from_the_future_in_succession_is_believed() -> None:
    clock = marked_clock()
    for number in range(4):
        clock.message_arrived(GPS_NS + 8 * NS, 6 * NS + number)
    clock.message_arrived(GPS_NS + 6 * NS, 6 * NS + 60 * MS)  # one in its place between them
    for number in range(4):
        clock.message_arrived(GPS_NS + 8 * NS, 6 * NS + number)
    assert clock.is_suspect and not clock.is_coarse
    assert clock.events(6 * NS) == []
    clock.message_arrived(GPS_NS + 8 * NS, 6 * NS)
    assert clock.is_coarse and not clock.is_suspect
    (stepped,) = clock.events(6 * NS)
    assert (stepped.name, stepped.is_fault) == ("receiver-stepped", True)
    assert "2.000 s ahead" in stepped.sentence
    estimate = clock.gps_at(6 * NS)
    assert estimate is not None and estimate.gps_ns == GPS_NS + 8 * NS + 350 * MS
    assert clock.events(6 * NS) == []


def test_the_clock_coasts_more_than_5_s_after_the_last_edge() -> None:
    clock = named_clock()
    last_ns = 2 * NS
    on_it, beyond = clock.gps_at(last_ns + 5 * NS), clock.gps_at(last_ns + 5 * NS + 1)
    assert on_it is not None and beyond is not None
    assert (on_it.in_holdover, on_it.coasting_ns, on_it.source) == (False, 5 * NS, "pps")
    assert (beyond.in_holdover, beyond.coasting_ns) == (True, 5 * NS + 1)
    assert clock.events(last_ns + 5 * NS) == []
    (fault,) = clock.events(last_ns + 5 * NS + 1)
    assert (fault.name, fault.is_fault) == ("pps-holdover", True)
    assert f"for 5 s: the clock coasts, its time is good to {beyond.sigma_ns * 1e-6:.3g} ms" in (
        fault.sentence
    )
    assert clock.events(last_ns + 9 * NS) == [], "once"
    clock.pps_edge(last_ns + 10 * NS, 1_000)
    (back,) = clock.events(last_ns + 10 * NS)
    assert (back.is_fault, back.sentence) == (False, "the pulse per second is back")


def test_marks_are_missed_after_three_pulses_and_more_than_10_s() -> None:
    clock = marked_clock()
    clock.mark_matched(GPS_NS + 4 * NS, 4 * NS, 50_000, key="late")  # the last one stays at 5 s
    on_it, beyond = clock.gps_at(15 * NS), clock.gps_at(15 * NS + 1)
    assert on_it is not None and beyond is not None
    assert (on_it.in_holdover, beyond.in_holdover) == (False, True)
    for _ in range(2):
        clock.pulse_given(50_000)
    assert clock.events(20 * NS) == []
    clock.pulse_given(50_000)
    assert clock.events(15 * NS) == []
    (fault,) = clock.events(15 * NS + 1)
    assert (fault.name, fault.is_fault) == ("mark-holdover", True)
    assert "no event mark for 10 s" in fault.sentence
    # With edges the time does not rest on marks, and their absence is no fault of the clock.
    clock.pps_edge(15 * NS, 1_000)
    assert [event.is_fault for event in clock.events(16 * NS)] == [False]


@pytest.mark.parametrize(
    ("has_messages", "good"),
    [(False, "no time of the receiver is known yet"), (True, "its time is good to 202 ms now")],
)
def test_a_silence_of_edges_is_counted_from_the_last_one_whatever_else_gives_time(
    has_messages: bool, good: str
) -> None:
    clock = GpsClock()
    clock.pps_edge(0, 1_000)
    if has_messages:
        clock.message_arrived(GPS_NS, 350 * MS)
    (fault,) = clock.events(8 * NS)
    assert fault.name == "pps-holdover"
    assert f"no edge of the pulse per second for 8 s: the clock coasts, {good}" in fault.sentence


def test_edges_that_50_messages_cannot_name_are_a_fault() -> None:
    clock = GpsClock()
    clock.pps_edge(0, 1_000)
    for _ in range(49):
        clock.message_arrived(GPS_NS, 800 * MS)
    assert clock.events(NS) == []
    clock.message_arrived(GPS_NS, 800 * MS)
    assert [(event.name, event.is_fault) for event in clock.events(NS)] == [
        ("second-unnamed", True)
    ]
    clock.mark_matched(GPS_NS, 0, 50_000)
    assert [(event.name, event.is_fault) for event in clock.events(NS)] == [
        ("second-unnamed", False)
    ]


def arrived(made: Matcher, given: Frame) -> Cause:
    return made.frame(given).cause


START_NS = pulse(1).mono_ns + pulse(1).delays_ns["0"]


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(("beyond_ns", "cause"), [(0, Cause.USED), (1, Cause.SPURIOUS)])
def test_a_frame_begins_within_20_ms_of_its_pulse(side: int, beyond_ns: int, cause: Cause) -> None:
    """20 ms, the pulse's 100 us and the latch's 1 us."""
    given = frame(1)
    assert given.device_ns is not None
    off_ns = 20 * MS + 100_000 + 1_000 + beyond_ns
    found = replace(given, device_ns=given.device_ns + side * off_ns)
    assert arrived(matcher(range(1, 2)), found) is cause


@pytest.mark.parametrize(
    ("age_ns", "cause"),
    [
        (20 * NS, Cause.USED),
        (20 * NS + 1, Cause.SPURIOUS),
        (-20 * MS - 100_000, Cause.USED),
        (-20 * MS - 100_001, Cause.SPURIOUS),
    ],
)
def test_a_frame_arrives_up_to_20_s_after_its_exposure_began(age_ns: int, cause: Cause) -> None:
    assert arrived(matcher(range(1, 2)), frame(1, mono_ns=START_NS + age_ns)) is cause


CLOCKLESS = {"device_ns": None, "device_clock_ns": None, "device_clock_mono_ns": None}


@pytest.mark.parametrize(
    ("off_ns", "number"),
    [(400 * MS, 2), (400 * MS + 1, None), (-400 * MS, 2), (-400 * MS - 1, None)],
)
def test_a_count_is_believed_where_the_frame_arrives_within_400_ms_of_the_usual(
    off_ns: int, number: int | None
) -> None:
    made = matcher(range(1, 4))
    made.frame(frame(1))  # arrives 500 ms after it began
    given = frame(2)
    found = made.frame(replace(given, mono_ns=given.mono_ns + off_ns, **CLOCKLESS))
    assert found.number == number


@pytest.mark.parametrize("known", [4, 5])
@pytest.mark.parametrize(("beyond_ns", "is_usual"), [(0, True), (1, False)])
def test_after_five_frames_a_start_lies_within_500_us_of_the_usual(
    known: int, beyond_ns: int, is_usual: bool
) -> None:
    """500 us, the pulse's 100 us, three times the latch's 1 us, 100 ppm since the latch."""
    made = matcher(range(1, 7))
    for number in range(1, known + 1):
        assert arrived(made, frame(number)) is Cause.USED
    given = frame(6)
    assert given.device_ns is not None and given.device_clock_ns is not None
    off_ns = 603_000 + beyond_ns
    start_ns = given.device_ns - 777
    found = replace(
        given, device_ns=777 + 10_000_000, device_clock_mono_ns=start_ns + off_ns - 10_000_000
    )
    unsure = 1_000  # 100 ppm of 10 ms since the latch
    found = replace(found, device_clock_mono_ns=start_ns + off_ns + unsure - 10_000_000)
    expected = Cause.USED if is_usual or known < 5 else Cause.SPURIOUS
    assert arrived(made, found) is expected


@pytest.mark.parametrize(("beyond_ns", "cause"), [(-1, Cause.USED), (1, Cause.SPURIOUS)])
def test_starts_that_scatter_widen_what_is_usual_to_six_sigmas(
    beyond_ns: int, cause: Cause
) -> None:
    made = matcher(range(1, 7))
    for number, off_ns in enumerate((-200_000, 200_000, 0, -200_000, 200_000), 1):
        given = frame(number)
        latched = replace(given, device_ns=0, device_clock_ns=0)
        start_ns = START_NS + (number - 1) * 2 * NS
        assert arrived(made, replace(latched, device_clock_mono_ns=start_ns + off_ns)) is Cause.USED
    window_ns = round(6 * 1.4826 * 200_000) + 103_000
    sixth = replace(frame(6), device_ns=0, device_clock_ns=0)
    start_ns = START_NS + 5 * 2 * NS + window_ns + beyond_ns
    assert arrived(made, replace(sixth, device_clock_mono_ns=start_ns)) is cause


@pytest.mark.parametrize(("missing"), ["device_ns", "device_clock_ns", "device_clock_mono_ns"])
def test_a_start_is_known_through_a_whole_latch_only(missing: str) -> None:
    given = frame(1, device_ns=70, device_clock_ns=50, device_clock_mono_ns=1_000)
    assert start_of_exposure_mono_ns(given) == 1_020
    assert start_of_exposure_mono_ns(replace(given, **{missing: None})) is None


def test_what_is_forgotten_is_what_lies_before_a_number() -> None:
    made = matcher(range(1, 4))
    made.frame(frame(2))
    made.forget_before(2)
    assert arrived(made, frame(1)) is Cause.SPURIOUS
    assert arrived(made, frame(2)) is Cause.DUPLICATE
    assert arrived(made, frame(3)) is Cause.USED
    made.forget_before(3)
    assert arrived(made, frame(2)) is Cause.SPURIOUS


@pytest.mark.parametrize(
    ("separation_ns", "is_one"), [(1_000, True), (-1_000, True), (1_001, False)]
)
def test_marks_of_one_input_are_the_same_up_to_a_microsecond(
    separation_ns: int, is_one: bool
) -> None:
    first = mark(1)
    assert _is_same(first, replace(first, gps_ns=first.gps_ns + separation_ns)) is is_one
    assert not _is_same(first, replace(first, channel=1))


@pytest.mark.parametrize(("separation_ns", "agree"), [(2_000_000, True), (2_000_001, False)])
def test_shifts_agree_within_a_millisecond_and_five_sigmas(separation_ns: int, agree: bool) -> None:
    # Both pulses are known to 0.1 ms.
    first, second = mark(1), replace(mark(1), gps_ns=mark(1).gps_ns + separation_ns)
    assert _agree((_PendingMark(first), pulse(1)), (_PendingMark(second), pulse(1))) is agree


@pytest.mark.parametrize(
    ("offset", "count", "is_allowed"),
    [(5, 12, True), (5, 13, False), (5, 11, False), (0xFFFF, 6, True), (None, 13, True)],
)
def test_a_count_is_allowed_where_it_differs_by_the_confirmed_offset(
    offset: int | None, count: int, is_allowed: bool
) -> None:
    marks = MarkMatcher(GpsClock())
    marks._channels[("gnss", 0)] = _Channel(offset, is_confirmed=offset is not None)
    assert marks._count_allows(mark(7, count=count), pulse(7)) is is_allowed


def marks_before_any_edge(*marks: EventMark, pulses: int = 1) -> MarkMatcher:
    """By messages alone: marks first, then pulses from 1 on."""
    clock = GpsClock()
    clock.message_arrived(GPS_NS, 60 * MS)
    matching = MarkMatcher(clock)
    for one in marks:
        matching.mark(replace(one, count_bits=0))
    for number in range(1, pulses + 1):
        matching.pulse(pulse(number))
    return matching


def test_a_first_mark_is_believed_next_to_one_of_another_time() -> None:
    matching = marks_before_any_edge(mark(1), mark(3))
    assert matching.mark_of(1) == replace(mark(1), count_bits=0)


def test_of_two_first_marks_near_one_pulse_neither_is_believed() -> None:
    near = replace(mark(1), gps_ns=mark(1).gps_ns + 100 * MS)
    matching = marks_before_any_edge(mark(1), near)
    assert matching.mark_of(1) is None
    assert matching.has_ambiguous(1)
