"""A flight of exposures shows small displacements that one exposure cannot see."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import pytest

from processing.geometry.placement import nominal_placements
from processing.mosaic.flight_validity import FlightValidity, evaluate_flight
from processing.mosaic.free_mosaic import free_mosaic
from processing.mosaic.stitch_record import ROTATIONS, StitchRecord, stitch_record
from processing.rig import Rig, find_rig
from tests.processing.synthetic import make_truth, tie_points_of

MINI = find_rig("ultracam-x-mini")
EXPOSURES = 48
Moves = Mapping[str, tuple[int, tuple[float, float]]]
"""By sensor: the first exposure with it, and how far, px."""


def camera_errors(rig: Rig, seed: int) -> dict[str, tuple[float, float]]:
    """What the calibration of one camera does not know, px: the same for all of a flight."""
    rng = np.random.default_rng([seed, 99])
    errors = {}
    for sensor in (s for cone in rig.pan_cones if len(cone.sensors) > 1 for s in cone.sensors):
        x, y = rng.normal(0.0, sensor.position_sigma_um / sensor.pitch_um, 2)
        errors[sensor.name] = (float(x), float(y))
    return errors


def template(rig: Rig) -> StitchRecord:
    """The record of one real adjustment, of a camera as calibrated: its covariance is what
    counts."""
    rng = np.random.default_rng(0)
    truth = make_truth(rig, rng, temperature_c=20.0, sensor_px=0.0)
    points = tie_points_of(
        truth, rng, per_overlap=60, per_sensor=60, sigma_pp_px=0.02, sigma_pc_px=0.1
    )
    read = dict.fromkeys(rig.probes, 20.0)
    mosaic = free_mosaic(rig, nominal_placements(rig, read, {}), points)
    record = stitch_record(rig, mosaic, read, read)
    # Turns of cones follow from the layers and say nothing of places.
    place_rows = [i for i, name in enumerate(record.names) if not name.endswith(ROTATIONS)]
    return dataclasses.replace(
        record,
        names=tuple(record.names[i] for i in place_rows),
        values=record.values[place_rows],
        covariance=record.covariance[np.ix_(place_rows, place_rows)],
    )


RECORD = template(MINI)
SPREAD, AXES = np.linalg.eigh(RECORD.covariance)


def records_of(moves: Moves, *, seed: int, count: int = EXPOSURES) -> dict[int, StitchRecord]:
    """Records of a flight in which sensors move, and dC falls by twelve kelvin."""
    errors = camera_errors(MINI, seed)
    coefficients = np.random.default_rng([seed, 98])
    drift = {s.name: coefficients.normal(0.0, s.drift.sigma_um_per_k, 2) for s in MINI.sensors}
    records = {}
    for number in range(1, count + 1):
        rng = np.random.default_rng([seed, number])
        dc = 8.0 - 12.0 * number / count
        probe_bias = {probe: float(rng.normal(0.0, 0.1)) for probe in MINI.probes}
        noise = AXES @ (np.sqrt(np.maximum(SPREAD, 0.0)) * rng.standard_normal(len(SPREAD)))
        values = noise.copy()
        for name, error in errors.items():
            sensor = MINI.sensor(name)
            since, far = moves.get(name, (count + 1, (0.0, 0.0)))
            per_kelvin = (sensor.drift.x_um_per_k, sensor.drift.y_um_per_k)
            for axis in (0, 1):
                place = (error[axis] + (number >= since) * far[axis]) * sensor.pitch_um
                place += drift[name][axis] * dc - per_kelvin[axis] * probe_bias[sensor.probe]
                values[RECORD.names.index(f"{name}.{'xy'[axis]}_um")] += place
        dc_k = {s.name: dc + probe_bias[s.probe] for s in MINI.sensors if s.name in RECORD.dc_k}
        records[number] = dataclasses.replace(RECORD, values=values, dc_k=dc_k)
    return records


def fly(moves: Moves, *, seed: int, count: int = EXPOSURES) -> FlightValidity:
    return evaluate_flight(MINI, records_of(moves, seed=seed, count=count))


def test_a_sensor_that_moves_by_eight_hundredths_is_named_with_the_exposure_it_began() -> None:
    validity = fly({"SU02": (31, (0.064, -0.048))}, seed=8)
    (step,) = validity.steps
    assert (step.kind, step.sensor, step.alternatives) == ("named", "SU02", ())
    assert abs(step.since - 31) <= 1 and step.earliest <= 31 <= step.latest
    assert math.hypot(step.dx_px - 0.064, step.dy_px + 0.048) < 4.0 * step.sigma_px
    assert step.sigma_px < 0.015
    assert f"SU02 has been displaced by {step.length_px:.2f} +- " in step.sentence
    assert f"px since exposure {step.since}" in step.sentence


def test_a_hundred_error_free_flights_report_nothing() -> None:
    for seed in range(100):
        validity = fly({}, seed=1000 + seed)
        assert validity.steps == (), seed
        assert set(validity.exposures) == {"0", "1", "2"}
        assert min(validity.exposures.values()) > EXPOSURES - 3


def test_what_is_stated_of_a_displacement_is_as_sure_as_its_sigma() -> None:
    normalised, spans, sure = [], 0, 0
    for seed in range(60):
        since, angle = 10 + seed % 30, 0.1 * seed
        moved = (0.08 * math.cos(angle), 0.08 * math.sin(angle))
        for step in fly({"SU02": (since, moved)}, seed=2000 + seed).steps:
            assert "SU02" in (step.sensor, *step.alternatives), seed
            sure += (step.sensor, step.alternatives) == ("SU02", ())
            spans += step.earliest <= since <= step.latest
            normalised.append((step.length_px - 0.08) / step.sigma_px)
    assert len(normalised) >= 54 and spans >= 0.95 * len(normalised) and sure >= 42
    assert 0.7 < float(np.std(normalised)) < 1.3 and abs(float(np.mean(normalised))) < 0.5


def test_what_was_displaced_before_the_flight_is_reported_from_its_beginning() -> None:
    (step,) = fly({"SU01": (0, (0.3, 0.2))}, seed=2, count=24).steps
    assert step.from_start and step.sensor == "SU01" and step.kind == "named"
    # What calibration does not know stays in the sum, however many exposures there are.
    assert step.sigma_px > 0.015
    assert math.hypot(step.dx_px - 0.3, step.dy_px - 0.2) < 4.0 * step.sigma_px
    assert "since before exposure 1" in step.sentence


def test_two_sensors_that_move_at_once_are_reported_as_ambiguous() -> None:
    validity = fly({"SU00": (20, (0.3, 0.1)), "SU03": (20, (-0.1, 0.3))}, seed=3, count=36)
    (step,) = validity.steps
    assert step.kind == "several" and abs(step.since - 20) <= 1
    assert "More than one sensor of cone 0" in step.sentence
    assert "cannot be determined" in step.sentence


def test_two_sensors_that_move_one_after_the_other_are_both_named() -> None:
    validity = fly({"SU00": (12, (0.3, 0.1)), "SU03": (26, (-0.1, 0.25))}, seed=4, count=36)
    assert [(s.sensor, s.kind) for s in validity.steps] == [("SU00", "named"), ("SU03", "named")]
    assert [s.since for s in validity.steps] == pytest.approx([12, 26], abs=1)


def test_in_a_cone_of_two_the_displaced_sensor_cannot_be_determined() -> None:
    (step,) = fly({"SU11": (15, (0.15, -0.1))}, seed=5, count=30).steps
    assert step.cone == "1" and step.kind == "relative"
    assert {step.sensor, *step.alternatives} == {"SU10", "SU11"}
    assert step.length_px == pytest.approx(math.hypot(0.15, 0.1), abs=4.0 * step.sigma_px)
    assert "against each other" in step.sentence


def test_one_wrong_exposure_is_no_displacement() -> None:
    records = records_of({}, seed=6, count=20)
    wrong = records_of({"SU02": (1, (0.5, 0.0))}, seed=6, count=20)[10]
    validity = evaluate_flight(MINI, records | {10: wrong})
    assert validity.steps == () and validity.left_out["0"] == (10,)


def test_real_adjustments_of_a_flight_give_the_same() -> None:
    errors = camera_errors(MINI, 7)
    records = {}
    for number in range(1, 13):
        rng = np.random.default_rng([7, number])
        places = dict(errors)
        if number >= 6:
            places["SU02"] = (errors["SU02"][0] + 0.1, errors["SU02"][1] - 0.1)
        truth = make_truth(MINI, rng, temperature_c=25.0, sensor_px=0.0, displaced=places)
        points = tie_points_of(truth, rng, per_overlap=60, per_sensor=60, sigma_pp_px=0.02)
        read = dict.fromkeys(MINI.probes, 25.0)
        mosaic = free_mosaic(MINI, nominal_placements(MINI, read, {}), points)
        records[number] = stitch_record(MINI, mosaic, read, read)
    (step,) = evaluate_flight(MINI, records).steps
    assert step.sensor == "SU02" and step.since == 6
    assert math.hypot(step.dx_px - 0.1, step.dy_px + 0.1) < 4.0 * step.sigma_px


def test_probes_that_misread_since_an_exposure_are_reported_and_no_sensor_of_the_master() -> None:
    errors = camera_errors(MINI, 9)
    records = {}
    for number in range(1, 13):
        rng = np.random.default_rng([9, number])
        truth = make_truth(MINI, rng, temperature_c=25.0, sensor_px=0.0, displaced=errors)
        points = tie_points_of(truth, rng, per_overlap=60, per_sensor=60, sigma_pp_px=0.02)
        read = dict.fromkeys(MINI.probes, 25.0)
        if number >= 7:
            read |= {"0": 29.0, "1": 22.0}
        mosaic = free_mosaic(MINI, nominal_placements(MINI, read, {}), points)
        records[number] = stitch_record(MINI, mosaic, read, read)
    master, other = sorted(evaluate_flight(MINI, records).steps, key=lambda step: step.cone)
    assert (master.kind, master.since, master.sensor) == ("misread", 7, "")
    assert master.probe_bias is not None and master.probe_bias.probe == "0"
    assert abs(master.probe_bias.bias_k - 4.0) < 4.0 * master.probe_bias.sigma_k < 2.0
    assert master.sentence.startswith("Probe 0 has read ")
    assert master.sentence.endswith("K too high on average since exposure 7 or earlier; check it.")
    # Of two sensors only the way between them is seen: a probe explains it as well as a slip.
    assert (other.kind, other.cone, other.since) == ("relative", "1", 7)
    assert other.probe_bias is not None and other.probe_bias.probe == "1"
    assert abs(other.probe_bias.bias_k + 3.0) < 4.0 * other.probe_bias.sigma_k < 2.0
    assert "or probe 1 has read " in other.sentence and "too low" in other.sentence


def test_a_stuck_probe_is_no_row_of_steps_and_hides_no_sensor() -> None:
    slipped = records_of({"SU02": (20, (0.2, -0.15))}, seed=10, count=32)
    for moved, records in (((), records_of({}, seed=10, count=32)), (("SU02",), slipped)):
        stuck = {}
        for number, record in records.items():
            # The mount cools by 0.375 K from one exposure to the next; the probe does not follow.
            bias_k = 0.375 * max(0, number - 8)
            values, dc_k = record.values.copy(), dict(record.dc_k)
            for sensor in MINI.master_sensors:
                drift = sensor.drift
                for what, rate in (
                    ("x_um", drift.x_um_per_k),
                    ("y_um", drift.y_um_per_k),
                    ("scale_ppm", drift.scale_ppm_per_k),
                ):
                    values[record.names.index(f"{sensor.name}.{what}")] -= rate * bias_k
                dc_k[sensor.name] += bias_k
            stuck[number] = dataclasses.replace(record, values=values, dc_k=dc_k)
        steps = [s for s in evaluate_flight(MINI, stuck).steps if s.cone == "0"]
        assert [s.probe_bias.probe for s in steps if s.probe_bias and s.kind == "misread"] == ["0"]
        assert tuple(s.sensor for s in steps if s.kind != "misread") == moved


def test_too_few_exposures_yield_nothing() -> None:
    assert evaluate_flight(MINI, {}).steps == ()
