"""Software triggers fired together, with a sigma that holds every head."""

from __future__ import annotations

import threading
import time
from typing import cast

import pytest

from drivers.contract import DeviceError, Head
from drivers.triggers.software import SoftwareTrigger
from tests.support.stopwatch import Stopwatch


class StubHead:
    """A head that takes its time to be triggered."""

    def __init__(self, name: str, takes_s: float = 0.0, error: str = "") -> None:
        self.name = name
        self.takes_s = takes_s
        self.error = error
        self.fired_ns: list[int] = []

    def trigger(self) -> None:
        if self.error:
            raise DeviceError(self.error)
        self.fired_ns.append(time.monotonic_ns())
        if self.takes_s:
            threading.Event().wait(self.takes_s)


def _trigger(**heads: StubHead) -> SoftwareTrigger:
    groups = {output: [cast(Head, head)] for output, head in heads.items()}
    return SoftwareTrigger("soft", {"timeout_s": 0.5}, heads=groups)


@pytest.mark.realtime
def test_all_heads_are_fired_at_once_and_sigma_holds_them() -> None:
    heads = {name: StubHead(name, takes_s=0.05) for name in ("a", "b", "c", "d")}
    trigger = _trigger(**heads)
    watch = Stopwatch()
    pulse = trigger.fire(7)
    assert watch.is_within(0.15), "one after the other would take 0.2 s"
    for head in heads.values():
        assert abs(head.fired_ns[0] - pulse.mono_ns) <= pulse.sigma_ns
    assert (pulse.sequence, pulse.count) == (7, 1)
    trigger.close()


def test_delays_are_stored_and_taken_off_the_pulse() -> None:
    first, last = StubHead("first"), StubHead("last")
    trigger = _trigger(first=first, last=last)
    trigger.program({"last": 50_000_000})
    trigger.fire(1)
    pulse = trigger.fire(2)
    spread_ns = last.fired_ns[1] - first.fired_ns[1]
    assert abs(spread_ns - 50_000_000) < 1_000_000 + 2 * pulse.sigma_ns
    assert abs(last.fired_ns[1] - 50_000_000 - pulse.mono_ns) <= pulse.sigma_ns
    trigger.close()


def test_a_head_that_fails_does_not_hold_the_others() -> None:
    good, bad = StubHead("good"), StubHead("bad", error="bad: lost")
    trigger = _trigger(good=good, bad=bad)
    assert trigger.fire(1).count == 1
    assert len(good.fired_ns) == 1
    assert trigger.statistics() == {"pulses": 1, "failures": 1}
    trigger.close()


def test_no_head_at_all_is_an_error_that_names_each() -> None:
    trigger = _trigger(a=StubHead("a", error="a: lost"), b=StubHead("b", error="b: not running"))
    with pytest.raises(DeviceError) as caught:
        trigger.fire(1)
    assert sorted(str(caught.value).splitlines()) == [
        "a: lost",
        "b: not running",
        "soft: no head was triggered",
    ]
    trigger.close()


def test_a_delay_for_an_output_that_is_not_there_is_refused() -> None:
    trigger = _trigger(a=StubHead("a"))
    with pytest.raises(DeviceError, match="output 'b' does not exist; the trigger has a"):
        trigger.program({"b": 0})
    trigger.close()
    with pytest.raises(DeviceError, match="closed"):
        trigger.fire(1)
