"""Pixels, columns and clusters without usable values, found from dark and flat series.

Three maps are looked at: response against its surroundings, dark signal, and temporal noise. A
column too faint to stand out pixel by pixel is found by the mean along it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[Any]
Flags = NDArray[np.bool_]

PIXEL_SIGMAS: Final = 7.0
"""Beyond this a pixel is no member of its sensor: one of 4e11 good ones."""
MIN_RESPONSE_LOSS: Final = 0.05
DARK_SIGMAS: Final = 12.0
"""Dark signals are skewed: a logarithmic normal with a spread of 20 % stays within."""
NOISE_FACTOR: Final = 3.0
"""A defect's temporal standard deviation against its surroundings'."""
COLUMN_SIGMAS: Final = 6.0
COLUMN_RUN_PX: Final = 32
_MIN_COLUMN_LOSS: Final = 0.01
_MIN_RUN_PX: Final = 24
_QUIET_SIGMAS: Final = 4.0
_BLOCK_PX: Final = 16
_DEGREE: Final = 6


@dataclass(frozen=True)
class DefectColumn:
    """A run along a column, last row included; `depth` in the map's unit relative to it."""

    column: int
    first_row: int
    last_row: int
    cause: str


@dataclass(frozen=True)
class DefectMap:
    """What was found. `mask` (height, width) uint8; `single_pixels`, `clusters` of two or more
    that are no column, and `columns`. `by_cause` counts pixels by the map that revealed them."""

    mask: NDArray[np.uint8]
    single_pixels: int
    clusters: tuple[int, ...]
    columns: tuple[DefectColumn, ...]
    by_cause: dict[str, int]


def find_defects(flat: Array, dark: Array, noise: Array) -> DefectMap:
    """Find pixels, columns and clusters without usable values.

    Args:
        flat: mean signal of even light above the offset, shape (height, width), DN.
        dark: dark signal, shape (height, width), DN/s.
        noise: temporal variance of the flat frames over what photon transfer predicts, shape
            (height, width), about one. It holds few frames, so only what is far off counts.

    Returns:
        The map of defects, and what it holds.
    """
    relative = relative_response(flat)
    dark_excess = dark - np.float32(np.median(dark))
    limit = max(PIXEL_SIGMAS * _robust_sigma(relative), MIN_RESPONSE_LOSS)
    causes = {
        "response": np.abs(relative) > limit,
        "dark signal": np.abs(dark_excess) > DARK_SIGMAS * _robust_sigma(dark_excess),
        "noise": noise > NOISE_FACTOR**2,
    }
    found = np.logical_or.reduce(list(causes.values()))
    columns: list[DefectColumn] = []
    for cause, values in (("response", relative), ("dark signal", dark_excess)):
        for column in _columns(np.asarray(values), cause, floor=cause == "response"):
            found[column.first_row : column.last_row + 1, column.column] = True
            columns.append(column)
    in_column = np.zeros_like(found)
    for c in columns:
        in_column[c.first_row : c.last_row + 1, c.column] = True
    single_pixels, clusters, found = _grouped(found, in_column)
    return DefectMap(
        mask=found.astype(np.uint8),
        single_pixels=single_pixels,
        clusters=clusters,
        columns=tuple(columns),
        by_cause={name: int(flags.sum()) for name, flags in causes.items()},
    )


def relative_response(flat: Array) -> Array:
    """Response against the smooth field around it, less one.

    Args:
        flat: mean signal of even light above the offset, shape (height, width), DN.

    Returns:
        Shape (height, width), float32; a pixel that is dark all over has -1.

    Example:
        >>> flat = np.full((64, 64), 1000.0)
        >>> flat[10, 20] = 900.0
        >>> round(float(relative_response(flat)[10, 20]), 3)
        -0.1
    """
    smooth = smooth_field(flat)
    return np.asarray(flat / smooth - 1.0, dtype=np.float32)


def smooth_field(values: Array) -> Array:
    """The smooth part of a map: a polynomial, fitted to medians of blocks.

    Neither a cluster nor a column moves a median of a block by more than a fraction of the noise.

    Args:
        values: shape (height, width), both 2 at least.

    Returns:
        Shape (height, width), float32.
    """
    height, width = values.shape
    rows = np.array_split(np.arange(height), max(2, height // _BLOCK_PX))
    columns = np.array_split(np.arange(width), max(2, width // _BLOCK_PX))
    y = np.array([r.mean() for r in rows])
    x = np.array([c.mean() for c in columns])
    medians = np.array(
        [[np.median(values[r[0] : r[-1] + 1, c[0] : c[-1] + 1]) for c in columns] for r in rows]
    )
    across = np.polynomial.legendre.legvander(2.0 * x / (width - 1) - 1.0, _DEGREE)
    down = np.polynomial.legendre.legvander(2.0 * y / (height - 1) - 1.0, _DEGREE)
    # A few blocks do not determine a high power; it would swing between their middles.
    chosen = [
        (i, j)
        for i in range(min(_DEGREE + 1, len(rows)))
        for j in range(min(_DEGREE + 1 - i, len(columns)))
    ]
    design = np.stack([np.outer(down[:, i], across[:, j]).ravel() for i, j in chosen], axis=1)
    weight = np.ones(medians.size)
    coefficients: Array = np.zeros(len(chosen))
    for _ in range(6):
        coefficients, *_ = np.linalg.lstsq(
            design * weight[:, None], medians.ravel() * weight, rcond=None
        )
        residual = medians.ravel() - design @ coefficients
        spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-9)
        weight = np.sqrt(1.0 / np.maximum(1.0, np.abs(residual) / (2.0 * spread)))
    table = np.zeros((_DEGREE + 1, _DEGREE + 1))
    for (i, j), value in zip(chosen, coefficients, strict=True):
        table[i, j] = value
    every_x = np.polynomial.legendre.legvander(2.0 * np.arange(width) / (width - 1) - 1.0, _DEGREE)
    every_y = np.polynomial.legendre.legvander(
        2.0 * np.arange(height) / (height - 1) - 1.0, _DEGREE
    )
    return np.asarray(every_y @ table @ every_x.T, dtype=np.float32)


def _robust_sigma(values: Array) -> float:
    """Standard deviation from the median absolute deviation."""
    middle = np.median(values)
    return float(1.4826 * np.median(np.abs(values - middle)))


def _columns(values: Array, cause: str, *, floor: bool) -> list[DefectColumn]:
    """Runs along columns whose mean stands out of their neighbours' on the left and right."""
    width = values.shape[1]
    reach = 4
    padded = np.pad(values, ((0, 0), (reach, reach)), mode="reflect")
    neighbours = [padded[:, k : k + width] for k in range(2 * reach + 1) if k != reach]
    difference = values - np.median(np.stack(neighbours), axis=0)
    size = min(COLUMN_RUN_PX, max(values.shape[0] // 4, 4))
    # Single outliers are not a column: they are held at what a good pixel may have.
    sigma = _robust_sigma(difference)
    calm = np.clip(difference, -_QUIET_SIGMAS * sigma, _QUIET_SIGMAS * sigma)
    running = ndimage.uniform_filter1d(calm, size, axis=0, mode="reflect")
    limit = COLUMN_SIGMAS * max(_robust_sigma(running), sigma / np.sqrt(size))
    limit = max(limit, _MIN_COLUMN_LOSS if floor else 0.0)
    found = []
    for column in np.flatnonzero((np.abs(running) > limit).any(axis=0)):
        labels, count = ndimage.label(np.abs(running[:, column]) > limit)
        for label in range(1, count + 1):
            rows = np.flatnonzero(labels == label)
            run = _run_limits(calm[:, column], rows, size)
            if run is None or run[1] - run[0] + 1 < _MIN_RUN_PX:
                continue
            # Two or three outliers move a mean; a column moves the median.
            if abs(float(np.median(calm[run[0] : run[1] + 1, column]))) > limit:
                found.append(DefectColumn(int(column), run[0], run[1], cause))
    return _merged(found)


def _run_limits(values: Array, rows: Array, size: int) -> tuple[int, int] | None:
    """First and last row of a run: where the sum of (value - half of its depth) is largest."""
    first, last = max(int(rows[0]) - size, 0), min(int(rows[-1]) + size, len(values) - 1)
    part = values[first : last + 1]
    inner = values[rows[0] : rows[-1] + 1]
    depth = float(np.median(inner))
    if depth == 0.0:
        return None
    gain = part * np.sign(depth) - abs(depth) / 2.0
    sums = np.concatenate([[0.0], np.cumsum(gain)])
    lowest = np.minimum.accumulate(sums)
    end = int(np.argmax(sums - lowest))
    start = int(np.argmin(sums[: end + 1]))
    return first + start, first + end - 1


def _merged(columns: list[DefectColumn]) -> list[DefectColumn]:
    """Runs of one column that touch or overlap become one."""
    result: list[DefectColumn] = []
    for c in sorted(columns, key=lambda c: (c.column, c.first_row)):
        if result and result[-1].column == c.column and c.first_row <= result[-1].last_row + 9:
            before = result.pop()
            last = max(before.last_row, c.last_row)
            c = DefectColumn(c.column, before.first_row, last, c.cause)
        result.append(c)
    return result


def _grouped(found: Flags, in_column: Flags) -> tuple[int, tuple[int, ...], Flags]:
    """Count single pixels and clusters in addition to the columns; holes within clusters are
    filled."""
    eight = np.ones((3, 3), bool)
    labels, count = ndimage.label(found & ~in_column, structure=eight)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    filled = found.copy()
    for index, where in enumerate(ndimage.find_objects(labels)):
        if sizes[index] >= 8:
            filled[where] |= ndimage.binary_fill_holes(labels[where] == index + 1)
    clusters = tuple(int(s) for s in sorted(sizes[sizes > 1], reverse=True))
    return int(np.sum(sizes == 1)), clusters, filled
