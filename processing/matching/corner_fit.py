"""Corners of a chessboard pattern by least squares: two crossing edges fitted to the grey values.

The window stays within the four squares that meet, so that markers in them do not pull.

Source: docs/explanation/mathematics/matching.md#corners-of-a-calibration-board.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float64]

_ITERATIONS: Final = 12
_RADIUS_PX: Final = (2.6, 9.0)
_MAX_SHIFT_PX: Final = 1.5
_MAX_MISFIT: Final = 0.12
"""Root mean square of what the model leaves, over the contrast; a hidden corner leaves more."""
_START_WIDTH_PX: Final = 1.0
_WIDTH_PX: Final = (0.3, 12.0)
_TEN_TO_NINETY: Final = 1.8124
"""Width of an edge erf(a / w) from 10 to 90 %, over w."""


def fitted_corners(
    picture: NDArray[np.uint8], start_px: Array, along_px: Array, clear_share: float
) -> tuple[Array, Array]:
    """Fit each corner.

    The model is m + c erf(a1 / w) erf(a2 / w): grey values of two edges that cross, a1 and a2 the
    distances from them. Seven unknowns: the corner, two directions, m, c and w.

    Args:
        picture: grey values, shape (height, width).
        start_px: column and row to about a pixel, shape (n, 2).
        along_px: sides of the square to the right and below, shape (n, 2, 2), px.
        clear_share: share of a square's side that is clear of anything but the pattern.

    Returns:
        Column and row, shape (n, 2), NaN where the model does not fit, and the width of the edges
        from 10 to 90 % of contrast, shape (n,), px.
    """
    if not len(start_px):
        return np.zeros((0, 2)), np.zeros(0)
    cross = along_px[:, 0, 0] * along_px[:, 1, 1] - along_px[:, 0, 1] * along_px[:, 1, 0]
    across = np.abs(cross)[:, None] / np.linalg.norm(along_px, axis=2)
    radius = np.clip(clear_share * across.min(axis=1), *_RADIUS_PX)
    reach = math.ceil(float(radius.max()))
    offset = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    middle = np.round(start_px).astype(np.int64)
    place = middle[:, None] + offset[None]
    height, width = picture.shape
    inside = ((place >= 0) & (place < [width, height])).all(axis=2)
    place = np.clip(place, 0, [width - 1, height - 1])
    values = picture[place[..., 1], place[..., 0]].astype(np.float64)
    weight = (inside & (np.linalg.norm(place - start_px[:, None], axis=2) <= radius[:, None])) * 1.0
    unknowns = _start(start_px, along_px, values, place, weight)
    for _ in range(_ITERATIONS):
        model, design = _model(unknowns, place)
        left = (values - model) * weight
        normal = np.einsum("npi,np,npj->nij", design, weight, design)
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(7)
        step = np.linalg.solve(normal, np.einsum("npi,np->ni", design, left)[..., None])[..., 0]
        # A damped step: directions and width may not run away from a poor start.
        limit = np.array([0.7, 0.7, 0.2, 0.2, 60.0, 60.0, 0.5])
        step *= np.minimum(1.0, 1.0 / np.max(np.abs(step) / limit, axis=1))[:, None]
        unknowns = unknowns + step
        unknowns[:, 6] = np.clip(unknowns[:, 6], *_WIDTH_PX)
    model, _ = _model(unknowns, place)
    left = (values - model) * weight
    misfit = np.sqrt((left**2).sum(axis=1) / weight.sum(axis=1)) / np.abs(unknowns[:, 5])
    good = (misfit < _MAX_MISFIT) & (
        np.linalg.norm(unknowns[:, :2] - start_px, axis=1) < _MAX_SHIFT_PX
    )
    px = np.where(good[:, None], unknowns[:, :2], np.nan)
    return np.asarray(px), np.asarray(_TEN_TO_NINETY * unknowns[:, 6])


def _start(start_px: Array, along_px: Array, values: Array, place: Array, weight: Array) -> Array:
    unknowns = np.zeros((len(start_px), 7))
    unknowns[:, :2] = start_px
    unknowns[:, 2:4] = np.arctan2(along_px[..., 1], along_px[..., 0])
    unknowns[:, 5], unknowns[:, 6] = 1.0, _START_WIDTH_PX
    pattern, _ = _model(unknowns, place)
    count = weight.sum(axis=1)
    unknowns[:, 4] = (values * weight).sum(axis=1) / count
    about = values - unknowns[:, 4, None]
    unknowns[:, 5] = (about * pattern * weight).sum(axis=1) / (pattern**2 * weight).sum(axis=1)
    return unknowns


def _model(unknowns: Array, place: Array) -> tuple[Array, Array]:
    """Grey values (n, p) and their derivatives by the seven unknowns (n, p, 7)."""
    x = place[..., 0] - unknowns[:, 0, None]
    y = place[..., 1] - unknowns[:, 1, None]
    contrast, width = unknowns[:, 5, None], unknowns[:, 6, None]
    edges, slopes, normals, along = [], [], [], []
    for k in (2, 3):
        cosine, sine = np.cos(unknowns[:, k, None]), np.sin(unknowns[:, k, None])
        distance = (-sine * x + cosine * y) / width
        edges.append(erf(distance))
        slopes.append(2.0 / math.sqrt(math.pi) * np.exp(-(distance**2)) / width)
        normals.append((-sine, cosine, distance))
        along.append(cosine * x + sine * y)
    by_first = contrast * slopes[0] * edges[1]
    by_second = contrast * slopes[1] * edges[0]
    design = np.stack(
        [
            -by_first * normals[0][0] - by_second * normals[1][0],
            -by_first * normals[0][1] - by_second * normals[1][1],
            -by_first * along[0],
            -by_second * along[1],
            np.ones_like(x),
            edges[0] * edges[1],
            -by_first * normals[0][2] - by_second * normals[1][2],
        ],
        axis=-1,
    )
    return unknowns[:, 4, None] + contrast * edges[0] * edges[1], design
