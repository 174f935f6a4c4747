"""From raw pixels to the virtual image and back, against the oracle."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from processing.geometry.drift import missing_probes
from processing.geometry.placement import (
    corrected_mm_from_raw,
    nominal_placements,
    raw_from_vip_mm,
    sensor_mm_from_raw,
    start_similarity,
    vip_mm_from_px,
    vip_mm_from_raw,
    vip_px_from_mm,
)
from processing.geometry.similarity import (
    Similarity,
    apply_similarity,
    fit_similarity,
    invert_similarity,
)
from processing.rig import find_rig
from tests.processing import oracle


@pytest.mark.parametrize("name", ["ultracam-x", "ultracam-x-mini"])
@pytest.mark.parametrize(("temperature_c", "tdi"), [(20.0, 0), (41.0, 12), (-3.0, 7)])
def test_every_sensor_falls_where_the_oracle_puts_it(
    name: str, temperature_c: float, tdi: int
) -> None:
    rig = find_rig(name)
    assert rig.virtual_image is not None
    placements = nominal_placements(
        rig,
        dict.fromkeys(rig.probes, temperature_c),
        {sensor.name: tdi for sensor in rig.sensors},
    )
    rng = np.random.default_rng(2)
    for cone in rig.cones:
        for sensor in cone.sensors:
            raw = rng.uniform(0, (sensor.width_px - 1, sensor.height_px - 1), (50, 2))
            found = vip_px_from_mm(rig.virtual_image, vip_mm_from_raw(placements[sensor.name], raw))
            truth = oracle.vip_px_of_raw(rig, cone, sensor, raw, temperature_c, tdi)
            np.testing.assert_allclose(found, truth, atol=2e-8, err_msg=sensor.name)


def test_an_adjusted_placement_is_p_times_s_times_u_of_equation_1() -> None:
    rig = find_rig("ultracam-x-mini")
    start = nominal_placements(rig, dict.fromkeys(rig.probes, 33.0), {})["SU11"]
    similarity = Similarity(
        start.similarity.x_mm + 0.004, start.similarity.y_mm - 0.007, 3e-4, 1.0001
    )
    layer = start.layer @ np.array([[1.0, 1e-5, 0.01], [-2e-5, 1.0001, -0.02], [1e-6, -2e-6, 1.0]])
    adjusted = dataclasses.replace(start, similarity=similarity, layer=layer)
    raw = np.random.default_rng(3).uniform(0, (1247, 831), (80, 2))
    u = corrected_mm_from_raw(start, raw)
    truth = oracle.placed(layer, (similarity.x_mm, similarity.y_mm, 3e-4, 1.0001), u)
    np.testing.assert_allclose(vip_mm_from_raw(adjusted, raw), truth, atol=1e-12)
    assert start_similarity(adjusted) == start.similarity


def test_the_start_of_a_placement_follows_its_principal_distance() -> None:
    rig = find_rig("ultracam-x-mini")
    start = nominal_placements(rig, {}, {})["SU10"]
    assert start_similarity(start) == start.similarity
    scaled = dataclasses.replace(start, f_ratio=1.25 * start.f_ratio)
    assert start_similarity(scaled).scale == pytest.approx(1.25 * start.similarity.scale)
    assert start_similarity(scaled).x_mm == pytest.approx(1.25 * start.similarity.x_mm)


def test_raw_pixels_come_back_from_the_virtual_image_to_a_millionth_of_a_pixel() -> None:
    for name in ("ultracam-x", "ultracam-x-mini"):
        rig = find_rig(name)
        placements = nominal_placements(
            rig,
            dict.fromkeys(rig.probes, 45.0),
            {sensor.name: 9 for cone in rig.pan_cones for sensor in cone.sensors},
        )
        rng = np.random.default_rng(4)
        for placement in placements.values():
            sensor = placement.sensor
            raw = rng.uniform(-30, (sensor.width_px + 30, sensor.height_px + 30), (200, 2))
            back = raw_from_vip_mm(placement, vip_mm_from_raw(placement, raw))
            assert np.abs(back - raw).max() < 1e-6


def test_a_skewed_sensor_falls_where_the_oracle_puts_it_and_comes_back() -> None:
    straight = find_rig("ultracam-x-mini")
    cone = straight.cones[0]
    skewed = dataclasses.replace(
        cone.sensors[1], skew_x_ppm_per_mm=-80.0, skew_y_ppm_per_mm=120.0, rotation_rad=0.02
    )
    sensors = (cone.sensors[0], skewed, *cone.sensors[2:])
    cone = dataclasses.replace(cone, sensors=sensors)
    rig = dataclasses.replace(straight, cones=(cone, *straight.cones[1:]))
    assert rig.virtual_image is not None
    warm = dict.fromkeys(rig.probes, 41.0)
    start = nominal_placements(rig, warm, {skewed.name: 12})[skewed.name]
    raw = np.random.default_rng(6).uniform(-30, (1277, 861), (200, 2))
    found = vip_mm_from_raw(start, raw)
    truth = oracle.vip_px_of_raw(rig, cone, skewed, raw, 41.0, 12)
    np.testing.assert_allclose(vip_px_from_mm(rig.virtual_image, found), truth, atol=2e-8)
    assert np.abs(raw_from_vip_mm(start, found) - raw).max() < 1e-6


def test_tdi_moves_the_row_origin_by_half_the_shifts_towards_where_the_charge_came_from() -> None:
    rig = find_rig("ultracam-x-mini")
    still = nominal_placements(rig, {}, {})["SU00"]
    moved = nominal_placements(rig, {}, {"SU00": 10})["SU00"]
    row_100 = sensor_mm_from_raw(moved, np.array([[0.0, 100.0]]))
    row_95 = sensor_mm_from_raw(still, np.array([[0.0, 95.0]]))
    np.testing.assert_array_equal(row_100, row_95)


def test_a_missing_probe_leaves_its_sensors_at_calibration() -> None:
    rig = find_rig("ultracam-x-mini")
    known = {probe: 40.0 for probe in rig.probes if probe != "1"}
    placements = nominal_placements(rig, known, {})
    calibrated = nominal_placements(rig, {}, {}, use_drift=False)
    assert missing_probes(rig, known) == ("1",)
    assert placements["SU10"].physical == calibrated["SU10"].physical
    assert placements["SU10"].f_ratio == 1.0
    assert placements["SU00"].physical != calibrated["SU00"].physical


def test_drift_of_one_kelvin_moves_a_sensor_by_its_coefficients() -> None:
    rig = find_rig("ultracam-x")
    sensor = rig.sensor("SU00")
    a = nominal_placements(rig, {"0": sensor.calibration_c}, {})["SU00"].physical
    b = nominal_placements(rig, {"0": sensor.calibration_c + 1.0}, {})["SU00"].physical
    assert (b.x_mm - a.x_mm) * 1e3 == pytest.approx(-0.8110)
    assert (b.y_mm - a.y_mm) * 1e3 == pytest.approx(0.4672)
    assert (b.rotation_rad - a.rotation_rad) * 1e6 == pytest.approx(0.535)
    assert (b.scale / a.scale - 1.0) * 1e6 == pytest.approx(2.6)


def test_virtual_pixels_count_from_the_upper_left_and_millimetres_from_the_middle() -> None:
    image = find_rig("ultracam-x").virtual_image
    assert image is not None
    corner = vip_mm_from_px(image, np.array([[0.0, 0.0]]))[0]
    assert corner == pytest.approx((-(14430 - 1) / 2 * 7.2e-3, (9420 - 1) / 2 * 7.2e-3))
    assert vip_px_from_mm(image, np.array([corner]))[0] == pytest.approx((0.0, 0.0), abs=1e-9)


def test_a_similarity_inverts_and_is_found_again_from_points() -> None:
    s = Similarity(3.0, -2.0, 0.4, 1.7)
    points = np.random.default_rng(5).normal(size=(20, 2))
    carried = apply_similarity(s, points)
    np.testing.assert_allclose(apply_similarity(invert_similarity(s), carried), points, atol=1e-12)
    found = fit_similarity(points, carried)
    assert (found.x_mm, found.y_mm, found.rotation_rad, found.scale) == pytest.approx(
        (3.0, -2.0, 0.4, 1.7)
    )
    with pytest.raises(ValueError, match="two"):
        fit_similarity(points[:1], carried[:1])
