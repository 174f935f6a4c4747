"""What supports weak tie points counts for what it is worth, neither more nor less."""

from __future__ import annotations

import math

import numpy as np
import pytest

from processing.geometry.projective import rotation_homography
from processing.geometry.rotation import rotation_matrix
from processing.mosaic.calibration_support import (
    SupportSettings,
    _layer_covariance,
    _probe_covariance,
    _sensor_variance,
    supported_mosaic,
)
from processing.mosaic.free_mosaic import free_mosaic, vip_precision_px
from processing.mosaic.validity import evaluate_master
from processing.rig import find_rig
from tests.processing.synthetic import make_truth, no_tie_points, tie_points_of

MINI = find_rig("ultracam-x-mini")


@pytest.mark.parametrize("noise", [1.0, 0.2])
def test_an_image_without_its_master_cone_lies_as_surely_as_the_platform_states(
    noise: float,
) -> None:
    """Three cones, each turned against the master by its own error: their mean places the image.

    It is independent of matching accuracy.
    """
    rng = np.random.default_rng(3)
    truth = make_truth(MINI, rng, sensor_px=0.02, layer_px=0.1)
    masters = tuple(sensor.name for sensor in MINI.master_sensors)
    points = tie_points_of(
        truth, rng, without=masters, sigma_pp_px=0.1 * noise, sigma_pc_px=0.3 * noise
    )
    read = dict.fromkeys(MINI.probes, 20.0)
    mosaic = free_mosaic(MINI, truth.start, points)
    validity = evaluate_master(MINI, mosaic, read)
    image = supported_mosaic(MINI, truth.start, points, mosaic, validity, read)
    sensor = MINI.sensor("SU30")
    middle = np.array([[(sensor.width_px - 1) / 2, (sensor.height_px - 1) / 2]])
    cone = MINI.cone_of("SU30")
    rotation_px = SupportSettings().rotation_rad * cone.lens.f_mm / sensor.pitch_mm
    stated = vip_precision_px(image, "SU30", middle)[0]
    assert stated == pytest.approx(np.full(2, rotation_px / np.sqrt(3.0)), rel=0.1)


def test_a_sensor_is_known_as_well_as_its_calibration_and_its_corners_as_its_place() -> None:
    sensor = MINI.sensor("SU10")
    read = {sensor.probe: sensor.calibration_c + 7.0}
    place_mm = math.hypot(sensor.position_sigma_um, 7.0 * sensor.drift.sigma_um_per_k) * 1e-3
    half_mm = math.hypot(sensor.width_px, sensor.height_px) * sensor.pitch_mm / 2.0
    x, y, rotation, scale = np.sqrt(_sensor_variance(sensor, read))
    assert (x, y) == pytest.approx((place_mm, place_mm))
    # Half a diagonal away, rotation and scale move a point as much as the place is uncertain.
    assert (rotation * half_mm, scale * half_mm) == pytest.approx((place_mm, place_mm))
    cold = np.sqrt(_sensor_variance(sensor, {}))[0]
    assert cold == pytest.approx(sensor.position_sigma_um * 1e-3)


def test_a_rotated_cone_moves_its_layer_as_its_homography_does() -> None:
    truth = make_truth(MINI, np.random.default_rng(1))
    mosaic = free_mosaic(MINI, truth.start, no_tie_points(MINI))
    settings = SupportSettings(
        rotation_rad=1e-5, floor_px=0.05, colour_floor_px=0.3, colour_shift_px=3.0
    )
    f, half = MINI.cone("1").lens.f_mm, mosaic.model.half_size_mm
    norm = np.diag([1.0 / half, 1.0 / half, 1.0])
    expected = np.zeros((8, 8))
    for axis in np.eye(3) * 1e-5:
        homography = norm @ rotation_homography(rotation_matrix(*axis), f, f) @ np.linalg.inv(norm)
        expected += np.outer(*[(homography - np.eye(3)).ravel()[:8]] * 2)
    pixel = mosaic.model.pitch_mm / half
    pan = _layer_covariance(mosaic, MINI.cone("1"), settings)
    floor = np.diag([(0.05 * pixel) ** 2] * 8)
    np.testing.assert_allclose(pan, expected + floor, rtol=1e-3, atol=1e-14)
    colour = _layer_covariance(mosaic, MINI.cone("G"), settings)
    own = np.array([0.3, 0.3, 3.0, 0.3, 0.3, 3.0, 0.3, 0.3]) * pixel
    rotation_only = _layer_covariance(
        mosaic,
        MINI.cone("G"),
        SupportSettings(rotation_rad=1e-5, colour_floor_px=0.0, colour_shift_px=0.0),
    )
    np.testing.assert_allclose(colour - rotation_only, np.diag(own**2), rtol=1e-6, atol=1e-16)


def test_a_layer_that_cannot_rotate_is_known_to_its_floor() -> None:
    """In PAN pixels: 0.05 of a PAN layer, 0.3 of the colour master and 3 of its parallax."""
    truth = make_truth(MINI, np.random.default_rng(1))
    mosaic = free_mosaic(MINI, truth.start, no_tie_points(MINI))
    settings = SupportSettings(rotation_rad=0.0)
    pixel = mosaic.model.pitch_mm / mosaic.model.half_size_mm
    for cone, floor in (("1", [0.05] * 8), ("G", [0.3, 0.3, 3.0, 0.3, 0.3, 3.0, 0.3, 0.3])):
        sigma = np.sqrt(np.diag(_layer_covariance(mosaic, MINI.cone(cone), settings)))
        np.testing.assert_allclose(sigma / pixel, floor, rtol=1e-9)


@pytest.mark.parametrize(("read", "sigma_k"), [(("0", "1"), 0.1), (("1",), 2.0), ((), 15.0)])
def test_a_probe_moves_all_its_sensors_together(read: tuple[str, ...], sigma_k: float) -> None:
    truth = make_truth(MINI, np.random.default_rng(1))
    mosaic = free_mosaic(MINI, truth.start, no_tie_points(MINI))
    sensors = MINI.master_sensors
    found = _probe_covariance(mosaic, sensors, dict.fromkeys(read, 25.0), SupportSettings())
    moved = np.zeros(len(mosaic.model.names))
    for s in sensors:
        first, drift = mosaic.model.sensors[s.name], s.drift
        moved[first : first + 2] = drift.x_um_per_k * 1e-3, drift.y_um_per_k * 1e-3
        moved[first + 2] = drift.rotation_urad_per_k * 1e-6
        moved[first + 3] = drift.scale_ppm_per_k * 1e-6
    np.testing.assert_allclose(found, np.outer(moved, moved) * sigma_k**2, rtol=1e-9)
