"""Free networks: inner constraints on points and stations, against all unknowns at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.network import Distances, Network, NetworkError
from tests.processing.bundle.simulated_networks import aerial


@pytest.fixture(scope="module")
def free() -> Network:
    network = aerial(seed=3, sigma_mm=2e-3, lines=2, along=3, points=40, control=0).network
    rays = np.bincount(network.image_points.point, minlength=40)
    assert (rays >= 2).sum() > 30
    return network


def in_datum(network: Network, datum: str, names: tuple[str, ...] = ()) -> Adjustment:
    return adjust(
        network,
        AdjustmentSettings(minimum_norm=True, free_datum=datum, datum_names=names),
    )


def dense(result: Adjustment) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Normal matrix of all unknowns, its seven null directions, and the adjusted points."""
    rows, points = result.equations, result.layout.eliminated_points
    c = result.layout.columns
    design = np.zeros((len(rows.misclosure), c + 3 * len(points)))
    design[:, :c] = rows.reduced.toarray()
    for k, p in enumerate(rows.point):
        if p >= 0:
            design[k, c + 3 * p : c + 3 * p + 3] = rows.point_part[k]
    scale = np.linalg.norm(design, axis=0)
    _, values, right = np.linalg.svd(design / scale)
    assert values[-7] < 1e-9 * values[0] < 1e-3 * values[-8]
    return design.T @ design, (right[-7:] / scale).T, list(points)


@pytest.mark.parametrize("datum", ["points", "stations", "all"])
@pytest.mark.parametrize("some", [False, True])
def test_covariances_are_those_of_inner_constraints(free, datum, some) -> None:
    if some:
        names = {"points": ("p3", "p7", "p12", "p20"), "stations": ("e0", "e2", "e5"),
                 "all": ("p3", "p7", "e0", "e5")}[datum]  # fmt: skip
    else:
        names = ()
    result = in_datum(free, datum, names)
    normal, null, points = dense(result)
    c, layout = result.layout.columns, result.layout
    chosen = np.zeros(len(normal), dtype=bool)
    if datum in ("points", "all"):
        for at, p in enumerate(points):
            chosen[c + 3 * at : c + 3 * at + 3] = not names or f"p{p}" in names
    if datum in ("stations", "all"):
        for k, columns in enumerate(layout.station):
            chosen[columns[columns >= 0]] = not names or f"e{k}" in names
    constraint = np.where(chosen[:, None], null, 0.0).T
    m = len(normal)
    bordered = np.zeros((m + 7, m + 7))
    bordered[:m, :m], bordered[m:, :m], bordered[:m, m:] = normal, constraint, constraint.T
    scale = np.sqrt(np.concatenate([np.diag(normal), np.ones(7)]))
    scale[m:] = np.linalg.norm(constraint / scale[:m], axis=1)
    wanted = np.linalg.inv(bordered / scale[:, None] / scale) / scale[:, None] / scale
    spread = np.sqrt(np.diag(wanted)[:m])
    own = np.sqrt(np.diag(result.cofactor))
    assert own == pytest.approx(spread[:c], rel=1e-4)
    of_points = np.sqrt(np.einsum("pii->pi", result.point_cofactor[points])).ravel()
    assert of_points == pytest.approx(spread[c:], rel=1e-4)
    reference = in_datum(free, "unknowns")
    assert result.sigma0 == pytest.approx(reference.sigma0, rel=1e-9)
    assert result.redundancy == reference.redundancy


def test_adjusted_coordinates_fit_the_starting_values_best(free) -> None:
    result = in_datum(free, "points")
    points = result.layout.eliminated_points
    difference = result.state.points[points] - free.points.xyz_m[points]
    about = result.state.points[points] - result.state.points[points].mean(axis=0)
    assert np.abs(difference.sum(axis=0)).max() < 1e-8
    assert np.abs(np.cross(about, difference).sum(axis=0)).max() < 1e-5
    assert abs((about * difference).sum()) < 1e-5
    # The same network: adjusted again from there, nothing moves.
    state = result.state
    again = replace(
        free,
        stations=replace(free.stations, position_m=state.station),
        attitudes=replace(free.attitudes, rotation=state.attitude),
        points=replace(free.points, xyz_m=state.points),
    )
    assert in_datum(again, "points").iterations[0] == pytest.approx(result.iterations[-1], rel=1e-6)


def test_a_datum_that_does_not_fix_the_block_or_names_nothing_is_refused(free) -> None:
    with pytest.raises(NetworkError, match="choose more"):
        in_datum(free, "points", ("p3",))
    with pytest.raises(NetworkError, match="x9, which are not there"):
        in_datum(free, "points", ("x9",))


def test_names_that_are_not_of_the_kind_of_the_datum_are_refused(free) -> None:
    with pytest.raises(NetworkError, match="the datum is of points and names e2, which are none"):
        in_datum(free, "points", ("p3", "p7", "p12", "p20", "e2"))
    with pytest.raises(NetworkError, match="the datum is of stations and names p3"):
        in_datum(free, "stations", ("e0", "e1", "e4", "p3"))


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (AdjustmentSettings(free_datum="points"), "set minimum_norm"),
        (AdjustmentSettings(datum_names=("p3",)), "set minimum_norm"),
        (AdjustmentSettings(minimum_norm=True, datum_names=("p3",)), "free_datum is unknowns"),
    ],
)
def test_a_datum_that_would_have_no_effect_is_refused(free, settings, sentence) -> None:
    with pytest.raises(NetworkError, match=sentence):
        adjust(free, settings)


@pytest.mark.parametrize("names", [(), ("e4",), ("e1", "e3")])
def test_the_dependent_datum_is_that_of_held_parameters(free, names) -> None:
    result = in_datum(free, "dependent", names)
    first = free.stations.names.index(names[0]) if names else 0
    offset = free.stations.position_m - free.stations.position_m[first]
    base, axis = np.unravel_index(np.argmax(offset), offset.shape)
    if len(names) == 2:
        base = free.stations.names.index(names[1])
        axis = int(np.argmax(np.abs(offset[base])))
    state = result.state
    assert state.station[first] == pytest.approx(free.stations.position_m[first], abs=1e-9)
    assert state.attitude[first] == pytest.approx(free.attitudes.rotation[first], abs=1e-12)
    given = free.stations.position_m[base, axis]
    assert state.station[base, axis] == pytest.approx(given, abs=1e-9)
    normal, _, _ = dense(result)
    layout = result.layout
    held = [*layout.station[first], *layout.attitude[first], layout.station[base, axis]]
    left = np.setdiff1d(np.arange(len(normal)), held)
    own = normal[np.ix_(left, left)]
    scale = np.sqrt(np.diag(own))
    wanted = np.zeros(len(normal))
    wanted[left] = np.diag(np.linalg.inv(own / scale[:, None] / scale)) / scale**2
    c = layout.columns
    found = np.diag(result.cofactor)
    assert found[left[left < c]] == pytest.approx(wanted[left[left < c]], rel=1e-4)
    assert np.abs(found[held]).max() < 1e-9 * found.max()
    points = layout.eliminated_points
    of_points = np.einsum("pii->pi", result.point_cofactor[points]).ravel()
    assert of_points == pytest.approx(wanted[c:], rel=1e-4)
    assert result.sigma0 == pytest.approx(in_datum(free, "unknowns").sigma0, rel=1e-9)


def test_a_dependent_datum_of_names_that_are_no_exposures_is_refused(free) -> None:
    with pytest.raises(NetworkError, match="the names of one or two free exposures are right"):
        in_datum(free, "dependent", ("p3",))


@pytest.mark.parametrize("some", [False, True])
def test_scale_bars_and_self_calibration_with_inner_constraints_on_points(free, some) -> None:
    """As of industrial targets: scale by bars, datum by all or chosen points, camera free."""
    ends = np.array([[3, 20], [7, 12]])
    xyz = free.points.xyz_m
    bars = Distances(
        ends[:, 0],
        ends[:, 1],
        np.linalg.norm(xyz[ends[:, 0]] - xyz[ends[:, 1]], axis=1),
        np.full(2, 0.01),
    )
    camera = replace(free.cameras[0], free=frozenset({"k1"}))
    network = replace(free, distances=bars, cameras=(camera,))
    names = ("p3", "p7", "p12", "p15", "p20") if some else ()
    result = in_datum(network, "points", names)
    layout, points = result.layout, list(result.layout.eliminated_points)
    c = layout.columns
    design = np.zeros((len(result.equations.misclosure), c + 3 * len(points)))
    design[:, :c] = result.equations.reduced.toarray()
    for k, p in enumerate(result.equations.point):
        if p >= 0:
            design[k, c + 3 * p : c + 3 * p + 3] = result.equations.point_part[k]
    scale = np.linalg.norm(design, axis=0)
    _, values, right = np.linalg.svd(design / scale)
    # Position and orientation are free; the bars give the scale.
    assert values[-6] < 1e-9 * values[0] < 1e-3 * values[-7]
    null = (right[-6:] / scale).T
    chosen = np.zeros(len(scale), dtype=bool)
    where = {int(p): c + 3 * at + np.arange(3) for at, p in enumerate(points)}
    where |= {int(p): layout.retained_points[p] for p in np.unique(ends)}
    for p, columns in where.items():
        chosen[columns] = not names or f"p{p}" in names
    constraint = np.where(chosen[:, None], null, 0.0).T
    normal, m = design.T @ design, len(scale)
    bordered = np.zeros((m + 6, m + 6))
    bordered[:m, :m], bordered[m:, :m], bordered[:m, m:] = normal, constraint, constraint.T
    unit = np.concatenate([scale, np.linalg.norm(constraint / scale, axis=1)])
    spread = np.sqrt(np.diag(np.linalg.inv(bordered / unit[:, None] / unit))[:m]) / scale
    for p, columns in where.items():
        own = np.sqrt(np.diag(result.point_cofactor[p]))
        assert own == pytest.approx(spread[columns], rel=1e-4), p
    # No datum of the same points has a smaller trace.
    trace = (spread[chosen] ** 2).sum()
    for other in ("unknowns", "stations", "dependent"):
        found = in_datum(network, other)
        of_points = sum(
            np.trace(found.point_cofactor[p]) for p in where if not names or f"p{p}" in names
        )
        assert of_points > trace
        assert found.sigma0 == pytest.approx(result.sigma0, rel=1e-9)
