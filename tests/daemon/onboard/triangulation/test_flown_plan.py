"""Lines of a plan that were left before their end, or begun behind their start."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.onboard.triangulation.flown_plan import missing_at_ends
from daemon.orientation.geodesy import place_at
from daemon.planning.model import PlannedLine, Point

ORIGIN = (47.0, 179.995)


def line(name: str, north_m: float = 0.0, length_m: float = 1000.0, **more) -> PlannedLine:
    start, end = (Point(*place_at(ORIGIN, east, north_m)) for east in (0.0, length_m))
    return PlannedLine(name, start, end, **more)


def missing(planned, flown: dict[str, list[float]], off_m: float = 0.0) -> dict[str, int]:
    places, names = [], []
    for k, (name, along) in enumerate(flown.items()):
        for east_m in along:
            places.append(place_at(ORIGIN, east_m, 300.0 * k + off_m))
            names.append(name)
    return missing_at_ends(planned, names, np.array(places).reshape(-1, 2))


def test_a_line_flown_from_end_to_end_misses_nothing() -> None:
    whole = [100.0 * k for k in range(11)]
    planned = [line("A"), line("B", 300.0)]
    assert missing(planned, {"A": whole, "B": whole[::-1]}, off_m=12.0) == {}
    late = [at + 40.0 for at in whole]
    assert missing([line("A", distance_m=100.0)], {"A": late}) == {}


@pytest.mark.parametrize(
    ("flown", "count"),
    [(range(10), 1), (range(8), 3), (range(2, 11), 2), (range(3, 8), 6), ([5], 10)],
)
def test_planned_exposures_without_image_are_counted_at_both_ends(flown, count) -> None:
    along = [100.0 * k for k in flown]
    assert missing([line("A", distance_m=100.0)], {"A": along}) == {"A": count}


def test_without_a_planned_distance_the_spacing_is_that_of_the_images() -> None:
    planned = [line("A"), line("B", 300.0)]
    whole = [100.0 * k for k in range(11)]
    assert missing(planned, {"A": whole[:8], "B": whole}) == {"A": 3}
    assert missing(planned, {"A": whole, "B": [0.0]}) == {"B": 10}
    assert missing([line("A")], {"A": [0.0]}) == {"A": 1}


def test_planned_places_count_where_the_plan_has_them() -> None:
    planned = [line("A", at_m=(0.0, 100.0, 400.0, 900.0))]
    assert missing(planned, {"A": [0.0, 100.0, 400.0]}) == {"A": 1}
    assert missing(planned, {"A": [0.0, 100.0, 400.0, 900.0]}) == {}


def test_a_line_without_image_is_not_counted_here() -> None:
    assert missing([line("A"), line("B", 300.0)], {"A": [100.0 * k for k in range(11)]}) == {}
