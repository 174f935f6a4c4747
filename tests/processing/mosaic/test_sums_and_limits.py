"""Sums of an adjustment and limits of a judgement, against their definitions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from processing.geometry.placement import nominal_placements
from processing.mosaic import validity
from processing.mosaic.free_mosaic import free_mosaic
from processing.mosaic.misfit import Misfit
from processing.mosaic.validity import Displacement, evaluate_master
from processing.rig import find_rig
from tests.processing.mosaic.test_precision import mosaic_of
from tests.processing.mosaic.test_validity import exposure
from tests.processing.synthetic import make_truth, no_tie_points, tie_points_of

MINI = find_rig("ultracam-x-mini")


def test_points_without_noise_leave_a_sigma0_of_nothing() -> None:
    rng = np.random.default_rng(2)
    truth = make_truth(MINI, rng, sensor_px=0.2, layer_px=0.5)
    points = tie_points_of(
        truth, rng, per_overlap=20, per_sensor=30, sigma_pp_px=1e-9, sigma_pc_px=1e-9
    )
    mosaic = free_mosaic(MINI, truth.start, points)
    assert mosaic.sigma0 < 1e-4
    assert mosaic.redundancy > 100.0
    # With a prior the unknowns take less than one degree of freedom each.
    supported = free_mosaic(MINI, truth.start, points, prior=np.eye(len(mosaic.values)))
    used = ~supported.outliers
    own = float(supported.redundancy_numbers[used].sum())
    assert supported.redundancy == pytest.approx(own, abs=1e-6)


def test_sums_are_those_of_the_points_in_use() -> None:
    _, mosaic = mosaic_of("ultracam-x-mini")
    used = ~mosaic.outliers
    assert mosaic.redundancy == pytest.approx(float(mosaic.redundancy_numbers[used].sum()))
    assert sum(mosaic.used.values()) == int(used.sum())
    assert mosaic.observations == 2 * int(used.sum())


def test_a_sensor_is_named_beyond_the_limit_of_two_coordinates_of_one_of_four() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    master_validity = evaluate_master(rig, mosaic, {})
    assert master_validity.limit == pytest.approx(chi2.isf(0.001 / 4, 2))
    assert master_validity.global_degrees_of_freedom == 4
    assert master_validity.global_limit == pytest.approx(chi2.isf(0.001, 4))


def test_a_camera_without_a_master_of_three_has_nothing_to_test() -> None:
    rig = find_rig("dmc-mini")
    mosaic = free_mosaic(rig, nominal_placements(rig, {}, {}), no_tie_points(rig))
    master_validity = evaluate_master(rig, mosaic, {})
    assert (
        master_validity.global_statistic,
        master_validity.global_degrees_of_freedom,
        master_validity.global_limit,
    ) == (0.0, 0, 0.0)
    assert master_validity.consistent and master_validity.limit == float("inf")
    assert (
        master_validity.hypotheses == ()
        and master_validity.displaced is None
        and not master_validity.several_displaced
    )


@pytest.mark.parametrize(("beyond", "displaced"), [(1.0, True), (-1.0, False)])
def test_of_what_a_wrong_probe_leaves_the_likeliest_sensor_decides(
    monkeypatch: pytest.MonkeyPatch, beyond: float, displaced: bool
) -> None:
    """Whether a sensor has moved as well, however wrong the probe is."""
    _, _, mosaic, read = exposure(40, {}, dc_k=0.0, misread_k=9.0)
    limit = float(chi2.isf(0.001 / 4, 2))
    plain = validity._hypotheses
    found: list[tuple[Displacement, ...]] = []

    def hypotheses(misfit: Misfit) -> tuple[Displacement, ...]:
        first, *others = plain(misfit)
        if len(found) == 2:
            first = dataclasses.replace(first, statistic=limit + beyond)
            others = [dataclasses.replace(h, statistic=limit - 2.0) for h in others]
        found.append((first, *others))
        return found[-1]

    monkeypatch.setattr(validity, "_hypotheses", hypotheses)
    master_validity = evaluate_master(MINI, mosaic, read)
    assert len(found) == 3
    assert master_validity.displaced == (found[2][0] if displaced else None)
    assert (master_validity.probe_bias is None) == displaced
