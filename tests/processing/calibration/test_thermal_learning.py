"""A flight of simulated tie points teaches the drift that was not in the rig file."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.calibration.thermal_learning import (
    LearnedDrift,
    ThermalState,
    add_exposure,
    empty_state,
    observability,
    solve_drift,
)
from processing.geometry.placement import nominal_placements
from processing.mosaic.free_mosaic import free_mosaic
from processing.mosaic.stitch_record import (
    StitchRecord,
    StitchRecordError,
    stitch_record,
    stitch_record_from_json,
    stitch_record_json,
)
from processing.rig import Cone, Rig, find_rig
from tests.processing.synthetic import make_truth, tie_points_of

DC_K = (-14.0, -10.0, -6.0, -2.0, 2.0, 6.0, 10.0, 14.0)
QUANTITIES = ("x_um", "y_um", "rotation_urad", "scale_ppm")


def aged(rig: Rig, seed: int = 11) -> Rig:
    """The camera as it has become: other rates, sensors a little off, other principal distances."""
    rng = np.random.default_rng(seed)

    def cone_of(cone: Cone) -> Cone:
        sensors = []
        for s in cone.sensors:
            d = s.drift
            drift = dataclasses.replace(
                d,
                x_um_per_k=d.x_um_per_k + rng.normal(0, 0.03),
                y_um_per_k=d.y_um_per_k + rng.normal(0, 0.03),
                rotation_urad_per_k=d.rotation_urad_per_k + rng.normal(0, 2.0),
            )
            sensors.append(
                dataclasses.replace(
                    s,
                    x_mm=s.x_mm + rng.normal(0, 3e-4),
                    y_mm=s.y_mm + rng.normal(0, 3e-4),
                    drift=drift,
                )
            )
        lens = dataclasses.replace(
            cone.lens, f_ppm_per_k=cone.lens.f_ppm_per_k + rng.normal(0, 2.0)
        )
        return dataclasses.replace(cone, sensors=tuple(sensors), lens=lens)

    return dataclasses.replace(rig, cones=tuple(cone_of(c) for c in rig.cones))


def flight(
    rig: Rig, true_rig: Rig, dcs: tuple[float, ...] = DC_K, *, seed: int = 1
) -> list[StitchRecord]:
    records = []
    for k, dc in enumerate(dcs):
        rng = np.random.default_rng([seed, k])
        truth = make_truth(true_rig, rng, temperature_c=20.0 + dc, sensor_px=0.0, layer_px=0.0)
        read = {probe: 20.0 + dc + rng.normal(0, 0.1) for probe in rig.probes}
        points = tie_points_of(truth, rng, per_overlap=100, per_sensor=200)
        mosaic = free_mosaic(rig, nominal_placements(rig, read, {}), points)
        records.append(stitch_record(rig, mosaic, read, read))
    return records


def gathered(rig: Rig, records: list[StitchRecord]) -> ThermalState:
    state = empty_state(rig)
    for record in records:
        state = add_exposure(rig, state, record)
    return state


@pytest.fixture(scope="module")
def rig() -> Rig:
    return find_rig("ultracam-x-mini")


@pytest.fixture(scope="module")
def true_rig(rig: Rig) -> Rig:
    return aged(rig)


@pytest.fixture(scope="module")
def records(rig: Rig, true_rig: Rig) -> list[StitchRecord]:
    return flight(rig, true_rig)


@pytest.fixture(scope="module")
def result(rig: Rig, records: list[StitchRecord]) -> LearnedDrift:
    return solve_drift(rig, gathered(rig, records))


def true_inner(rig: Rig, true_rig: Rig, cone: str) -> NDArray[np.float64]:
    """True less assumed rates of a cone (m, 4), without what is common to its sensors."""
    pairs = zip(rig.cone(cone).sensors, true_rig.cone(cone).sensors, strict=True)
    off = np.array(
        [
            [
                b.drift.x_um_per_k - a.drift.x_um_per_k,
                b.drift.y_um_per_k - a.drift.y_um_per_k,
                b.drift.rotation_urad_per_k - a.drift.rotation_urad_per_k,
                b.drift.scale_ppm_per_k - a.drift.scale_ppm_per_k,
            ]
            for a, b in pairs
        ]
    )
    rotation, grow = off[:, 2].mean(), off[:, 3].mean()
    for row, s in zip(off, rig.cone(cone).sensors, strict=True):
        row[0] -= (-rotation * s.y_mm + grow * s.x_mm) * 1e-3
        row[1] -= (rotation * s.x_mm + grow * s.y_mm) * 1e-3
    return np.asarray(off - off.mean(axis=0))


def test_the_rates_are_found_within_their_standard_deviations(
    rig: Rig, true_rig: Rig, result: LearnedDrift
) -> None:
    errors, sizes = [], []
    for cone in ("0", "1", "2"):
        truth = true_inner(rig, true_rig, cone)
        for row, sensor in zip(truth, (s for s in result.sensors if s.cone == cone), strict=True):
            found = np.array([sensor.rates[q] for q in QUANTITIES])
            sigma = np.array([sensor.rate_sigmas[q] for q in QUANTITIES])
            errors += list((found - row) / sigma)
            sizes.append(np.abs(row[:2]).max() / sigma[0])
    assert 0.4 < np.mean(np.square(errors)) < 1.9 and np.abs(errors).max() < 4.0
    assert max(sizes) > 3.0
    assert all(f < 1.6 for f in result.variance_factors.values())


def test_the_intercept_takes_the_displacement_not_the_rate(
    rig: Rig, true_rig: Rig, result: LearnedDrift
) -> None:
    master = [s for s in result.sensors if s.cone == "0"]
    moved = {
        a.name: (b.x_mm - a.x_mm, b.y_mm - a.y_mm)
        for a, b in zip(rig.cone("0").sensors, true_rig.cone("0").sensors, strict=True)
    }
    middle = np.mean(list(moved.values()), axis=0)
    for sensor in master:
        true_um = (np.array(moved[sensor.sensor]) - middle) * 1e3
        for k, what in enumerate(("x_um", "y_um")):
            off = sensor.offsets[what] - true_um[k]
            assert abs(off) < 4.0 * sensor.offset_sigmas[what]
            assert sensor.offset_sigmas[what] < 0.1


def test_principal_distances_are_found_against_the_master_cone(
    rig: Rig, true_rig: Rig, result: LearnedDrift
) -> None:
    def off(cone: str) -> float:
        return true_rig.cone(cone).lens.f_ppm_per_k - rig.cone(cone).lens.f_ppm_per_k

    assert [s.cone for s in result.scales] == ["1", "2", "3", "G"]
    for scale in result.scales:
        expected = off(scale.cone) - off("0")
        assert abs(scale.f_ppm_per_k - expected) < 4.0 * scale.sigma_ppm_per_k
        assert scale.sigma_ppm_per_k < 2.0


def test_below_five_kelvin_of_spread_nothing_is_learned(
    rig: Rig, records: list[StitchRecord]
) -> None:
    close = [r for r in records if -3.0 < r.dc_k["SU00"] < 3.0]
    few = solve_drift(rig, gathered(rig, close))
    assert not few.sensors and not few.scales
    assert set(few.reasons) == {
        "0 places", "1 places", "2 places", "1 scale", "2 scale", "3 scale", "G scale",
    }  # fmt: skip
    assert "5 K are needed" in few.reasons["0 places"]


def test_the_order_of_exposures_does_not_matter(
    rig: Rig, records: list[StitchRecord], result: LearnedDrift
) -> None:
    state = gathered(rig, records[4:][::-1])
    for record in records[:4]:
        state = add_exposure(rig, state, record)
    for a, b in zip(solve_drift(rig, state).sensors, result.sensors, strict=True):
        assert a.rates["x_um"] == pytest.approx(b.rates["x_um"], rel=1e-6, abs=1e-9)


def test_a_datum_over_other_sensors_teaches_the_same(rig: Rig, true_rig: Rig) -> None:
    rng = np.random.default_rng(5)
    truth = make_truth(true_rig, rng, temperature_c=30.0, sensor_px=0.0, layer_px=0.0)
    read = dict.fromkeys(rig.probes, 30.0)
    start, points = nominal_placements(rig, read, {}), tie_points_of(truth, rng)
    vectors = []
    for out in ((), ("SU01",)):
        mosaic = free_mosaic(rig, start, points, excluded_datum_sensors=out)
        state = add_exposure(rig, empty_state(rig), stitch_record(rig, mosaic, read, read))
        vectors.append(state.places["0"].vector / np.sqrt(np.diag(state.places["0"].information)))
    assert np.allclose(vectors[0], vectors[1], atol=0.02 * np.abs(vectors[0]).max())


def test_a_cone_without_a_measured_temperature_or_a_frame_is_passed_over(
    rig: Rig, records: list[StitchRecord]
) -> None:
    without = tuple(n for n in records[0].measured if n not in ("SU10", "SU11"))
    state = add_exposure(rig, empty_state(rig), dataclasses.replace(records[0], measured=without))
    assert state.places["1"].exposures == 0 and state.places["0"].exposures == 1
    assert state.scales["1"].exposures == 0 and state.scales["3"].exposures == 1


def test_another_calibrations_record_is_refused(rig: Rig, records: list[StitchRecord]) -> None:
    other = dataclasses.replace(records[0], calibration_id="another")
    with pytest.raises(ValueError, match="does not belong"):
        add_exposure(rig, empty_state(rig), other)


def test_what_cannot_be_seen_is_stated(rig: Rig) -> None:
    by_quantity = {o.what: o for o in observability(rig)}
    assert sum(not o.observable for o in by_quantity.values()) == 5
    assert not by_quantity["cone 0: common shift, rotation and scale of its sensors"].observable
    assert not by_quantity["a change of the principal distance common to all cones"].observable
    assert any("12 rates" in what for what, o in by_quantity.items() if o.observable)


def test_a_record_survives_its_file_and_a_broken_one_is_refused(
    records: list[StitchRecord],
) -> None:
    content = json.loads(json.dumps(stitch_record_json(records[0])))
    back = stitch_record_from_json(content)
    assert back.names == records[0].names and back.dc_k["SU30"] == content["dc_k"]["SU30"]
    assert np.allclose(back.values, records[0].values, rtol=1e-8)
    assert np.allclose(back.covariance, records[0].covariance, rtol=1e-7)
    for wrong in ({"format": 9}, {"values": [1.0]}, {"names": None}, {"dc_k": "no"}):
        with pytest.raises(StitchRecordError):
            stitch_record_from_json(content | wrong)


def test_a_rig_of_single_sensors_teaches_its_principal_distances_and_no_places() -> None:
    rig = find_rig("ultracam-l-mini")
    true_rig = aged(rig)
    result = solve_drift(rig, gathered(rig, flight(rig, true_rig, (-12.0, -4.0, 4.0, 12.0))))
    assert not result.sensors and len(result.scales) >= 1
    master = rig.master_cone
    for scale in result.scales:
        off = [
            true_rig.cone(c).lens.f_ppm_per_k - rig.cone(c).lens.f_ppm_per_k
            for c in (scale.cone, master)
        ]
        assert abs(scale.f_ppm_per_k - (off[0] - off[1])) < 4.0 * scale.sigma_ppm_per_k
