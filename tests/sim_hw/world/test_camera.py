"""The true camera projects as independent code does, and its errors have the values set."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from processing.rig import Lens, load_rig, shipped_rigs
from sim_hw.world import true_camera
from sim_hw.world.flight import FlightPlan, SimulatedFlight
from sim_hw.world.rendering import ExposureParameters
from sim_hw.world.truth import true_vip
from sim_hw.world.world import World, WorldSettings

EPOCH = 1_400_000_000_000_000_000
RIG = shipped_rigs()["ultracam-x-mini"]


def world(**changes: object) -> World:
    settings = WorldSettings(rig_file=str(RIG), seed=3, epoch_gps_ns=EPOCH, dc_k=12.0)
    return World(replace(settings, **changes))


def test_the_ideal_camera_agrees_with_opencv_on_a_pinhole() -> None:
    rig = load_rig(RIG)
    image = rig.virtual_image
    assert image is not None
    flight = SimulatedFlight(FlightPlan(3000.0, 55.0, 2000.0, 500.0), 7, EPOCH)
    pose = flight.pose(EPOCH + 3_141_592_653)
    ground = np.random.default_rng(1).uniform([-300, -100, -9], [300, 400, 9], (200, 3))
    column, row = true_camera.ideal_pixels(ground, rig, pose)
    # OpenCV's camera looks along +z with y down: x right, y backward, z down of the aircraft.
    enu_from_cv = pose.enu_from_body @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    master = rig.cone(rig.master_cone)
    centre = pose.position_enu_m + pose.enu_from_body @ np.array(master.position_mm) * 1e-3
    rotation, _ = cv2.Rodrigues(enu_from_cv.T)
    f_px = image.f_mm / (image.pitch_um * 1e-3)
    matrix = np.array(
        [[f_px, 0, (image.width_px - 1) / 2], [0, f_px, (image.height_px - 1) / 2], [0, 0, 1]]
    )
    expected, _ = cv2.projectPoints(ground, rotation, -enu_from_cv.T @ centre, matrix, None)
    assert np.column_stack([column, row]) == pytest.approx(expected[:, 0], abs=1e-6)


def test_the_lens_correction_has_the_signs_of_eq_5_1() -> None:
    lens = Lens(100.0, 0.0, 5.6, "", 0.01, -0.02, 0.05, 1e-6, 2e-10, 3e-14, 4e-6, 5e-6, 6e-5, 7e-5)
    x, y, r2 = 20.0, -10.0, 500.0
    radial = r2 * 1e-6 + r2**2 * 2e-10 + r2**3 * 3e-14
    dx = 0.01 + x / 100 * 0.05 + x * radial + (r2 + 2 * x * x) * 4e-6 + 2 * x * y * 5e-6
    dx += x * 6e-5 + y * 7e-5
    dy = -0.02 + y / 100 * 0.05 + y * radial + 2 * x * y * 4e-6 + (r2 + 2 * y * y) * 5e-6
    ideal = true_camera.undistorted(lens, np.array([[x, y]]))
    assert ideal[0] == pytest.approx([x + dx, y + dy], abs=1e-12)


def test_a_sensor_drifts_with_the_temperature_of_its_probe() -> None:
    rig = load_rig(RIG)
    true = true_camera.TrueCamera(
        rig,
        {s.name: (0.0, 0.0) for s in rig.sensors},
        {c.name: (0.0, 0.0, 0.0) for c in rig.cones},
    )
    sensor = rig.sensor("SU00")
    middle = (np.array(623.5), np.array(415.5))
    cold, warm = (true.layer_from_pixel(sensor, *middle, temperature_c=t) for t in (20.0, 30.0))
    assert cold == pytest.approx([sensor.x_mm, sensor.y_mm], abs=1e-12)
    assert warm - cold == pytest.approx([-0.7688e-2, 0.4245e-2], abs=1e-12)
    corners = np.array([0.0, 1247.0]), np.array([415.5, 415.5])
    ends = true.layer_from_pixel(sensor, *corners, temperature_c=30.0)
    length = np.linalg.norm(ends[1] - ends[0])
    assert length == pytest.approx(1247 * 0.0072 * (1 + 104e-6), rel=1e-9)
    measured_rotation = np.arctan2(*(ends[1] - ends[0])[::-1])
    assert measured_rotation == pytest.approx(39.2e-6 + 21.41e-6, abs=1e-12)


def test_a_displaced_sensor_is_displaced_and_the_others_are_within_calibration() -> None:
    found = world(displaced_px={"SU02": (1.0, -0.6)}).camera.place_error_mm
    plain = world().camera.place_error_mm
    moved = np.subtract(found["SU02"], plain["SU02"]) / 0.0072
    assert moved == pytest.approx([1.0, -0.6], abs=1e-9)
    others = np.array([e for name, e in plain.items() if name != "SU02"]) * 1e3
    assert 0.05 < others.std() < 0.25
    assert all(found[name] == plain[name] for name in found if name != "SU02")


def test_without_errors_or_motion_a_pixel_lands_where_its_calibrated_ray_points() -> None:
    still = world(dc_k=0.0)
    rig = still.rig
    calm = FlightPlan(
        3000.0,
        55.0,
        2000.0,
        500.0,
        wind_across_mps=0.0,
        attitude_rms_deg=0.0,
        rate_rms_dps=0.0,
        track_deviation_rms_m=0.0,
    )
    flight = SimulatedFlight(calm, 1, EPOCH)
    exact = true_camera.TrueCamera(
        rig,
        {s.name: (0.0, 0.0) for s in rig.sensors},
        {c.name: (0.0, 0.0, 0.0) for c in rig.cones},
    )
    still.camera = exact
    still.temperatures = true_camera.ProbeTemperatures(
        base_c=dict.fromkeys(rig.probes, 20.0),
        wave_k=dict.fromkeys(rig.probes, 0.0),
        period_s=dict.fromkeys(rig.probes, 1.0),
        phase=dict.fromkeys(rig.probes, 0.0),
    )
    # Cone 1 is 80 mm ahead of the master: at the same place it fires 80 mm / v earlier.
    ahead_ns = round(0.08 / 55.0 * 1e9)
    look = ExposureParameters(EPOCH - ahead_ns, 3900.0, tdi_shifts=2)
    columns, rows = np.array([0.0, 600.0, 1247.0]), np.array([0.0, 300.0, 831.0])
    vip = true_vip(still, flight, "SU10", look, columns=columns, rows=rows, master_mid_gps_ns=EPOCH)
    sensor, cone = rig.sensor("SU10"), rig.cone("1")
    at = exact.layer_from_pixel(sensor, columns, rows - 1.0, temperature_c=20.0)
    ray = np.column_stack([true_camera.undistorted(cone.lens, at), np.full(3, -cone.lens.f_mm)])
    ray = ray @ true_camera.rotation_opk(cone.rotation_rad).T
    image = ray[:, :2] / -ray[:, 2:] * 100.5 / 0.0072
    assert vip[0] == pytest.approx(image[:, 0] + 1739.5, abs=1e-5)
    assert vip[1] == pytest.approx(1112.5 - image[:, 1], abs=1e-5)
