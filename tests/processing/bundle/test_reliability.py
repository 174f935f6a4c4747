"""Critical values, minimal detectable bias and external reliability against direct computation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks.blunder_search import aerial_lines, false_alarms, search
from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.critical_values import critical_value, number_of_tests
from processing.bundle.data_snooping import names_of
from processing.bundle.network import Network, NetworkError
from processing.bundle.normal_equations import reduced_equations
from processing.bundle.reliability import reliability_of
from tests.processing.bundle.simulated_networks import aerial

BAARDA = AdjustmentSettings(significance=0.05, test="baarda")


@pytest.fixture(scope="module")
def strip() -> Network:
    return aerial(seed=4, sigma_mm=2e-3, lines=2, along=4, points=60, gnss_sigma_m=0.05).network


def held(places: list[tuple[float, float, float]]) -> Network:
    """Images held above five points on their base line, without errors."""
    network = aerial(seed=1, lines=1, along=len(places), points=5, control=0, disturb=0.0).network
    count = len(places)
    ground = np.column_stack(
        [[-40.0, -20.0, 0.0, 20.0, 40.0], np.zeros(5), [3.0, 9.0, 5.0, 1.0, 7.0]]
    )
    ray = ground[None] - np.array(places)[:, None]
    xy = -70.0 * ray[:, :, :2] / ray[:, :, 2:]
    return replace(
        network,
        stations=replace(
            network.stations, position_m=np.array(places), fixed=np.ones(count, dtype=bool)
        ),
        attitudes=replace(
            network.attitudes,
            rotation=np.tile(np.eye(3), (count, 1, 1)),
            fixed=np.ones(count, bool),
        ),
        points=replace(network.points, xyz_m=ground),
        image_points=replace(
            network.image_points,
            image=np.repeat(np.arange(count), 5),
            point=np.tile(np.arange(5), count),
            xy_mm=xy.reshape(-1, 2),
            sigma_mm=np.full((5 * count, 2), 1e-3),
        ),
    )


@pytest.mark.parametrize(
    ("places", "each"),
    [
        # Two rays: the parallax across the base alone.
        ([(-50.0, 0.0, 1000.0), (50.0, 0.0, 1000.0)], 1),
        # Three: one test along the base, three across it.
        ([(-100.0, 0.0, 1000.0), (0.0, 0.0, 1000.0), (100.0, 0.0, 1000.0)], 4),
    ],
)
def test_residuals_that_are_proportional_are_one_test(places, each) -> None:
    result = adjust(held(places))
    reduced = reduced_equations(result.equations, result.layout)
    assert number_of_tests(result.equations, reduced, result.redundancy_number) == 5 * each


def test_the_limit_grows_with_the_number_of_tests_and_is_reported(strip) -> None:
    result = adjust(strip, replace(BAARDA, significance=0.01))
    assert result.excluded.count == 0
    assert 60 < result.tests < result.observations
    single = 1.0 - 0.99 ** (1.0 / result.tests)
    assert result.reject_limit == pytest.approx(stats.norm.isf(single / 2.0), rel=1e-9)
    # Pope's test knows sigma0 from the residuals it tests: none exceeds the root of the redundancy.
    assert critical_value("pope", 0.01, 10**9, 4) < 2.0
    assert critical_value("pope", 0.05, 1, 10**7) == pytest.approx(1.96, abs=1e-3)
    with pytest.raises(NetworkError, match="one of them sets the limit"):
        adjust(strip, replace(BAARDA, reject_beyond=4.0))
    with pytest.raises(NetworkError, match="significance is 2; it is between 0 and 1"):
        adjust(strip, replace(BAARDA, significance=2.0))


def test_a_bias_of_the_detectable_size_has_the_stated_residual_and_moves_its_point(strip) -> None:
    clean = adjust(strip, replace(BAARDA, power=0.9))
    found = reliability_of(clean)
    assert found.noncentrality == pytest.approx(clean.reject_limit + 1.2816, abs=1e-4)
    rows = clean.equations
    rays = np.bincount(strip.image_points.point, minlength=60)
    own = [
        k
        for k in np.flatnonzero(rows.group == 1)
        if rays[strip.image_points.point[rows.source[k]]] >= 4
    ]
    for k in (own[0], own[len(own) // 2], own[-1]):
        source = int(rows.source[k])
        xy = strip.image_points.xy_mm.copy()
        # A hundredth of it: the adjustment is not linear.
        xy[source, 1] += 0.01 * found.detectable[k]
        moved = adjust(replace(strip, image_points=replace(strip.image_points, xy_mm=xy)))
        changed = (clean.residual[k] - moved.residual[k]) / np.sqrt(clean.redundancy_number[k])
        assert changed == pytest.approx(0.01 * found.noncentrality, rel=1e-3)
        shift = moved.state.points - clean.state.points
        point = strip.image_points.point[source]
        assert np.linalg.norm(shift[point]) == pytest.approx(
            0.01 * found.point_shift_m[k], rel=1e-3
        )
        # The function that changes most is that of the adjusted observations themselves.
        fitted = moved.residual - clean.residual
        fitted[k] += 0.01 * found.detectable[k] / rows.sigma[k]
        assert np.linalg.norm(fitted) == pytest.approx(0.01 * found.bias_to_noise[k], rel=1e-3)
        # No unknown moves by more of its standard deviation than stated.
        spread = np.sqrt(np.einsum("nii->ni", clean.point_cofactor))
        ratio = np.abs(shift) / spread
        assert np.nanmax(ratio) <= 0.01 * found.bias_to_noise[k] * (1.0 + 1e-3)
        assert np.nanmax(ratio) > 0.001 * found.bias_to_noise[k]


def test_pope_states_what_can_be_detected_with_the_sigma_found(strip) -> None:
    table = strip.image_points
    half = replace(strip, image_points=replace(table, sigma_mm=table.sigma_mm / 2.0))
    half = replace(half, gnss=replace(half.gnss, sigma_m=half.gnss.sigma_m / 2.0))
    half = replace(half, points=replace(half.points, sigma_m=half.points.sigma_m / 2.0))
    same = [reliability_of(adjust(n)).detectable for n in (strip, half)]
    assert same[0] == pytest.approx(same[1], rel=1e-6)
    a_priori = [
        reliability_of(adjust(n, AdjustmentSettings(test="baarda"))).detectable
        for n in (strip, half)
    ]
    finite = np.isfinite(a_priori[0])
    assert a_priori[1][finite] == pytest.approx(a_priori[0][finite] / 2.0, rel=1e-6)


def test_minimal_control_is_stated_to_be_uncontrolled() -> None:
    network = aerial(seed=2, sigma_mm=2e-3, points=60, control=3).network
    sigma = network.points.sigma_m.copy()
    sigma[1, :] = [0.02, 0.02, 0.02]
    sigma[0, :] = [0.02, np.nan, np.nan]
    sigma[2, :] = [0.02, 0.02, 0.02]
    found = adjust(replace(network, points=replace(network.points, sigma_m=sigma)))
    control = np.isin(found.equations.group, (2, 3))
    assert control.sum() == 7
    assert np.isinf(reliability_of(found).detectable[control]).all()


@pytest.mark.parametrize("function", ["huber", "cauchy", "tukey", "danish"])
def test_every_weight_function_finds_blunders_and_a_wrong_control_point(function) -> None:
    network = aerial(
        seed=1, sigma_mm=2e-3, lines=3, along=4, points=160, control=12, gnss_sigma_m=0.05
    ).network
    table = network.image_points
    rays = np.bincount(table.point)[table.point]
    wrong = np.flatnonzero((rays >= 4) & (table.point >= 20))[::60]
    xy = table.xy_mm.copy()
    xy[wrong] += [0.2, -0.25]
    xyz = network.points.xyz_m.copy()
    xyz[3, 0] += 10.0
    spoilt = replace(
        network,
        image_points=replace(table, xy_mm=xy),
        points=replace(network.points, xyz_m=xyz),
    )
    settings = AdjustmentSettings(robust=True, weight_function=function)
    result = adjust(spoilt, settings)
    assert result.rejected[wrong].all()
    assert "control point p3 X" in names_of(network, result.excluded)
    final = adjust(spoilt, replace(settings, significance=0.01))
    assert names_of(network, final.excluded) == ("control point p3 X",)
    assert set(np.flatnonzero(final.rejected)) == set(wrong)


def test_weight_functions_differ_in_what_they_leave_out_of_a_moderate_error(strip) -> None:
    table = strip.image_points
    xy = table.xy_mm.copy()
    rays = np.bincount(table.point)[table.point]
    at = int(np.flatnonzero(rays >= 6)[0])
    xy[at] += 7.0 * table.sigma_mm[at]
    spoilt = replace(strip, image_points=replace(table, xy_mm=xy))
    left_out = {
        function: adjust(
            spoilt, AdjustmentSettings(robust=True, weight_function=function)
        ).rejected[at]
        for function in ("huber", "cauchy", "tukey", "danish")
    }
    assert left_out == {"huber": False, "cauchy": True, "tukey": True, "danish": True}


def test_false_alarms_and_blunders_of_a_small_block_are_as_chosen() -> None:
    block = aerial_lines(lines=2, along=3, points=80)
    settings = AdjustmentSettings(significance=0.2)
    alarms = false_alarms(block, settings, 60)
    assert alarms["inside"], alarms
    found = search(aerial_lines(lines=3, along=4, points=150), settings, 2)
    assert found["share_found"] == 1.0
    assert found["controllable"] > 5
    assert found["problems"] == 0
