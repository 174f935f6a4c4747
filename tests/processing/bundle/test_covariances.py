"""Covariances of chosen points with everything, high correlations, residuals by area."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.adjustment_results import image_residuals_mm
from processing.bundle.correlations import high_correlations
from processing.bundle.network import NetworkError
from processing.bundle.residual_areas import residual_areas
from tests.processing.bundle.simulated_networks import aerial


@pytest.mark.parametrize("datum", ["none", "unknowns", "points", "dependent"])
def test_covariances_of_retained_points_are_those_of_all_unknowns_at_once(datum) -> None:
    control = 8 if datum == "none" else 0
    block = aerial(seed=3, sigma_mm=2e-3, lines=2, along=3, points=40, control=control)
    settings = AdjustmentSettings(
        minimum_norm=datum != "none", free_datum="unknowns" if datum == "none" else datum
    )
    plain = adjust(block.network, settings)
    chosen = [int(p) for p in plain.layout.eliminated_points[[12, 20, 25]]]
    names = tuple(f"p{p}" for p in chosen)
    result = adjust(block.network, replace(settings, retained=names))
    at = [k for k, u in enumerate(result.layout.unknowns) if u.kind == "point"]
    joint = result.cofactor[np.ix_(at, at)]
    of_points = np.concatenate([np.diag(joint)[3 * k : 3 * k + 3] for k in range(3)])
    alone = np.einsum("pii->pi", plain.point_cofactor[chosen]).ravel()
    if datum != "unknowns":
        assert of_points == pytest.approx(alone, rel=1e-5)
        assert result.state.points[chosen] == pytest.approx(plain.state.points[chosen], abs=1e-6)
    assert result.sigma0 == pytest.approx(plain.sigma0, rel=1e-9)
    if datum != "none":
        return
    normal = dense_normal(plain)
    c = plain.layout.columns
    points = list(plain.layout.eliminated_points)
    of = np.concatenate([c + 3 * points.index(p) + np.arange(3) for p in chosen])
    scale = np.sqrt(np.diag(normal))
    wanted = np.linalg.inv(normal / scale[:, None] / scale) / scale[:, None] / scale
    assert joint == pytest.approx(wanted[np.ix_(of, of)], rel=1e-6, abs=1e-12)
    with_stations = result.cofactor[np.ix_(at, range(c))]
    assert with_stations == pytest.approx(wanted[np.ix_(of, range(c))], rel=1e-6, abs=1e-12)


def dense_normal(result) -> np.ndarray:
    rows, points = result.equations, result.layout.eliminated_points
    c = result.layout.columns
    design = np.zeros((len(rows.misclosure), c + 3 * len(points)))
    design[:, :c] = rows.reduced.toarray()
    for k, p in enumerate(rows.point):
        if p >= 0:
            design[k, c + 3 * p : c + 3 * p + 3] = rows.point_part[k]
    return design.T @ design


def test_a_retained_point_that_is_not_there_is_refused() -> None:
    with pytest.raises(NetworkError, match="covariances of x1: no object points"):
        adjust(aerial(sigma_mm=1e-3).network, AdjustmentSettings(retained=("x1",)))


def test_f_and_height_of_a_block_over_level_ground_are_named_across_all_exposures() -> None:
    block = aerial(seed=2, sigma_mm=1e-3, relief_m=1.0, tilt_rad=1e-3, points=120)
    free = replace(block.network.cameras[0], free=frozenset({"df"}), sigma={"df": 0.5})
    result = adjust(replace(block.network, cameras=(free,)))
    groups = high_correlations(result)
    first = groups[0]
    assert {first.first_kind, first.second_kind} == {"camera", "station"}
    assert not first.is_of_one
    assert first.count == len(block.network.stations.names)
    assert {first.largest[0].first, first.largest[0].second} >= {"camera c df"}
    assert all(abs(c.value) > 0.9 and c.first != c.second for g in groups for c in g.largest)
    # Against all pairs, one by one.
    spread = np.sqrt(np.diag(result.cofactor))
    every = np.abs(np.triu(result.cofactor / spread[:, None] / spread, 1)) > 0.9
    assert sum(g.count for g in groups) == every.sum()
    same = [g for g in groups if g.is_of_one and g.first_kind == "attitude"]
    assert all(c.first.split()[1] == c.second.split()[1] for g in same for c in g.largest)


def test_residuals_are_stated_by_area_along_the_axes_of_the_ground() -> None:
    block = aerial(seed=2, sigma_mm=1e-3, lines=3, along=5, points=400)
    result = adjust(block.network)
    table = block.network.image_points
    plain = residual_areas(result, 4)
    assert plain.count.sum() == (~result.left_out[table.point]).sum()
    every = image_residuals_mm(result)
    squares = (plain.rms_mm**2 * plain.count).sum() / plain.count.sum()
    assert squares == pytest.approx(np.nanmean(every**2), rel=1e-9)
    # Residuals of 5 um east in one corner, none elsewhere, whatever way the images fly.
    rows = result.equations
    attitude = result.state.attitude[block.network.images.attitude[table.image]]
    ground = result.state.points[table.point, :2]
    corner = (ground < plain.centre_m[0] + 0.5 * plain.size_m).all(axis=1)
    east = 5e-3 * attitude[:, 0, :2] * corner[:, None]
    residual = np.zeros_like(result.residual)
    for axis in range(2):
        own = rows.group == axis
        residual[own] = east[rows.source[own], axis] / rows.sigma[own]
    areas = residual_areas(replace(result, residual=residual), 4)
    assert areas.mean_mm[0] == pytest.approx([5e-3, 0.0], abs=1e-5)
    assert np.abs(areas.mean_mm[1:]).max() == 0.0
    assert areas.centre_m[1] - areas.centre_m[0] == pytest.approx([areas.size_m, 0.0])


def test_areas_need_a_number() -> None:
    with pytest.raises(ValueError, match="0 areas"):
        residual_areas(adjust(aerial(sigma_mm=1e-3).network), 0)
