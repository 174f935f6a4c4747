"""Grid of ground pixels, and where in object space their centres lie.

The surface is a lattice of Cartesian coordinates at one reference height with the direction of the
vertical, plus a height for each pixel. Map projection and earth curvature are in the lattice, which
the caller computes; relief is in the heights.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.terrain_rays import HeightModel

Array = NDArray[Any]

LATTICE_STEP_PX: Final = 64
"""At 1 m GSD the sphere departs from a bilinear cell of this size by 0.08 mm."""
_SPAN_M: Final = 100.0

CartesianOf = Callable[[Array], Array]
"""From east, north, height (n, 3), m, to the Cartesian system of the camera stations, (n, 3), m."""


@dataclass(frozen=True)
class GroundGrid:
    """North-up grid of square ground pixels.

    `east_m`, `north_m` are the centre of pixel (0, 0); rows go south.
    """

    east_m: float
    north_m: float
    gsd_m: float
    width_px: int
    height_px: int

    def window(self, column: int, row: int, width_px: int, height_px: int) -> GroundGrid:
        """Part of the grid from a pixel on.

        Args:
            column: first column, px.
            row: first row, px.
            width_px: columns of the part.
            height_px: rows of the part.

        Returns:
            The part; its pixels are those of the grid.

        Example:
            >>> GroundGrid(100.0, 500.0, 0.5, 40, 40).window(10, 4, 8, 8)
            GroundGrid(east_m=105.0, north_m=498.0, gsd_m=0.5, width_px=8, height_px=8)
        """
        return GroundGrid(
            self.east_m + column * self.gsd_m,
            self.north_m - row * self.gsd_m,
            self.gsd_m,
            width_px,
            height_px,
        )

    def coarser(self, factor: int) -> GroundGrid:
        """Grid of blocks of pixels; the last ones may reach beyond.

        Args:
            factor: pixels to a block along each axis.

        Returns:
            The coarser grid.

        Example:
            >>> GroundGrid(0.5, 9.5, 1.0, 10, 10).coarser(4)
            GroundGrid(east_m=2.0, north_m=8.0, gsd_m=4.0, width_px=3, height_px=3)
        """
        shift_m = (factor - 1) / 2.0 * self.gsd_m
        return GroundGrid(
            self.east_m + shift_m,
            self.north_m - shift_m,
            self.gsd_m * factor,
            -(-self.width_px // factor),
            -(-self.height_px // factor),
        )

    @property
    def columns_m(self) -> Array:
        """East of each column, (width,), m."""
        return self.east_m + np.arange(self.width_px) * self.gsd_m

    @property
    def rows_m(self) -> Array:
        """North of each row, (height,), m."""
        return self.north_m - np.arange(self.height_px) * self.gsd_m


@dataclass(frozen=True)
class GroundSurface:
    """Object coordinates of the pixels of a grid.

    Attributes:
        base_m: (r, c, 3), Cartesian coordinates of every `step_px`-th pixel at the reference
            height; the last nodes reach past the grid.
        up_m: (r, c, 3), what a metre of height adds.
        above_m: (height, width) float32, heights above the reference, NaN where not known.
        step_px: pixels from node to node.
    """

    base_m: Array
    up_m: Array
    above_m: Array
    step_px: int


def heights_on(grid: GroundGrid, model: HeightModel) -> Array:
    """Heights of a height model at the pixels of a grid, bilinear.

    Args:
        grid: in the coordinate system of the model.
        model: heights, m.

    Returns:
        (height, width) float64, m; NaN outside the model and next to unknown heights.

    Example:
        >>> model = HeightModel(np.array([[0.0, 10.0], [0.0, 10.0]]), 0.0, 100.0, 50.0, -100.0)
        >>> heights_on(GroundGrid(25.0, 60.0, 50.0, 2, 1), model)
        array([[ 5., nan]])
    """
    heights = np.asarray(model.height_m)
    rows, columns = heights.shape
    column = (grid.columns_m - model.x_m) / model.step_x_m
    row = (grid.rows_m - model.y_m) / model.step_y_m
    c = np.clip(np.floor(column), 0, columns - 2).astype(int)
    r = np.clip(np.floor(row), 0, rows - 2).astype(int)
    u, v = (column - c)[None, :], (row - r)[:, None]
    first, last = heights[r], heights[r + 1]
    upper = first[:, c] * (1.0 - u) + first[:, c + 1] * u
    lower = last[:, c] * (1.0 - u) + last[:, c + 1] * u
    found = upper * (1.0 - v) + lower * v
    found[(row < 0) | (row > rows - 1)] = np.nan
    found[:, (column < 0) | (column > columns - 1)] = np.nan
    return np.asarray(found)


def ground_surface(
    grid: GroundGrid,
    ground: HeightModel | float,
    cartesian_of: CartesianOf | None = None,
    *,
    step_px: int = LATTICE_STEP_PX,
) -> GroundSurface:
    """Surface of a height model, or of a plane, under a grid.

    Args:
        grid: ground pixels.
        ground: heights in the system of the grid; a number is a plane at that height, m.
        cartesian_of: from the grid's system to that of the camera stations; None: they are the
            same, Cartesian.
        step_px: pixels from node to node of the lattice.

    Returns:
        The surface.
    """
    if isinstance(ground, HeightModel):
        heights = heights_on(grid, ground)
    else:
        heights = np.full((grid.height_px, grid.width_px), float(ground))
    known = heights[np.isfinite(heights)]
    reference_m = float(known.mean()) if known.size else 0.0
    rows, columns = (math.ceil(n / step_px) + 1 for n in (grid.height_px, grid.width_px))
    east = grid.east_m + np.arange(columns) * step_px * grid.gsd_m
    north = grid.north_m - np.arange(rows) * step_px * grid.gsd_m
    e, n = np.meshgrid(east, north)
    low = np.stack([e, n, np.full_like(e, reference_m)], axis=-1).reshape(-1, 3)
    high = low + np.array([0.0, 0.0, _SPAN_M])
    if cartesian_of is not None:
        low, high = cartesian_of(low), cartesian_of(high)
    return GroundSurface(
        low.reshape(rows, columns, 3),
        ((high - low) / _SPAN_M).reshape(rows, columns, 3),
        (heights - reference_m).astype(np.float32),
        step_px,
    )
