"""A planned line is exposed at its planned places, in either direction and at every pass."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from daemon.planning.model import LocalPlane, Plan, PlannedLine, Point
from daemon.planning.steering import PlanTrigger
from drivers.contract import NavSample
from tests.daemon.onboard.flight.test_flight import nav as any_sample

NS = 1_000_000_000
ORIGIN = Point(48.0, 11.0)
PLANE = LocalPlane(ORIGIN)
SPEED_MPS = 60.0
Leg = tuple[tuple[float, float], tuple[float, float]]


def line(name: str, east_m: float, length_m: float = 1000.0, **about: Any) -> PlannedLine:
    """A line to the north, `east_m` from the origin."""
    start, end = PLANE.place(east_m, 0.0), PLANE.place(east_m, length_m)
    return replace(PlannedLine(name, start, end), **about)


def trigger(*lines: PlannedLine, interval_s: float = 1.0) -> PlanTrigger:
    return PlanTrigger(
        Plan("test", lines),
        distance_m=100.0,
        corridor_m=80.0,
        min_interval_ns=round(interval_s * NS),
    )


def flown(steering: PlanTrigger, legs: list[Leg]) -> list[tuple[float, float, str]]:
    """Fly straight legs (east, north) and give place and line of every exposure.

    Positions come ten times a second; the clock goes on between two legs.
    """
    taken: list[tuple[float, float, str]] = []
    now_s, last_ns = 0.0, None
    for start, end in legs:
        way = np.subtract(end, start)
        length_m = float(np.hypot(*way))
        north, east = SPEED_MPS * way[1] / length_m, SPEED_MPS * way[0] / length_m
        for k in range(int(length_m / SPEED_MPS * 10)):
            at_ns = round((now_s + k * 0.1) * NS)
            here = np.add(start, way * (k * 0.1 * SPEED_MPS / length_m))
            place = PLANE.place(*(float(value) for value in here))
            sample: NavSample = replace(
                any_sample(0.0),
                mono_ns=at_ns,
                latitude_deg=place.latitude_deg,
                longitude_deg=place.longitude_deg,
                velocity_ned_mps=(float(north), float(east), 0.0),
            )
            due_ns = steering.due(at_ns, last_ns, sample)
            if due_ns is not None and due_ns < at_ns + NS // 10:
                fired_ns = max(due_ns, at_ns)
                found = steering.line_of(fired_ns, sample)
                steering.fired(fired_ns, sample)
                last_ns = fired_ns
                on = here + np.array([east, north]) * (fired_ns - at_ns) * 1e-9
                taken.append((float(on[0]), float(on[1]), found.id if found else ""))
        now_s += length_m / SPEED_MPS + 30.0
    return taken


def norths(taken: list[tuple[float, float, str]]) -> list[float]:
    return [round(north, 1) for _, north, _ in taken]


def test_a_line_is_exposed_at_its_places_and_nowhere_else() -> None:
    taken = flown(trigger(line("7", 0.0)), [((0, -700), (0, 1700))])
    assert norths(taken) == [100.0 * k for k in range(11)]
    assert {name for _, _, name in taken} == {"7"}


def test_flown_the_other_way_the_places_are_the_same() -> None:
    taken = flown(trigger(line("7", 0.0, 950.0)), [((0, 1700), (0, -700))])
    assert norths(taken) == [100.0 * k for k in range(10, -1, -1)]


def test_waypoints_are_exposed_as_they_are_named() -> None:
    taken = flown(trigger(line("7", 0.0, at_m=(30.0, 250.0, 980.0))), [((0, -300), (0, 1500))])
    assert norths(taken) == [30.0, 250.0, 980.0]


def test_a_distance_of_the_line_goes_before_that_of_the_trigger() -> None:
    taken = flown(trigger(line("7", 0.0, distance_m=250.0)), [((0, -300), (0, 1500))])
    assert norths(taken) == [0.0, 250.0, 500.0, 750.0, 1000.0]


def test_two_lines_are_distinguished_and_the_turn_is_not_exposed() -> None:
    legs = [
        ((0.0, -300.0), (0.0, 1500.0)),
        ((0.0, 1500.0), (300.0, 1500.0)),
        ((310.0, 1500.0), (310.0, -300.0)),
    ]
    taken = flown(trigger(line("a", 0.0), line("b", 300.0)), legs)
    assert [name for _, _, name in taken] == ["a"] * 11 + ["b"] * 11


def test_a_line_flown_again_is_exposed_again() -> None:
    leg = ((0.0, -300.0), (0.0, 1500.0))
    taken = flown(trigger(line("7", 0.0)), [leg, leg])
    assert norths(taken) == [100.0 * k for k in range(11)] * 2


def test_who_joins_in_the_middle_exposes_the_rest() -> None:
    assert norths(flown(trigger(line("7", 0.0)), [((0, 451), (0, 1500))]))[0] == 500.0


@pytest.mark.parametrize("leg", [((90, -300), (90, 1500)), ((-800, 300), (800, 700))])
def test_next_to_or_across_a_line_nothing_is_exposed(leg: Leg) -> None:
    assert flown(trigger(line("7", 0.0)), [leg]) == []


def test_the_camera_is_never_triggered_faster_than_its_limit() -> None:
    taken = norths(flown(trigger(line("7", 0.0), interval_s=2.0), [((0, -300), (0, 1500))]))
    ways = np.diff(taken)
    assert min(ways) >= 2.0 * SPEED_MPS - 0.2
    # Places that were passed meanwhile by more than a quarter are left out, the others are late.
    late_m = [north - 100.0 * math.floor(north / 100.0) for north in taken]
    assert max(late_m) <= 25.0 + 0.2


def test_without_position_or_without_motion_nothing_is_due() -> None:
    steering = trigger(line("7", 0.0))
    still = replace(any_sample(0.0), velocity_ned_mps=(0.1, 0.0, 0.0))
    assert steering.due(0, None, None) is None
    assert steering.due(0, None, still) is None
    assert steering.due(0, None, replace(any_sample(0.0), fix="none")) is None
    assert steering.line_of(0, None) is None


def at(
    east_m: float, north_m: float, speed_mps: float = SPEED_MPS, course_deg: float = 0.0
) -> NavSample:
    place = PLANE.place(east_m, north_m)
    course = math.radians(course_deg)
    return replace(
        any_sample(0.0),
        mono_ns=0,
        latitude_deg=place.latitude_deg,
        longitude_deg=place.longitude_deg,
        velocity_ned_mps=(speed_mps * math.cos(course), speed_mps * math.sin(course), 0.0),
    )


@pytest.mark.parametrize(
    ("sample", "is_on"),
    [
        (at(79.9, 500.0), True),
        (at(80.1, 500.0), False),
        (at(-79.9, 500.0), True),
        (at(-80.1, 500.0), False),
        (at(0.0, 500.0, course_deg=19.9), True),
        (at(0.0, 500.0, course_deg=20.1), False),
        (at(0.0, 500.0, course_deg=199.9), True),
        (at(0.0, 500.0, speed_mps=0.99), False),
        (at(0.0, 500.0, speed_mps=1.01), True),
        (at(0.0, 1099.9), True),
        (at(0.0, 1100.1), False),
        (at(0.0, -5000.0), True),
    ],
)
def test_a_line_is_flown_within_its_corridor_and_course(sample: NavSample, is_on: bool) -> None:
    assert (trigger(line("7", 0.0)).on_line(sample) is not None) is is_on


@pytest.mark.parametrize(
    ("course_deg", "along_m", "across_m"), [(0, 400.0, 30.0), (180, 600.0, -30.0)]
)
def test_a_place_on_a_line_is_counted_in_flight_direction(
    course_deg: float, along_m: float, across_m: float
) -> None:
    here = trigger(line("7", 100.0)).on_line(at(130.0, 400.0, course_deg=course_deg))
    assert here is not None
    assert (here.along_m, here.across_m, here.length_m) == pytest.approx(
        (along_m, across_m, 1000.0), abs=1e-6
    )
    assert (here.speed_mps, here.is_reversed) == (pytest.approx(SPEED_MPS), course_deg == 180)
    assert here.along_at_m(2 * NS) == pytest.approx(along_m + 2 * SPEED_MPS)


def test_a_place_is_counted_along_and_across_an_oblique_line() -> None:
    oblique = PlannedLine("8", PLANE.place(300.0, 100.0), PLANE.place(900.0, 900.0))
    steering = trigger(line("7", -2000.0), oblique)
    course_deg = math.degrees(math.atan2(0.6, 0.8))
    for heading_change_deg, along_m, across_m in ((0.0, 400.0, 30.0), (180.0, 600.0, -30.0)):
        # 400 m from the start, and 30 m to the right of it.
        sample = at(
            300.0 + 240.0 + 24.0, 100.0 + 320.0 - 18.0, course_deg=course_deg + heading_change_deg
        )
        here = steering.on_line(sample)
        assert here is not None
        assert (here.along_m, here.across_m) == pytest.approx((along_m, across_m), abs=0.1)


@pytest.mark.parametrize(
    ("north_m", "name"), [(-49.9, "7"), (-50.1, None), (1049.9, "7"), (1050.1, None)]
)
def test_an_exposure_is_of_a_line_up_to_half_a_distance_beyond_its_ends(
    north_m: float, name: str | None
) -> None:
    found = trigger(line("7", 0.0)).line_of(0, at(0.0, north_m))
    assert (found.id if found else None) == name


@pytest.mark.parametrize(("north_m", "next_m"), [(224.9, 200.0), (225.1, 300.0)])
def test_a_place_is_exposed_late_by_a_quarter_of_the_distance_at_most(
    north_m: float, next_m: float
) -> None:
    steering = trigger(line("7", 0.0))
    due_ns = steering.due(0, None, at(0.0, north_m))
    assert due_ns == pytest.approx((next_m - north_m) / SPEED_MPS * NS, abs=1e3)


@pytest.mark.parametrize(("beyond_m", "place"), [(0.0, 0), (1e-9, 1)])
def test_a_place_is_left_behind_beyond_a_quarter_of_the_distance_only(
    beyond_m: float, place: int
) -> None:
    steering = trigger(line("7", 0.0))
    here = steering.on_line(at(0.0, 0.0))
    assert here is not None
    here = replace(here, along_m=25.0 + beyond_m)
    assert steering._follow(here, here.mono_ns)[steering._next] == 100.0 * place


@pytest.mark.parametrize(("north_m", "next_m"), [(175.1, 300.0), (174.9, 200.0)])
def test_an_exposure_counts_for_a_place_from_a_quarter_of_the_distance_on(
    north_m: float, next_m: float
) -> None:
    steering = trigger(line("7", 0.0))
    sample = at(0.0, north_m)
    steering.fired(0, sample)
    due_ns = steering.due(0, None, sample)
    assert due_ns == pytest.approx((next_m - north_m) / SPEED_MPS * NS, abs=1e3)


def test_of_lines_that_overlap_the_one_that_is_flown_goes_before_the_one_ahead() -> None:
    near, ahead = (
        line("near", 50.0),
        PlannedLine("ahead", PLANE.place(0, 600), PLANE.place(0, 1600)),
    )
    for lines in ((near, ahead), (ahead, near)):
        here = trigger(*lines).on_line(at(0.0, 500.0))
        assert here is not None and here.line.id == "near"
        here = trigger(*lines).on_line(at(0.0, 700.0))
        assert here is not None and here.line.id == "ahead"


def test_a_line_with_fewer_places_follows_one_with_more() -> None:
    steering = trigger(line("long", 0.0), line("short", 0.0, 300.0))
    flown(steering, [((0, -300), (0, 1300))])
    short = PLANE.place(0.0, 400.0), PLANE.place(0.0, 600.0)
    steering = trigger(line("long", 0.0), PlannedLine("short", *short))
    steering.add_retake(PlannedLine("short R1", *short, at_m=(50.0,)), of="long")
    assert len(flown(steering, [((0, 1300), (0, -300)), ((0, -300), (0, 1300))])) > 11
