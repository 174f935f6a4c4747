"""Guidance agrees with geodesics of PROJ and with hand-computed turns, times and limits."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pyproj
import pytest

from daemon.planning.guidance import (
    Guidance,
    GuidanceLimits,
    exceeded,
    guide,
    limits_of,
    turn_deg,
)
from daemon.planning.model import LocalPlane, PlannedLine, Point, Specification
from tests.daemon.onboard.flight.test_flight import nav as any_sample

GEOD = pyproj.Geod(ellps="WGS84")
START = Point(48.0, 11.0)
LIMITS = GuidanceLimits(50.0, below_m=30.0, above_m=60.0)


def line(course_deg: float = 0.0, length_m: float = 3000.0, name: str = "A1") -> PlannedLine:
    longitude, latitude, _ = GEOD.fwd(START[1], START[0], course_deg, length_m)
    return PlannedLine(name, START, Point(latitude, longitude))


def guidance(
    of: PlannedLine, at: tuple[float, float], *, track_deg: float = 0.0, **about: Any
) -> Guidance:
    velocity = (60 * math.cos(math.radians(track_deg)), 60 * math.sin(math.radians(track_deg)), 0.0)
    sample = replace(
        any_sample(0.0), latitude_deg=at[0], longitude_deg=at[1], velocity_ned_mps=velocity,
        height_m=about.pop("height_m", 1000.0), heading_rad=about.pop("heading_rad", None),
        roll_rad=math.radians(about.pop("roll_deg", 0.0)),
    )  # fmt: skip
    given = {"is_reversed": False, "places_m": (), "planned_height_m": 1000.0, "limits": LIMITS}
    found = guide(of, sample, **(given | about))
    assert found is not None
    return found


def nearest_on_geodesic(of: PlannedLine, at: tuple[float, float]) -> tuple[float, float]:
    """Distance along and across by search along the geodesic: another method than the plane's."""
    azimuth, _, length_m = GEOD.inv(of.start[1], of.start[0], of.end[1], of.end[0])
    low, high = -length_m, 2 * length_m
    for _ in range(60):
        thirds = (2 * low + high) / 3, (low + 2 * high) / 3
        distances = []
        for along_m in thirds:
            longitude, latitude, _ = GEOD.fwd(of.start[1], of.start[0], azimuth, along_m)
            distances.append(GEOD.inv(longitude, latitude, at[1], at[0])[2])
        low, high = (low, thirds[1]) if distances[0] < distances[1] else (thirds[0], high)
    longitude, latitude, _ = GEOD.fwd(of.start[1], of.start[0], azimuth, low)
    return low, GEOD.inv(longitude, latitude, at[1], at[0])[2]


@pytest.mark.parametrize("course_deg", [0.0, 37.0, 123.0, 270.0])
@pytest.mark.parametrize("length_m", [800.0, 20_000.0])
def test_along_and_across_agree_with_a_search_on_the_geodesic(
    course_deg: float, length_m: float
) -> None:
    planned = line(course_deg, length_m)
    random = np.random.default_rng(4)
    for along, across in random.uniform((-0.2, -400.0), (1.2, 400.0), (8, 2)):
        longitude, latitude, azimuth = GEOD.fwd(START[1], START[0], course_deg, along * length_m)
        heading = azimuth + 270.0
        longitude, latitude, _ = GEOD.fwd(longitude, latitude, heading, across)
        found = guidance(planned, (latitude, longitude), track_deg=course_deg)
        peer_along, peer_across = nearest_on_geodesic(planned, (latitude, longitude))
        assert found.along_m == pytest.approx(peer_along, abs=0.05)
        assert abs(found.across_m) == pytest.approx(peer_across, abs=0.05)


def test_right_of_the_line_is_positive_in_either_direction() -> None:
    plane = LocalPlane(START)
    east = plane.place(30.0, 1000.0)
    north = guidance(line(), tuple(east))
    south = guidance(line(), tuple(east), is_reversed=True, track_deg=180.0)
    assert north.across_m == pytest.approx(30.0, abs=0.01)
    assert south.across_m == pytest.approx(-30.0, abs=0.01)
    assert north.to_end_m == pytest.approx(2000.0, abs=0.01)
    assert south.to_end_m == pytest.approx(1000.0, abs=0.01)
    assert (north.course_deg, round(south.course_deg)) == (0.0, 180)


def test_times_distances_countdown_and_crab() -> None:
    plane = LocalPlane(START)
    at = tuple(plane.place(0.0, 600.0))
    found = guidance(line(), at, heading_rad=math.radians(5.0), places_m=(0.0, 500.0, 1000.0))
    assert found.stage == "line"
    assert found.to_end_s == pytest.approx(40.0, abs=0.01)
    assert found.next_exposure_m == pytest.approx(400.0, abs=0.01)
    assert found.next_exposure_s == pytest.approx(400 / 60, abs=0.01)
    assert found.exposures_left == 1
    assert found.crab_deg == pytest.approx(5.0)
    before = guidance(line(), tuple(plane.place(0.0, -1200.0)))
    assert (before.stage, round(before.to_start_s or 0, 2)) == ("approach", 20.0)
    away = guidance(line(), at, track_deg=180.0)
    assert (away.to_end_s, away.next_exposure_s) == (None, None)


def test_a_deviation_is_expected_before_the_next_exposure() -> None:
    plane = LocalPlane(START)
    at = tuple(plane.place(20.0, 600.0))
    straight = guidance(line(), at, places_m=(900.0,))
    drifting = guidance(line(), at, places_m=(900.0,), track_deg=8.0)
    assert straight.exceeded == ()
    assert drifting.across_m == pytest.approx(20.0, abs=0.01)
    assert drifting.across_ahead_m == pytest.approx(
        20.0 + 300 * math.tan(math.radians(8.0)), abs=0.1
    )
    assert drifting.exceeded == ("across",)


def test_the_track_of_a_turn_onto_a_line_predicts_no_deviation() -> None:
    """Nor does the bank of a correction on the line hide one."""
    plane = LocalPlane(START)
    before, on_it = (tuple(plane.place(-20.0, north_m)) for north_m in (-600.0, 600.0))
    turning = {"track_deg": 15.0, "places_m": (0.0, 900.0)}
    assert guidance(line(), before, roll_deg=4.0, **turning).exceeded == ("across",)
    for roll_deg in (6.0, -20.0):
        found = guidance(line(), before, roll_deg=roll_deg, **turning)
        assert found.across_ahead_m == found.across_m == pytest.approx(-20.0, abs=0.01)
        assert found.exceeded == ()
        far = tuple(plane.place(-60.0, -600.0))
        assert guidance(line(), far, roll_deg=roll_deg, **turning).exceeded == ("across",)
        assert guidance(line(), on_it, roll_deg=roll_deg, **turning).exceeded == ("across",)


@pytest.mark.parametrize(
    ("across_m", "ahead_m", "height_m", "expected"),
    [
        (50.0, 50.0, 60.0, ()),
        (50.1, 0.0, 0.0, ("across",)),
        (0.0, -50.1, 0.0, ("across",)),
        (0.0, 0.0, -30.0, ()),
        (0.0, 0.0, -30.1, ("height",)),
        (0.0, 0.0, 60.1, ("height",)),
        (-60.0, 0.0, -40.0, ("across", "height")),
        (0.0, 0.0, None, ()),
    ],
)
def test_limits_hold_up_to_their_value(
    across_m: float, ahead_m: float, height_m: float | None, expected: tuple[str, ...]
) -> None:
    assert exceeded(across_m, ahead_m, height_m, LIMITS) == expected


def test_limits_keep_the_overlap_that_the_plan_tolerates() -> None:
    asked = Specification(forward_overlap=0.8, sidelap=0.3, overlap_tolerance=0.1, gsd_m=0.06)
    limits = limits_of(
        asked, image_across_m=1000.0, height_above_ground_m=800.0, gsd_m=0.05, corridor_m=250.0
    )
    assert limits.across_m == pytest.approx(100.0)
    # At the lower limit the sidelap is what is tolerated: 0.3 - 0.1.
    assert limits.below_m is not None
    assert 1 - 0.7 / (1 - limits.below_m / 800.0) == pytest.approx(0.2)
    assert limits.above_m == pytest.approx(800.0 * (0.06 / 0.05 - 1))
    narrow = limits_of(
        asked, image_across_m=1000.0, height_above_ground_m=800.0, gsd_m=0.05, corridor_m=60.0,
        height_tolerance_m=12.0,
    )  # fmt: skip
    assert narrow == GuidanceLimits(60.0, 12.0, 12.0)


def test_the_turn_onto_the_next_line() -> None:
    plane = LocalPlane(START)
    east = PlannedLine("A2", plane.place(500.0, 0.0), plane.place(500.0, 3000.0))
    right = guidance(line(), START, next_line=(east, True)).turn
    assert right is not None
    assert (right.side, round(right.angle_deg), round(right.to_start_m)) == ("right", 180, 500)
    west = PlannedLine("A3", plane.place(-500.0, 3000.0), plane.place(-500.0, 0.0))
    left = guidance(line(), START, next_line=(west, False)).turn
    assert left is not None
    assert (left.side, round(left.to_start_m)) == ("left", 500)


def test_turns_are_shortest() -> None:
    assert [turn_deg(10.0, 350.0), turn_deg(350.0, 10.0), turn_deg(90.0, 270.0)] == [-20, 20, -180]


def test_without_a_position_or_a_length_there_is_no_guidance() -> None:
    point = PlannedLine("P", START, START)
    assert guide(
        point, any_sample(0.0), is_reversed=False, places_m=(0.0,), planned_height_m=None,
        limits=LIMITS,
    ) is None  # fmt: skip
    lost = replace(any_sample(0.0), latitude_deg=None)
    assert guide(
        line(), lost, is_reversed=False, places_m=(), planned_height_m=None, limits=LIMITS
    ) is None  # fmt: skip


def test_without_velocity_height_or_heading_their_figures_are_absent() -> None:
    sample = replace(any_sample(0.0), velocity_ned_mps=None, height_m=None, heading_rad=None)
    found = guide(
        line(), sample, is_reversed=False, places_m=(100.0,), planned_height_m=None, limits=LIMITS
    )
    assert found is not None
    absent = ("height_deviation_m", "to_start_s", "track_deg", "crab_deg", "next_exposure_s")
    assert [getattr(found, name) for name in absent] == [None] * 5
