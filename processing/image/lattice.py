"""Lattices of inverse mapping: sensor positions of the pixels of a target raster.

A lattice holds raw (column, row) at every `cell_px`-th target pixel, `OUTSIDE` where the sensor is
far; between the nodes it is bilinear. The pixels are fetched in `processing.image.resampling`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, raw_from_vip_mm, vip_mm_from_px
from processing.geometry.projective import apply_projective
from processing.rig import VirtualImage

Array = NDArray[Any]

OUTSIDE: Final = -1e9


@dataclass(frozen=True)
class Raster:
    """A target raster over the virtual image: each pixel covers `ratio` x `ratio` VIP pixels.

    VIP pixel of raster pixel (c, r): (ratio * c + (ratio - 1) / 2, the same for r).
    """

    width_px: int
    height_px: int
    ratio: float


def pan_raster(image: VirtualImage) -> Raster:
    """The virtual image's own raster.

    Args:
        image: virtual image.

    Returns:
        A raster of ratio 1.
    """
    return Raster(image.width_px, image.height_px, 1)


def colour_raster(image: VirtualImage) -> Raster:
    """The raster of the colour product: `colour_ratio` VIP pixels to the pixel.

    Args:
        image: virtual image.

    Returns:
        A raster of ratio `colour_ratio`.
    """
    return Raster(image.colour_width_px, image.colour_height_px, image.colour_ratio)


def lattice_shape(raster: Raster, cell_px: int) -> tuple[int, int]:
    """Nodes that hold all pixels of a raster between them.

    Args:
        raster: target raster.
        cell_px: lattice spacing, target pixels.

    Returns:
        Rows and columns of nodes.
    """
    return math.ceil(raster.height_px / cell_px) + 1, math.ceil(raster.width_px / cell_px) + 1


def fill_lattice(
    image: VirtualImage,
    raster: Raster,
    placement: SensorPlacement,
    cell_px: int,
    out: Array,
    *,
    source_from_target_mm: Array | None = None,
) -> None:
    """Write the raw coordinates of one sensor at the lattice nodes.

    Args:
        image: virtual image.
        raster: target raster over it.
        placement: start or adjusted.
        cell_px: lattice spacing, target pixels.
        out: (rows, columns, 2) float64, see `lattice_shape`; overwritten. Nodes more than two cells
            from the sensor become `OUTSIDE`.
        source_from_target_mm: (3, 3) homography in VIP mm applied first; carries a point of the
            target raster to where the sensor's placement thinks it is. None: they agree.
    """
    rows, columns, _ = out.shape
    out[:] = OUTSIDE
    # Find the sensor on every eighth node first; inverting the lens everywhere would be wasted.
    sparse_rows = np.unique(np.append(np.arange(0, rows, 8), rows - 1))
    sparse_columns = np.unique(np.append(np.arange(0, columns, 8), columns - 1))
    raw = _nodes(
        image, raster, placement, cell_px, sparse_rows, sparse_columns, source_from_target_mm
    )
    reach = 2.0 * cell_px * raster.ratio
    sensor = placement.sensor
    near = _within(raw, sensor.width_px, sensor.height_px, 8.0 * reach)
    if not near.any():
        return
    hit_rows = sparse_rows[near.any(axis=1)]
    hit_columns = sparse_columns[near.any(axis=0)]
    row_span = np.arange(max(hit_rows[0] - 8, 0), min(hit_rows[-1] + 9, rows))
    column_span = np.arange(max(hit_columns[0] - 8, 0), min(hit_columns[-1] + 9, columns))
    raw = _nodes(image, raster, placement, cell_px, row_span, column_span, source_from_target_mm)
    raw[~_within(raw, sensor.width_px, sensor.height_px, reach)] = OUTSIDE
    out[row_span[0] : row_span[-1] + 1, column_span[0] : column_span[-1] + 1] = raw


def interpolate_lattice(lattice: Array, cell_px: int, colrow: Array) -> Array:
    """Raw coordinates at target pixels, bilinear as in the resampling.

    Args:
        lattice: from `fill_lattice`, (rows, columns, 2).
        cell_px: its spacing, target pixels.
        colrow: column and row of target pixels, (n, 2).

    Returns:
        Raw column and row, (n, 2); NaN where a node of the cell is `OUTSIDE`.
    """
    x = np.asarray(colrow[:, 0], np.float64) / cell_px
    y = np.asarray(colrow[:, 1], np.float64) / cell_px
    j = np.clip(np.floor(x).astype(np.intp), 0, lattice.shape[1] - 2)
    i = np.clip(np.floor(y).astype(np.intp), 0, lattice.shape[0] - 2)
    fx, fy = (x - j)[:, None], (y - i)[:, None]
    corners = (lattice[i, j], lattice[i, j + 1], lattice[i + 1, j], lattice[i + 1, j + 1])
    raw: Array = (1.0 - fy) * ((1.0 - fx) * corners[0] + fx * corners[1]) + fy * (
        (1.0 - fx) * corners[2] + fx * corners[3]
    )
    raw[np.any([c[:, 0] == OUTSIDE for c in corners], axis=0)] = np.nan
    return raw


def _nodes(
    image: VirtualImage,
    raster: Raster,
    placement: SensorPlacement,
    cell_px: int,
    rows: Array,
    columns: Array,
    source_from_target_mm: Array | None,
) -> Array:
    middle = (raster.ratio - 1) / 2.0
    c, r = np.meshgrid(columns * float(cell_px), rows * float(cell_px))
    px = np.stack([c.ravel(), r.ravel()], axis=1) * raster.ratio + middle
    xy = vip_mm_from_px(image, px)
    if source_from_target_mm is not None:
        xy = apply_projective(source_from_target_mm, xy)
    raw: Array = raw_from_vip_mm(placement, xy)
    return raw.reshape(len(rows), len(columns), 2)


def _within(raw: Array, width: int, height: int, reach: float) -> Array:
    with np.errstate(invalid="ignore"):
        near: Array = (
            (raw[..., 0] > -reach)
            & (raw[..., 0] < width + reach)
            & (raw[..., 1] > -reach)
            & (raw[..., 1] < height + reach)
        )
    return near
