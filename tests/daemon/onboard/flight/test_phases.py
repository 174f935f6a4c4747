"""The phase follows the facts one step at a time, and never where it may not go."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from daemon.onboard.flight.phases import ALLOWED_NEXT, Phase, PhaseInputs, PhaseMachine

FACTS = st.builds(
    PhaseInputs, *(st.booleans() for _ in ("prepared", "armed", "runs", "landed", "failed"))
)


def test_a_whole_flight_goes_through_every_phase_but_fault() -> None:
    machine = PhaseMachine()
    assert machine.phase is Phase.IDLE
    entered = []
    for facts in (
        PhaseInputs(),
        PhaseInputs(is_prepared=True),
        PhaseInputs(is_prepared=True, is_armed=True),
        PhaseInputs(is_prepared=True, is_armed=True, is_running=True),
        PhaseInputs(is_prepared=True, is_armed=True),
        PhaseInputs(is_prepared=True, is_armed=True, has_landed=True),
    ):
        entered += machine.advance(facts)
    assert entered == [Phase.READY, Phase.ARMED, Phase.FLYING, Phase.ARMED, Phase.LANDED]


def test_nothing_is_a_fact_until_it_is_stated() -> None:
    assert PhaseInputs() == PhaseInputs(False, False, False, False, False)
    machine = PhaseMachine()
    assert machine.advance(PhaseInputs()) == []
    assert machine.advance(PhaseInputs(is_prepared=True)) == [Phase.READY]
    assert machine.advance(PhaseInputs(is_armed=True)) == [Phase.ARMED]
    assert machine.advance(PhaseInputs(is_running=True)) == [Phase.FLYING]
    assert machine.advance(PhaseInputs(has_landed=True)) == [Phase.LANDED]
    assert machine.advance(PhaseInputs(has_failed=True)) == [Phase.FAULT]


def test_a_line_that_runs_at_once_is_armed_first() -> None:
    facts = PhaseInputs(is_prepared=True, is_armed=True, is_running=True)
    assert PhaseMachine().advance(facts) == [Phase.READY, Phase.ARMED, Phase.FLYING]


def test_a_line_that_runs_unarmed_is_not_flying() -> None:
    assert PhaseMachine().advance(PhaseInputs(is_prepared=True, is_running=True)) == [Phase.READY]


def test_what_is_lost_on_the_ground_disarms_and_in_the_air_does_not() -> None:
    machine = PhaseMachine()
    machine.advance(PhaseInputs(is_prepared=True, is_armed=True))
    assert machine.advance(PhaseInputs(is_prepared=True)) == [Phase.READY]
    machine.advance(PhaseInputs(is_prepared=True, is_armed=True, is_running=True))
    assert machine.advance(PhaseInputs(is_prepared=True, is_running=True)) == []
    assert machine.advance(PhaseInputs(is_prepared=True)) == [Phase.ARMED, Phase.READY]


@given(st.lists(FACTS, max_size=30))
def test_whatever_happens_only_allowed_steps_are_taken_and_a_fault_stays(
    history: list[PhaseInputs],
) -> None:
    machine = PhaseMachine()
    phase = machine.phase
    for facts in history:
        was = machine.phase
        for entered in machine.advance(facts):
            assert entered in ALLOWED_NEXT[phase]
            phase = entered
        assert phase is machine.phase
        if was is Phase.FAULT or facts.has_failed:
            assert machine.phase is Phase.FAULT
        assert machine.advance(facts) == []
