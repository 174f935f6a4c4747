"""Large blocks: a reduced matrix in blocks near its diagonal gives the figures of a dense one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from processing.bundle import block_order
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.block_band import BandCofactor
from processing.bundle.correlations import high_correlations
from processing.bundle.network import Network, NetworkError
from processing.bundle.rank_diagnosis import RankDefectError
from tests.processing.bundle.simulated_networks import aerial, with_everything


@cache
def strip(*, is_controlled: bool = True, has_lines: bool = True) -> Network:
    """Two lines of 20 images, with control and antenna positions with drifts, or without."""
    network = aerial(
        seed=5,
        sigma_mm=2e-3,
        lines=2,
        along=20,
        points=500,
        control=12 if is_controlled else 0,
        gnss_sigma_m=0.05 if has_lines else None,
    ).network
    if not has_lines:
        return network
    camera = replace(network.cameras[0], free=frozenset({"df", "k1"}))
    return replace(network, cameras=(camera,), gnss=replace(network.gnss, drift="linear"))


def both(network: Network, settings: AdjustmentSettings) -> tuple[Adjustment, Adjustment]:
    dense = adjust(network, settings)
    blocks = adjust(network, replace(settings, dense_columns=0))
    assert isinstance(blocks.cofactors, BandCofactor)
    return dense, blocks


def assert_same(blocks: Adjustment, dense: Adjustment) -> None:
    sigma = np.sqrt(dense.cofactors.diagonal())
    own = dense.layout.station[:, 0] >= 0
    moved = np.abs(blocks.state.station - dense.state.station)[own]
    assert (moved < 1e-6 * sigma[dense.layout.station[own]] + 1e-9).all()
    assert blocks.sigma0 == pytest.approx(dense.sigma0, rel=1e-9, abs=1e-9)
    assert blocks.cofactors.diagonal() == pytest.approx(sigma**2, rel=1e-7)
    scale = np.abs(dense.cofactor).max()
    assert blocks.cofactor == pytest.approx(dense.cofactor, rel=1e-6, abs=1e-9 * scale)
    finite = np.isfinite(dense.point_cofactor)
    assert (finite == np.isfinite(blocks.point_cofactor)).all()
    found, wanted = blocks.point_cofactor[finite], dense.point_cofactor[finite]
    assert found == pytest.approx(wanted, rel=1e-6, abs=1e-9 * np.abs(wanted).max())
    assert blocks.redundancy_number == pytest.approx(dense.redundancy_number, abs=1e-8)
    assert blocks.influence == pytest.approx(dense.influence, abs=1e-7)
    assert (blocks.rejected == dense.rejected).all()


def test_blocks_near_the_diagonal_give_the_figures_of_the_dense_matrix() -> None:
    dense, blocks = both(strip(), AdjustmentSettings())
    order = blocks.layout.order
    assert order is not None and order.blocks >= 3
    assert_same(blocks, dense)


def test_everything_at_once_gives_the_figures_of_the_dense_matrix() -> None:
    network = with_everything().network
    assert_same(*reversed(both(network, AdjustmentSettings())))


@pytest.mark.parametrize("datum", ["unknowns", "points", "stations", "dependent"])
def test_a_free_network_gives_the_figures_of_the_dense_matrix(datum) -> None:
    network = strip(is_controlled=False, has_lines=False)
    dense, blocks = both(network, AdjustmentSettings(minimum_norm=True, free_datum=datum))
    assert len(blocks.rank_defects) == len(dense.rank_defects) == 7
    assert blocks.sigma0 == pytest.approx(dense.sigma0, rel=1e-9)
    assert blocks.redundancy == dense.redundancy
    spread, wanted = (np.sqrt(np.clip(r.cofactors.diagonal(), 0, None)) for r in (blocks, dense))
    assert spread == pytest.approx(wanted, rel=1e-5, abs=1e-6 * wanted.max())
    found, known = (np.sqrt(np.einsum("pii->pi", r.point_cofactor)) for r in (blocks, dense))
    assert found == pytest.approx(known, rel=1e-5, nan_ok=True)


def test_blunders_of_a_large_block_are_those_of_the_dense_matrix() -> None:
    network = strip()
    random = np.random.default_rng(4)
    wrong = random.choice(len(network.image_points.image), 12, replace=False)
    xy = network.image_points.xy_mm.copy()
    xy[wrong] += random.choice([-0.1, 0.1], (12, 2))
    network = replace(network, image_points=replace(network.image_points, xy_mm=xy))
    dense, blocks = both(network, AdjustmentSettings(significance=0.05))
    assert dense.rejected[wrong].sum() >= 10
    assert_same(blocks, dense)


def test_high_correlations_of_a_large_block_are_those_within_its_blocks() -> None:
    dense, blocks = both(strip(), AdjustmentSettings())
    known = {(c.first, c.second) for g in high_correlations(dense, listed=10**6) for c in g.largest}
    found = {
        (c.first, c.second): c.value
        for g in high_correlations(blocks, listed=10**6)
        for c in g.largest
    }
    assert found and set(found) <= known
    at = {u.name: k for k, u in enumerate(dense.layout.unknowns)}
    spread = np.sqrt(dense.cofactors.diagonal())
    for (first, second), value in found.items():
        i, j = at[first], at[second]
        assert value == pytest.approx(dense.cofactor[i, j] / spread[i] / spread[j], abs=1e-8)


def test_what_a_large_block_does_not_determine_is_named() -> None:
    network = strip(is_controlled=False, has_lines=False)
    with pytest.raises(RankDefectError) as dense:
        adjust(network)
    with pytest.raises(RankDefectError) as blocks:
        adjust(network, AdjustmentSettings(dense_columns=0))
    assert str(blocks.value) == str(dense.value)
    assert "scale of the whole block cannot be determined" in str(blocks.value)


def test_an_order_that_does_not_fit_into_memory_is_refused(monkeypatch) -> None:
    monkeypatch.setattr(block_order, "MAX_VALUES", 1000)
    with pytest.raises(NetworkError, match="look for points with images far apart"):
        adjust(strip(), AdjustmentSettings(dense_columns=0))


def test_the_whole_covariance_of_too_many_unknowns_is_refused(monkeypatch) -> None:
    result = adjust(strip(), AdjustmentSettings(dense_columns=0))
    monkeypatch.setattr("processing.bundle.adjust._MAX_WHOLE", 100)
    with pytest.raises(NetworkError, match="does not fit into memory"):
        _ = result.cofactor
