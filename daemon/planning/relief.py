"""The relief under a flight plan, out of the configured height model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.configuration.model import PlanSection
from daemon.orientation.elevation import read_elevation
from daemon.orientation.georeference import Georeference
from processing.geometry.terrain_rays import HeightModel

NODES = 9
"""Along each axis of a strip, at which places are brought into the model's coordinate system; in
between they are interpolated, good to centimetres over tens of kilometres."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TerrainRelief:
    """Heights of a model above the level ground of the plan."""

    model: HeightModel
    system: Georeference
    ground_height_m: float

    def __call__(self, places: Array) -> Array:
        """Metres above the plan's ground; 0 where the model does not say.

        Args:
            places: (n, m, 2), latitude and longitude in degrees, a regular grid.
        """
        nodes = [np.unique(np.linspace(0, n - 1, NODES).astype(int)) for n in places.shape[:2]]
        coarse = np.empty((len(nodes[0]), len(nodes[1]), 3))
        for i, row in enumerate(nodes[0]):
            for j, column in enumerate(nodes[1]):
                latitude, longitude = (float(v) for v in places[row, column])
                there = self.system.place(latitude, longitude, self.ground_height_m)
                coarse[i, j] = there.east_m, there.north_m, there.height_m
        between = _between(
            _between(coarse, nodes[0], places.shape[0], 0), nodes[1], places.shape[1], 1
        )
        heights = self.model.at(between[..., :2].reshape(-1, 2)).reshape(places.shape[:2])
        return np.asarray(np.nan_to_num(heights - between[..., 2], nan=0.0))


def relief_of(plan: PlanSection) -> TerrainRelief | None:
    """The relief of a plan with a height model; None where there is none.

    Raises:
        ElevationError, GeoreferenceError: the model or its coordinate system cannot be used.
    """
    if plan.elevation is None:
        return None
    system = Georeference(plan.elevation_crs)
    return TerrainRelief(read_elevation(plan.elevation, system), system, plan.ground_height_m)


def relief_or_reason(plan: PlanSection) -> tuple[TerrainRelief | None, str]:
    """The relief, or None and the message why the ground is taken as level.

    Without a configured height model the sentence is empty.
    """
    try:
        return relief_of(plan), ""
    except DaemonError as error:
        return None, f"Level ground is assumed: {error}"


def _between(values: Array, nodes: NDArray[np.int64], count: int, axis: int) -> Array:
    """Linear interpolation of the values at some indices to all of them."""
    at = np.arange(count)
    low = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, max(len(nodes) - 2, 0))
    high = np.minimum(low + 1, len(nodes) - 1)
    span = np.maximum(nodes[high] - nodes[low], 1)
    share = ((at - nodes[low]) / span).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
    before, after = np.take(values, low, axis=axis), np.take(values, high, axis=axis)
    return np.asarray(before + (after - before) * share)
