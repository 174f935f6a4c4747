"""The effect of each fault on the data of a device, on the test's own clock."""

from __future__ import annotations

import pytest

from sim_hw.faults.channel import BytesDamage, Channel
from sim_hw.faults.plan import PlannedFault
from sim_hw.world.world_clock import NS_PER_S, NS_PER_WEEK


def channel(
    name: str, *, lasts_s: float | None = None, amount: float = 0.0, topic: str = ""
) -> Channel[bytes]:
    faulty = Channel(
        [PlannedFault(name, "d", 2.0, None, lasts_s, amount, topic)], BytesDamage(), seed=1
    )
    faulty.begin(0)
    return faulty


def delivered(faulty: Channel[bytes], seconds: int = 8) -> list[tuple[float, bytes]]:
    """One message a second, and when it goes out."""
    sent = []
    for second in range(seconds):
        sent += [
            (delivery.at_ns / NS_PER_S, delivery.message)
            for delivery in faulty.send(b"message %d" % second, second * NS_PER_S)
        ]
    return sent


def numbers(faulty: Channel[bytes]) -> list[int]:
    return [int(message.split()[1]) for _, message in delivered(faulty)]


def test_without_a_duration_one_message_is_lost() -> None:
    assert numbers(channel("lost")) == [0, 1, 3, 4, 5, 6, 7]


def test_with_a_duration_all_are_lost_as_long() -> None:
    assert numbers(channel("lost", lasts_s=3.0)) == [0, 1, 5, 6, 7]


def test_a_late_message_keeps_its_content_and_not_its_time() -> None:
    assert delivered(channel("late", amount=2.5))[2] == (4.5, b"message 2")


def test_a_duplicate_follows_its_original() -> None:
    assert numbers(channel("duplicate")) == [0, 1, 2, 2, 3, 4, 5, 6, 7]


def test_a_reordered_message_comes_behind_the_next() -> None:
    assert numbers(channel("reordered")) == [0, 1, 3, 2, 4, 5, 6, 7]


def test_a_corrupt_message_has_its_length() -> None:
    damaged = delivered(channel("corrupt"))[2][1]
    assert len(damaged) == 9 and damaged != b"message 2"


def test_a_truncated_message_breaks_off() -> None:
    broken = delivered(channel("truncated"))[2][1]
    assert b"message 2".startswith(broken) and len(broken) < 9


def test_a_stuck_device_repeats_its_last_message() -> None:
    assert numbers(channel("stuck", lasts_s=3.0)) == [0, 1, 1, 1, 1, 5, 6, 7]


def test_an_older_message_is_sent_once() -> None:
    assert numbers(channel("older-frame")) == [0, 1, 1, 3, 4, 5, 6, 7]


@pytest.mark.parametrize("name", ["silent", "cable-pulled", "power-cycle"])
def test_a_silent_device_sends_nothing_for_a_while(name: str) -> None:
    faulty = channel(name, lasts_s=3.0)
    assert numbers(faulty) == [0, 1, 5, 6, 7]
    assert {hit.fault for hit in faulty.occurrences} == {name}


def test_power_comes_back_once() -> None:
    faulty = channel("power-cycle", lasts_s=3.0)
    assert [faulty.is_powered(s * NS_PER_S) for s in (1, 3, 6)] == [True, False, True]
    back = [faulty.has_power_cycled(s * NS_PER_S) for s in range(8)]
    assert back == [False] * 5 + [True, False, False]


def test_a_counter_restarts_once_whatever_its_duration() -> None:
    faulty = channel("counter-reset", lasts_s=5.0)
    assert [faulty.counter_restarts(s * NS_PER_S) for s in range(5)] == [False] * 2 + [
        True,
        False,
        False,
    ]


def test_clocks_step_drift_and_lose_weeks() -> None:
    assert channel("clock-step", amount=0.37).clock_error_ns(9 * NS_PER_S) == 370_000_000
    assert channel("clock-drift", amount=200.0).clock_error_ns(12 * NS_PER_S) == 2_000_000
    week = channel("wrong-week", amount=-1024.0, lasts_s=3.0)
    assert week.clock_error_ns(3 * NS_PER_S) == -1024 * NS_PER_WEEK
    assert week.clock_error_ns(6 * NS_PER_S) == 0


def test_a_fault_of_marks_leaves_positions_alone() -> None:
    faulty = channel("lost", topic="mark")
    assert faulty.send(b"position", 3 * NS_PER_S, topic="navigation")
    assert not faulty.send(b"mark", 3 * NS_PER_S, topic="mark")
    assert faulty.send(b"mark", 4 * NS_PER_S, topic="mark")


def test_silence_about_marks_leaves_positions_alone() -> None:
    faulty = channel("silent", lasts_s=3.0, topic="mark")
    assert not faulty.is_silent(3 * NS_PER_S)
    assert not faulty.send(b"mark", 3 * NS_PER_S, topic="mark")
    assert faulty.send(b"position", 3 * NS_PER_S, topic="navigation")
    assert not faulty.send(b"mark", 4 * NS_PER_S, topic="mark")
    assert faulty.send(b"mark", 5 * NS_PER_S, topic="mark")
    assert {hit.fault for hit in faulty.occurrences} == {"silent"}


def test_a_fault_that_waits_for_a_pulse_begins_with_it() -> None:
    faulty = Channel([PlannedFault("lost", "d", None, 3, None, 0.0)], BytesDamage(), seed=1)
    faulty.begin(0)
    sent = []
    for count in range(1, 6):
        faulty.pulse(count, count * NS_PER_S)
        sent += [d.message for d in faulty.send(b"%d" % count, count * NS_PER_S)]
    assert sent == [b"1", b"2", b"4", b"5"]


def test_a_flood_comes_ten_times_a_second_while_it_lasts() -> None:
    faulty = channel("flooding", lasts_s=3.0)
    due = [t for t in range(0, 8 * NS_PER_S, 10_000_000) if faulty.flood_is_due(t)]
    assert len(due) == 30 and due[0] == 2 * NS_PER_S
