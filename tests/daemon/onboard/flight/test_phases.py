"""The phase follows the facts one step at a time, and never where it may not go."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from daemon.onboard.flight.phases import NEXT, Facts, Phase, StateMachine

FACTS = st.builds(
    Facts, *(st.booleans() for _ in ("prepared", "armed", "runs", "landed", "failed"))
)


def test_a_whole_flight_goes_through_every_phase_but_fault() -> None:
    machine = StateMachine()
    assert machine.phase is Phase.IDLE
    entered = []
    for facts in (
        Facts(),
        Facts(is_prepared=True),
        Facts(is_prepared=True, is_armed=True),
        Facts(is_prepared=True, is_armed=True, runs=True),
        Facts(is_prepared=True, is_armed=True),
        Facts(is_prepared=True, is_armed=True, has_landed=True),
    ):
        entered += machine.follow(facts)
    assert entered == [Phase.READY, Phase.ARMED, Phase.FLYING, Phase.ARMED, Phase.LANDED]


def test_nothing_is_a_fact_until_it_is_stated() -> None:
    assert Facts() == Facts(False, False, False, False, False)
    machine = StateMachine()
    assert machine.follow(Facts()) == []
    assert machine.follow(Facts(is_prepared=True)) == [Phase.READY]
    assert machine.follow(Facts(is_armed=True)) == [Phase.ARMED]
    assert machine.follow(Facts(runs=True)) == [Phase.FLYING]
    assert machine.follow(Facts(has_landed=True)) == [Phase.LANDED]
    assert machine.follow(Facts(has_failed=True)) == [Phase.FAULT]


def test_a_line_that_runs_at_once_is_armed_first() -> None:
    facts = Facts(is_prepared=True, is_armed=True, runs=True)
    assert StateMachine().follow(facts) == [Phase.READY, Phase.ARMED, Phase.FLYING]


def test_a_line_that_runs_unarmed_is_not_flying() -> None:
    assert StateMachine().follow(Facts(is_prepared=True, runs=True)) == [Phase.READY]


def test_what_is_lost_on_the_ground_disarms_and_in_the_air_does_not() -> None:
    machine = StateMachine()
    machine.follow(Facts(is_prepared=True, is_armed=True))
    assert machine.follow(Facts(is_prepared=True)) == [Phase.READY]
    machine.follow(Facts(is_prepared=True, is_armed=True, runs=True))
    assert machine.follow(Facts(is_prepared=True, runs=True)) == []
    assert machine.follow(Facts(is_prepared=True)) == [Phase.ARMED, Phase.READY]


@given(st.lists(FACTS, max_size=30))
def test_whatever_happens_only_allowed_steps_are_taken_and_a_fault_stays(
    history: list[Facts],
) -> None:
    machine = StateMachine()
    phase = machine.phase
    for facts in history:
        was = machine.phase
        for entered in machine.follow(facts):
            assert entered in NEXT[phase]
            phase = entered
        assert phase is machine.phase
        if was is Phase.FAULT or facts.has_failed:
            assert machine.phase is Phase.FAULT
        assert machine.follow(facts) == []
