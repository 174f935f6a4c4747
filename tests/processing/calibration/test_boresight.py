"""Boresight, lever arm, time offset err as their covariance predicts; inseparable parameters are
named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.boresight import error_of, evaluate, inertial_of, network_of
from daemon.postflight.calibration.boresight_calibration import controlled_of
from processing.bundle.adjust import adjust
from processing.bundle.initial_values import completed
from processing.calibration.boresight import (
    PARAMETER_SCALES,
    PARAMETERS,
    BoresightCalibration,
    calibrate_boresight,
    mounting_of,
)
from sim_hw.blocks.calibration_flight import (
    FULL,
    ONE_WAY,
    CalibrationLine,
    simulate_calibration_flight,
)

SEEDS = (1, 2, 3)


@pytest.fixture(scope="module")
def runs() -> list[tuple[BoresightCalibration, np.ndarray, float, int]]:
    return [evaluate(seed, FULL) for seed in SEEDS]


def test_errors_are_as_large_as_their_covariance_states(runs) -> None:
    squares, rank = sum(r[2] for r in runs), sum(r[3] for r in runs)
    low, high = chi2.ppf([0.0005, 0.9995], rank)
    assert low < squares < high
    for found, error, _, _ in runs:
        there = found.determined
        assert (np.abs(error[there]) < 4.5 * found.sigma[there]).all()
        assert found.sigma0 == pytest.approx(1.0, abs=0.2)


def test_a_full_flight_leaves_only_height_and_the_lever_arm_down_together(runs) -> None:
    for found, _, _, rank in runs:
        assert rank == 9
        (together,) = found.inseparable
        assert together.parameters == ("lever arm down", "position shift up")
        assert "survey the lever arm" in together.sentence
        assert found.mounting.antenna_m[2] == pytest.approx(-1.25, abs=0.3), "as it was given"


def test_a_surveyed_lever_arm_parts_them() -> None:
    found, error, _, rank = evaluate(1, FULL, lever_sigma_m=0.02)
    assert rank == 10 and not found.inseparable and found.determined.all()
    assert (np.abs(error) < 4.0 * found.sigma).all()


def test_one_direction_at_one_speed_is_reported_with_what_would_separate_it() -> None:
    found, error, squares, rank = evaluate(1, ONE_WAY)
    assert rank == 7
    groups = {u.parameters for u in found.inseparable}
    assert ("lever arm forward", "position shift north") in groups
    assert ("lever arm right", "position shift east") in groups
    assert any("opposite and in crossing" in u.sentence for u in found.inseparable)
    assert found.determined[:3].all() and (np.abs(error[:3]) < 4.0 * found.sigma[:3]).all()
    assert squares / rank < chi2.ppf(0.9995, rank) / rank


def _calm(lines: tuple[CalibrationLine, ...]) -> BoresightCalibration:
    flight = simulate_calibration_flight(4, lines, swing_deg=(0.001, 0.002))
    result = adjust(completed(network_of(flight)))
    every = tuple(range(len(flight.centre_m)))
    given = mounting_of(np.array([0.3, -0.2, -1.2]), np.zeros(3))
    return calibrate_boresight(
        controlled_of(result, every), inertial_of(flight), given, held=("shift",)
    )


def test_in_calm_air_one_speed_confuses_time_with_the_lever_arm_and_two_do_not() -> None:
    one = (
        CalibrationLine(0.0, 700.0, 65.0),
        CalibrationLine(180.0, 700.0, 65.0),
        CalibrationLine(90.0, 1100.0, 65.0),
    )
    (together,) = _calm(one).inseparable
    assert set(together.parameters) == {"lever arm forward", "time offset"}
    assert "fly two speeds" in together.sentence
    assert not _calm(FULL).inseparable


def test_what_is_held_stays(runs) -> None:
    flight = simulate_calibration_flight(1)
    result = adjust(completed(network_of(flight)))
    given = mounting_of(flight.antenna_m, np.zeros(3), time_offset_s=0.001)
    found = calibrate_boresight(
        controlled_of(result, tuple(range(len(flight.centre_m)))),
        inertial_of(flight),
        given,
        held=("lever", "time"),
    )
    assert found.mounting.time_offset_s == 0.001
    assert (found.mounting.antenna_m == flight.antenna_m).all()
    assert np.isnan(found.sigma[3:7]).all()
    assert len(PARAMETERS) == len(PARAMETER_SCALES) == len(error_of(found, flight)) == 10


def test_a_group_that_is_none_is_refused() -> None:
    flight = simulate_calibration_flight(1)
    result = adjust(completed(network_of(flight)))
    every = tuple(range(len(flight.centre_m)))
    with pytest.raises(ValueError, match="one of boresight, lever, time, shift"):
        calibrate_boresight(
            controlled_of(result, every),
            inertial_of(flight),
            mounting_of(np.zeros(3), np.zeros(3)),
            held=("clock",),
        )
