"""Where image rays meet the ground of a height model: footprints of images that look sideways.

The model is a grid of heights in the coordinate system of the rays; between its points heights are
bilinear. Oblique rays may graze a ridge: the first piece of ground along the ray counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.curvature_refraction import MEAN_EARTH_RADIUS_M

Array = NDArray[np.float64]

_STEPS: Final = 4000
_HALVINGS: Final = 30


@dataclass(frozen=True)
class HeightModel:
    """Heights (h, w), m, NaN where not known.

    `x_m`, `y_m` are the coordinates of the first column and row, `step_x_m`, `step_y_m` what the
    next ones add (y usually falls).
    """

    height_m: Array
    x_m: float
    y_m: float
    step_x_m: float
    step_y_m: float

    def at(self, xy_m: Array) -> Array:
        """Heights at places, bilinear between grid points.

        Args:
            xy_m: shape (n, 2), m, in the system of the model.

        Returns:
            Shape (n,), m; NaN outside, and next to unknown heights.

        Example:
            >>> model = HeightModel(np.array([[0.0, 10.0], [0.0, 10.0]]), 0.0, 100.0, 50.0, -100.0)
            >>> model.at(np.array([[25.0, 60.0], [75.0, 60.0]]))
            array([ 5., nan])
        """
        column = (xy_m[:, 0] - self.x_m) / self.step_x_m
        row = (xy_m[:, 1] - self.y_m) / self.step_y_m
        height, width = self.height_m.shape
        inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
        c = np.clip(np.floor(np.nan_to_num(column)), 0, width - 2).astype(int)
        r = np.clip(np.floor(np.nan_to_num(row)), 0, height - 2).astype(int)
        u, v = column - c, row - r
        z = self.height_m
        upper = z[r, c] * (1 - u) + z[r, c + 1] * u
        lower = z[r + 1, c] * (1 - u) + z[r + 1, c + 1] * u
        return np.where(inside, upper * (1 - v) + lower * v, np.nan)


def on_terrain(
    centre_m: Array,
    rays: Array,
    model: HeightModel,
    *,
    earth_radius_m: float | None = MEAN_EARTH_RADIUS_M,
) -> Array:
    """Ground points of rays from one projection centre.

    Args:
        centre_m: east, north, height, shape (3,), m.
        rays: directions of any length, object axes, shape (n, 3).
        model: heights of the ground, in the height system of the centre.
        earth_radius_m: heights are counted from a sphere, which falls away below a straight ray;
            None: the system is Cartesian.

    Returns:
        The first ground along each ray, shape (n, 3), m; NaN for one that leaves the model or does
        not come down.

    Example:
        A ray 45 degrees down from 100 m above level ground.

        >>> model = HeightModel(np.full((5, 5), 20.0), -200.0, 200.0, 100.0, -100.0)
        >>> rays = np.array([[1.0, 0.0, -1.0]])
        >>> on_terrain(np.array([0.0, 0.0, 120.0]), rays, model, earth_radius_m=None).round(6)
        array([[100.,   0.,  20.]])
    """
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    top, bottom = float(np.nanmax(model.height_m)), float(np.nanmin(model.height_m))
    down = unit[:, 2] < -1e-6
    with np.errstate(divide="ignore", invalid="ignore"):
        # Above all ground; the sphere only falls away below.
        first = np.where(down, np.maximum((top - centre_m[2]) / unit[:, 2], 0.0), np.nan)
        # The sphere falls away by at most this over the longest ray that is followed.
        last = np.where(down, 1.05 * (bottom - 100.0 - centre_m[2]) / unit[:, 2], np.nan)
    step = min(abs(model.step_x_m), abs(model.step_y_m)) / 2.0

    def above(distance: Array) -> Array:
        point = centre_m + unit * distance[:, None]
        over = point[:, 2] - model.at(point[:, :2])
        if earth_radius_m is not None:
            over = over + (distance**2) * (1.0 - unit[:, 2] ** 2) / (2.0 * earth_radius_m)
        return np.asarray(over)

    sideways = np.maximum(np.hypot(unit[:, 0], unit[:, 1]), 1e-3)
    stride = np.maximum(step / sideways, (last - first) / _STEPS)
    near, far = first.copy(), np.full(len(first), np.nan)
    open_ = np.isfinite(first)
    at = first.copy()
    while open_.any():
        at = np.where(open_, at + stride, at)
        over = above(at)
        hit = open_ & (over <= 0.0)
        far[hit] = at[hit]
        lost = open_ & ((at > last) | (np.isnan(over) & np.isfinite(above(near)) & ~hit))
        near = np.where(open_ & ~hit & ~lost, at, near)
        open_ &= ~hit & ~lost
    good = np.isfinite(far)
    for _ in range(_HALVINGS):
        middle = np.where(good, (near + far) / 2.0, 0.0)
        under = above(middle) <= 0.0
        far, near = np.where(good & under, middle, far), np.where(good & ~under, middle, near)
    found = centre_m + unit * far[:, None]
    if earth_radius_m is not None:
        found[:, 2] += far**2 * (1.0 - unit[:, 2] ** 2) / (2.0 * earth_radius_m)
    return np.asarray(found)
