"""OpenCV's rational model against OpenCV, its derivatives, and its conversion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from processing.bundle.camera_model import ideal_mm
from processing.bundle.network import CameraModel, NetworkError
from processing.bundle.rational_distortion import (
    camera_of_rational,
    rational_distorted,
    rational_undistorted,
)

RATIONAL = np.array([0.31, 0.05, 4e-4, -3e-4, 0.002, 0.42, 0.06, 0.004])
F_MM = 30.0


def by_opencv(directions: np.ndarray) -> np.ndarray:
    points = np.column_stack([directions, np.ones(len(directions))])
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, np.eye(3), RATIONAL)[0].reshape(-1, 2)


def test_distorted_coordinates_are_those_of_opencv_and_are_inverted() -> None:
    ideal = np.random.default_rng(1).uniform(-0.9, 0.9, (200, 2))
    found, by_ideal = rational_distorted(RATIONAL, ideal)
    assert found == pytest.approx(by_opencv(ideal), abs=1e-12)
    assert rational_undistorted(RATIONAL, found) == pytest.approx(ideal, abs=1e-11)
    for axis in range(2):
        step = 1e-6 * np.eye(2)[axis]
        up, down = (rational_distorted(RATIONAL, ideal + s)[0] for s in (step, -step))
        assert (up - down) / 2e-6 == pytest.approx(by_ideal[:, :, axis], abs=1e-8)


@pytest.mark.parametrize(("model", "below_mm"), [("opencv", 2e-3), ("centred", 2e-2)])
def test_a_converted_camera_sees_the_same_directions_to_the_residual_stated(model, below_mm):
    camera = CameraModel("c", F_MM, 0.2, -0.1, model=model)
    found = camera_of_rational(camera, RATIONAL, (18.0, 12.0))
    assert 0.0 < found.rms_mm < found.largest_mm < below_mm
    directions = np.array([[0.3, 0.1], [-0.4, 0.3], [0.1, -0.3]])
    measured = by_opencv(directions * [1.0, -1.0]) * [F_MM, -F_MM] + [0.2, -0.1]
    c = found.camera.f_mm - found.camera.interior[2]
    seen = ideal_mm(found.camera, found.camera.interior, np.zeros(0), measured) / c
    assert np.abs(seen - directions).max() * F_MM < 2.0 * found.largest_mm


def test_coefficients_of_brown_alone_are_those_of_the_forward_model() -> None:
    brown = np.array([-0.08, 0.12, 3e-4, -2e-4, -0.02, 0.0, 0.0, 0.0])
    camera = CameraModel("c", F_MM, model="opencv")
    found = camera_of_rational(camera, brown, (18.0, 12.0))
    assert found.largest_mm < 1e-8
    wanted = np.zeros(10)
    wanted[3:8] = brown[[0, 1, 4, 2, 3]]
    assert found.camera.interior == pytest.approx(wanted, abs=1e-6)
    assert found.camera == replace(camera, interior=found.camera.interior)


def test_a_distortion_that_folds_the_frame_is_refused() -> None:
    with pytest.raises(NetworkError, match="cannot be inverted at"):
        rational_undistorted(np.array([-0.9, 0, 0, 0, 0, 0, 0, 0]), np.array([[0.8, 0.0]]))
