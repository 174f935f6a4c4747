"""Residual distortion beyond the ten parameters: a grid of corrections that is added to them.

Direction: *ideal from measured*, as the ten parameters. The grid is taken at the measured place and
added to what they made of it.

Source: docs/explanation/mathematics/lens.md#residual-grid.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.rig import LensGrid

Array = NDArray[np.float64]

DIRECTION: Final = "ideal_from_measured"
_STIFFNESS: Final = 0.3


@dataclass(frozen=True)
class ResidualGrid:
    """Nodes at `x_mm` (nx,) and `y_mm` (ny,) of the layer; `delta_mm` (ny, nx, 2) to be added."""

    x_mm: Array
    y_mm: Array
    delta_mm: Array

    def correction_to_ideal(self, measured_mm: Array) -> Array:
        """The correction at measured places, bilinear between nodes.

        Args:
            measured_mm: shape (n, 2), mm in the layer, y up.

        Returns:
            Shape (n, 2), mm, to be added; beyond the grid that of its border.

        Example:
            Half way between nodes of 0 and 4 um, and beyond the border.

            >>> delta_mm = np.zeros((2, 2, 2))
            >>> delta_mm[:, 1, 0] = 0.004
            >>> grid = ResidualGrid(np.array([0.0, 10.0]), np.array([0.0, 10.0]), delta_mm)
            >>> grid.correction_to_ideal(np.array([[5.0, 5.0], [99.0, 5.0]]))
            array([[0.002, 0.   ],
                   [0.004, 0.   ]])
        """
        (i, u), (j, v) = _cells(self.x_mm, self.y_mm, measured_mm)
        u, v, delta = u[:, None], v[:, None], self.delta_mm
        lower = delta[j, i] * (1.0 - u) + delta[j, i + 1] * u
        upper = delta[j + 1, i] * (1.0 - u) + delta[j + 1, i + 1] * u
        return np.asarray(lower * (1.0 - v) + upper * v)

    def as_lens_grid(self) -> LensGrid:
        """As a rig file holds it.

        Returns:
            The same nodes in mm, corrections in um, rounded to 1e-6 um.
        """
        um = np.round(self.delta_mm * 1e3, 6)
        return LensGrid(
            tuple(self.x_mm.tolist()),
            tuple(self.y_mm.tolist()),
            tuple(tuple(row) for row in um[..., 0].tolist()),
            tuple(tuple(row) for row in um[..., 1].tolist()),
        )


@lru_cache(maxsize=64)
def grid_of_lens(grid: LensGrid) -> ResidualGrid:
    """The grid of a rig file's lens.

    Args:
        grid: nodes in mm, corrections in um.

    Returns:
        The same grid, corrections in mm; one object for equal grids.
    """
    delta_mm = np.stack([np.array(grid.dx_um), np.array(grid.dy_um)], axis=-1) * 1e-3
    return ResidualGrid(np.array(grid.x_mm), np.array(grid.y_mm), delta_mm)


def fit_residual_grid(
    measured_mm: Array, residual_mm: Array, *, half_mm: tuple[float, float], nodes: tuple[int, int]
) -> ResidualGrid:
    """Fit a grid to residuals by smoothed least squares.

    Args:
        measured_mm: places in the layer, shape (n, 2), mm.
        residual_mm: computed less measured, ideal side, shape (n, 2), mm.
        half_mm: how far the grid reaches from the middle of the places, across and down.
        nodes: number of nodes across and down, two or more each.

    Returns:
        The grid of the corrections to be added.

    Source: docs/explanation/mathematics/lens.md#residual-grid.

    Example:
        >>> x, y = np.meshgrid(np.linspace(-10.0, 10.0, 5), np.linspace(-10.0, 10.0, 5))
        >>> places_mm = np.column_stack([x.ravel(), y.ravel()])
        >>> residual_mm = np.full((25, 2), 0.001)
        >>> grid = fit_residual_grid(places_mm, residual_mm, half_mm=(10.0, 10.0), nodes=(4, 4))
        >>> grid.correction_to_ideal(np.array([[3.0, -2.0]])).round(6)
        array([[0.001, 0.001]])
    """
    middle = (measured_mm.max(axis=0) + measured_mm.min(axis=0)) / 2.0
    x = middle[0] + np.linspace(-half_mm[0], half_mm[0], nodes[0])
    y = middle[1] + np.linspace(-half_mm[1], half_mm[1], nodes[1])
    data = _bilinear(x, y, measured_mm)
    bend = _STIFFNESS * _second_differences(nodes)
    design = np.vstack([data, bend])
    wanted = np.vstack([residual_mm, np.zeros((len(bend), 2))])
    solved, *_ = np.linalg.lstsq(design, wanted, rcond=None)
    delta = np.asarray(solved.reshape(nodes[1], nodes[0], 2), dtype=np.float64)
    return ResidualGrid(x, y, delta)


def cross_validation_residuals(
    measured_mm: Array, residual_mm: Array, *, half_mm: tuple[float, float], nodes: tuple[int, int]
) -> Array:
    """What a grid fitted to every other residual leaves of the rest, and the other way.

    Args:
        measured_mm: places in the layer, shape (n, 2), mm.
        residual_mm: computed less measured, ideal side, shape (n, 2), mm.
        half_mm: as of `fit_residual_grid`.
        nodes: as of `fit_residual_grid`.

    Returns:
        What is left of each residual, shape (n, 2), mm.

    Source: docs/explanation/mathematics/lens.md#residual-grid.
    """
    left = np.empty_like(residual_mm)
    index = np.arange(len(measured_mm))
    for parity in (0, 1):
        own = index % 2 == parity
        grid = fit_residual_grid(measured_mm[~own], residual_mm[~own], half_mm=half_mm, nodes=nodes)
        left[own] = residual_mm[own] - grid.correction_to_ideal(measured_mm[own])
    return left


def grid_bytes(grid: ResidualGrid) -> bytes:
    """The grid as `.npz`.

    Args:
        grid: to be written.

    Returns:
        Content of the file: `x_mm`, `y_mm`, `delta_mm` and `direction`.
    """
    stream = io.BytesIO()
    np.savez(
        stream,
        x_mm=grid.x_mm,
        y_mm=grid.y_mm,
        delta_mm=grid.delta_mm,
        direction=np.array(DIRECTION),
    )
    return stream.getvalue()


def grid_from_bytes(data: bytes) -> ResidualGrid:
    """Read what `grid_bytes` wrote.

    Args:
        data: content of the file.

    Returns:
        The grid.

    Raises:
        ValueError: it holds other arrays, or another direction.
    """
    with np.load(io.BytesIO(data), allow_pickle=False) as content:
        if sorted(content.files) != ["delta_mm", "direction", "x_mm", "y_mm"]:
            raise ValueError(f"a residual grid holds other arrays than {sorted(content.files)}")
        direction = str(content["direction"])
        if direction != DIRECTION:
            raise ValueError(f"the grid's direction is {direction!r}; {DIRECTION!r} is read here")
        return ResidualGrid(content["x_mm"], content["y_mm"], content["delta_mm"])


def _bilinear(x: Array, y: Array, places: Array) -> Array:
    """Weights of the nodes at places, (n, nodes)."""
    result = np.zeros((len(places), len(y), len(x)))
    rows = np.arange(len(places))
    (i, u), (j, v) = _cells(x, y, places)
    for down, share_y in ((0, 1.0 - v), (1, v)):
        for across, share_x in ((0, 1.0 - u), (1, u)):
            result[rows, j + down, i + across] += share_x * share_y
    return result.reshape(len(places), -1)


def _cells(x: Array, y: Array, places: Array) -> list[tuple[Any, Any]]:
    """Of places (n, 2): the node before, and how far towards the next, across and down."""
    at: list[tuple[Any, Any]] = []
    for nodes, values in ((x, places[:, 0]), (y, places[:, 1])):
        step = nodes[1] - nodes[0]
        place = np.clip((values - nodes[0]) / step, 0.0, len(nodes) - 1.0)
        # Where a lens folds there is no place, and no correction either.
        low = np.minimum(np.nan_to_num(place).astype(int), len(nodes) - 2)
        at.append((low, place - low))
    return at


def _second_differences(nodes: tuple[int, int]) -> Array:
    across, down = nodes
    index = np.arange(across * down).reshape(down, across)
    rows = []
    triples = [index[:, k : k + 3].reshape(-1, 3) for k in range(across - 2)]
    triples += [index[k : k + 3].T.reshape(-1, 3) for k in range(down - 2)]
    for a, b, c in np.vstack(triples):
        row = np.zeros(across * down)
        row[[a, b, c]] = 1.0, -2.0, 1.0
        rows.append(row)
    return np.array(rows)
