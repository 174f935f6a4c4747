"""A retake exposes exactly the places of its segment, once, and the rest of the line not again."""

from __future__ import annotations

import pytest

from daemon.planning.model import Plan
from daemon.planning.retakes import RETAKES_MAX, RetakeError, retake_line
from daemon.planning.steering import PlanTrigger
from tests.daemon.planning.test_steering import PLANE, flown, line, trigger

LEG = ((0.0, -300.0), (0.0, 1300.0))


def with_retake(from_m: float, to_m: float) -> PlanTrigger:
    steering = trigger(line("A1", 0.0))
    flown(steering, [LEG])
    assert steering.flown == {"A1"}
    plan = Plan("test", (line("A1", 0.0),))
    steering.add_retake(retake_line(plan, "A1", from_m, to_m, distance_m=100.0), of="A1")
    return steering


def norths(taken: list[tuple[float, float, str]]) -> list[int]:
    return [round(north) for _, north, _ in taken]


def test_a_single_exposure_is_repeated_at_its_planned_place() -> None:
    steering = with_retake(310.0, 310.0)
    taken = flown(steering, [LEG])
    assert len(taken) == 1
    assert taken[0][1] == pytest.approx(300.0, abs=5.0)
    assert taken[0][2] == "A1 R1"
    assert steering.upcoming() == []


def test_a_segment_is_repeated_in_either_direction() -> None:
    there = flown(with_retake(200.0, 500.0), [LEG])
    back = flown(with_retake(500.0, 200.0), [(LEG[1], LEG[0])])
    assert [round(n, -2) for n in norths(there)] == [200, 300, 400, 500]
    assert [round(n, -2) for n in norths(back)] == [500, 400, 300, 200]


def test_a_flown_retake_lets_its_line_be_flown_again() -> None:
    steering = with_retake(310.0, 310.0)
    flown(steering, [LEG])
    assert len(flown(steering, [LEG])) == 11


def test_a_line_that_is_not_flown_keeps_its_places_next_to_a_retake() -> None:
    steering = trigger(line("A1", 0.0), line("A2", 500.0))
    plan = steering.plan
    steering.add_retake(retake_line(plan, "A1", 300.0, 300.0, distance_m=100.0), of="A1")
    assert [one.id for one in steering.upcoming()] == ["A1 R1", "A1", "A2"]
    assert len(flown(steering, [((500.0, -300.0), (500.0, 1300.0))])) == 11


@pytest.mark.parametrize(
    ("line_id", "from_m", "to_m", "why"),
    [
        ("B9", 0.0, 10.0, "no line 'B9'"),
        ("A1", 5000.0, 6000.0, "not on line A1"),
        ("A1", -5000.0, -4000.0, "not on line A1"),
    ],
)
def test_a_segment_off_the_plan_is_refused(
    line_id: str, from_m: float, to_m: float, why: str
) -> None:
    plan = Plan("test", (line("A1", 0.0),))
    with pytest.raises(RetakeError, match=why):
        retake_line(plan, line_id, from_m, to_m, distance_m=100.0)


def test_ids_are_unused_and_their_number_is_bounded() -> None:
    plan = Plan("test", (line("A1", 0.0),))
    assert retake_line(plan, "A1", 0, 0, distance_m=100.0, taken=["A1 R1"]).id == "A1 R2"
    many = [f"A1 R{k}" for k in range(RETAKES_MAX)]
    with pytest.raises(RetakeError, match="planned already"):
        retake_line(plan, "A1", 0, 0, distance_m=100.0, taken=many)


def test_a_plan_of_one_point_has_no_retake() -> None:
    point = PLANE.origin
    plan = Plan("test", (line("A1", 0.0, length_m=0.0),))
    assert plan.lines[0].start == point
    with pytest.raises(RetakeError, match="no length"):
        retake_line(plan, "A1", 0, 0, distance_m=100.0)
