"""Object points that their rays do not fix, before any adjustment."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.equation_rows import Equations
from processing.bundle.equations import equations
from processing.bundle.image_rows import BehindCameraError
from processing.bundle.network import Network
from processing.bundle.normal_equations import point_normals
from processing.bundle.unknowns import ParameterLayout, ParameterValues, layout_of

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

_MIN_POINT_INFORMATION: Final = 1e-10
_MAX_BEHIND_FRACTION: Final = 0.05


def undetermined_points(
    network: Network, state: ParameterValues, weight: Array | None = None
) -> Flags:
    """Object points whose rays do not fix them.

    They are seen once or from one projection centre only. Or their starting value is behind a
    camera that sees them. Only a few points may be: with many, the images are wrong.

    Args:
        network: observations.
        state: orientations and coordinates at which rays are intersected.
        weight: factor on the weight of each image point, shape (image points,); zero leaves it
            out; None: one.

    Returns:
        Shape (points,), True where a point is not fixed. None of them where more than a few are
        behind a camera.
    """
    found = np.zeros(len(network.points.names), dtype=bool)
    if weight is None:
        weight = np.ones(len(network.image_points.image))
    try:
        rows, layout = _bare_equations(network, found, state, weight)
    except BehindCameraError as error:
        behind = np.unique(network.image_points.point[error.image_points])
        behind = behind[~(network.points.sigma_m[behind] == 0.0).all(axis=1)]
        if len(behind) > max(1.0, _MAX_BEHIND_FRACTION * len(found)):
            return found
        found[behind] = True
        try:
            rows, layout = _bare_equations(network, found, state, weight)
        except BehindCameraError:
            return found
    while True:
        eliminated, tied = layout.eliminated_points, _tied_points(layout)
        weak = eliminated[_is_weak(point_normals(rows, layout), layout.locked[eliminated])]
        weak_tied = tied[_is_weak(_tied_normals(rows, layout, tied), layout.locked[tied])]
        found[weak] = found[weak_tied] = True
        if not len(weak_tied):
            return found
        # Distances to these points have no rows any more.
        rows, layout = _bare_equations(network, found, state, weight)


def _is_weak(normals: Array, locked: Flags) -> Flags:
    values = np.linalg.eigvalsh(normals)
    weak = ~(values[:, 0] > _MIN_POINT_INFORMATION * np.maximum(values[:, 2], 1e-300))
    return np.asarray(weak & ~locked.all(axis=1))


def _tied_points(layout: ParameterLayout) -> Indices:
    """Object points with columns of their own, which distances end at."""
    return np.flatnonzero((layout.retained_points >= 0).any(axis=1))


def _tied_normals(rows: Equations, layout: ParameterLayout, tied: Indices) -> Array:
    """Normal matrices of tied points, the other ends of their distances held, (tied, 3, 3)."""
    result = np.zeros((len(tied), 3, 3))
    if not len(tied):
        return result
    at = layout.retained_points[tied]
    own = rows.reduced[:, at.ravel().clip(0)].tocsc()
    for i in range(3):
        for j in range(i, 3):
            products = own[:, i::3].multiply(own[:, j::3]).sum(axis=0)
            result[:, i, j] = result[:, j, i] = np.asarray(products).ravel()
    held = at < 0
    result[held[:, :, None] | held[:, None, :]] = 0.0
    result[:, range(3), range(3)] += np.where(held, 1.0, 0.0)
    return result


def _bare_equations(
    network: Network, left_out: Flags, state: ParameterValues, weight: Array
) -> tuple[Equations, ParameterLayout]:
    """Rows with the derivatives of object points only."""
    layout = layout_of(network, left_out)
    bare = replace(
        layout,
        **{
            name: np.full_like(getattr(layout, name), -1)
            for name in (
                *("station", "attitude", "head_rotation", "head_offset"),
                *("head_delay", "readout", "jitter", "pattern", "interior"),
            )
        },
        terms=tuple(np.full_like(t, -1) for t in layout.terms),
    )
    return equations(network, bare, state, weight), layout
