"""A region of one frame that is less sharp than the other frames show the same ground.

Colour heads are compared with each other and with PAN reduced to their pixels. A PAN head is
compared by how much detail of its own pixels goes with the detail that colour sees there: no other
head resolves as finely, but blur takes detail that the rest of the image has.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel
from processing.quality.common_windows import CommonWindows
from processing.quality.figures.image import LocalBlurFigures
from processing.rig import Rig

Array = NDArray[Any]

CELLS: Final = 4
"""A frame is divided into so many cells each way; a region is two by two of them."""
MIN_WINDOWS: Final = 24
"""Of the whole grid in a region."""
SUSPICIOUS: Final = (0.06, 0.3)
"""Deficits of colour and of PAN from which on all windows are measured, half of what changes the
verdict."""
MIN_FRAMES: Final = 3
SINGLE_AXIS_DEFICIT: Final = 0.1
"""A band that only PAN can be compared with may hold so much less: near infrared, of vegetation."""
OVER_NOISE: Final = 2.0
"""Detail counts where it is so many times that of noise."""
_AXES: Final[tuple[Literal["columns", "rows"], ...]] = ("columns", "rows")


@dataclass(frozen=True)
class LocalBlur:
    """The least sharp region of one frame.

    `deficit` is zero for a frame as sharp as the others: for colour what is missing of the share
    of the finest detail (0.25 without any, about 0.45 sharp), for PAN the logarithm of how many
    times less energy of detail is left. `region` is left, top, right, bottom as shares of the
    frame; `along` the direction in pixels in which most is missing.
    """

    sensor: str
    pan: bool
    deficit: float
    region: tuple[float, float, float, float]
    along: Literal["columns", "rows"]


def _local_blurs(ground: CommonWindows) -> tuple[LocalBlur, ...]:
    """The least sharp region of every frame that can be compared."""
    colour, pan = _colour_deficits(ground), _pan_deficits(ground)
    found = []
    for k, name in enumerate(ground.names):
        deficits = pan if ground.pan[k] else colour
        worst = _worst_region(ground.place[k], deficits[k], MIN_WINDOWS // ground.every)
        if worst is not None:
            found.append(LocalBlur(name, bool(ground.pan[k]), *worst))
    return tuple(found)


def local_blur_figures(rig: Rig, ground: CommonWindows | None) -> LocalBlurFigures:
    """The colour head and the PAN head with the least sharp region, in figures of the report.

    Of PAN only what the next frame does not have counts: grounds differ in how their detail goes on
    below the pixels of colour, and then in several frames.

    Args:
        rig: the camera.
        ground: windows that heads share; None where there are none.

    Returns:
        Sensor, deficit and region in pixels of both; None for a kind that cannot be compared.
    """
    figures = _figures(rig, () if ground is None else _local_blurs(ground))
    deficits = figures.colour_blur_deficit, figures.pan_blur_deficit
    if ground is not None and any(
        deficit is not None and deficit > limit
        for deficit, limit in zip(deficits, SUSPICIOUS, strict=True)
    ):
        figures = _figures(rig, _local_blurs(ground.finer()))
    return figures


def _figures(rig: Rig, blurs: Sequence[LocalBlur]) -> LocalBlurFigures:
    colour, _ = _least_sharp([b for b in blurs if not b.pan])
    pan, next_pan = _least_sharp([b for b in blurs if b.pan])
    usual = 0.0 if next_pan is None else max(0.0, next_pan.deficit)
    return LocalBlurFigures(
        colour_blur_sensor=None if colour is None else colour.sensor,
        colour_blur_deficit=None if colour is None else colour.deficit,
        colour_blur_region=None if colour is None else _pixels(rig, colour),
        pan_blur_sensor=None if pan is None else pan.sensor,
        pan_blur_deficit=None if pan is None else pan.deficit - usual,
        pan_blur_region=None if pan is None else _pixels(rig, pan),
    )


def _least_sharp(blurs: Sequence[LocalBlur]) -> tuple[LocalBlur | None, LocalBlur | None]:
    """The least sharp region, and the next."""
    worst, following, *_ = [*sorted(blurs, key=lambda blur: -blur.deficit), None, None]
    return worst, following


def _pixels(rig: Rig, blur: LocalBlur) -> str:
    """Where a region is, raw pixels."""
    sensor = rig.sensor(blur.sensor)
    left, right = (round(share * sensor.width_px) for share in blur.region[::2])
    top, bottom = (round(share * sensor.height_px) for share in blur.region[1::2])
    return f"columns {left} to {right - 1}, rows {top} to {bottom - 1}"


def _colour_deficits(ground: CommonWindows) -> Array:
    """How much less of the finest detail each window (f, n, 2) holds than the median frame's."""
    with np.errstate(invalid="ignore", divide="ignore"):
        clear = ground.far > OVER_NOISE * 2.0 * ground.noise_reduced[..., None]
        share = np.where(clear, ground.near / ground.far, np.nan)
    several = np.isfinite(share).sum(axis=0) >= MIN_FRAMES
    single_axis = np.isfinite(share[~ground.pan]).sum(axis=0) < 2
    return np.where(several, _median(share) - share - SINGLE_AXIS_DEFICIT * single_axis, np.nan)


def _pan_deficits(ground: CommonWindows) -> Array:
    """Logarithms of how much energy of detail of own pixels is missing, (f, n, 2)."""
    mean = ground.mean[..., None]
    seen = ~ground.pan
    with np.errstate(invalid="ignore", divide="ignore"):
        curved = ground.curved[seen]
        clear = curved > OVER_NOISE * 6.0 * ground.noise_reduced[seen][..., None]
        detail = _median(np.where(clear, np.log(curved / mean[seen] ** 2), np.nan))
        enough = clear.sum(axis=0) >= min(2, int(seen.sum()))
        noise = 2.0 * ground.noise[..., None]
        fine = np.log(np.maximum(ground.fine, 0.05 * noise) / mean**2)
        missing = np.where(enough, detail, np.nan) - fine
        usual = -_median(missing[ground.pan].reshape(-1, 1))
        # Noise would stand in for detail: only where the usual share of it would show clearly.
        expected = np.exp(detail + usual) * mean**2
        return np.where(expected > OVER_NOISE * noise, missing + usual, np.nan)


def _worst_region(
    place: Array, deficits: Array, enough: int
) -> tuple[float, tuple[float, float, float, float], Literal["columns", "rows"]] | None:
    """The largest median deficit of any region of a frame, in either direction."""
    medians = _region_medians(place, deficits, enough)
    if not np.isfinite(medians).any():
        return None
    left, top, axis = (int(k) for k in np.unravel_index(np.nanargmax(medians), medians.shape))
    region = (left / CELLS, top / CELLS, (left + 2) / CELLS, (top + 2) / CELLS)
    return float(medians[left, top, axis]), region, _AXES[axis]


@compiled_kernel()
def _region_medians(place: Array, deficits: Array, enough: int) -> Array:
    """Medians (left, top, axis) of finite deficits (n, 2); NaN of fewer than enough."""
    medians = np.full((CELLS - 1, CELLS - 1, 2), np.nan)
    values = np.empty(len(place))
    for left in range(CELLS - 1):
        for top in range(CELLS - 1):
            for axis in range(2):
                count = 0
                for i in range(len(place)):
                    if not (np.isfinite(place[i, 0]) and np.isfinite(deficits[i, axis])):
                        continue
                    column, row = np.floor(place[i, 0] * CELLS), np.floor(place[i, 1] * CELLS)
                    if left <= column <= left + 1 and top <= row <= top + 1:
                        values[count] = deficits[i, axis]
                        count += 1
                if count >= enough:
                    medians[left, top, axis] = np.median(values[:count])
    return medians


def _median(values: Array) -> Array:
    """Median along the first axis of what is there; NaN where nothing is."""
    flat = np.ascontiguousarray(values.reshape(len(values), math.prod(values.shape[1:])))
    return np.asarray(_column_medians(flat).reshape(values.shape[1:]))


@compiled_kernel()
def _column_medians(values: Array) -> Array:
    """Medians of the columns (k, n) without NaN; NaN where no value of a column is finite."""
    medians = np.full(values.shape[1], np.nan)
    column = np.empty(len(values))
    for i in range(values.shape[1]):
        count = finite = 0
        for k in range(len(values)):
            if not np.isnan(values[k, i]):
                column[count] = values[k, i]
                count += 1
                finite += np.isfinite(values[k, i])
        if finite:
            found = column[:count]
            found.sort()
            medians[i] = 0.5 * (found[(count - 1) // 2] + found[count // 2])
    return medians
