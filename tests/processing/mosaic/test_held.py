"""What converging heads hold, against adjustments of the same points with another calibration."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, vip_mm_from_raw
from processing.matching.tie_points import TiePoints
from processing.mosaic.free_mosaic import Mosaic, free_mosaic
from processing.mosaic.held import calibrated_parts, held_quantities, scale_figures, scaled_part
from processing.mosaic.mounting import verified_mosaic
from processing.mosaic.precision import (
    UncertaintyContribution,
    datum_covariance,
    disturbance_covariance_px,
    placed_sigma_px,
)
from processing.rig import Cone, Sensor, find_rig
from tests.processing.synthetic import make_truth, tie_points_of

Array = NDArray[np.float64]
DMC = find_rig("dmc-mini")
READ = dict.fromkeys(DMC.probes, 30.0)
AT = np.array([[3.0, 5.0], [1700.0, 20.0], [900.0, 500.0], [40.0, 990.0], [1650.0, 1000.0]])


@functools.cache
def points() -> TiePoints:
    rng = np.random.default_rng(5)
    truth = make_truth(DMC, rng, sensor_px=0.0, layer_px=0.3)
    return tie_points_of(truth, rng, per_overlap=90, per_sensor=60)


@functools.cache
def calibrated(head: str = "", moved_um: float = 0.0, f_ppm: float = 0.0) -> Mosaic:
    """The adjustment with a rig file that is off in one head."""

    def sensor(s: Sensor) -> Sensor:
        return dataclasses.replace(s, x_mm=s.x_mm + moved_um * 1e-3)

    def cone(c: Cone) -> Cone:
        if c.name != head:
            return c
        lens = dataclasses.replace(c.lens, f_mm=c.lens.f_mm * (1.0 + f_ppm * 1e-6))
        return dataclasses.replace(c, lens=lens, sensors=tuple(sensor(s) for s in c.sensors))

    rig = dataclasses.replace(DMC, cones=tuple(cone(c) for c in DMC.cones))
    return free_mosaic(rig, nominal_placements(rig, READ, {}), points())


def apart_px(wrong: Mosaic) -> dict[str, Array]:
    """Where pixels are placed, less where the right rig file places them."""
    right = calibrated()
    return {
        s.name: (
            vip_mm_from_raw(wrong.placements[s.name], AT)
            - vip_mm_from_raw(right.placements[s.name], AT)
        )
        / right.model.pitch_mm
        for c in DMC.pan_cones
        for s in c.sensors
    }


@pytest.mark.parametrize(("moved_um", "f_ppm"), [(12.0, 0.0), (0.0, 400.0)])
def test_a_wrong_place_or_scale_bends_the_image_as_its_pattern(
    moved_um: float, f_ppm: float
) -> None:
    found = held_quantities(calibrated(), points())
    assert found is not None
    shift, _, scale = found.parts["2"]
    part = shift.times(moved_um * 1e-3) if moved_um else scale.times(-f_ppm * 1e-6)
    wrong = apart_px(calibrated("2", moved_um, f_ppm))
    for name, error in wrong.items():
        assert np.abs(error).max() > 0.02
        np.testing.assert_allclose(part.at(calibrated(), name, AT), error, atol=0.01)


@pytest.mark.parametrize("head", ["1", "4"])
@pytest.mark.parametrize("f_ppm", [-300.0, 120.0])
def test_residuals_say_which_head_has_another_scale_and_by_how_much(
    head: str, f_ppm: float
) -> None:
    wrong = verified_mosaic(DMC, calibrated(head, 0.0, f_ppm), points())
    found = held_quantities(wrong, points())
    assert found is not None
    expected = [-f_ppm * 1e-6 * (cone == head) for cone in found.cones]
    np.testing.assert_allclose(found.scales, expected, atol=25e-6)
    figures = scale_figures(found)
    assert figures.platform_scale_head == head
    assert figures.platform_scale_ppm == pytest.approx(f_ppm, abs=25.0)
    part = scaled_part(found, least=50e-6)
    assert part is not None
    for name, error in apart_px(wrong).items():
        np.testing.assert_allclose(part.at(wrong, name, AT), error, atol=0.03)


def test_a_healthy_platform_has_no_scaled_head() -> None:
    found = held_quantities(calibrated(), points())
    assert found is not None and np.abs(found.scales).max() < 40e-6
    assert scaled_part(found, least=50e-6) is None


def test_a_scale_within_its_own_sigma_is_no_finding() -> None:
    found = held_quantities(calibrated(), points())
    assert found is not None
    loud = dataclasses.replace(found, scales=np.array([0.0, 9e-4, 0.0, 0.0]))
    assert scaled_part(loud, least=50e-6) is not None
    unsure = dataclasses.replace(loud, scale_sigmas=np.full(4, 3e-4))
    assert scaled_part(unsure, least=50e-6) is None and scale_figures(unsure) is None
    assert scale_figures(loud).platform_scale_head == "2"


def test_rigs_with_a_master_hold_nothing() -> None:
    rig = find_rig("ultracam-l-mini")
    rng = np.random.default_rng(5)
    truth = make_truth(rig, rng)
    tied = tie_points_of(truth, rng, per_overlap=60, per_sensor=60)
    assert held_quantities(free_mosaic(rig, truth.start, tied), tied) is None


def test_places_drift_and_probes_widen_the_sigma_of_a_healthy_platform() -> None:
    mosaic = calibrated()
    found = held_quantities(mosaic, points())
    assert found is not None
    sensor = DMC.sensor("P2")
    sigma_k = dict.fromkeys(DMC.probes, 0.1)
    parts = calibrated_parts(DMC, found, READ, sigma_k)
    dc_k = 30.0 - sensor.calibration_c
    of_place = np.hypot(sensor.position_sigma_um, sensor.drift.sigma_um_per_k * dc_k)
    of_head = [part for part in parts if "2" in part.layers]
    assert of_head[0].layers["2"][0] == pytest.approx(of_place * 1e-3)
    assert of_head[1].layers["2"][1] == pytest.approx(of_place * 1e-3)
    ppm = sensor.drift.scale_ppm_per_k - DMC.cone("2").lens.f_ppm_per_k
    warmed = sum(part.layers["2"][2] for part in of_head[2:])
    assert warmed == pytest.approx(ppm * 0.1e-6)
    disturbance = UncertaintyContribution(parts=parts)
    variance = np.diag(disturbance_covariance_px(DMC, mosaic, {"P2": AT}, disturbance))
    expected = sum(part.at(mosaic, "P2", AT) ** 2 for part in parts)
    np.testing.assert_allclose(variance.reshape(-1, 2), expected, rtol=1e-9)
    alone = placed_sigma_px(DMC, mosaic, "P2", AT, datum_covariance(DMC, mosaic, READ)) ** 2
    both = (
        placed_sigma_px(DMC, mosaic, "P2", AT, datum_covariance(DMC, mosaic, READ), disturbance)
        ** 2
    )
    np.testing.assert_allclose(both - alone, expected, rtol=1e-6)
