"""Points of a strip and the images that see them, counted on rectangles laid out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from daemon.planning.image_counts import (
    Array,
    ExposureFootprint,
    LineStrip,
    StripCoverage,
    count_images,
    gaps_of,
    image_shares,
    is_inside,
    project_footprints,
    strip_of,
)
from daemon.planning.model import LocalPlane, PlannedLine, Point
from daemon.planning.reflight_planning import _exposures, _images_at, _runs
from processing.quality.valid_area import ValidArea

PLANE = LocalPlane(Point(47.0, 15.0))
LINE = PlannedLine("1", PLANE.place(0.0, 0.0), PLANE.place(0.0, 100.0))


def strip(half_width_m: float = 20.0, image_along_m: float = 40.0) -> LineStrip:
    """Northwards: `along` is north, left is west."""
    strip_made = strip_of(LINE, PLANE, half_width_m=half_width_m, image_along_m=image_along_m)
    assert strip_made is not None
    return strip_made


def box(west: float, south: float, east: float, north: float) -> tuple[Point, ...]:
    """A footprint: left and right behind, right and left ahead."""
    corners = ((west, south), (east, south), (east, north), (west, north))
    return tuple(PLANE.place(*corner) for corner in corners)


def seen_of(one: ExposureFootprint, over: LineStrip) -> list[StripCoverage]:
    return list(project_footprints(PLANE, [one]).seen(over))


def points_of(one: ExposureFootprint, over: LineStrip) -> set[tuple[int, int]]:
    """North and east of the points seen, whole metres."""
    found = set()
    for seen in seen_of(one, over):
        along, across = over.along[seen.where[0]], over.across[seen.where[1]]
        for i, j in np.argwhere(seen.inside):
            found.add((round(along[i]), round(-across[j])))
    return found


@pytest.mark.parametrize(
    ("half_width_m", "image_along_m", "step_m", "rows", "columns"),
    [
        (20.0, 40.0, 2.0, 51, 21),
        (20.0, 512.0, 2.0, 51, 21),
        (20.0, 1024.0, 4.0, 26, 11),
        (8.0, 40.0, 2.0, 51, 9),
        (1.0, 40.0, 2.0, 51, 9),
        (9.0, 40.0, 2.0, 51, 10),
    ],
)
def test_a_strip_has_points_every_2_m_or_256_to_an_image(
    half_width_m: float, image_along_m: float, step_m: float, rows: int, columns: int
) -> None:
    strip_made = strip(half_width_m, image_along_m)
    assert (len(strip_made.along), len(strip_made.across)) == (rows, columns)
    assert (strip_made.along[0], strip_made.along[1], strip_made.along[-1]) == (
        0.0,
        step_m,
        step_m * (rows - 1),
    )
    assert (strip_made.across[0], strip_made.across[-1]) == (-half_width_m, half_width_m)
    assert strip_made.cell_m == (step_m, pytest.approx(2 * half_width_m / (columns - 1)))
    assert strip_made.length_m == pytest.approx(100.0)


def test_the_points_of_a_strip_lie_ahead_and_to_the_left() -> None:
    strip_made = strip()
    assert strip_made.points.shape == (51, 21, 2)
    assert strip_made.points[0, 0] == pytest.approx((20.0, 0.0), abs=1e-6)
    assert strip_made.points[50, 20] == pytest.approx((-20.0, 100.0), abs=1e-6)
    assert strip_made.place(30.0, 5.0) == pytest.approx((-5.0, 30.0), abs=1e-6)
    assert strip_made.left == pytest.approx((-1.0, 0.0), abs=1e-9)
    still = PlannedLine("1", PLANE.place(0.0, 0.0), PLANE.place(0.0, 0.0))
    assert strip_of(still, PLANE, half_width_m=1.0, image_along_m=1.0) is None


def test_relief_is_queried_at_the_places_of_the_points() -> None:
    requested: list[Array] = []

    def relief(places: Array) -> Array:
        requested.append(places)
        return np.zeros(places.shape[:2])

    strip_made = strip_of(LINE, PLANE, half_width_m=20.0, image_along_m=40.0, relief=relief)
    assert (
        strip_made is not None
        and strip_made.relief_m is not None
        and strip_made.relief_m.shape == (51, 21)
    )
    for row, column in ((0, 0), (50, 20), (13, 7)):
        expected = PLANE.place(*strip_made.points[row, column])
        # A millimetre: places between the corners are interpolated.
        assert requested[0][row, column] == pytest.approx(tuple(expected), abs=1e-8)


@pytest.mark.parametrize(
    ("west", "south", "east", "north"),
    [
        (-9, 11, 9, 31),
        (-30, -15, 30, 9),
        (3, 91, 30, 130),
        (-30, -30, -11, 130),
        (-50, -50, 50, 150),
        (-1, 49, 1, 51),
    ],
)
def test_an_image_sees_the_points_within_its_footprint(
    west: float, south: float, east: float, north: float
) -> None:
    expected = {
        (n, e)
        for n in range(0, 101, 2)
        for e in range(-20, 21, 2)
        if south <= n <= north and west <= e <= east
    }
    assert points_of(ExposureFootprint(1, box(west, south, east, north)), strip()) == expected


@pytest.mark.parametrize(
    ("footprint", "is_near"),
    [
        ((-10, -30, 10, -0.5), False),
        ((-10, -30, 10, 0.5), True),
        ((-10, 100.5, 10, 120), False),
        ((-10, 99.5, 10, 120), True),
        ((20.5, 10, 40, 30), False),
        ((19.5, 10, 40, 30), True),
        ((-40, 10, -20.5, 30), False),
        ((-40, 10, -19.5, 30), True),
    ],
)
def test_an_image_next_to_a_strip_is_not_evaluated(
    footprint: tuple[float, float, float, float], is_near: bool
) -> None:
    one = ExposureFootprint(1, box(*footprint))
    assert (
        project_footprints(PLANE, [ExposureFootprint(7, ()), one]).near(strip()) == (one,)
    ) is is_near


def test_relief_carries_ground_out_of_an_image_and_another_into_it() -> None:
    """Ground 50 m high under a camera at 100 m is seen where level ground twice as far out is."""
    high = replace(strip(), relief_m=np.full((51, 21), 50.0))
    projection_centre = (PLANE.place(0.0, 50.0), 100.0)
    one = ExposureFootprint(1, box(-21, 29, 21, 71), projection_centre=projection_centre)
    expected = {
        (n, e)
        for n in range(0, 101, 2)
        for e in range(-20, 21, 2)
        if abs(2 * (n - 50)) <= 21 and abs(2 * e) <= 21
    }
    assert points_of(one, high) == expected
    deep = replace(strip(), relief_m=np.full((51, 21), -100.0))
    beyond = {(n, e) for n in range(8, 93, 2) for e in range(-20, 21, 2)}
    assert points_of(one, deep) == beyond, "half as far out"
    assert points_of(replace(one, projection_centre=None), high) == points_of(one, strip())


def test_images_and_their_gaps_are_counted_by_band() -> None:
    over = strip()
    halves = ValidArea(4, 2, {"pan": ((0, 0, 4, 1),), "red": ((0, 0, 1, 2),)})
    full = ExposureFootprint(1, box(-50, -50, 50, 150))
    part = ExposureFootprint(2, box(-19, 21, 19, 61), area=halves)
    seen = list(project_footprints(PLANE, [full, part]).seen(over))
    inside, gaps = count_images(over, seen)
    rows, columns = over.along, -over.across
    within = (rows[:, None] > 21) & (rows[:, None] < 61) & (np.abs(columns) < 19)
    assert np.array_equal(inside, 1 + within)
    # The upper row of cells is the half ahead, the first of four columns the western quarter.
    assert np.array_equal(gaps["pan"], within & (rows > 41)[:, None])
    assert np.array_equal(gaps["red"], within & (columns < -9.5))
    assert set(gaps) == {"pan", "red"}


def test_shares_run_from_the_top_left_of_the_image() -> None:
    corners = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 20.0], [0.0, 20.0]])
    points = np.array([[0.0, 20.0], [40.0, 20.0], [10.0, 5.0], [60.0, -5.0]])
    expected = np.array([[0.0, 0.0], [1.0, 0.0], [0.25, 0.75], [1.5, 1.25]])
    assert image_shares(corners, points) == pytest.approx(expected)
    assert is_inside(expected).tolist() == [True, True, True, False]
    assert is_inside(
        np.array([[0.0, 1.0], [1.0, 0.0], [-1e-6, 0.5], [0.5, 1.000001]])
    ).tolist() == [*(True, True, False, False)]
    assert np.isnan(image_shares(np.zeros((4, 2)), points)).all()


def test_shares_of_a_tilted_image_are_those_of_its_collinear_rays() -> None:
    """Rays (u, v, 1), tilted ahead by 30 degrees about the camera at 100 m."""
    c, s = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))

    def ground(u: float, v: float) -> tuple[float, float]:
        x, y = u - 0.5, 0.5 - v
        down = c - y * s
        return 100.0 * x / down, 100.0 * (s + y * c) / down

    corners = np.array([ground(0, 1), ground(1, 1), ground(1, 0), ground(0, 0)])
    shares = np.array([[0.3, 0.2], [0.9, 0.7], [0.5, 0.5]])
    points = np.array([ground(*share) for share in shares])
    assert image_shares(corners, points) == pytest.approx(shares, abs=1e-9)
    assert np.isnan(image_shares(corners, np.array([[0.0, -500.0]]))).all(), "behind the camera"


def test_the_cells_of_gaps_run_across_and_down() -> None:
    area = ValidArea(4, 2, {"red": ((3, 1, 4, 2),)})
    shares = np.array([[0.99, 0.99], [0.99, 0.49], [0.74, 0.99], [1.0, 1.0], [np.nan, np.nan]])
    gaps = gaps_of(area, shares, np.array([True, True, True, True, False]))
    assert {band: flags.tolist() for band, flags in gaps.items()} == {
        "red": [True, False, False, True, False]
    }
    assert gaps_of(None, shares, np.ones(5, np.bool_)) == {}
    assert gaps_of(ValidArea(4, 2, {}), shares, np.ones(5, np.bool_)) == {}


def test_images_at_stations_see_half_an_image_less_a_margin_to_each_side() -> None:
    stations = np.array([0.0, 40.0, 80.0])
    along = np.array([0.0, 49.5, 49.6, 49.7, 30.3, 30.4, 40.0, 129.6, 129.7, -49.6])
    counts = _images_at(along, stations, 100.0)
    assert counts.tolist() == [2, 3, 3, 2, 2, 3, 3, 1, 0, 1]
    assert _images_at(np.array([50.0, 50.1]), stations, 100.0, margin_m=0.0).tolist() == [3, 2]


def test_runs_and_numbers_in_words() -> None:
    flags = np.array([True, True, False, True, False, False, True])
    assert _runs(flags) == [(0, 1), (3, 3), (6, 6)]
    assert _exposures([5]) == "exposure 5"
    assert _exposures([5, 4, 9, 3, 5]) == "exposures 3 to 5, 9"
    assert _exposures([1, 3]) == "exposures 1, 3"
