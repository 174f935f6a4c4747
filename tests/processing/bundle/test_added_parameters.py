"""Parameters that are estimated after an adjustment are what unknowns of it would be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.adjust import adjust
from processing.bundle.block_adjustment import added_parameters
from tests.processing.bundle.simulated_networks import aerial

DF_MM = 0.1


def test_a_principal_distance_is_found_from_the_equations_without_it() -> None:
    block = aerial(sigma_mm=1e-3, heights=(1000.0, 700.0), gnss_sigma_m=0.02)
    table, camera = block.network.image_points, block.network.cameras[0]
    xy = table.xy_mm * (1.0 + DF_MM / camera.f_mm)
    network = replace(block.network, image_points=replace(table, xy_mm=xy))
    n, m = len(network.images.names), len(xy)
    plain = adjust(network)
    none = np.zeros((n, 3, 1))
    added = added_parameters(
        plain, none, none, np.array([np.inf]), image_mm=(xy / camera.f_mm)[:, :, None]
    )
    free = adjust(replace(network, cameras=(replace(camera, free=frozenset({"df"})),)))
    column = free.layout.interior[0, 2]
    sigma = np.sqrt(free.cofactor[column, column])
    assert added.sigma[0] / max(1.0, plain.sigma0) == pytest.approx(sigma, rel=0.01)
    # The ten change coordinates, of which this is the derivative: df has the other sign.
    assert added.value[0] == pytest.approx(-free.state.interior[0, 2], abs=0.1 * sigma)
    assert added.value[0] == pytest.approx(DF_MM, abs=4.0 * sigma)
    assert sigma < DF_MM / 8.0
    # Image points that were left out have no say.
    wild = np.zeros((m, 2, 1))
    wild[0] = 1.0
    without = replace(plain, weight=np.concatenate([[0.0], plain.weight[1:]]))
    silent = added_parameters(without, none, none, np.array([np.inf]), image_mm=wild)
    assert not np.isfinite(silent.sigma[0])
