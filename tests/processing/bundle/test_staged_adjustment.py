"""Blocks that do not converge from their first starting values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle import staged_adjustment
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.network import Network, NetworkError
from processing.bundle.staged_adjustment import adjust_in_stages, interior_held_first
from processing.bundle.starting_values import starting_values
from tests.processing.bundle.plain_block import plain_block


def test_an_interior_orientation_is_held_first_where_it_does_not_converge(monkeypatch) -> None:
    network = plain_block(2)
    free: list[frozenset[str]] = []

    def failing_first(given: Network, settings: AdjustmentSettings, **_: object) -> Adjustment:
        free.append(given.cameras[0].free)
        if len(free) == 1:
            raise NetworkError(["no convergence"])
        return adjust(given, settings)

    monkeypatch.setattr(staged_adjustment, "adjust", failing_first)
    result = adjust_in_stages(network, AdjustmentSettings())
    assert free == [{"df"}, frozenset(), {"df"}]
    assert result.sigma0 == pytest.approx(adjust(network).sigma0, rel=1e-6)


def test_images_without_orientation_are_oriented_relatively_next(monkeypatch) -> None:
    network = plain_block(3, points=300, relief_m=40.0)
    (camera,) = network.cameras
    n = len(network.stations.names)
    network = replace(
        network,
        cameras=(replace(camera, free=frozenset()),),
        stations=replace(network.stations, position_m=np.full((n, 3), np.nan)),
        attitudes=replace(network.attitudes, rotation=np.full((n, 3, 3), np.nan)),
    )
    starts: list[np.ndarray] = []

    def failing_first(given: Network, settings: AdjustmentSettings, **_: object) -> Adjustment:
        starts.append(given.stations.position_m)
        if len(starts) == 1:
            raise NetworkError(["no convergence"])
        return adjust(given, settings)

    monkeypatch.setattr(staged_adjustment, "adjust", failing_first)
    result = adjust_in_stages(network, AdjustmentSettings())
    assert len(starts) == 2 and np.abs(starts[1] - starts[0]).max() > 1e-3
    assert result.sigma0 == pytest.approx(1.0, abs=0.15)


def test_held_first_changes_orientations_and_tie_points_alone() -> None:
    network = plain_block(2)
    after = interior_held_first(network, AdjustmentSettings(significance=0.05))
    assert after.cameras == network.cameras
    control = np.isfinite(network.points.sigma_m)
    assert (after.points.xyz_m[control] == network.points.xyz_m[control]).all()
    assert (after.stations.position_m != network.stations.position_m).all()


def test_a_block_that_nothing_starts_raises_the_first_error() -> None:
    network = plain_block(2)
    table = network.image_points
    wrong = replace(table, point=np.random.default_rng(1).permutation(table.point))
    network = replace(network, image_points=wrong)
    with pytest.raises(NetworkError) as first:
        adjust(starting_values(network))
    with pytest.raises(NetworkError) as error:
        adjust_in_stages(network, AdjustmentSettings())
    assert error.value.problems == first.value.problems
