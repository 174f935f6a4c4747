"""A principal distance over flat ground: steps that follow the curved valley of its heights."""

from __future__ import annotations

from dataclasses import replace

import pytest

from processing.bundle import gauss_newton
from processing.bundle.adjust import adjust
from processing.bundle.adjustment_results import parameters_of
from processing.bundle.network import NetworkError
from tests.processing.bundle.plain_block import plain_block

SEEDS = range(1, 5)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_principal_distance_over_flat_ground_converges_to_the_truth(seed) -> None:
    result = adjust(plain_block(seed))
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    (parameter,) = parameters_of(result)
    assert parameter.sigma is not None and parameter.sigma > 1.0
    assert abs(parameter.value) < 3.0 * parameter.sigma
    assert len(result.iterations) < 25


def test_straight_steps_alone_do_not_converge(monkeypatch) -> None:
    monkeypatch.setattr(gauss_newton, "_BENT_BELOW", 0.0)
    with pytest.raises(NetworkError, match="no convergence"):
        adjust(plain_block(1))


def test_a_block_without_a_valley_takes_the_steps_of_gauss_newton(monkeypatch) -> None:
    network = plain_block(1)
    held = replace(network, cameras=(replace(network.cameras[0], free=frozenset()),))
    bent = adjust(held).iterations
    monkeypatch.setattr(gauss_newton, "_BENT_BELOW", 0.0)
    assert adjust(held).iterations == bent
