"""The earlier method: right where the calibration holds, worse where it does not."""

from __future__ import annotations

import numpy as np
import pytest

from processing.geometry.placement import start_similarity
from processing.mosaic.fixed_mosaic import fixed_mosaic
from processing.mosaic.free_mosaic import free_mosaic
from processing.rig import find_rig
from tests.processing.mosaic.test_free_mosaic import inner_error_px
from tests.processing.synthetic import make_truth, no_tie_points, tie_points_of

MINI = find_rig("ultracam-x-mini")


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_it_has_four_times_eight_unknowns_and_moves_no_sensor() -> None:
    rng = np.random.default_rng(1)
    truth = make_truth(MINI, rng, sensor_px=0.0)
    mosaic = fixed_mosaic(MINI, truth.start, tie_points_of(truth, rng))
    assert mosaic.method == "fixed"
    # PAN and green are adjusted one after the other, with three iterations each at least.
    assert mosaic.iterations >= 6
    assert len(mosaic.values) == mosaic.rank == len(mosaic.parameter_names) == 32
    assert mosaic.covariance.shape == (32, 32)
    assert mosaic.redundancy == mosaic.observations - 32
    for placement in mosaic.placements.values():
        assert placement.similarity == start_similarity(placement)
    assert np.array_equal(mosaic.placements["SU00"].layer, truth.start["SU00"].layer)


def test_with_sensors_in_place_it_finds_the_layers() -> None:
    rng = np.random.default_rng(2)
    truth = make_truth(MINI, rng, sensor_px=0.0)
    mosaic = fixed_mosaic(MINI, truth.start, tie_points_of(truth, rng))
    assert rms(inner_error_px(truth, mosaic)) < 0.08
    assert mosaic.sigma_pp_px == pytest.approx(0.1, rel=0.06)
    assert mosaic.sigma_pc_px == pytest.approx(0.3, rel=0.06)


def test_with_sensors_out_of_place_the_free_method_is_several_times_better() -> None:
    rng = np.random.default_rng(3)
    truth = make_truth(MINI, rng, sensor_px=0.5)
    points = tie_points_of(truth, rng)
    fixed = rms(inner_error_px(truth, fixed_mosaic(MINI, truth.start, points)))
    free = rms(inner_error_px(truth, free_mosaic(MINI, truth.start, points)))
    assert free < 0.05
    assert fixed > 5.0 * free


def test_missing_tie_points_hold_layers_at_their_start() -> None:
    rng = np.random.default_rng(4)
    truth = make_truth(MINI, rng, sensor_px=0.0)
    without_green = fixed_mosaic(MINI, truth.start, tie_points_of(truth, rng, without=("G",)))
    assert {name.split(".")[0] for name in without_green.undetermined} == {"G"}
    nothing = fixed_mosaic(MINI, truth.start, no_tie_points(MINI))
    assert len(nothing.undetermined) == 32
    assert not nothing.values.any()
