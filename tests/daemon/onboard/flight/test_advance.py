"""`Flight.advance` under any order of records, results of the disk and instants.

The devices and the disk are drawn by hypothesis. What the flight returns is carried out late, in
any order that one writer allows.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)

from daemon.mission.exposure import Exposure
from daemon.onboard.flight.decisions import Actions, PendingStore
from daemon.onboard.flight.flight import SEAL_RETRY_NS
from drivers.contract import DeviceEvent
from tests.daemon.onboard.flight.test_flight import (
    HEADS,
    LIMITS,
    NS,
    flight,
    fly_one,
    frame,
    mark,
    nav,
    pulse,
)

pytestmark = pytest.mark.trust
LONGEST_WAIT_NS = round((LIMITS.frame_timeout_s + LIMITS.mark_timeout_s) * NS)


class AnyFlight(RuleBasedStateMachine):
    """One flight: whatever comes in whatever order, each exposure ends once, in order."""

    @initialize(has_pps=st.booleans())
    def begin(self, *, has_pps: bool) -> None:
        self.flight = flight(has_pps=has_pps)
        self.now_ns = 0
        self.next_ns: int | None = None
        self.ordered = 0
        self.unanswered: list[int] = []
        self.fired: list[int] = []
        self.to_store: list[PendingStore] = []
        self.stored: set[int] = set()
        self.sealing: Exposure | None = None
        self.sealed: list[int] = []
        self.lost: set[int] = set()

    @rule()
    def order(self) -> None:
        self.ordered += 1
        assert self.flight.order(self.now_ns) == self.ordered
        self.unanswered.append(self.ordered)

    @precondition(lambda self: self.unanswered)
    @rule(is_given=st.booleans())
    def answer(self, *, is_given: bool) -> None:
        number = self.unanswered.pop(0)
        if is_given:
            self.flight.fired(pulse(number, self.now_ns / NS))
            self.fired.append(number)
        else:
            self.flight.not_fired(number, "the unit does not answer")

    @precondition(lambda self: self.fired)
    @rule(head=st.sampled_from(HEADS), age=st.integers(0, 3))
    def deliver(self, head: str, age: int) -> None:
        number = self.fired[-1 - age % len(self.fired)]
        of_pulse = self.flight._matcher._pulses.get(number)
        if of_pulse is not None:
            arrived = frame(head, of_pulse)
            self.flight.take(replace(arrived, mono_ns=max(self.now_ns, arrived.mono_ns)))

    @precondition(lambda self: self.fired)
    @rule(age=st.integers(0, 3))
    def stamp(self, age: int) -> None:
        of_pulse = self.flight._matcher._pulses.get(self.fired[-1 - age % len(self.fired)])
        if of_pulse is not None:
            stamped = mark(of_pulse)
            self.flight.take(replace(stamped, mono_ns=max(self.now_ns, stamped.mono_ns)))

    @rule()
    def locate(self) -> None:
        self.flight.take(nav(self.now_ns / NS))

    @rule(head=st.sampled_from(HEADS), name=st.sampled_from(["lost", "recovered"]))
    def head_changes(self, head: str, name: str) -> None:
        self.flight.take(DeviceEvent(head, name, name == "lost", "", self.now_ns))

    @rule(seconds=st.sampled_from([0.001, 0.1, 0.5, 1.35, 3.1, 8.1]))
    def advance(self, seconds: float) -> None:
        self.now_ns += round(seconds * NS)
        self._carry_out(self.flight.advance(self.now_ns))

    def _carry_out(self, actions: Actions) -> None:
        assert actions.next_ns is None or actions.next_ns > actions.mono_ns
        again = self.flight.advance(actions.mono_ns)
        assert again.decision is None and not again.clock_events, "each action is returned once"
        assert again.next_ns == actions.next_ns
        self.next_ns = actions.next_ns
        self.to_store += actions.store
        self.lost |= {number for number, _ in actions.lost}
        if actions.seal is not None:
            assert self.sealing is None, "one record is with the writer at a time"
            assert actions.seal.number == len(self.sealed) + 1, "records are sealed in order"
            state = actions.seal.state
            assert (actions.seal.number in self.stored) == (state != "lost")
            self.sealing = actions.seal

    @precondition(lambda self: self.to_store)
    @rule(is_refused=st.booleans())
    def writer_stores(self, *, is_refused: bool) -> None:
        capture = self.to_store.pop(0).capture
        if is_refused:
            self.flight.not_stored(capture.number, "No space left on device")
        else:
            self.flight.stored(capture.number, capture.frames)
            self.stored.add(capture.number)

    @precondition(lambda self: self.sealing is not None)
    @rule(is_refused=st.booleans())
    def writer_seals(self, *, is_refused: bool) -> None:
        assert self.sealing is not None
        record, self.sealing = self.sealing, None
        if is_refused:
            self.flight.seal_refused(self.now_ns)
            assert self.flight.advance(self.now_ns + SEAL_RETRY_NS - 1).seal is None
        else:
            assert self.flight.sealed(record.number) is record
            self.sealed.append(record.number)

    @invariant()
    def books_balance(self) -> None:
        if hasattr(self, "flight"):
            assert self.flight.ledger.imbalances() == []

    def teardown(self) -> None:
        """With no further record, waiting for `next_ns` alone seals everything."""
        if not hasattr(self, "flight"):
            return
        self._carry_out(self.flight.advance(self.now_ns))
        deadline_ns = self.now_ns + LONGEST_WAIT_NS + 2 * NS + SEAL_RETRY_NS
        while self.flight.open_numbers:
            while self.to_store:
                self.writer_stores(is_refused=False)
            if self.sealing is not None:
                self.writer_seals(is_refused=False)
            due = self.flight.advance(self.now_ns)
            if due.decision is None and self.flight.open_numbers:
                assert due.next_ns is not None, "an open exposure always has an end"
                assert due.next_ns > self.now_ns
                self.now_ns = due.next_ns
                assert self.now_ns <= deadline_ns
            self._carry_out_once(due)
        assert self.sealed == list(range(1, self.ordered + 1))
        self.flight.land()
        assert self.flight.ledger.imbalances(has_landed=True) == []

    def _carry_out_once(self, due: Actions) -> None:
        self.to_store += due.store
        self.sealing = due.seal or self.sealing


TestAnyFlight = AnyFlight.TestCase
TestAnyFlight.settings = settings(
    max_examples=60,
    stateful_step_count=40,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)


@given(heads=st.permutations(HEADS), gaps_ms=st.lists(st.integers(1, 2000), min_size=3, max_size=3))
def test_frames_are_stored_with_the_last_of_them_and_not_later(
    heads: list[str], gaps_ms: list[int]
) -> None:
    flying, now_ns = flight(), 0
    given_pulse = fly_one(flying, 1, 0.0, ())
    for head, gap_ms in zip(heads, gaps_ms, strict=True):
        assert not flying.advance(now_ns).store
        now_ns += gap_ms * 1_000_000
        flying.take(frame(head, given_pulse))
    assert [due.capture.number for due in flying.advance(now_ns).store] == [1]


def test_the_next_instant_is_that_of_the_next_time_out() -> None:
    flying = flight()
    assert flying.advance(0).next_ns is None
    given_pulse = fly_one(flying, 1, 0.0, HEADS[:2])
    assert flying.advance(NS).next_ns == 8 * NS + 1
    assert not flying.advance(8 * NS).store
    (due,) = flying.advance(8 * NS + 1).store
    flying.stored(1, due.capture.frames)
    second = fly_one(flying, 2, 8.5)
    flying.take(mark(second))
    flying.take(mark(given_pulse))
    actions = flying.advance(9 * NS)
    assert actions.seal is not None and actions.seal.number == 1
    flying.sealed(1)
    flying.stored(2, actions.store[0].capture.frames)
    assert flying.advance(9 * NS).next_ns == round(11.5 * NS) + 1
    assert flying.advance(round(11.5 * NS)).seal is None
    assert flying.advance(round(11.5 * NS) + 1).seal is not None


def test_a_mark_without_a_pulse_is_given_up_at_the_instant_that_was_returned() -> None:
    flying = flight()
    stray = mark(pulse(7, 1.0))
    flying.take(stray)
    end_ns = stray.mono_ns + LONGEST_WAIT_NS
    assert flying.advance(2 * NS).next_ns == end_ns + 1
    assert flying.advance(end_ns).spurious == ()
    assert flying.advance(end_ns + 1).spurious == (stray,)
    assert flying.advance(end_ns + 2).next_ns is None


def test_expired_time_outs_store_and_seal_at_once() -> None:
    flying = flight()
    fly_one(flying, 1, 0.0, HEADS[:1])
    fly_one(flying, 2, 1.35, ())
    assert flying.advance(2 * NS).decision is None
    flying.expire_timeouts()
    actions = flying.advance(2 * NS)
    assert [due.capture.number for due in actions.store] == [1]
    assert actions.lost == ((2, "no head sent a frame"),)
    flying.stored(1, actions.store[0].capture.frames)
    for number in (1, 2):
        due = flying.advance(2 * NS)
        assert due.seal is not None and due.seal.number == number
        flying.sealed(number)
    assert not flying.open_numbers


def test_a_frame_of_a_lost_exposure_is_late_and_not_retained() -> None:
    flying = flight()
    given_pulse = fly_one(flying, 1, 0.0, ())
    flying.advance(9 * NS)
    flying.take(frame("G", given_pulse))
    sheet = flying.ledger.sheet().frames
    assert (sheet.used, sheet.late) == (0, 1)
