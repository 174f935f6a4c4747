"""dC by stitching against the dC the tie points were made with."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from processing.geometry.placement import nominal_placements
from processing.mosaic.estimated_dc import EstimatedDc, combined_dc, estimate_dc, expansion_rate
from processing.mosaic.free_mosaic import free_mosaic
from processing.rig import Cone, Rig, Sensor, ThermalDrift, find_rig
from tests.processing.synthetic import make_truth, tie_points_of

CALIBRATION_PX = 0.02


@pytest.fixture(scope="module")
def rig() -> Rig:
    return find_rig("ultracam-x-mini")


def estimates(
    rig: Rig, dc_k: float, seed: int, *, measured_dc_k: float | None = None
) -> tuple[EstimatedDc, ...]:
    """One exposure at `dc_k`; the probes say `measured_dc_k`."""
    rng = np.random.default_rng(seed)
    truth = make_truth(rig, rng, temperature_c=20.0 + dc_k, sensor_px=CALIBRATION_PX, layer_px=3.0)
    probe_dc_k = dc_k if measured_dc_k is None else measured_dc_k
    temperatures = dict.fromkeys(rig.probes, 20.0 + probe_dc_k)
    mosaic = free_mosaic(rig, nominal_placements(rig, temperatures, {}), tie_points_of(truth, rng))
    return estimate_dc(rig, mosaic, temperatures)


def with_sensors(rig: Rig, change: Callable[[Sensor], Sensor]) -> Rig:
    def changed(cone: Cone) -> Cone:
        return dataclasses.replace(cone, sensors=tuple(change(s) for s in cone.sensors))

    return dataclasses.replace(rig, cones=tuple(changed(cone) for cone in rig.cones))


def test_the_error_of_an_estimate_is_what_its_sigma_states(rig: Rig) -> None:
    errors = []
    for seed in range(16):
        dc = -20.0 + 40.0 * seed / 15.0
        for e in estimates(rig, dc, seed):
            assert e.estimated_k is not None and e.sigma_k is not None and e.sigma_k < 0.7
            errors.append((e.estimated_k - dc) / e.sigma_k)
            assert not e.disagrees
    # 48 estimates: the mean square lies within the 99.9 % interval of chi-square.
    assert 0.46 < np.mean(np.square(errors)) < 1.8
    assert np.abs(errors).max() < 4.0


def test_only_cones_of_two_or_more_sensors_give_an_estimate(rig: Rig) -> None:
    found = estimates(rig, 10.0, 1)
    assert [e.cone for e in found] == ["0", "1", "2"]
    combined = combined_dc(found)
    assert combined is not None and combined[1] < min(e.sigma_k or 9.0 for e in found)
    assert abs(combined[0] - 10.0) < 4.0 * combined[1]
    assert combined_dc([]) is None


def test_what_the_probes_say_does_not_move_the_estimate(rig: Rig) -> None:
    right, stuck = estimates(rig, 12.0, 3), estimates(rig, 12.0, 3, measured_dc_k=0.0)
    for a, b in zip(right, stuck, strict=True):
        assert a.estimated_k == pytest.approx(b.estimated_k, abs=0.02)
        assert b.measured_k == 0.0 and b.disagrees and not a.disagrees
        # At one temperature of all sensors the whole growth is the rate times the estimate.
        assert a.estimated_k is not None
        assert a.expansion_ppm == pytest.approx(a.rate_ppm_per_k * a.estimated_k, rel=1e-6)


def test_an_expired_model_disagrees_with_its_probes(rig: Rig) -> None:
    def softer(sensor: Sensor) -> Sensor:
        d = sensor.drift
        drift = dataclasses.replace(
            d, x_um_per_k=0.75 * d.x_um_per_k, y_um_per_k=0.75 * d.y_um_per_k
        )
        return dataclasses.replace(sensor, drift=drift)

    rng = np.random.default_rng(4)
    truth = make_truth(rig, rng, temperature_c=35.0, sensor_px=0.02, layer_px=1.0)
    points = tie_points_of(truth, rng)
    expired = with_sensors(rig, softer)
    probe_dc_k = dict.fromkeys(rig.probes, 35.0)
    mosaic = free_mosaic(expired, nominal_placements(expired, probe_dc_k, {}), points)
    assert all(e.disagrees for e in estimate_dc(expired, mosaic, probe_dc_k))


def test_a_mount_that_expands_like_silicon_yields_nothing(rig: Rig) -> None:
    silicon_ppm = rig.sensor("SU00").drift.scale_ppm_per_k

    def like_silicon(sensor: Sensor) -> Sensor:
        grown = silicon_ppm * 1e-3
        drift = dataclasses.replace(
            sensor.drift, x_um_per_k=sensor.x_mm * grown, y_um_per_k=sensor.y_mm * grown
        )
        return dataclasses.replace(sensor, drift=drift)

    silicon_rig = with_sensors(rig, like_silicon)
    assert abs(expansion_rate(silicon_rig.cone("0").sensors)[0]) < 1e-6
    for e in estimates(silicon_rig, 15.0, 5, measured_dc_k=0.0):
        assert e.estimated_k is None and e.sigma_k is None and not e.disagrees


def test_close_to_silicon_the_sigma_grows(rig: Rig) -> None:
    def invar_like(sensor: Sensor) -> Sensor:
        d = sensor.drift
        drift = ThermalDrift(0.3 * d.x_um_per_k, 0.3 * d.y_um_per_k, 0.0, d.scale_ppm_per_k, 0.001)
        return dataclasses.replace(sensor, drift=drift)

    softer = with_sensors(rig, invar_like)
    for near, far in zip(estimates(softer, 9.0, 6), estimates(rig, 9.0, 6), strict=True):
        assert near.estimated_k is not None and near.sigma_k is not None
        assert near.sigma_k > 3.0 * (far.sigma_k or 0.0)
        assert abs(near.estimated_k - 9.0) < 4.0 * near.sigma_k


def test_a_displaced_sensor_of_the_master_cone_can_be_left_out(rig: Rig) -> None:
    rng = np.random.default_rng(7)
    truth = make_truth(
        rig, rng, temperature_c=30.0, sensor_px=0.02, displaced={"SU02": (-3.0, -2.0)}
    )
    probe_dc_k = dict.fromkeys(rig.probes, 30.0)
    mosaic = free_mosaic(rig, nominal_placements(rig, probe_dc_k, {}), tie_points_of(truth, rng))
    fooled, robust = (
        estimate_dc(rig, mosaic, probe_dc_k, displaced=out)[0] for out in ((), ("SU02",))
    )
    assert fooled.disagrees and not robust.disagrees
    assert robust.estimated_k == pytest.approx(10.0, abs=4.0 * (robust.sigma_k or 0.0))


def test_without_tie_points_there_is_no_estimate(rig: Rig) -> None:
    rng = np.random.default_rng(8)
    truth = make_truth(rig, rng)
    points = tie_points_of(truth, rng, without=tuple(s.name for s in rig.sensors))
    mosaic = free_mosaic(rig, truth.start, points)
    assert all(e.estimated_k is None for e in estimate_dc(rig, mosaic, {}))


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_a_thousand_error_free_exposures_raise_no_flag_and_no_stuck_probe_is_missed(
    rig: Rig,
) -> None:
    """Calibration, coefficients and probes off by their sigmas; probe 1 then off by two limits."""
    false, missed, errors = 0, 0, []
    for k in range(1000):
        rng = np.random.default_rng([77, k])

        def off(sensor: Sensor, rng: np.random.Generator = rng) -> Sensor:
            d = sensor.drift
            x, y = rng.normal(0.0, d.sigma_um_per_k, 2)
            drift = dataclasses.replace(d, x_um_per_k=d.x_um_per_k + x, y_um_per_k=d.y_um_per_k + y)
            return dataclasses.replace(sensor, drift=drift)

        true_rig, dc = with_sensors(rig, off), rng.uniform(-20.0, 20.0)
        truth = make_truth(
            true_rig, rng, temperature_c=20.0 + dc, sensor_px=CALIBRATION_PX, layer_px=1.0
        )
        points = tie_points_of(truth, rng, per_overlap=60, per_sensor=120)
        read = {probe: 20.0 + dc + rng.normal(0.0, 0.1) for probe in rig.probes}
        mosaic = free_mosaic(rig, nominal_placements(rig, read, {}), points)
        found = estimate_dc(rig, mosaic, read)
        false += any(e.disagrees for e in found)
        errors += [((e.estimated_k or 0.0) - dc) / (e.sigma_k or 1.0) for e in found]
        limit = max(4.5 * float(np.hypot(found[1].sigma_k or 0.0, 0.1)), 1.0)
        stuck = read | {"1": read["1"] - 2.0 * limit}
        mosaic = free_mosaic(rig, nominal_placements(rig, stuck, {}), points)
        missed += not estimate_dc(rig, mosaic, stuck)[1].disagrees
    assert false <= 1 and missed <= 10
    assert 0.92 < np.mean(np.square(errors)) < 1.09
    assert np.mean(np.abs(errors) < 3.0) > 0.99 and np.abs(errors).max() < 5.0
