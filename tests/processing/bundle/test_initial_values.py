"""Starting values against poses and points made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from processing.bundle.initial_values import intersect, resect
from tests.processing.bundle.simulated_networks import rotation_of

STATION = np.array([512.0, -230.0, 1040.0])
CAMERA_FROM_OBJECT = rotation_of(0.05, -0.12, 0.7)
F_MM = 70.0
GROUND = np.array(
    [
        [400.0, -300.0, 10.0],
        [640.0, -330.0, 45.0],
        [610.0, -110.0, -20.0],
        [430.0, -90.0, 30.0],
        [520.0, -240.0, 70.0],
    ]
)


def seen(points: np.ndarray) -> np.ndarray:
    camera = (points - STATION) @ CAMERA_FROM_OBJECT.T
    return -F_MM * camera[:, :2] / camera[:, 2:]


@pytest.mark.parametrize("count", [4, 5])
def test_an_image_is_oriented_from_four_known_points(count: int) -> None:
    station, object_from_camera = resect(seen(GROUND)[:count], GROUND[:count], F_MM)
    np.testing.assert_allclose(station, STATION, atol=1e-4)
    np.testing.assert_allclose(object_from_camera, CAMERA_FROM_OBJECT.T, atol=1e-7)


def test_three_known_points_are_too_few() -> None:
    with pytest.raises(ValueError, match="3 known points in an image; a resection takes four"):
        resect(seen(GROUND)[:3], GROUND[:3], F_MM)


def test_a_point_lies_where_its_rays_are_nearest() -> None:
    # Two rays along x and y pass each other at a height of two; a third point has one ray,
    # a fourth two that are parallel, a fifth none.
    point = np.array([0, 0, 1, 1, 2, 3, 3])
    station = np.array(
        [[0, 5, 4], [7, 0, 6], [0, 0, 0], [9, 0, 0], [1, 1, 1], [0, 0, 0], [1, 0, 0]], float
    )
    direction = np.array(
        [[1, 0, 0], [0, 2, 0], [3, 4, 5], [-6, 4, 5], [0, 0, 1], [0, 0, 1], [0, 0, 2]], float
    )
    found, rays = intersect(5, point, station, direction)
    assert rays.tolist() == [2, 2, 1, 2, 0]
    np.testing.assert_allclose(found[0], [7.0, 5.0, 5.0], atol=1e-9)
    np.testing.assert_allclose(found[1], [3.0, 4.0, 5.0], atol=1e-9)
    assert np.isnan(found[2:]).all()
