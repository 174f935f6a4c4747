"""Starting values of a block without any orientation: relative orientation and a similarity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.initial_values import completed
from processing.bundle.network import Gnss, Network, NetworkError, no_gnss
from processing.bundle.rank_diagnosis import RankDefectError
from processing.bundle.starting_values import starting_values
from tests.processing.bundle.simulated_networks import SimulatedNetwork, aerial


@pytest.fixture(scope="module")
def simulated() -> SimulatedNetwork:
    return aerial(seed=3, sigma_mm=1e-3, points=130, gnss_sigma_m=0.05)


def _bare(simulated: SimulatedNetwork, control: Sequence[int], gnss: Gnss | None = None) -> Network:
    """Without orientations and coordinates but those of some control points."""
    network = simulated.network
    xyz, sigma = np.full_like(simulated.points, np.nan), np.full_like(simulated.points, np.nan)
    xyz[list(control)], sigma[list(control)] = simulated.points[list(control)], 0.02
    return replace(
        network,
        stations=replace(network.stations, position_m=np.full_like(simulated.station, np.nan)),
        attitudes=replace(network.attitudes, rotation=np.full_like(simulated.attitude, np.nan)),
        points=replace(network.points, xyz_m=xyz, sigma_m=sigma),
        gnss=gnss or no_gnss(),
    )


def test_three_control_points_begin_a_block_without_orientations(simulated) -> None:
    network = _bare(simulated, [0, 3, 6])
    with pytest.raises(NetworkError, match="three in a block"):
        completed(network)
    result = adjust(starting_values(network))
    sigma = np.sqrt(result.cofactors.diagonal()[result.layout.station])
    away = (result.state.station - simulated.station) / sigma
    assert 0.9 < result.sigma0 < 1.1
    assert np.abs(away).max() < 5.0


def test_antenna_positions_begin_a_block_without_control(simulated) -> None:
    network = _bare(simulated, [], simulated.network.gnss)
    result = adjust(starting_values(network))
    assert 0.9 < result.sigma0 < 1.1
    assert np.abs(result.state.station - simulated.station).max() < 0.3


def test_a_free_network_needs_no_value_at_all(simulated) -> None:
    network = starting_values(_bare(simulated, []))
    with pytest.raises(RankDefectError, match="position in X of the whole block"):
        adjust(network)
    free = adjust(network, AdjustmentSettings(minimum_norm=True))
    assert 0.9 < free.sigma0 < 1.1
    assert len(free.rank_defects) == 7


def test_known_points_of_another_shape_are_refused(simulated) -> None:
    network = _bare(simulated, [0, 3, 6])
    xyz = network.points.xyz_m.copy()
    xyz[3, 0] += 700.0
    wrong = replace(network, points=replace(network.points, xyz_m=xyz))
    with pytest.raises(NetworkError, match="3 known places do not fit the shape"):
        starting_values(wrong)


def test_two_known_points_are_not_enough(simulated) -> None:
    with pytest.raises(NetworkError, match="no orientation and see too few known points"):
        starting_values(_bare(simulated, [0, 3]))
