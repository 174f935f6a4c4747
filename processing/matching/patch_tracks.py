"""Tie points from patches: features of earlier images found again in a new one.

Only a patch of each feature is retained, not its image. Prediction and search are those of
`processing.matching.block_matching`, the compiled kernels those of `processing.matching.patches`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.matching.patches import INTERPOLATION, MARGIN_PX, match_patches, select_features

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Picture = NDArray[np.float32]
Patches = NDArray[np.uint16]

_EDGE_PX: Final = 4
"""Beyond the margin of a patch, so that a place moved by a part of a pixel stays inside."""


@dataclass(frozen=True)
class PatchMatching:
    """How patches are matched.

    Attributes:
        window_px: side of the correlation window, odd.
        min_correlation, min_peak_margin, max_sigma_px: what a match must reach.
        min_contrast: least mean squared gradient of a feature along its weaker direction, over the
            image's mean squared; less is noise, as on water.
    """

    window_px: int = 19
    min_correlation: float = 0.85
    min_peak_margin: float = 0.1
    max_sigma_px: float = 0.1
    min_contrast: float = 1e-6

    @property
    def side_px(self) -> int:
        """Side of a patch: the window and its margins."""
        return self.window_px + 2 * MARGIN_PX

    @property
    def margin_px(self) -> int:
        """Least distance of a feature or a prediction from the edge of an image."""
        return self.side_px // 2 + _EDGE_PX


def usable(pixels: NDArray[Any]) -> Picture:
    """An image for matching.

    Args:
        pixels: (h, w), any number; 0 is no data.

    Returns:
        Shape (h, w), NaN without data.
    """
    picture = pixels.astype(np.float32)
    picture[pixels == 0] = np.nan
    return picture


def features_in(picture: Picture, cells: Indices, settings: PatchMatching) -> Indices:
    """The best feature of each cell, where there is one.

    Args:
        picture: (h, w), NaN without data.
        cells: (n, 4) first and last column, first and last row of each cell, px.
        settings: window and least contrast.

    Returns:
        Column and row, shape (k, 2), k at most n.
    """
    if not len(cells):
        return np.zeros((0, 2), dtype=np.int64)
    found = select_features(picture, cells, settings.window_px // 2, 2, False)
    level = float(np.nanmean(picture[::8, ::8])) ** 2
    if not np.isfinite(level):
        return np.zeros((0, 2), dtype=np.int64)
    strong = found[:, 2] > settings.min_contrast * level
    return np.asarray(np.round(found[strong][:, :2]), dtype=np.int64)


def cut_patches(
    picture: Picture, places: Indices, settings: PatchMatching
) -> tuple[Patches, Indices]:
    """Cut a patch around each place.

    Args:
        picture: (h, w), NaN without data.
        places: column and row of the middle, (n, 2), at least `margin_px` from the edges.
        settings: size of patches.

    Returns:
        Patches, shape (k, side, side), and which places they are of, shape (k,): those with data
        everywhere.
    """
    half = settings.side_px // 2
    reach = np.arange(-half, half + 1)
    rows = places[:, 1, None, None] + reach[:, None]
    columns = places[:, 0, None, None] + reach
    cut = picture[rows, columns]
    whole = np.flatnonzero(np.isfinite(cut).all(axis=(1, 2)))
    return np.clip(cut[whole], 1, 65535).astype(np.uint16), whole


def match_to_picture(
    patches: Patches,
    quarters: Indices,
    predicted_px: Array,
    picture: Picture,
    search_px: int,
    settings: PatchMatching,
) -> Array:
    """Find patches in an image.

    Args:
        patches: (n, side, side) from `cut_patches`.
        quarters: (n,) quarter turns, counter-clockwise, that align a patch with the image.
        predicted_px: (n, 2) column and row of the middles in the image.
        picture: (h, w), NaN without data.
        search_px: radius around the prediction.
        settings: window and limits.

    Returns:
        Column and row of the middles, shape (n, 2), NaN where nothing reached the limits.

    Source: docs/explanation/mathematics/matching.md#least-squares-matching.
    """
    at = np.full((len(patches), 2), np.nan)
    height, width = picture.shape
    last = np.array([width - 1, height - 1])
    inside = np.asarray(np.isfinite(predicted_px).all(axis=1))
    margin_px = settings.margin_px
    inside[inside] = (
        (predicted_px[inside] > margin_px) & (predicted_px[inside] < last - margin_px)
    ).all(axis=1)
    rows = np.flatnonzero(inside)
    if not len(rows):
        return at
    side = settings.side_px
    column = np.concatenate(
        [np.rot90(patches[k], int(quarters[k])) for k in rows], axis=0
    ).astype(np.float32)  # fmt: skip
    middle = np.stack(
        [np.full(len(rows), side // 2), np.arange(len(rows)) * side + side // 2], axis=1
    ).astype(np.int64)
    result = match_patches(
        column, picture, middle, np.round(predicted_px[rows]).astype(np.int64),
        np.array([0, last[0], 0, last[1]], dtype=np.int64), 1, settings.window_px // 2,
        search_px, False, INTERPOLATION,
    )  # fmt: skip
    good = (
        (result[:, 7] > 0.0)
        & (result[:, 4] <= settings.max_sigma_px)
        & (result[:, 5] >= settings.min_correlation)
        & (result[:, 6] >= settings.min_peak_margin)
    )
    # Both places moved by a part of a pixel; what counts is where the patch's middle is.
    at[rows[good]] = result[good, 2:4] - (result[good, :2] - middle[good])
    return at


def grid_cells(size_px: tuple[int, int], cells: tuple[int, int], margin_px: int) -> Indices:
    """An even grid of cells over an image.

    Args:
        size_px: columns and rows of the image.
        cells: columns and rows of the grid.
        margin_px: left free at every edge.

    Returns:
        Shape (cells, 4): first and last column, first and last row, row by row.
    """
    columns = np.linspace(margin_px, size_px[0] - margin_px, cells[0] + 1).astype(np.int64)
    rows = np.linspace(margin_px, size_px[1] - margin_px, cells[1] + 1).astype(np.int64)
    return np.array(
        [
            (columns[c], columns[c + 1] - 1, rows[r], rows[r + 1] - 1)
            for r in range(cells[1])
            for c in range(cells[0])
        ],
        dtype=np.int64,
    )
