"""Reflights are exactly those of a brute-force search over the ground.

The brute force shares nothing with the advisor: it counts, for single points of the ground, the
images that see them, by crossing numbers in longitude and latitude.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from daemon.planning.model import LocalPlane, Plan, PlannedLine, Point, Specification
from daemon.planning.reflight_planning import STEP_M, ExposureFootprint, reflights

ORIGIN = Point(47.07, 15.43)
PLANE = LocalPlane(ORIGIN)
ALONG_M, ACROSS_M = 500.0, 750.0
SPECIFICATION = Specification(forward_overlap=0.6, sidelap=0.3)
BASE_M = ALONG_M * 0.4
LINE_M = 2000.0


def block(lines: int = 3, heading_deg: float = 30.0) -> Plan:
    """Parallel lines, every other one flown the other way."""
    ahead, left = axes(heading_deg)
    spacing_m = ACROSS_M * 0.7
    planned = []
    for i in range(lines):
        a = -left * i * spacing_m
        b = a + ahead * LINE_M
        start, end = (a, b) if i % 2 == 0 else (b, a)
        planned.append(PlannedLine(f"{i + 1}", PLANE.place(*start), PLANE.place(*end)))
    return Plan("block", tuple(planned), SPECIFICATION)


def axes(heading_deg: float) -> tuple[np.ndarray, np.ndarray]:
    angle = math.radians(heading_deg)
    ahead = np.array([math.sin(angle), math.cos(angle)])
    return ahead, np.array([-ahead[1], ahead[0]])


def fly(plan: Plan, seed: int = 1, wander_m: float = 5.0) -> list[ExposureFootprint]:
    """All planned stations, with the small errors of a real flight and a little more image."""
    random = np.random.default_rng(seed)
    taken: list[ExposureFootprint] = []
    for line in plan.lines:
        start, end = np.array(PLANE.flat(line.start)), np.array(PLANE.flat(line.end))
        ahead = (end - start) / LINE_M
        for station in np.arange(0.0, LINE_M + 1, BASE_M):
            centre = start + ahead * station + random.normal(0, wander_m, 2)
            rotation = random.normal(0, math.radians(0.5))
            taken.append(
                ExposureFootprint(len(taken) + 1, footprint(centre, ahead, rotation, grown=1.06))
            )
    return taken


def footprint(
    centre: np.ndarray, ahead: np.ndarray, rotation: float = 0.0, grown: float = 1.0
) -> tuple[Point, ...]:
    c, s = math.cos(rotation), math.sin(rotation)
    a = np.array([c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]])
    left = np.array([-a[1], a[0]])
    x, y = ALONG_M / 2 * grown, ACROSS_M / 2 * grown
    corners = [centre + a * u * x + left * v * y for u, v in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return tuple(PLANE.place(*corner) for corner in corners)


def is_seen(point: Point, corners: tuple[Point, ...]) -> bool:
    """By crossing number."""
    inside = False
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        if (a.latitude_deg > point.latitude_deg) != (b.latitude_deg > point.latitude_deg):
            share = (point.latitude_deg - a.latitude_deg) / (b.latitude_deg - a.latitude_deg)
            if point.longitude_deg < a.longitude_deg + share * (b.longitude_deg - a.longitude_deg):
                inside = not inside
    return inside


def brute_force(plan: Plan, taken: list[ExposureFootprint]) -> dict[str, list[tuple[float, float]]]:
    """Stations of each line between which some point of its strip is seen too rarely."""
    counting = [one for one in taken if not one.exclusion_reason]
    found: dict[str, list[tuple[float, float]]] = {}
    half_m = ACROSS_M * (1 - SPECIFICATION.sidelap) / 2
    for line in plan.lines:
        start, end = np.array(PLANE.flat(line.start)), np.array(PLANE.flat(line.end))
        ahead = (end - start) / LINE_M
        left = np.array([-ahead[1], ahead[0]])
        bad = set()
        for along in np.arange(0.0, LINE_M + 1, 4.0):
            planned = sum(
                abs(along - s) <= ALONG_M / 2 - STEP_M for s in np.arange(0, LINE_M + 1, BASE_M)
            )
            for across in np.linspace(-half_m, half_m, 9):
                point = PLANE.place(*(start + ahead * along + left * across))
                if sum(is_seen(point, one.corners) for one in counting) < min(planned, 2):
                    bad.add(min(int(along // BASE_M), int(LINE_M // BASE_M) - 1))
        for cell in sorted(bad):
            spans = found.setdefault(line.id, [])
            a, b = cell * BASE_M, (cell + 1) * BASE_M
            if spans and spans[-1][1] >= a:
                spans[-1] = (spans[-1][0], b)
            else:
                spans.append((a, b))
    return found


def advised(plan: Plan, taken: list[ExposureFootprint]) -> dict[str, list[tuple[float, float]]]:
    found: dict[str, list[tuple[float, float]]] = {}
    advice = reflights(plan, taken, image_along_m=ALONG_M, image_across_m=ACROSS_M)
    for one in advice.segments:
        found.setdefault(one.line.id, []).append((one.from_m, one.to_m))
    return found


def test_a_block_flown_as_planned_needs_nothing() -> None:
    plan = block()
    advice = reflights(plan, fly(plan), image_along_m=ALONG_M, image_across_m=ACROSS_M)
    assert advice.is_complete
    assert advice.covered_m == pytest.approx(advice.planned_m)
    assert advice.planned_m == pytest.approx(3 * LINE_M, abs=1.0)


@pytest.mark.parametrize("seed", range(4))
def test_planted_gaps_blur_and_cloud_are_named_exactly(seed: int) -> None:
    plan = block()
    taken = fly(plan, seed)
    random = np.random.default_rng(100 + seed)
    gap = int(random.integers(2, 8))
    del taken[gap : gap + 2]  # two triggers lost on the first line
    blurred, clouded = int(random.integers(14, 18)), int(random.integers(24, 28))
    taken[blurred] = replace(taken[blurred], exclusion_reason="refly (BLUR)")
    taken[clouded] = replace(taken[clouded], exclusion_reason="refly (TIE_POINTS)")
    expected = brute_force(plan, taken)
    assert expected  # something was planted
    found = advised(plan, taken)
    assert found.keys() == expected.keys()
    for line, spans in expected.items():
        assert np.array(found[line]) == pytest.approx(np.array(spans), abs=1e-6), line


def test_the_reasons_name_the_exposures() -> None:
    plan = block(1)
    taken = fly(plan)
    taken[4] = replace(taken[4], exclusion_reason="refly (BLUR)")
    advice = reflights(plan, taken, image_along_m=ALONG_M, image_across_m=ACROSS_M)
    (segment,) = advice.segments
    assert segment.reasons == ("exposure 5: refly (BLUR)",)
    assert segment.from_m <= 4 * BASE_M <= segment.to_m
    start = np.array(PLANE.flat(segment.start)) - np.array(PLANE.flat(plan.lines[0].start))
    assert float(np.hypot(*start)) == pytest.approx(segment.from_m, abs=0.01)


@pytest.mark.parametrize("index", [0, 5, -1])
def test_an_exposure_without_a_place_is_named_next_to_those_that_touch_the_hole(index: int) -> None:
    plan = block(1)
    taken = fly(plan)
    number = taken[index].number
    taken[index] = ExposureFootprint(number, (), exclusion_reason="no position")
    (segment,) = reflights(plan, taken, image_along_m=ALONG_M, image_across_m=ACROSS_M).segments
    assert segment.reasons == (f"exposure {number}: no position",)


def test_a_hole_has_the_same_area_at_either_edge_of_a_strip() -> None:
    plan = block(1)
    ahead, left = axes(30.0)
    areas_m2 = []
    for shift_m in (-0.2 * ACROSS_M, 0.2 * ACROSS_M):
        taken = [
            ExposureFootprint(number, footprint(ahead * station_m + left * shift_m, ahead))
            for number, station_m in enumerate(np.arange(0.0, LINE_M + 1, BASE_M), 1)
        ]
        advice = reflights(plan, taken, image_along_m=ALONG_M, image_across_m=ACROSS_M)
        areas_m2.append(advice.hole_m2)
    # The strip is 0.7 images wide; of its half, 0.05 images are not seen.
    assert areas_m2[0] == pytest.approx(0.05 * ACROSS_M * LINE_M, rel=0.05)
    assert areas_m2[1] == pytest.approx(areas_m2[0], rel=1e-3)


def test_a_line_flown_off_its_place_is_flown_again_entirely() -> None:
    plan = block(1)
    _, left = axes(30.0)
    neighbours = [
        ExposureFootprint(
            one.number,
            tuple(
                PLANE.place(*(np.array(PLANE.flat(c)) + left * 0.4 * ACROSS_M)) for c in one.corners
            ),
        )
        for one in fly(plan)
    ]
    assert advised(plan, neighbours) == {"1": [(0.0, pytest.approx(LINE_M))]}


def test_a_line_that_was_never_flown_is_flown_completely() -> None:
    plan = block(2)
    only_first = [one for one in fly(plan) if one.number <= 11]
    assert advised(plan, only_first)["2"] == [(0.0, pytest.approx(LINE_M))]


def test_only_lines_for_which_something_changed_are_evaluated_again():
    plan = block(lines=2)
    first, second = (line.id for line in plan.lines)
    taken, known = fly(plan), {}

    def find_reflights(unflown, exposures=taken):
        reflights(
            plan,
            exposures,
            image_along_m=ALONG_M,
            image_across_m=ACROSS_M,
            unflown=unflown,
            known=known,
        )
        return dict(known)

    def unchanged(before, after):
        return {line for line in after if after[line] is before.get(line)}

    begun = find_reflights({first: (100.0, 300.0)})
    assert set(begun) == {first, second}
    equal = find_reflights({first: tuple(map(float, (100, 300)))})
    assert unchanged(begun, equal) == {first, second}
    moved = find_reflights({first: (100.0, 400.0)})
    assert unchanged(equal, moved) == {second}
    flown = find_reflights({})
    assert unchanged(moved, flown) == {second}
    unplaced = find_reflights({}, [*taken, ExposureFootprint(len(taken) + 1, ())])
    assert unchanged(flown, unplaced) == set()


@pytest.mark.trust
@pytest.mark.parametrize("image_m", [0.4, 3.0, 30.0])
def test_images_of_a_few_metres_are_required_like_large_ones(image_m):
    end = PLANE.place(0.0, 20 * image_m)
    plan = Plan("small", (PlannedLine("1", PLANE.place(0.0, 0.0), end),), SPECIFICATION)

    def find_reflights(taken):
        return reflights(plan, taken, image_along_m=image_m, image_across_m=1.5 * image_m)

    def square(number, at_m):
        corners = ((-0.75, -0.5), (0.75, -0.5), (0.75, 0.5), (-0.75, 0.5))
        return ExposureFootprint(
            number, tuple(PLANE.place(x * image_m, at_m + y * image_m) for x, y in corners)
        )

    flown = [square(k + 1, at) for k, at in enumerate(np.arange(0, 20.1, 0.4) * image_m)]
    assert find_reflights(flown).is_complete
    assert find_reflights([]).segments[0].length_m == pytest.approx(20 * image_m)
    assert find_reflights([]).covered_m == 0.0
    gap = [one for one in flown if not 20 <= one.number <= 22]
    (segment,) = find_reflights(gap).segments
    assert segment.from_m <= 7.7 * image_m and segment.to_m >= 8.3 * image_m
    assert segment.length_m < 5 * image_m


def area_of(corners: tuple[Point, ...]) -> float:
    """By the shoelace formula, square metres."""
    x, y = np.array([PLANE.flat(corner) for corner in corners]).T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


@pytest.mark.parametrize("length_m", [LINE_M, LINE_M + 0.3 * STEP_M, LINE_M + 0.6 * STEP_M])
@pytest.mark.parametrize("lost", [slice(0, 2), slice(-2, None), slice(4, 6), slice(None)])
def test_a_hole_has_the_area_of_its_rings_and_ends_with_its_line(
    length_m: float, lost: slice
) -> None:
    ahead, _ = axes(30.0)
    line = PlannedLine("1", PLANE.place(0.0, 0.0), PLANE.place(*(ahead * length_m)))
    taken = [
        ExposureFootprint(number, footprint(ahead * station_m, ahead))
        for number, station_m in enumerate(np.arange(0.0, length_m + BASE_M, BASE_M), 1)
    ]
    whole = len(range(len(taken))[lost]) == len(taken)
    taken[lost] = [replace(one, exclusion_reason="refly (BLUR)") for one in taken[lost]]
    plan = Plan("block", (line,), SPECIFICATION)
    (segment,) = reflights(plan, taken, image_along_m=ALONG_M, image_across_m=ACROSS_M).segments
    rings_m2 = sum(area_of(ring) for hole in segment.holes for ring in hole.rings)
    assert segment.area_m2 == pytest.approx(rings_m2, rel=1e-6)
    if whole:
        # No point of the line is seen: the hole is its whole strip, up to the last planned image.
        assert segment.area_m2 == pytest.approx(0.7 * ACROSS_M * length_m, rel=1e-3)
