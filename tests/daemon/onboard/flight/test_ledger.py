"""Transitions and books: what may happen, and that everything adds up at every moment."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from daemon.mission.exposure import Exposure
from daemon.onboard.flight.ledger import CAUSES, Ledger, LedgerError, Receipts
from daemon.onboard.flight.transitions import (
    TRANSITIONS,
    ExposureState,
    ExposureStatus,
    StorageState,
    Transition,
    next_status,
)
from tests.daemon.small_camera import SENSORS, capture_of, final_record

STANDINGS = [ExposureStatus(s, k) for s, k in itertools.product(ExposureState, StorageState)]


def test_every_step_that_is_not_listed_is_refused():
    for status, step in itertools.product(STANDINGS, Transition):
        if (status, step) in TRANSITIONS:
            next_status(status, step)
        else:
            with pytest.raises(LedgerError, match="cannot be"):
                next_status(status, step)


def test_nothing_happens_to_a_sealed_exposure_and_none_opens_again():
    for (before, _), result in TRANSITIONS.items():
        assert before.storage is not StorageState.SEALED
        assert before.state is ExposureState.OPEN or result.state is not ExposureState.OPEN


def test_what_is_stored_is_never_lost():
    for (before, _), result in TRANSITIONS.items():
        if before.storage is StorageState.STORED:
            assert result.state is not ExposureState.LOST


def test_only_judged_exposures_are_sealed_and_only_with_pixels_or_lost():
    ends = {r for r in TRANSITIONS.values() if r.storage is StorageState.SEALED}
    assert {r.state for r in ends} == {
        ExposureState.COMPLETE,
        ExposureState.DEGRADED,
        ExposureState.LOST,
    }
    for (before, step), result in TRANSITIONS.items():
        if step is Transition.SEAL:
            assert before.storage is StorageState.STORED or result.state is ExposureState.LOST


class AnyFlight(RuleBasedStateMachine):
    """Whatever happens in whatever order: the equations of the ledger hold after each step."""

    @initialize()
    def begin(self):
        self.ledger = Ledger(SENSORS)
        self.triggers = 0
        self.frames = dict.fromkeys(SENSORS, 0)
        self.marks = 0
        self.used = {}

    @rule(used=st.sets(st.sampled_from(SENSORS)))
    def trigger(self, used):
        self.triggers += 1
        self.ledger.trigger(self.triggers)
        self.used[self.triggers] = used
        for head in used:
            self.frames[head] += 1
            self.ledger.frame(head, "pending")
            self.ledger.frame(head, "used")

    @rule(head=st.sampled_from(SENSORS), cause=st.sampled_from(CAUSES[1:]), ahead=st.booleans())
    def useless_frame(self, head, cause, ahead):
        if ahead:
            self.ledger.frame(head, "pending")
        self.ledger.frame(head, cause)
        self.frames[head] += 1

    @rule(cause=st.sampled_from(["late", "duplicate", "corrupt", "spurious", "pending"]))
    def mark(self, cause):
        before = self.ledger.sheet().marks
        self.ledger.mark(cause)
        if cause == "pending" or not before.pending:
            self.marks += 1

    @rule(
        step=st.sampled_from(["complete", "degraded", "lost", "stored", "sealed"]), data=st.data()
    )
    def go_on(self, step, data):
        if not self.triggers:
            return
        number = data.draw(st.integers(1, self.triggers))
        before = self.ledger.sheet()
        missing = {head: "no frame" for head in SENSORS if head not in self.used[number]}
        causes = missing or {"store": "refused"}
        try:
            if step == "complete":
                self.ledger.set_state(number, "complete", missing)
            elif step in ("degraded", "lost"):
                self.ledger.set_state(number, step, causes)
            elif step == "stored":
                self.ledger.stored(number)
            else:
                self.ledger.sealed(number)
        except LedgerError:
            assert self.ledger.sheet() == before

    @invariant()
    def it_balances(self):
        sheet = self.ledger.sheet()
        assert sheet.imbalances == ()
        assert sheet.triggers == self.triggers
        assert sheet.triggers == sheet.open + sheet.complete + sheet.degraded + sheet.lost
        for line in sheet.heads:
            assert line.received == self.frames[line.name]
        for line in (*sheet.heads, sheet.frames, sheet.marks):
            assert line.received == line.pending + line.used + line.late + line.duplicate + (
                line.corrupt + line.spurious
            )
        assert sheet.frames.received == sum(self.frames.values())
        assert sheet.marks.received == self.marks
        assert sheet.sealed <= sheet.triggers and sheet.stored <= sheet.triggers
        assert self.ledger.imbalances(self.frames) == []


AnyFlight.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestAnyFlight = AnyFlight.TestCase


def test_a_frame_used_twice_is_an_imbalance():
    ledger = Ledger(["SU00"])
    ledger.trigger(1)
    ledger.frame("SU00", "used")
    ledger.set_state(1, "complete")
    assert ledger.imbalances() == []
    ledger.frame("SU00", "used")
    assert ledger.imbalances() == [
        "SU00: 2 frames used, but 1 exposures have one and 0 are open or lost"
    ]


def test_a_frame_that_was_forgotten_is_an_imbalance():
    ledger = Ledger(["SU00"])
    ledger.trigger(1)
    ledger.set_state(1, "complete")
    assert "SU00: 0 frames used, but 1 exposures have one" in ledger.imbalances()[0]


def test_a_frame_the_driver_delivered_but_nobody_saw_is_an_imbalance():
    ledger = Ledger(["SU00"])
    ledger.frame("SU00", "late")
    assert ledger.imbalances({"SU00": 1}) == []
    assert ledger.imbalances({"SU00": 2}) == ["SU00: its driver delivered 2 frames, 1 arrived"]


def test_more_marks_than_triggers_is_an_imbalance():
    ledger = Ledger()
    ledger.mark("used")
    assert ledger.imbalances() == ["marks: 1 used for 0 triggers"]


def test_a_flight_goes_on_with_its_records_and_its_last_sheet():
    flown = Ledger(SENSORS)
    records = []
    for number in (1, 2, 3):
        sensors = SENSORS if number < 3 else SENSORS[:2]
        flown.trigger(number)
        for head in sensors:
            flown.frame(head, "used")
        flown.mark("used")
        records.append(final_record(capture_of(number, sensors)))
        flown.set_state(number, records[-1].state, dict(records[-1].missing))
        flown.stored(number)
        flown.sealed(number)
    flown.trigger(4)
    flown.set_state(4, "lost", {"exposure": "no head sent a frame"})
    flown.sealed(4)
    records.append(replace(Exposure(number=4), state="lost", missing=(("SU00", "none"),)))
    flown.frame("SU01", "duplicate")
    flown.mark("spurious")
    resumed = Ledger.resume(records, heads=SENSORS, sheet=flown.sheet().as_json())
    assert resumed.sheet() == flown.sheet()
    assert resumed.sheet().is_balanced
    assert resumed.sheet().as_json()["triggers"] == {
        "triggers": 4, "open": 0, "complete": 2, "degraded": 1, "lost": 1, "stored": 3, "sealed": 4,
    }  # fmt: skip


def test_a_damaged_sheet_counts_as_nothing():
    sheet = {"heads": [{"name": 3, "late": 1}, 7, {"name": "SU00", "late": -1}], "marks": "many"}
    assert Ledger.resume([], sheet=sheet).sheet().frames.received == 0


def test_after_landing_nothing_may_be_open_or_pending():
    ledger = Ledger(["SU00"])
    ledger.trigger(1)
    ledger.frame("SU00", "pending")
    ledger.mark("pending")
    assert ledger.imbalances() == []
    assert ledger.imbalances(has_landed=True) == [
        "SU00: 1 pending after landing",
        "marks: 1 pending after landing",
        "1 exposures are open after landing",
    ]
    ledger.frame("SU00", "used")
    ledger.mark("spurious")
    ledger.set_state(1, "complete")
    assert ledger.imbalances(has_landed=True) == []


def test_every_count_of_a_sheet_is_exact():
    ledger = Ledger(["SU00", "SU01"])
    assert Receipts("SU00") == Receipts("SU00", 0, 0, 0, 0, 0, 0, 0, 0)
    assert ledger.sheet().heads == (Receipts("SU00"), Receipts("SU01"))
    for number in range(1, 8):
        ledger.trigger(number)
    counts = {"used": 2, "late": 3, "duplicate": 4, "corrupt": 5, "spurious": 6}
    for cause, count in counts.items():
        for _ in range(count):
            ledger.frame("SU00", "pending")
            ledger.frame("SU00", cause)
            ledger.mark(cause)
    ledger.frame("SU00", "pending")
    ledger.set_state(1, "complete")
    for number in (2, 3, 4):
        ledger.set_state(number, "degraded", {"SU01": "no frame", "mark": "none came"})
    ledger.set_state(5, "lost", {"exposure": "no pulse"})
    for number in (1, 2, 3):
        ledger.stored(number)
    for number in (1, 5):
        ledger.sealed(number)
    sheet = ledger.sheet()
    assert (sheet.triggers, sheet.open, sheet.complete, sheet.degraded, sheet.lost) == (
        *(7, 2, 1, 3, 1),
    )
    # Stored are two that wait and one that is sealed; the lost one is sealed without pixels.
    assert (sheet.stored, sheet.sealed) == (3, 2)
    assert sheet.heads[0] == Receipts("SU00", 21, 2, 3, 4, 5, 6, pending=1, missing=0)
    assert sheet.heads[1] == Receipts("SU01", missing=3)
    assert sheet.frames == Receipts("frames", 21, 2, 3, 4, 5, 6, pending=1, missing=3)
    assert sheet.marks == Receipts("marks", 20, 2, 3, 4, 5, 6, pending=0, missing=3)
    assert ledger.open_numbers() == [6, 7]
    # SU00 has four exposures and three undecided ones; SU01 one exposure, and no frame at all.
    assert sheet.imbalances == (
        "SU00: 2 frames used, but 4 exposures have one and 3 are open or lost",
        "SU01: 0 frames used, but 1 exposures have one and 3 are open or lost",
    )


@pytest.mark.parametrize(("used", "balances"), [(1, False), (2, True), (5, True), (6, False)])
def test_used_frames_lie_between_whole_exposures_and_those_with_the_undecided(used, balances):
    ledger = Ledger(["SU00"])
    for number in (1, 2, 3, 4, 5):
        ledger.trigger(number)
    for _ in range(used):
        ledger.frame("SU00", "used")
    for number in (1, 2):
        ledger.set_state(number, "complete")
    ledger.set_state(3, "lost", {"exposure": "no pulse"})
    assert (ledger.imbalances() == []) is balances


def test_marks_are_as_many_as_triggers_at_most():
    ledger = Ledger()
    ledger.trigger(1)
    ledger.mark("used")
    assert ledger.imbalances() == []
    ledger.mark("used")
    assert ledger.imbalances() == ["marks: 2 used for 1 triggers"]


def test_an_exposure_judged_worse_names_its_last_causes_alone():
    ledger = Ledger(["SU00", "SU01"])
    ledger.trigger(1)
    ledger.set_state(1, "degraded", {"SU00": "late"})
    ledger.set_state(1, "degraded", {"SU01": "late", "SU00": "late"})
    assert [head.missing for head in ledger.sheet().heads] == [1, 1]
    ledger.set_state(1, "lost", {"exposure": "the disk refused"})
    assert [head.missing for head in ledger.sheet().heads] == [0, 0]


@pytest.mark.parametrize(
    ("state", "causes", "message"),
    [
        ("complete", {"SU00": "late"}, "is complete, but missing: SU00"),
        ("degraded", {}, "is degraded; state what is missing"),
        ("lost", {}, "is lost; state what is missing"),
        ("open", {}, "the final state is complete, degraded or lost"),
        ("gone", {}, "the final state is complete, degraded or lost"),
    ],
)
def test_a_judgement_and_its_causes_fit_each_other(state, causes, message):
    ledger = Ledger(["SU00"])
    ledger.trigger(1)
    with pytest.raises(LedgerError, match=f"exposure 1: {message}"):
        ledger.set_state(1, state, causes)
    assert ledger.open_numbers() == [1]


def test_a_number_is_triggered_once_and_an_unknown_one_is_refused():
    ledger = Ledger()
    ledger.trigger(1)
    with pytest.raises(LedgerError, match="exposure 1 was triggered already"):
        ledger.trigger(1)
    with pytest.raises(LedgerError, match="exposure 2 was never triggered"):
        ledger.status(2)
    with pytest.raises(LedgerError, match="SU00: cause 'odd'; it is one of pending, used, late"):
        ledger.frame("SU00", "odd")
    assert ledger.sheet().triggers == 1


def test_a_sheet_carries_on_what_is_in_no_record_and_nothing_else():
    line = {"name": "SU00", "used": 9, "late": 1, "duplicate": True, "corrupt": 0, "spurious": 2}
    sheet = {"heads": (line,), "marks": {"used": 9, "late": 4, "spurious": "2"}}
    resumed = Ledger.resume([], sheet=sheet).sheet()
    assert resumed.heads == (Receipts("SU00", received=3, late=1, spurious=2),)
    assert resumed.marks == Receipts("marks", received=4, late=4)


def test_a_record_that_names_no_cause_is_resumed_with_one():
    records = [
        replace(Exposure(number=1), state="lost", missing=()),
        replace(Exposure(number=2), state="complete", missing=(("SU00", "late"),)),
    ]
    sheet = Ledger.resume(records, heads=["SU00"]).sheet()
    assert (sheet.complete, sheet.degraded, sheet.lost, sheet.stored) == (0, 1, 1, 1)
    assert sheet.heads[0].missing == 1
