"""The adjustment against truth, against plain dense least squares, and against blunders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.network import (
    CameraModel,
    LinearConstraint,
    MeasuredAttitudes,
    Network,
    NetworkError,
)
from processing.geometry.rotation import vectors_from_rotations
from tests.processing.bundle.simulated_networks import (
    SimulatedNetwork,
    aerial,
    rotation_of,
    with_everything,
)


def _dense(result: Adjustment) -> tuple[np.ndarray, np.ndarray]:
    """The whole design matrix of the last rows: columns, then eliminated points."""
    rows = result.equations
    held = result.layout.locked[result.layout.eliminated_points].ravel()
    points = np.zeros((len(rows.misclosure), len(held)))
    for row, (who, part) in enumerate(zip(rows.point, rows.point_part, strict=True)):
        if who >= 0:
            points[row, 3 * who : 3 * who + 3] = part
    return np.hstack([rows.reduced.toarray(), points[:, ~held]]), ~held


def test_without_noise_the_truth_comes_back() -> None:
    simulated = with_everything()
    result = adjust(simulated.network)
    assert np.abs(result.state.station - simulated.station).max() < 1e-5
    assert np.abs(result.state.interior[0][:3] - simulated.interior[0][:3]).max() < 1e-6
    assert result.state.terms[0][0] == pytest.approx(3e-5, abs=1e-9)
    oblique = rotation_of(0.5, 0.01, 0.02)
    assert (
        np.abs(vectors_from_rotations((result.state.head_rotation[1].T @ oblique)[None])).max()
        < 1e-7
    )


def test_covariances_and_redundancy_numbers_are_those_of_the_full_inverse() -> None:
    simulated = with_everything()
    result = adjust(simulated.network)
    design, free = _dense(result)
    scale = np.linalg.norm(design, axis=0)
    inverse = np.linalg.inv((design / scale).T @ (design / scale)) / scale[:, None] / scale
    c = result.layout.columns
    size = np.sqrt(np.diag(inverse))
    off = (result.cofactor - inverse[:c, :c]) / size[:c, None] / size[:c]
    assert np.abs(off).max() < 1e-6
    full_inverse = np.zeros((len(free), len(free)))
    full_inverse[np.ix_(free, free)] = inverse[c:, c:]
    for k, point in enumerate(result.layout.eliminated_points):
        own = full_inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        assert np.abs(result.point_cofactor[point] - own).max() < 1e-6 * np.abs(own).max()
    leverage = np.einsum("ij,jk,ik->i", design, inverse, design)
    assert np.abs(result.redundancy_number - (1.0 - leverage)).max() < 1e-7
    assert result.redundancy == len(design) - design.shape[1]
    assert result.redundancy_number.sum() == pytest.approx(result.redundancy, abs=1e-6)


def test_constraints_are_fulfilled_and_their_cofactors_are_those_of_the_bordered_inverse() -> None:
    simulated = aerial(sigma_mm=1e-3, seed=5, control_sigma_m=0.5)
    names = [f"station {name} X" for name in simulated.network.stations.names]
    network = replace(simulated.network, constraints=(LinearConstraint(dict.fromkeys(names, 1.0)),))
    result = adjust(network)
    moved = result.state.station[:, 0] - network.stations.position_m[:, 0]
    assert abs(moved.sum()) < 1e-9
    design, _ = _dense(result)
    size = design.shape[1]
    border = np.zeros((size + 1, size + 1))
    border[:size, :size] = design.T @ design
    border[size, : result.layout.columns] = result.layout.constraints[0]
    border[:, size] = border[size]
    inverse = np.linalg.inv(border)[: result.layout.columns, : result.layout.columns]
    assert np.allclose(result.cofactor, inverse, rtol=1e-5, atol=1e-12)
    assert result.redundancy == len(design) - size + 1


def _adjusted(seed: int) -> tuple[SimulatedNetwork, Adjustment]:
    simulated = aerial(seed=seed, sigma_mm=1e-3, gnss_sigma_m=0.05, points=40, lines=2, along=4)
    return simulated, adjust(simulated.network)


def test_uncertainty_is_realistic() -> None:
    squares, dimensions, errors = 0.0, 0, []
    for seed in range(24):
        simulated, result = _adjusted(seed)
        columns = result.layout.station.ravel()
        error = (result.state.station - simulated.station).ravel()
        covariance = result.cofactor[np.ix_(columns, columns)]
        squares += float(error @ np.linalg.solve(covariance, error))
        dimensions += len(error)
        for point in result.layout.eliminated_points:
            own = result.point_cofactor[point]
            off = result.state.points[point] - simulated.points[point]
            errors.append(off / np.sqrt(np.diag(own)))
    low, high = stats.chi2.ppf([0.0005, 0.9995], dimensions)
    assert low < squares < high
    normalised = np.abs(np.concatenate(errors))
    assert (normalised < 3.0).mean() > 0.99
    assert normalised.max() < 5.0


def test_sigma0_and_components_find_wrong_sigmas() -> None:
    simulated = aerial(seed=7, sigma_mm=2e-3, gnss_sigma_m=0.05, points=250, lines=3, along=8)
    table, gnss = simulated.network.image_points, simulated.network.gnss
    network = replace(
        simulated.network,
        image_points=replace(table, sigma_mm=table.sigma_mm / 2.0),
        gnss=replace(gnss, sigma_m=gnss.sigma_m * 3.0),
    )
    result = adjust(network, AdjustmentSettings(variance_components=True))
    assert result.factors["image x"] == pytest.approx(4.0, rel=0.15)
    assert result.factors["image y"] == pytest.approx(4.0, rel=0.15)
    assert result.factors["GNSS height"] == pytest.approx(1.0 / 9.0, rel=0.6)
    assert "control height" not in result.factors, "a redundancy of two is too small"
    assert result.sigma0 == pytest.approx(1.0, rel=0.02)


def test_blunders_are_found_and_nothing_else() -> None:
    simulated = aerial(seed=8, sigma_mm=1e-3, points=200, lines=3, along=6)
    table = simulated.network.image_points
    rays = np.bincount(table.point, minlength=200)
    several = np.flatnonzero(rays[table.point] >= 5)
    wrong = np.random.default_rng(1).choice(several, 25, replace=False)
    xy = table.xy_mm.copy()
    xy[wrong] += np.random.default_rng(2).normal(0, 1, (25, 2)) * 0.3 + 0.1
    network = replace(simulated.network, image_points=replace(table, xy_mm=xy))
    plain = adjust(network)
    assert plain.sigma0 > 10.0
    result = adjust(network, AdjustmentSettings(robust=True, reject_beyond=4.0))
    assert set(wrong) <= set(np.flatnonzero(result.rejected))
    assert int(result.rejected.sum()) <= 28
    assert result.sigma0 == pytest.approx(1.0, abs=0.08)


def test_a_point_seen_once_is_left_out_and_changes_nothing() -> None:
    simulated = aerial(seed=9, sigma_mm=1e-3)
    table = simulated.network.image_points
    rays = np.bincount(table.point, minlength=60)
    lonely = int(np.flatnonzero(rays[8:] >= 3)[0]) + 8
    first = int(np.flatnonzero(table.point == lonely)[0])
    keep = (table.point != lonely) | (np.arange(len(table.point)) == first)
    network = replace(simulated.network, image_points=_only(table, keep))
    without = replace(simulated.network, image_points=_only(table, table.point != lonely))
    result, reference = adjust(network), adjust(without)
    assert result.left_out[lonely]
    assert np.isnan(result.point_cofactor[lonely]).all()
    assert np.abs(result.state.station - reference.state.station).max() < 1e-9
    assert result.redundancy == reference.redundancy


def _only(table, keep):
    return replace(
        table,
        image=table.image[keep],
        point=table.point[keep],
        xy_mm=table.xy_mm[keep],
        sigma_mm=table.sigma_mm[keep],
    )


def test_shared_projection_centres_share_three_unknowns() -> None:
    simulated = with_everything()
    images = simulated.network.images
    # Every image an attitude of its own, the projection centres of an exposure in one.
    n = len(images.names)
    heads = simulated.network.heads
    own = np.array(
        [simulated.attitude[images.attitude[k]] @ heads[images.head[k]].rotation for k in range(n)]
    )
    network = replace(
        simulated.network,
        attitudes=replace(
            simulated.network.attitudes, names=images.names, rotation=own, fixed=np.zeros(n, bool)
        ),
        images=replace(images, attitude=np.arange(n), head=np.full(n, -1)),
        heads=(),
        gnss=replace(simulated.network.gnss, attitude=np.arange(0, n, 2)),
        measured_attitudes=MeasuredAttitudes(np.arange(n), own, np.full((n, 3), 1e-3)),
    )
    result = adjust(network)
    kinds = [u.kind for u in result.layout.unknowns]
    assert kinds.count("station") == 3 * 9
    assert kinds.count("attitude") == 3 * 18


def test_tables_that_do_not_fit_are_refused_with_all_their_mistakes() -> None:
    network = aerial().network
    broken = replace(
        network,
        cameras=(CameraModel("c", -70.0),),
        images=replace(network.images, station=network.images.station + 1),
        image_points=replace(network.image_points, sigma_mm=network.image_points.sigma_mm * 0.0),
    )
    with pytest.raises(NetworkError) as caught:
        adjust(broken)
    text = str(caught.value)
    assert "station that is not there" in text
    assert "f -70.0 mm" in text
    assert "sigma that is not positive" in text


def test_starting_values_far_off_end_in_a_sentence() -> None:
    network: Network = aerial().network
    below = network.stations.position_m - np.array([0.0, 0.0, 5000.0])
    with pytest.raises(NetworkError, match="better starting values"):
        adjust(replace(network, stations=replace(network.stations, position_m=below)))


def test_sigmas_are_scaled_only_where_that_is_requested() -> None:
    simulated = aerial(seed=7, sigma_mm=2e-3, points=120)
    table = simulated.network.image_points
    network = replace(simulated.network, image_points=replace(table, sigma_mm=table.sigma_mm / 2.0))
    result = adjust(network)
    assert result.factors == {}
    assert result.sigma0 == pytest.approx(2.0, rel=0.15)


def test_each_round_of_data_snooping_is_announced_with_its_number() -> None:
    simulated = aerial(seed=8, sigma_mm=1e-3, points=60)
    table = simulated.network.image_points
    rays = np.bincount(table.point, minlength=60)
    wrong = np.flatnonzero(table.point == int(np.flatnonzero(rays >= 6)[-1]))[:2]
    xy = table.xy_mm.copy()
    xy[wrong] += [[0.1, 0.05], [-0.02, 0.03]]
    network = replace(simulated.network, image_points=replace(table, xy_mm=xy))
    rounds, objectives = [], []

    def report_progress(what: str, number: int, value: float) -> None:
        if what == "iteration":
            objectives.append(value)
        elif what.endswith("left out"):
            rounds.append((what, number))
            # What the iterations before it ended with.
            assert value == objectives[-1]

    result = adjust(network, AdjustmentSettings(reject_beyond=5.0), progress=report_progress)
    assert [number for _, number in rounds] == list(range(1, len(rounds) + 1))
    assert rounds[-1][0] == f"{int(result.rejected.sum())} observations left out"
    assert set(wrong) <= set(np.flatnonzero(result.rejected))


def _with_narrow_rays(base_m: float) -> Network:
    """A block with one more image next to the first, and twelve points that only these two see."""
    simulated = aerial(seed=2, sigma_mm=5e-3, points=80)
    network, random = simulated.network, np.random.default_rng(2)
    place, rotation = simulated.station[0], simulated.attitude[0]
    neighbour = place + rotation @ np.array([base_m, 0.0, 0.0])
    new = np.column_stack(
        [place[:2] + random.uniform(-200, 200, (12, 2)), random.uniform(0, 60, 12)]
    )
    ground = np.vstack([simulated.points, new])
    image, point, xy = [], [], []
    for which, station, points in ((0, place, range(80, 92)), (8, neighbour, range(92))):
        for p in points:
            ray = rotation.T @ (ground[p] - station)
            seen = -70.0 * ray[:2] / ray[2]
            if abs(seen[0]) < 29.0 and abs(seen[1]) < 19.0:
                image.append(which)
                point.append(p)
                xy.append(seen + random.normal(0, 5e-3, 2))
    stations, attitudes = network.stations, network.attitudes
    images, points, table = network.images, network.points, network.image_points
    return replace(
        network,
        stations=replace(
            stations,
            names=(*stations.names, "neighbour"),
            position_m=np.vstack([stations.position_m, neighbour]),
            fixed=np.append(stations.fixed, False),
        ),
        attitudes=replace(
            attitudes,
            names=(*attitudes.names, "neighbour"),
            rotation=np.concatenate([attitudes.rotation, rotation[None]]),
            fixed=np.append(attitudes.fixed, False),
        ),
        images=replace(
            images,
            names=(*images.names, "neighbour"),
            station=np.append(images.station, 8),
            attitude=np.append(images.attitude, 8),
            camera=np.append(images.camera, 0),
            head=np.append(images.head, -1),
        ),
        points=replace(
            points,
            names=(*points.names, *(f"w{k}" for k in range(12))),
            xyz_m=np.vstack([points.xyz_m, new + random.normal(0, 1, new.shape) * [5, 5, 100]]),
            sigma_m=np.vstack([points.sigma_m, np.full((12, 3), np.nan)]),
            at_infinity=np.append(points.at_infinity, np.zeros(12, dtype=bool)),
        ),
        image_points=replace(
            table,
            image=np.append(table.image, image),
            point=np.append(table.point, point),
            xy_mm=np.vstack([table.xy_mm, xy]),
            sigma_mm=np.full((len(table.image) + len(image), 2), 5e-3),
        ),
    )


@pytest.mark.parametrize("base_m", [5.0, 1.0, 0.2, 0.05])
def test_points_of_nearly_parallel_rays_never_stop_a_block(base_m) -> None:
    """0.3, 0.06, 0.01 and 0.003 degrees."""
    network = _with_narrow_rays(base_m)
    assert network.images.names[8] == "neighbour"
    result = adjust(network)
    assert result.sigma0 == pytest.approx(1.0, abs=0.1)
    if base_m == 5.0:
        assert not result.left_out[80:].any()
    reference = adjust(aerial(seed=2, sigma_mm=5e-3, points=80).network)
    spread = np.sqrt(np.diag(reference.cofactor)[reference.layout.station.ravel()])
    moved = (result.state.station[:8] - reference.state.station).ravel()
    assert np.abs(moved / spread).max() < 3.0
