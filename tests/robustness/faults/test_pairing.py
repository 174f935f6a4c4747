"""Flights on a fake clock: every exposure gets its own frames, mark and position, or none."""

from __future__ import annotations

import pytest

from benchmarks.pairing import SMALL_RIG, Case, fly, many_case, shortcomings, single_cases

pytestmark = pytest.mark.timeout(600)
EACH = 30
MANY = 500
SINGLE = [
    pytest.param(case, id=f"{case.title} {case.device}")
    for case in single_cases(EACH, rig_name=SMALL_RIG)
]


def test_without_a_fault_everything_is_matched() -> None:
    score = fly(Case("none", "", ()), 300, seed=1)
    assert not shortcomings(score)
    assert score.frames_right == score.frames_received == 300 * 13
    assert score.marks_right == score.marks_received == score.untouched_matched == 300


@pytest.mark.parametrize("case", SINGLE)
def test_under_a_single_fault_what_it_does_not_touch_is_matched(case: Case) -> None:
    score = fly(case, EACH, seed=1, rig_name=SMALL_RIG)
    assert not shortcomings(score), score.examples
    assert score.occurrences and score.untouched > EACH // 2


def test_under_many_faults_nothing_is_paired_wrongly_and_what_can_be_is_paired() -> None:
    score = fly(many_case(MANY, seed=1), MANY, seed=1)
    assert not shortcomings(score, single=False), score.examples


@pytest.mark.soak
@pytest.mark.timeout(7200)
def test_ten_thousand_exposures_under_many_faults() -> None:
    score = fly(many_case(10_000, seed=2), 10_000, seed=2)
    assert not shortcomings(score, single=False), score.examples
