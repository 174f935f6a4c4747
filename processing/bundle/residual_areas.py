"""Image residuals by areas of the ground: where a block fits badly, and in which direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import image_residuals_mm

Array = NDArray[np.float64]

_CELLS: Final = 12


@dataclass(frozen=True)
class ResidualAreas:
    """Residuals of image points by square areas of the ground.

    Attributes:
        centre_m: (n, 2) X and Y of the areas, m.
        size_m: length of their sides, m.
        count: (n,) image points.
        rms_mm: (n,) root mean square of both coordinates, mm.
        mean_mm: (n, 2) mean residual along X and Y of the object system, mm in the image.
    """

    centre_m: Array
    size_m: float
    count: NDArray[np.int64]
    rms_mm: Array
    mean_mm: Array


def residual_areas(result: Adjustment, cells: int = _CELLS) -> ResidualAreas:
    """Residuals of image points by areas of the ground.

    Args:
        result: the adjustment.
        cells: areas along the longer side of the block.

    Returns:
        Areas that hold an object point, row by row from the lowest Y. Residuals are turned by the
        attitude of their image, so that those of opposite lines may be compared.

    Raises:
        ValueError: no cells.

    Source: docs/explanation/mathematics/bundle.md#residuals-by-area.
    """
    if cells < 1:
        raise ValueError(f"{cells} areas; at least one is needed")
    network, table = result.network, result.network.image_points
    residual = image_residuals_mm(result)
    near = ~network.points.at_infinity[table.point]
    own = np.flatnonzero(np.isfinite(residual).all(axis=1) & near)
    if not len(own):
        empty = np.zeros((0, 2))
        return ResidualAreas(empty, 0.0, np.zeros(0, np.int64), np.zeros(0), empty)
    ground = result.state.points[table.point[own], :2]
    low = ground.min(axis=0)
    span = np.maximum(np.ptp(ground, axis=0), 1e-9)
    size = float(span.max()) / cells
    across = np.maximum(np.ceil(span / size - 1e-9), 1.0).astype(np.int64)
    at = np.clip(((ground - low) / size).astype(np.int64), 0, across - 1)
    flat = at[:, 1] * across[0] + at[:, 0]
    seen, cell, count = np.unique(flat, return_inverse=True, return_counts=True)
    images = network.images
    rotation = result.state.attitude[images.attitude]
    mounted = np.flatnonzero(images.head >= 0)
    rotation[mounted] = rotation[mounted] @ result.state.head_rotation[images.head[mounted]]
    turned = np.einsum("mij,mj->mi", rotation[table.image[own]][:, :2, :2], residual[own])

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(cell, weights=values, minlength=len(seen)) / count)

    corner = np.stack([seen % across[0], seen // across[0]], axis=1)
    return ResidualAreas(
        low + (corner + 0.5) * size,
        size,
        count,
        np.sqrt(mean((residual[own] ** 2).mean(axis=1))),
        np.stack([mean(turned[:, 0]), mean(turned[:, 1])], axis=1),
    )
