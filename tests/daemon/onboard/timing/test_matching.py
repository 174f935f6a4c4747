"""Frames and marks go to their pulse by time and count; what fits nothing stays unmatched."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.onboard.timing.gps_clock import GpsClock
from daemon.onboard.timing.matching import Cause, FiredPulse, Matcher
from drivers.contract import EventMark, Frame, FrameStatus

NS = 1_000_000_000
GPS_NS = 1_400_000_000 * NS
CONES = {"SU00": "0", "G": "G"}


def pulse(number: int, *, interval_ns: int = 2 * NS) -> FiredPulse:
    delays_ns = {"0": 1_000_000, "G": 0}
    return FiredPulse(number, number * interval_ns, 100_000, number, delays_ns, 3_000_000)


def frame(number: int, head: str = "SU00", **changes: object) -> Frame:
    start_ns = pulse(number).mono_ns + pulse(number).delays_ns[CONES[head]]
    made = Frame(
        head=head,
        slot=0,
        status=FrameStatus.COMPLETE,
        frame_id=number,
        counter=number,
        width_px=8,
        height_px=8,
        pixel_format="Mono16",
        device_ns=start_ns + 777,
        device_clock_ns=777,
        device_clock_mono_ns=0,
        latch_sigma_ns=1000,
        mono_ns=start_ns + NS // 2,
        exposure_time_us=4000.0,
        temperature_c=None,
    )
    return replace(made, **changes)


def mark(number: int, count: int | None = None, **changes: object) -> EventMark:
    at_ns = pulse(number).mono_ns + pulse(number).strobe_delay_ns
    made = EventMark(
        "gnss",
        0,
        GPS_NS + at_ns,
        20,
        (number if count is None else count) & 0xFFFF,
        16,
        True,
        at_ns,
    )
    return replace(made, **changes)


def matcher(pulses: range) -> Matcher:
    clock = GpsClock()
    clock.message_arrived(GPS_NS, 60_000_000)
    made = Matcher(CONES, clock)
    for number in pulses:
        made.pulse(pulse(number))
    return made


def test_frames_of_every_head_find_their_pulse() -> None:
    matching = matcher(range(1, 5))
    for number in range(1, 5):
        for head in CONES:
            found = matching.frame(frame(number, head))
            assert (found.number, found.cause) == (number, Cause.USED)


def first_of_a_busy_machine(late_ns: int) -> Matcher:
    """A first pulse that came so long before the middle of a round trip of 80 ms, and its mark.

    Messages that arrive without any delay already leave the clock 350 ms behind.
    """
    clock = GpsClock()
    clock.message_arrived(GPS_NS, 0)
    matching = Matcher(CONES, clock)
    matching.pulse(replace(pulse(1), sigma_ns=40_000_000))
    true_ns = GPS_NS + pulse(1).mono_ns + pulse(1).strobe_delay_ns - late_ns
    arrived_ns = pulse(1).mono_ns + pulse(1).strobe_delay_ns + NS // 5
    matching.mark(mark(1, gps_ns=true_ns, mono_ns=arrived_ns))
    return matching


def test_the_first_mark_of_a_busy_machine_is_taken() -> None:
    """The round trip of its pulse counts in addition to what messages leave open."""
    for late_ns in (10_000_000, 30_000_000):
        assert first_of_a_busy_machine(late_ns).mark_of(1) is not None
    assert first_of_a_busy_machine(60_000_000).mark_of(1) is None


def test_a_lost_frame_does_not_shift_its_neighbours() -> None:
    matching = matcher(range(1, 5))
    assert [matching.frame(frame(n)).number for n in (1, 3, 4)] == [1, 3, 4]


def test_a_second_frame_of_one_pulse_is_a_duplicate() -> None:
    matching = matcher(range(1, 3))
    matching.frame(frame(1))
    assert matching.frame(frame(1)).cause is Cause.DUPLICATE


def test_a_frame_of_no_pulse_is_spurious_and_an_incomplete_one_corrupt() -> None:
    matching = matcher(range(1, 3))
    stray = frame(1, device_ns=frame(1).device_ns + NS)
    assert matching.frame(stray).cause is Cause.SPURIOUS
    assert matching.frame(frame(2, status=FrameStatus.INCOMPLETE)).cause is Cause.CORRUPT
    assert matching.frame(frame(2)).cause is Cause.USED


def test_a_damaged_frame_without_a_time_may_be_of_every_pulse_that_waits() -> None:
    matching = matcher(range(1, 5))
    matching.frame(frame(1))
    clockless = {"device_ns": None, "device_clock_ns": None, "device_clock_mono_ns": None}
    damaged = frame(3, status=FrameStatus.INCOMPLETE, counter=None, **clockless)
    found = matching.frame(damaged)
    assert (found.number, found.cause, found.possible) == (None, Cause.CORRUPT, (2, 3))
    matching.frame(frame(2))
    assert matching.frame(damaged).number == 3, "nothing else is left"


def test_a_head_without_a_clock_is_matched_by_its_count_once_that_is_known() -> None:
    matching = matcher(range(1, 4))
    matching.frame(frame(1))
    clockless = {"device_ns": None, "device_clock_ns": None, "device_clock_mono_ns": None}
    assert matching.frame(frame(3, **clockless)).number == 3


def test_a_head_without_clock_and_count_is_not_guessed_between_two_pulses() -> None:
    matching = matcher(range(1, 3))
    blind = frame(2, device_ns=None, device_clock_ns=None, device_clock_mono_ns=None, counter=None)
    assert matching.frame(blind).cause is Cause.SPURIOUS


def test_a_lost_event_mark_does_not_shift_its_neighbours() -> None:
    matching = matcher(range(1, 6))
    matched = {n: matching.mark(mark(n)).number for n in (1, 2, 4, 5)}
    assert matched == {1: 1, 2: 2, 4: 4, 5: 5}


def test_a_mark_late_by_a_whole_exposure_still_finds_its_pulse() -> None:
    matching = matcher(range(1, 4))
    assert matching.mark(mark(1)).number == 1
    assert matching.mark(mark(3)).number == 3
    assert matching.mark(mark(2, mono_ns=9 * NS)).number == 2


def test_a_repeated_mark_is_a_duplicate_and_an_untrusted_one_corrupt() -> None:
    matching = matcher(range(1, 4))
    matching.mark(mark(1))
    assert matching.mark(mark(1)).cause is Cause.DUPLICATE
    assert matching.mark(mark(2, time_valid=False)).cause is Cause.CORRUPT


def test_a_mark_of_no_pulse_is_spurious() -> None:
    matching = matcher(range(1, 4))
    matching.mark(mark(1))
    stray = mark(2, gps_ns=mark(2).gps_ns + NS)
    assert matching.mark(stray).cause is Cause.PENDING, "its pulse may still arrive"
    assert matching.marks.give_up(9 * NS) == [stray]


def test_if_the_clock_is_off_two_agreeing_marks_correct_it_and_none_is_shifted() -> None:
    matching = matcher(range(1, 6))
    matching.mark(mark(1))
    for number in (2, 3, 4, 5):
        late = mark(number)
        matching.mark(replace(late, gps_ns=late.gps_ns + 50_000_000))
    found = [matching.mark_of(number) for number in (2, 3, 4, 5)]
    assert [m.count for m in found if m is not None] == [2, 3, 4, 5]


def test_a_mark_that_neither_time_nor_count_explains_stays_unmatched() -> None:
    matching = matcher(range(1, 4))
    matching.mark(mark(1))
    odd = mark(2, count=7, gps_ns=mark(2).gps_ns + NS // 4)
    assert matching.mark(odd).cause is Cause.PENDING
    assert matching.mark_of(2) is None and matching.mark_of(3) is None
    assert matching.marks.give_up(9 * NS) == [odd]


def test_a_first_mark_that_fits_two_pulses_stays_unmatched() -> None:
    clock = GpsClock()
    clock.message_arrived(GPS_NS, 60_000_000)
    matching = Matcher(CONES, clock)
    for number in (1, 2):
        matching.pulse(pulse(number, interval_ns=NS // 8))
    at_ns = 3 * NS // 8
    found = matching.mark(mark(1, gps_ns=GPS_NS + at_ns, mono_ns=at_ns))
    assert found.cause is Cause.PENDING and found.is_ambiguous
    assert matching.marks.has_ambiguous(1) and matching.marks.has_ambiguous(2)


def test_a_count_that_wraps_is_nothing_special() -> None:
    matching = matcher(range(1, 5))
    numbers = [matching.mark(mark(n, count=0xFFFE + n)).number for n in range(1, 5)]
    assert numbers == [1, 2, 3, 4]


@settings(deadline=None, max_examples=40)
@given(st.lists(st.integers(1, 30), unique=True), st.randoms())
def test_whatever_is_lost_or_reordered_nothing_is_paired_wrongly(
    kept: list[int], rng: object
) -> None:
    matching = matcher(range(1, 31))
    matching.mark(mark(1))
    shuffled = list(kept)
    rng.shuffle(shuffled)
    for number in shuffled:
        assert matching.frame(frame(number)).number == number
        assert matching.mark(mark(number)).number == number


def test_a_frame_nobody_asked_for_is_not_taken_for_that_of_a_pulse_nearby() -> None:
    matching = matcher(range(1, 30))
    for number in range(1, 8):
        assert matching.frame(frame(number)).cause is Cause.USED
    stray = frame(8, device_ns=frame(8).device_ns - 9_000_000)
    assert matching.frame(stray).cause is Cause.SPURIOUS
    assert matching.frame(frame(8)).cause is Cause.USED


def test_a_head_whose_delay_has_changed_is_believed_again_after_three_frames() -> None:
    matching = matcher(range(1, 30))
    for number in range(1, 8):
        matching.frame(frame(number))
    later = [
        matching.frame(frame(n, device_ns=frame(n).device_ns + 9_000_000)) for n in range(8, 14)
    ]
    assert [match.cause is Cause.USED for match in later] == [False, False, True, True, True, True]


def test_none_of_the_frames_of_a_head_that_floods_is_believed_until_it_stops() -> None:
    matching = matcher(range(1, 30))
    for number in range(1, 8):
        matching.frame(frame(number))
    for tenth in (1, 2, 3):
        device_ns = frame(8).device_ns - tenth * 100_000_000
        assert matching.frame(frame(8, device_ns=device_ns)).cause is Cause.SPURIOUS
    assert matching.frame(frame(8)).is_ambiguous
    assert matching.frame(frame(9)).cause is Cause.USED
