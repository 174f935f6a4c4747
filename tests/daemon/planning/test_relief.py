"""Heights above the plan's ground at every point of a grid, as for each place by itself."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from daemon.planning.relief import TerrainRelief, _between


class Plane:
    """A coordinate system whose metres follow from degrees, and a model that is a slope in it."""

    def place(self, latitude: float, longitude: float, height_m: float) -> Any:
        return SimpleNamespace(
            east_m=1000.0 * longitude, north_m=2000.0 * latitude, height_m=height_m + 3.0
        )

    def at(self, places: np.ndarray) -> np.ndarray:
        heights = 500.0 + 0.5 * places[:, 0] - 0.25 * places[:, 1]
        heights[places[:, 0] > 16_900.0] = np.nan
        return cast(np.ndarray, heights)


@pytest.mark.parametrize(("rows", "columns"), [(40, 23), (9, 9), (2, 30), (1, 1)])
def test_relief_is_the_models_height_less_the_ground(rows: int, columns: int) -> None:
    latitude, longitude = np.meshgrid(
        np.linspace(47.0, 47.2, rows), np.linspace(15.0, 17.0, columns), indexing="ij"
    )
    system = cast(Any, Plane())
    relief = TerrainRelief(system, system, 400.0)(np.stack([latitude, longitude], axis=-1))
    expected = 500.0 + 500.0 * longitude - 500.0 * latitude - 403.0
    expected[longitude > 16.9] = 0.0
    assert relief == pytest.approx(expected, abs=1e-6)
    assert (relief[longitude > 16.9] == 0.0).all()


def test_between_nodes_values_are_interpolated_along_one_axis() -> None:
    nodes = np.array([0, 3, 5])
    values = np.array([[[0.0, 1.0]], [[9.0, 4.0]], [[5.0, 0.0]]])
    between = _between(values, nodes, 6, 0)
    assert between[:, 0].tolist() == pytest.approx(
        np.array([[0, 1], [3, 2], [6, 3], [9, 4], [7, 2], [5, 0]])
    )
    transposed = _between(values.transpose(1, 0, 2), nodes, 6, 1)
    assert transposed[0] == pytest.approx(between[:, 0])
    assert _between(values[:1], np.array([0]), 1, 0) == pytest.approx(values[:1])
