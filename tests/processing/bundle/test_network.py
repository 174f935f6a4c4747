"""Networks whose tables contradict each other are refused with what is wrong, by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.network import NetworkError, validate
from tests.processing.bundle.simulated_networks import with_everything


def refusal(change) -> str:
    network = with_everything().network
    with pytest.raises(NetworkError) as caught:
        change(network)
    return str(caught.value)


def test_a_name_that_is_given_twice_is_the_one_named() -> None:
    def twice(n) -> None:
        names = (*n.points.names[:-1], n.points.names[1])
        validate(replace(n, points=replace(n.points, names=names)))

    name = with_everything().network.points.names[1]
    assert f"object point {name} is given twice" in refusal(twice)


@pytest.mark.parametrize("table", ["image_points", "gnss"])
def test_a_sigma_of_zero_is_refused(table: str) -> None:
    def zero(n) -> None:
        own = getattr(n, table)
        field = "sigma_mm" if table == "image_points" else "sigma_m"
        sigma = np.array(getattr(own, field))
        sigma.flat[0] = 0.0
        validate(replace(n, **{table: replace(own, **{field: sigma})}))

    assert "sigma" in refusal(zero)


def test_a_place_that_is_not_finite_is_refused() -> None:
    def lost(n) -> None:
        xyz = n.stations.position_m.copy()
        xyz[0, 1] = np.nan
        validate(replace(n, stations=replace(n.stations, position_m=xyz)))

    assert "stations hold a value that is not a finite number" in refusal(lost)
