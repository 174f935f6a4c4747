"""A displaced sensor is named and its datum repaired; a healthy rig raises no alarm."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from processing.geometry.placement import nominal_placements, vip_mm_from_raw
from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic.free_mosaic import Mosaic, free_mosaic
from processing.mosaic.validity import evaluate_master, robust_datum
from processing.rig import Rig, find_rig
from tests.processing.geometry.test_topology import side_by_side_rig
from tests.processing.synthetic import Truth, make_truth, tie_points_of

Array = NDArray[np.float64]
MINI = find_rig("ultracam-x-mini")
PITCH_MM = 7.2e-3
MASTER = ("SU00", "SU01", "SU02", "SU03")


def calibration_offsets(rng: np.random.Generator, dc_k: float) -> dict[str, tuple[float, float]]:
    """What calibration and TDM coefficients may be off by, drawn from their sigmas, px."""
    result = {}
    for cone in MINI.pan_cones:
        if len(cone.sensors) < 2:
            continue
        probe_error_k = rng.normal(0.0, 0.1)
        for sensor in cone.sensors:
            sigma_um = math.hypot(sensor.position_sigma_um, sensor.drift.sigma_um_per_k * dc_k)
            common = np.array([sensor.drift.x_um_per_k, sensor.drift.y_um_per_k]) * probe_error_k
            x, y = (rng.normal(0.0, sigma_um, 2) + common) / 7.2
            result[sensor.name] = (float(x), float(y))
    return result


def exposure(
    seed: int,
    displaced: dict[str, tuple[float, float]],
    *,
    dc_k: float = 10.0,
    sigma_pp_px: float = 0.03,
    sigma_pc_px: float = 0.15,
    misread_k: float = 0.0,
    rig: Rig = MINI,
) -> tuple[Truth, TiePoints, Mosaic, dict[str, float]]:
    """An exposure whose probe 0 reads `misread_k` too much."""
    rng = np.random.default_rng(seed)
    offsets = calibration_offsets(rng, dc_k)
    for name, (x, y) in displaced.items():
        offsets[name] = (offsets[name][0] + x, offsets[name][1] + y)
    truth = make_truth(rig, rng, temperature_c=20.0 + dc_k, sensor_px=0.0, displaced=offsets)
    points = tie_points_of(truth, rng, sigma_pp_px=sigma_pp_px, sigma_pc_px=sigma_pc_px)
    read = dict.fromkeys(rig.probes, 20.0 + dc_k) | {"0": 20.0 + dc_k + misread_k}
    mosaic = free_mosaic(rig, nominal_placements(rig, read, {}), points)
    return truth, points, mosaic, read


def absolute_error_px(truth: Truth, mosaic: Mosaic) -> float:
    """Root mean square distance of PAN pixels from their true place, without any fit."""
    errors = []
    for name, placement in truth.placements.items():
        if placement.cone.role == "pan":
            raw = np.random.default_rng(0).uniform(0, (1247, 831), (50, 2))
            off = vip_mm_from_raw(mosaic.placements[name], raw) - vip_mm_from_raw(placement, raw)
            errors.append(np.sum((off / PITCH_MM) ** 2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(errors))))


def test_fifty_error_free_exposures_raise_no_alarm_and_follow_the_chi_square() -> None:
    statistics = []
    for seed in range(50):
        _, _, mosaic, temperatures = exposure(seed, {})
        validity = evaluate_master(MINI, mosaic, temperatures)
        assert validity.displaced is None, seed
        assert not validity.several_displaced
        assert not any(relative.significant for relative in validity.relative), seed
        assert validity.global_degrees_of_freedom == 4
        statistics.append(validity.global_statistic)
    low, high = chi2.ppf([0.0005, 0.9995], 4 * 50)
    assert low < sum(statistics) < high


@pytest.mark.parametrize("length", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("sensor", MASTER)
def test_a_displaced_master_sensor_is_named_with_its_displacement(
    sensor: str, length: float
) -> None:
    angle = 2.0 * MASTER.index(sensor) + length
    moved = (length * math.cos(angle), length * math.sin(angle))
    _, _, mosaic, temperatures = exposure(7, {sensor: moved})
    validity = evaluate_master(MINI, mosaic, temperatures)
    assert validity.displaced is not None
    assert validity.displaced.sensor == sensor
    assert not validity.several_displaced
    error = (validity.displaced.dx_px - moved[0], validity.displaced.dy_px - moved[1])
    assert abs(error[0]) < 4.0 * validity.displaced.sigma_x_px
    assert abs(error[1]) < 4.0 * validity.displaced.sigma_y_px
    assert validity.displaced.sigma_x_px < 0.08
    # Half of it shows as a residual in the datum of all four.
    residual = next(r for r in validity.residuals if r.sensor == sensor)
    assert math.hypot(residual.dx_px, residual.dy_px) == pytest.approx(length / 2.0, abs=0.1)


def test_the_estimated_displacement_is_as_good_as_its_sigma() -> None:
    normalised = []
    for seed in range(30):
        _, _, mosaic, temperatures = exposure(200 + seed, {"SU02": (0.9, -0.6)})
        d = evaluate_master(MINI, mosaic, temperatures).displaced
        assert d is not None
        assert d.sensor == "SU02"
        normalised += [(d.dx_px - 0.9) / d.sigma_x_px, (d.dy_px + 0.6) / d.sigma_y_px]
    low, high = chi2.ppf([0.0005, 0.9995], len(normalised))
    assert low < float(np.sum(np.square(normalised))) < high


def test_the_robust_datum_corrects_the_absolute_position_and_nothing_else() -> None:
    truth, points, mosaic, temperatures = exposure(11, {"SU01": (1.6, -1.2)})
    validity = evaluate_master(MINI, mosaic, temperatures)
    repaired = robust_datum(MINI, truth.start, points, mosaic, validity)
    assert repaired.datum_sensors == ("SU00", "SU02", "SU03")
    assert absolute_error_px(truth, mosaic) > 0.5
    assert absolute_error_px(truth, repaired) < 0.08
    assert repaired.sigma0 == pytest.approx(mosaic.sigma0, rel=1e-3)


def test_without_a_displaced_sensor_the_robust_datum_is_the_same_mosaic() -> None:
    truth, points, mosaic, temperatures = exposure(12, {})
    validity = evaluate_master(MINI, mosaic, temperatures)
    assert robust_datum(MINI, truth.start, points, mosaic, validity) is mosaic


def test_the_evaluation_does_not_depend_on_the_datum() -> None:
    truth, points, mosaic, temperatures = exposure(13, {"SU03": (0.5, 0.5)})
    first = evaluate_master(MINI, mosaic, temperatures)
    second = evaluate_master(
        MINI, robust_datum(MINI, truth.start, points, mosaic, first), temperatures
    )
    assert first.displaced is not None
    assert second.displaced is not None
    assert second.displaced.sensor == "SU03"
    assert second.displaced.dx_px == pytest.approx(first.displaced.dx_px, abs=1e-3)
    assert second.global_statistic == pytest.approx(first.global_statistic, rel=5e-3)


def test_a_small_displacement_that_two_sensors_explain_alike_is_reported_as_ambiguous() -> None:
    truth, points, mosaic, temperatures = exposure(17, {"SU00": (0.2, 0.0)}, sigma_pp_px=0.05)
    validity = evaluate_master(MINI, mosaic, temperatures)
    assert validity.displaced is not None
    assert validity.alternatives
    assert validity.displaced.sensor not in validity.alternatives
    assert len(validity.hypotheses) == 4
    # Wrongly blamed it would spoil the datum, so the datum rests on neither.
    ambiguous = {validity.displaced.sensor, *validity.alternatives}
    repaired = robust_datum(MINI, truth.start, points, mosaic, validity)
    assert len(ambiguous) == 2 and set(repaired.datum_sensors) == set(MASTER) - ambiguous
    _, _, clear, temperatures = exposure(14, {"SU00": (3.0, 0.0)})
    assert evaluate_master(MINI, clear, temperatures).alternatives == ()


@pytest.mark.parametrize(("left", "named"), [(20, False), (60, True)])
def test_where_a_few_points_of_another_sensor_explain_it_nobody_is_named(
    left: int, named: bool
) -> None:
    truth, points, _, temperatures = exposure(17, {"SU00": (0.2, 0.0)}, sigma_pp_px=0.05)
    ambiguous = evaluate_master(MINI, free_mosaic(MINI, truth.start, points), temperatures)
    assert ambiguous.displaced is not None and ambiguous.displaced.sensor == "SU00"
    other = ambiguous.alternatives[0]
    number = points.names.index(other)
    of_other = (points.sensor_a == number) | (points.sensor_b == number)
    rows = np.flatnonzero(of_other & (points.kind == PAN_TO_PAN))
    keep = np.ones(len(points), np.bool_)
    keep[rows] = False
    keep[rows[:: max(1, len(rows) // left)][:left]] = True
    fewer = free_mosaic(MINI, truth.start, points.only(keep))
    validity = evaluate_master(MINI, fewer, temperatures)
    found = validity.displaced if named else validity.insignificant_displacement
    assert found is not None and found.sensor in ("SU00", other)
    assert (validity.displaced is not None) is named


def test_two_displaced_sensors_are_not_passed_off_as_one() -> None:
    _, _, mosaic, temperatures = exposure(15, {"SU00": (2.0, 0.0), "SU03": (0.0, 2.0)})
    assert evaluate_master(MINI, mosaic, temperatures).several_displaced


def test_a_biased_probe_is_named_and_no_sensor_is() -> None:
    off = []
    for seed in range(40, 46):
        _, _, mosaic, temperatures = exposure(seed, {}, dc_k=0.0, misread_k=9.0)
        validity = evaluate_master(MINI, mosaic, temperatures)
        assert validity.hypotheses[0].statistic > validity.limit, "a sensor would have been accused"
        assert validity.displaced is None and not validity.several_displaced
        assert validity.probe_bias is not None and validity.probe_bias.probe == "0"
        assert validity.probe_bias.sigma_k < 0.5
        off.append((validity.probe_bias.bias_k - 9.0) / validity.probe_bias.sigma_k)
    assert max(np.abs(off)) < 4.0


def test_a_sensor_that_moved_is_named_whatever_the_probe_reads() -> None:
    for misread_k in (-4.0, 0.0, 4.0):
        _, _, mosaic, temperatures = exposure(47, {"SU03": (0.5, 0.3)}, misread_k=misread_k)
        validity = evaluate_master(MINI, mosaic, temperatures)
        assert validity.displaced is not None and validity.displaced.sensor == "SU03", misread_k
        assert validity.probe_bias is None and not validity.several_displaced


def test_a_sensor_with_a_probe_of_its_own_may_be_warm_or_displaced() -> None:
    cones = [
        dataclasses.replace(
            cone,
            sensors=tuple(
                dataclasses.replace(s, probe="9") if s.name == "SU02" else s for s in cone.sensors
            ),
        )
        for cone in MINI.cones
    ]
    rig = dataclasses.replace(MINI, cones=tuple(cones))
    drift = rig.sensor("SU02").drift
    two_kelvin = (2.0 * drift.x_um_per_k / 7.2, 2.0 * drift.y_um_per_k / 7.2)
    _, _, mosaic, temperatures = exposure(48, {"SU02": two_kelvin}, dc_k=0.0, rig=rig)
    validity = evaluate_master(rig, mosaic, temperatures)
    assert validity.displaced is not None and validity.displaced.sensor == "SU02"
    assert validity.probe_bias is not None and validity.probe_bias.probe == "9"
    assert validity.probe_bias.bias_k == pytest.approx(-2.0, abs=4.0 * validity.probe_bias.sigma_k)
    across = (-two_kelvin[1], two_kelvin[0])
    _, _, mosaic, temperatures = exposure(49, {"SU02": across}, dc_k=0.0, rig=rig)
    validity = evaluate_master(rig, mosaic, temperatures)
    assert validity.displaced is not None and validity.probe_bias is None


def test_in_a_two_sensor_cone_only_the_relative_displacement_is_known() -> None:
    _, _, mosaic, temperatures = exposure(16, {"SU11": (0.6, -0.4)})
    validity = evaluate_master(MINI, mosaic, temperatures)
    assert validity.displaced is None
    assert validity.observability == {
        "0": "named",
        "1": "relative",
        "2": "relative",
        "3": "unobservable",
    }
    one, two = validity.relative
    assert (one.cone, one.sensor_a, one.sensor_b) == ("1", "SU10", "SU11")
    assert one.significant
    assert one.dx_px == pytest.approx(-0.6, abs=4 * one.sigma_x_px)
    assert one.dy_px == pytest.approx(0.4, abs=4 * one.sigma_y_px)
    assert not two.significant


def test_a_sensor_alone_in_its_cone_moves_unseen() -> None:
    rng = np.random.default_rng(17)
    truth = make_truth(MINI, rng, sensor_px=0.0, temperature_c=20.0)
    # A move of SU30 within its layer is a move of the layer: P takes it all.
    p = truth.placements["SU30"]
    moved = dataclasses.replace(
        p, similarity=dataclasses.replace(p.similarity, x_mm=p.similarity.x_mm + 2 * PITCH_MM)
    )
    shifted = dataclasses.replace(truth, placements={**truth.placements, "SU30": moved})
    mosaic = free_mosaic(MINI, truth.start, tie_points_of(shifted, rng))
    validity = evaluate_master(MINI, mosaic, dict.fromkeys(MINI.probes, 20.0))
    assert validity.displaced is None
    assert validity.consistent
    assert mosaic.sigma0 == pytest.approx(1.0, abs=0.05)


def test_with_three_master_sensors_a_displacement_is_seen_but_nobody_is_cleared() -> None:
    rng = np.random.default_rng(18)
    truth = make_truth(MINI, rng, sensor_px=0.0, temperature_c=20.0, displaced={"SU00": (3.0, 0)})
    points = tie_points_of(truth, rng, without=("SU03",))
    validity = evaluate_master(
        MINI, free_mosaic(MINI, truth.start, points), dict.fromkeys(MINI.probes, 20.0)
    )
    assert validity.observability["0"] == "relative"
    assert validity.displaced is not None
    assert set(validity.alternatives) | {validity.displaced.sensor} == {"SU00", "SU01", "SU02"}


def test_a_rig_of_single_sensors_has_nothing_to_evaluate() -> None:
    rig = side_by_side_rig()
    rng = np.random.default_rng(19)
    truth = make_truth(rig, rng)
    mosaic = free_mosaic(rig, truth.start, tie_points_of(truth, rng))
    validity = evaluate_master(rig, mosaic, {})
    assert validity.observability == {"0": "unobservable", "1": "unobservable"}
    assert validity.displaced is None
    assert validity.consistent
    assert validity.residuals == ()


def test_an_unknown_temperature_widens_what_counts_as_error_free() -> None:
    _, _, mosaic, temperatures = exposure(20, {"SU00": (0.5, 0.0)})
    known = evaluate_master(MINI, mosaic, temperatures)
    unknown = evaluate_master(MINI, mosaic, {})
    assert known.displaced is not None
    assert unknown.global_statistic < known.global_statistic
