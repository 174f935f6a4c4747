"""Attitudes as quaternions agree with scipy's Rotation, at gimbal lock too."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from drivers.receivers.attitude import (
    Quaternion,
    angles_of,
    interpolated_quaternion,
    quaternion_of,
)

ANGLE = st.floats(-math.pi, math.pi)
PITCH = st.floats(-1.57, 1.57)


def rotation_of(quaternion: Quaternion) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)


def angle_between(a: Rotation, b: Rotation) -> float:
    return float((a.inv() * b).magnitude())


@given(ANGLE, PITCH, ANGLE)
def test_a_quaternion_is_the_rotation_heading_pitch_roll(
    roll: float, pitch: float, heading: float
) -> None:
    expected = Rotation.from_euler("ZYX", [heading, pitch, roll])
    assert angle_between(rotation_of(quaternion_of(roll, pitch, heading)), expected) < 1e-12


@pytest.mark.parametrize(
    "attitude", [(0.1, 0.2, 0.3), (-0.4, 0.5, 6.0), (1.0, -1.2, 3.0), (3.0, 0.0, 0.0)]
)
def test_angles_and_quaternions_are_each_others_inverse(
    attitude: tuple[float, float, float],
) -> None:
    assert angles_of(quaternion_of(*attitude)) == pytest.approx(attitude, abs=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("away_rad", [0.0, 1e-9, 2e-7, 1e-6, 1e-3])
def test_angles_near_gimbal_lock_give_the_rotation_back(sign: float, away_rad: float) -> None:
    q = quaternion_of(0.3, sign * (math.pi / 2 - away_rad), 0.7)
    roll, pitch, heading = angles_of(q)
    again = rotation_of(quaternion_of(roll, pitch, heading))
    assert angle_between(again, rotation_of(q)) < (1e-8 if away_rad > 1e-7 else 2e-7)
    assert pitch == pytest.approx(sign * (math.pi / 2 - away_rad), abs=1e-12)
    if away_rad > 1e-7:
        assert (roll, heading) == pytest.approx((0.3, 0.7), abs=1e-6)
    else:
        assert (roll, heading) == pytest.approx((0.0, 0.7 - sign * 0.3), abs=1e-6)


@given(ANGLE, PITCH, ANGLE, ANGLE, PITCH, ANGLE, st.floats(0.0, 1.0))
def test_between_two_attitudes_it_is_the_interpolation_of_scipy(
    r1: float, p1: float, h1: float, r2: float, p2: float, h2: float, share: float
) -> None:
    first, second = quaternion_of(r1, p1, h1), quaternion_of(r2, p2, h2)
    between = rotation_of(interpolated_quaternion(first, second, share))
    both = Rotation.concatenate([rotation_of(first), rotation_of(second)])
    apart = angle_between(both[0], both[1])
    if apart < math.pi - 1e-6:  # half a turn has two shortest arcs
        assert angle_between(between, Slerp([0.0, 1.0], both)(share)) < 1e-7


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_between_two_headings_the_shorter_arc_is_shared(share: float, sign: int) -> None:
    first = quaternion_of(0.0, 0.0, math.radians(350.0))
    w, x, y, z = quaternion_of(0.0, 0.0, math.radians(30.0))
    second = (sign * w, sign * x, sign * y, sign * z)
    heading = math.degrees(angles_of(interpolated_quaternion(first, second, share))[2])
    assert heading == pytest.approx((350.0 + 40.0 * share) % 360.0, abs=1e-9)
    assert interpolated_quaternion(first, first, share) == first
