"""Faults of a head's stream: each counter that grew has its sentence, no other has."""

from __future__ import annotations

from collections import Counter

import pytest

from drivers.cameras.aravis.stream_faults import stream_faults

EVENTS = {
    "kernel_drops": ("kernel-drops", "net.core.rmem_max"),
    "other_senders": ("other-sender", "only 10.0.0.7 is accepted"),
    "chunks_unreadable": ("chunks-unreadable", "chunks = false"),
    "frames_swapped": ("byte-order", 'Set byte_order = "big"'),
}


@pytest.mark.parametrize("counter", EVENTS)
def test_the_counter_that_grew_is_reported_alone(counter: str) -> None:
    before = Counter(dict.fromkeys(EVENTS, 2))
    found = list(
        stream_faults(
            "PAN-1",
            before,
            before + Counter({counter: 3}),
            others="only 10.0.0.7 is accepted",
            byte_order="little",
        )
    )
    event, remedy = EVENTS[counter]
    assert [name for name, _ in found] == [event]
    assert "PAN-1" in found[0][1]
    assert remedy in found[0][1]


def test_counters_that_stay_or_start_at_zero_are_not_reported() -> None:
    before = Counter(dict.fromkeys(EVENTS, 2))
    for now in (before, Counter()):
        assert not list(stream_faults("PAN-1", before, now, others="", byte_order="big"))
