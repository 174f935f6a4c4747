"""Counting by sequence numbers that wrap, skip, repeat and start again."""

from __future__ import annotations

from drivers.cameras.v4l2.sequence import Counted, SequenceCounter


def told(*sequences: int) -> list[Counted]:
    count = SequenceCounter()
    return [count.take(number) for number in sequences]


def test_frames_are_counted_from_one_and_gaps_are_frames_missing() -> None:
    assert [(c.counter, c.missing) for c in told(0, 1, 2, 5)] == [(1, 0), (2, 0), (3, 0), (6, 2)]


def test_frames_lost_before_the_first_are_counted_too() -> None:
    assert told(3) == [Counted(4, 3)]


def test_a_number_that_wraps_goes_on() -> None:
    last = (1 << 32) - 1
    counters = [c.counter for c in told(0, last - 1, last, 0, 1)]
    assert counters == [1, 2, 3, 4, 5]
    assert [c.missing for c in told(0, last - 1, last, 0, 1)] == [0, 0, 0, 0, 0]


def test_a_number_that_comes_twice_is_told() -> None:
    assert told(0, 0, 1) == [Counted(1, 0), Counted(1, 0, is_repeated=True), Counted(2, 0)]


def test_a_step_back_is_a_restart_and_counting_goes_on() -> None:
    assert told(0, 1, 2, 0, 1)[3:] == [Counted(4, 0, is_restart=True), Counted(5, 0)]
