"""Brown's distortion against OpenCV's, and the lens that undoes it against both."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from processing.geometry.brown import Brown, lens_from_brown, measured_from_ideal_brown
from processing.geometry.lens import ideal_from_measured

BROWN = Brown(1460.0, (650.0, 470.0), -0.1, 0.15, -0.02, 4e-4, -7e-4)
WIDTH, HEIGHT, PITCH_MM = 1280, 960, 3.75e-3


def frame() -> np.ndarray:
    """Ideal points all over the frame, units of the focal length, y down."""
    column, row = np.meshgrid(np.linspace(0, WIDTH - 1, 23), np.linspace(0, HEIGHT - 1, 17))
    return np.column_stack([column.ravel() - 650.0, row.ravel() - 470.0]) / 1460.0


def test_points_are_distorted_as_by_opencv() -> None:
    ideal = frame()
    b = BROWN
    distorted, _ = cv2.projectPoints(
        np.column_stack([ideal, np.ones(len(ideal))]),
        np.zeros(3), np.zeros(3), np.eye(3), np.array([b.k1, b.k2, b.p1, b.p2, b.k3]),
    )  # fmt: skip
    np.testing.assert_allclose(measured_from_ideal_brown(b, ideal), distorted[:, 0], atol=1e-12)


def test_the_lens_undoes_the_distortion_within_what_it_states() -> None:
    lens, worst_px = lens_from_brown(
        BROWN, width_px=WIDTH, height_px=HEIGHT, pitch_mm=PITCH_MM, f_number=2.2, serial="17"
    )
    assert 1e-4 < worst_px < 0.2
    assert (lens.f_mm, lens.f_number, lens.serial) == (pytest.approx(5.475), 2.2, "17")
    up = np.array([1.0, -1.0]) * lens.f_mm
    ideal = frame()
    found = ideal_from_measured(lens, measured_from_ideal_brown(BROWN, ideal) * up)
    assert np.abs(found - ideal * up).max() <= 1.05 * worst_px * PITCH_MM


def test_a_lens_without_distortion_needs_no_correction() -> None:
    none = replace(BROWN, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
    lens, worst_px = lens_from_brown(
        none, width_px=WIDTH, height_px=HEIGHT, pitch_mm=PITCH_MM, f_number=2.2, serial=""
    )
    assert worst_px == pytest.approx(0.0, abs=1e-9)
    assert (lens.k1, lens.k2, lens.k3, lens.p1, lens.p2) == pytest.approx((0.0,) * 5, abs=1e-12)


def test_a_distortion_that_cannot_be_undone_within_a_pixel_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot be undone within a pixel"):
        lens_from_brown(
            replace(BROWN, k1=-1.2, k2=0.0),
            width_px=WIDTH, height_px=HEIGHT, pitch_mm=PITCH_MM, f_number=2.2, serial="",
        )  # fmt: skip
