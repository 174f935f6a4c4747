"""Positions of one target in many images, by intensity-based least squares among the images.

There is no drawn template: every image is matched to others of the same target under an affine
change, gain and offset, and the positions that fit all matches are adjusted. What "the target's
middle" is stays undetermined by one common shift, which the orientation of a series takes.
Source: Heier et al. (2002), 5.1.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

Array = NDArray[np.float64]

_ORDER: Final = 5
_STEPS: Final = 12
_CONVERGED_PX: Final = 1e-3
_MAX_STEP_PX: Final = 3.0
_MIN_CORRELATION: Final = 0.9


@dataclass(frozen=True)
class TargetImage:
    """A cut-out around the target, DN, and its first guess of the middle (column, row) in it.

    From the nominal geometry: `pixels_by_target` (2, 2), the derivative of pixel position by place
    on the target, and `bend` (2, 3), half of the second ones (of x x, x y, y y), for aslant through
    the lens a target is no affine picture of itself.
    """

    pixels: Array
    middle: Array
    pixels_by_target: Array
    bend: Array


@dataclass(frozen=True)
class TargetMatch:
    """Where the middle of `a` is found in `b`: `offset_px` from b's guess, (2,); `affine` (2, 2)
    carries steps in a to steps in b; `sigma_px` from the grey values that are left."""

    a: int
    b: int
    offset_px: Array
    affine: Array
    sigma_px: float
    correlation: float


@dataclass(frozen=True)
class TargetPositions:
    """Adjusted positions (n, 2) px in their cut-outs, NaN for images without a good match.

    `sigma_px` (n,) is what grey values say of a position; `closure_px` the root mean square of what
    the adjusted positions leave of the matches.
    """

    position_px: Array
    sigma_px: Array
    closure_px: float
    matches: tuple[TargetMatch, ...]
    failed: tuple[int, ...]


def first_guess(pixels: Array) -> Array:
    """Middle of what is brighter than the border of a cut-out.

    Args:
        pixels: grey values, (h, w).

    Returns:
        Column and row, (2,), px; the cut-out's middle where nothing is brighter.
    """
    border = np.concatenate([pixels[:3].ravel(), pixels[-3:].ravel()])
    level = float(np.median(border))
    lit = pixels > level + 0.3 * (float(np.percentile(pixels, 98)) - level)
    row, column = np.nonzero(lit)
    if not row.size:
        return np.array([(pixels.shape[1] - 1) / 2, (pixels.shape[0] - 1) / 2])
    # The middle of the extent: holes in the pattern do not pull it.
    low, high = (np.array([np.quantile(column, q), np.quantile(row, q)]) for q in (0.005, 0.995))
    return np.asarray((low + high) / 2.0)


def positions_of(
    images: Sequence[TargetImage],
    *,
    half_px: int,
    partners: int = 3,
    progress: Callable[[int, int], None] | None = None,
) -> TargetPositions:
    """Match each image to its neighbours in the list and to some far away, and adjust.

    Args:
        images: cut-outs of one target; each is matched to the one before it, among others.
        half_px: half the side of the window around the target.
        partners: how many earlier images each is matched to; at least one.
        progress: called with the number of pairs that are done, and of all pairs.

    Returns:
        Positions by image, the matches behind them, and the images without one.
    """
    pairs = _pairs(len(images), partners)
    splines = [spline_filter(image.pixels, order=_ORDER) for image in images]
    found: list[TargetMatch] = []
    for k, (a, b) in enumerate(pairs):
        match = _matched(images, splines, a, b, half_px)
        if match is not None:
            found.append(match)
        if progress is not None:
            progress(k + 1, len(pairs))
    return _adjusted(images, found)


def _pairs(count: int, partners: int) -> list[tuple[int, int]]:
    """Each image with the one before, and with others farther back in growing steps."""
    steps = [1] + [round(1 + 7 * 2.6**k) for k in range(partners - 1)]
    return [(b - step, b) for b in range(1, count) for step in dict.fromkeys(steps) if b >= step]


def _matched(
    images: Sequence[TargetImage], splines: Sequence[Any], a: int, b: int, half_px: int
) -> TargetMatch | None:
    """Least squares of b, resampled under an affine change, against a."""
    side = np.arange(-half_px, half_px + 1, dtype=float)
    u, v = (g.ravel() for g in np.meshgrid(side, side))
    own = images[a].middle
    whole_px = np.round(own)
    # a is taken as it is, at whole pixels: no interpolation smooths its noise.
    column, row = (u + whole_px[0]).astype(int), (v + whole_px[1]).astype(int)
    u, v = column - own[0], row - own[1]
    height, width = images[a].pixels.shape
    if column.min() < 0 or row.min() < 0 or column.max() >= width or row.max() >= height:
        return None
    reference = images[a].pixels[row, column]
    onto = np.linalg.inv(images[a].pixels_by_target)
    place = onto @ np.stack([u, v])
    place = onto @ (np.stack([u, v]) - _bent(images[a].bend, place))
    rotation, offset = np.eye(2), np.zeros(2)
    shape = (len(side), len(side))
    correlation, sigma = 0.0, math.inf
    for step in range(_STEPS):
        on_target = rotation @ place
        at = images[b].pixels_by_target @ on_target + _bent(images[b].bend, on_target)
        at = at + (images[b].middle + offset)[:, None]
        reach = np.array(images[b].pixels.shape[::-1])[:, None]
        inside = ((at > 1.0) & (at < reach - 2.0)).all(axis=0)
        if inside.mean() < 0.9:
            return None
        seen = map_coordinates(splines[b], at[::-1], order=_ORDER, prefilter=False, mode="mirror")
        down, across = np.gradient(seen.reshape(shape))
        gu, gv = across.ravel(), down.ravel()
        design = np.stack([gu, gv, gu * u, gu * v, gv * u, gv * v, -seen, -np.ones_like(u)], 1)
        # reference = gain * seen + offset; a step in the target's own system, composed.
        design, parameters = design[inside], (reference - seen)[inside]
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
        normal = design.T @ design / scale[:, None] / scale
        try:
            inverse = np.linalg.inv(normal) / scale[:, None] / scale
        except np.linalg.LinAlgError:
            return None
        solved = inverse @ (design.T @ parameters)
        left = parameters - design @ solved
        variance = float(left @ left) / (len(left) - 8)
        move = np.array([[1 + solved[2], solved[3]], [solved[4], 1 + solved[5]]])
        gain = 1.0 - solved[6]
        stride = solved[:2] / gain
        if not np.isfinite(solved).all() or float(np.hypot(*stride)) > _MAX_STEP_PX:
            return None
        offset = offset + images[b].pixels_by_target @ rotation @ onto @ stride
        rotation = rotation @ onto @ (np.eye(2) + (move - np.eye(2)) / gain) @ np.linalg.inv(onto)
        correlation = float(np.corrcoef(seen[inside], reference[inside])[0, 1])
        sigma = math.sqrt(variance * float(inverse[0, 0] + inverse[1, 1]) / 2.0)
        if step > 1 and float(np.hypot(*stride)) < _CONVERGED_PX:
            break
    else:
        return None
    if correlation < _MIN_CORRELATION:
        return None
    affine = images[b].pixels_by_target @ rotation @ onto
    return TargetMatch(a, b, offset, affine, sigma, correlation)


def _bent(bend: Array, place: Array) -> Array:
    """What the second derivatives add at places (2, n) on the target."""
    x, y = place
    return np.asarray(bend @ np.stack([x * x, x * y, y * y]))


def _adjusted(images: Sequence[TargetImage], matches: Sequence[TargetMatch]) -> TargetPositions:
    """Corrections e of the guesses from e_b - A e_a = offset; their sum on the target is zero."""
    count = len(images)
    joined = np.zeros(count, bool)
    for m in matches:
        joined[[m.a, m.b]] = True
    rows = 2 * len(matches) + 2
    design, parameters = np.zeros((rows, 2 * count)), np.zeros(rows)
    for k, m in enumerate(matches):
        design[2 * k : 2 * k + 2, 2 * m.b : 2 * m.b + 2] = np.eye(2)
        design[2 * k : 2 * k + 2, 2 * m.a : 2 * m.a + 2] = -m.affine
        parameters[2 * k : 2 * k + 2] = m.offset_px
    for k in np.flatnonzero(joined).tolist():
        design[-2:, 2 * k : 2 * k + 2] = np.linalg.inv(images[k].pixels_by_target)
    # On the target the guesses' common error: in its own units, not in pixels of any image.
    design[-2:] *= float(np.mean([np.linalg.norm(i.pixels_by_target) for i in images]))
    solved, *_ = np.linalg.lstsq(design, parameters, rcond=None)
    left = (parameters - design @ solved)[:-2]
    sigma = np.full(count, math.nan)
    for k in np.flatnonzero(joined).tolist():
        # A match holds the noise of both of its images.
        own = [m.sigma_px for m in matches if k in (m.a, m.b)]
        sigma[k] = float(np.median(own)) / math.sqrt(2.0)
    position = np.stack([image.middle for image in images]) + solved.reshape(-1, 2)
    position[~joined] = math.nan
    return TargetPositions(
        position,
        sigma,
        float(np.sqrt(np.mean(left**2))) if left.size else math.nan,
        tuple(matches),
        tuple(int(k) for k in np.flatnonzero(~joined)),
    )
