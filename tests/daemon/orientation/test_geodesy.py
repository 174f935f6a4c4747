"""Geodesy against published examples, and against the emulator's own formulas."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.orientation.geodesy import (
    ECEF_FROM_GEODETIC,
    ELLIPSOID,
    east_north_m,
    metres_per_degree,
    place_at,
    utm_of,
)
from daemon.orientation.local_frame import LocalFrame, enu_axes
from daemon.planning.model import LocalPlane, Point
from sim_hw.world import ellipsoid

# IOGP guidance note 7-2, examples of the methods 9602 and 9837.
PLACE_DEG = (53 + 48 / 60 + 33.820 / 3600, 2 + 7 / 60 + 46.380 / 3600)
HEIGHT_M = 73.0
GEOCENTRIC_M = (3_771_793.968, 140_253.342, 5_124_304.349)
TOPOCENTRIC_M = (-189_013.869, -128_642.040, -4_220.171)


def test_geocentric_coordinates_are_those_of_the_guidance_note() -> None:
    found = ECEF_FROM_GEODETIC.transform(PLACE_DEG[1], PLACE_DEG[0], HEIGHT_M)
    assert found == pytest.approx(GEOCENTRIC_M, abs=1e-3)
    back = ECEF_FROM_GEODETIC.transform(*GEOCENTRIC_M, direction="INVERSE")
    assert back[:2] == pytest.approx((PLACE_DEG[1], PLACE_DEG[0]), abs=1e-8)
    assert back[2] == pytest.approx(HEIGHT_M, abs=2e-3)


def test_topocentric_coordinates_are_those_of_the_guidance_note() -> None:
    # The example's origin is 200 m above the ellipsoid, that of the frame on it.
    frame = LocalFrame(55.0, 5.0)
    found = frame.from_geodetic(*(np.array(v) for v in (*PLACE_DEG, HEIGHT_M)))
    assert found - [0.0, 0.0, 200.0] == pytest.approx(TOPOCENTRIC_M, abs=1e-3)
    back = frame.to_geodetic(found)
    assert back == pytest.approx([*PLACE_DEG, HEIGHT_M], abs=1e-8)


def test_geodesics_are_those_of_the_documentation_of_geographiclib() -> None:
    wellington, salamanca = (-41.32, 174.81), (40.96, -5.50)
    assert math.hypot(*east_north_m(wellington, salamanca)) == pytest.approx(19_959_679.267)
    southwest_m = 20_000e3 * math.sqrt(0.5)
    assert place_at((-32.06, 115.74), -southwest_m, -southwest_m) == pytest.approx(
        (32.11195529, -63.95925278), abs=1e-8
    )


@given(st.floats(-85, 85), st.floats(-180, 180), st.floats(-5e4, 5e4), st.floats(-5e4, 5e4))
def test_the_plane_about_an_origin_has_an_inverse(
    latitude: float, longitude: float, east_m: float, north_m: float
) -> None:
    place = place_at((latitude, longitude), east_m, north_m)
    back = east_north_m((latitude, longitude), place)
    assert back == pytest.approx((east_m, north_m), abs=1e-6)


@pytest.mark.parametrize("latitude_deg", [-70.0, 0.0, 48.0])
@pytest.mark.parametrize("height_m", [0.0, 3000.0])
def test_the_length_of_a_degree_is_the_derivative_of_earth_centred_coordinates(
    latitude_deg: float, height_m: float
) -> None:
    step = 1e-4

    def length_m(north: float, east: float) -> float:
        ends = [
            ellipsoid.ecef_from_geodetic(latitude_deg + s * north, 11.0 + s * east, height_m)
            for s in (1, -1)
        ]
        return float(np.linalg.norm(ends[0] - ends[1])) / (2 * step)

    found = metres_per_degree(latitude_deg, height_m)
    assert found == pytest.approx((length_m(step, 0.0), length_m(0.0, step)), rel=1e-7)


def test_a_long_line_across_track_is_the_shortest_one() -> None:
    # By lengths of a degree at the origin the middle of this line was 20 m off.
    plane = LocalPlane(Point(48.0, 11.0))
    azimuth_deg, _, length_m = ELLIPSOID.inv(11.0, 48.0, 11.4, 48.0)
    longitude, latitude, _ = ELLIPSOID.fwd(11.0, 48.0, azimuth_deg, length_m / 2)
    end, middle = plane.flat(Point(48.0, 11.4)), plane.flat(Point(latitude, longitude))
    assert math.hypot(*end) == pytest.approx(length_m, abs=1e-6)
    assert middle == pytest.approx((end[0] / 2, end[1] / 2), abs=1e-6)
    again = plane.place(*end)
    assert (again.latitude_deg, again.longitude_deg) == pytest.approx((48.0, 11.4), abs=1e-12)


def test_lengths_in_the_plane_are_right_to_two_hundred_thousandths_at_50_km() -> None:
    plane, away = LocalPlane(Point(48.0, 11.0)), 50e3 / math.sqrt(2)
    one, other = plane.place(away, away), plane.place(away + 70.7, away - 70.7)
    _, _, length_m = ELLIPSOID.inv(
        one.longitude_deg, one.latitude_deg, other.longitude_deg, other.latitude_deg
    )
    assert math.hypot(70.7, 70.7) == pytest.approx(length_m, rel=2e-5)


def test_the_axes_of_a_place_are_those_of_the_emulator() -> None:
    for latitude, longitude in ((48.0, 11.0), (-33.0, -70.0), (0.0, 180.0), (90.0, 0.0)):
        theirs = ellipsoid.ecef_from_enu_rotation(latitude, longitude)
        assert enu_axes(latitude, longitude) == pytest.approx(theirs, abs=1e-15)


@pytest.mark.parametrize(
    ("place", "code"),
    [
        ((48.0, 11.0), "EPSG:32632"),
        ((-33.0, 151.0), "EPSG:32756"),
        ((0.0, -180.0), "EPSG:32601"),
        ((84.0, 179.9), "EPSG:32660"),
        ((84.1, 0.0), None),
        ((-80.1, 0.0), None),
    ],
)
def test_a_place_has_a_zone_of_utm_between_80_south_and_84_north(
    place: tuple[float, float], code: str | None
) -> None:
    assert utm_of(*place) == code


def test_proj_is_never_allowed_to_use_the_network() -> None:
    program = (
        "import daemon.orientation.geodesy, pyproj.network; "
        "print(pyproj.network.is_network_enabled())"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env={"PROJ_NETWORK": "ON"}, capture_output=True, text=True,
        timeout=60, check=True,
    )  # fmt: skip
    assert done.stdout.strip() == "False"
