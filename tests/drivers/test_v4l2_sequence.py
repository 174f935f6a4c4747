"""Counting by sequence numbers that wrap, skip, repeat and start again."""

from __future__ import annotations

from drivers.cameras.v4l2.sequence import SequenceCount, SequenceCounter


def counted_frames(*sequences: int) -> list[SequenceCount]:
    count = SequenceCounter()
    return [count.advance(number) for number in sequences]


def test_frames_are_counted_from_one_and_gaps_are_frames_missing() -> None:
    assert [(c.counter, c.missing) for c in counted_frames(0, 1, 2, 5)] == [
        (1, 0),
        (2, 0),
        (3, 0),
        (6, 2),
    ]


def test_frames_lost_before_the_first_are_counted_too() -> None:
    assert counted_frames(3) == [SequenceCount(4, 3)]


def test_a_number_that_wraps_goes_on() -> None:
    last = (1 << 32) - 1
    counters = [c.counter for c in counted_frames(0, last - 1, last, 0, 1)]
    assert counters == [1, 2, 3, 4, 5]
    assert [c.missing for c in counted_frames(0, last - 1, last, 0, 1)] == [0, 0, 0, 0, 0]


def test_a_number_that_comes_twice_is_reported() -> None:
    assert counted_frames(0, 0, 1) == [
        SequenceCount(1, 0),
        SequenceCount(1, 0, is_repeated=True),
        SequenceCount(2, 0),
    ]


def test_a_step_back_is_a_restart_and_counting_goes_on() -> None:
    assert counted_frames(0, 1, 2, 0, 1)[3:] == [
        SequenceCount(4, 0, is_restart=True),
        SequenceCount(5, 0),
    ]
