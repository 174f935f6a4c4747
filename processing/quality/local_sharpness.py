"""A region of one frame that is less sharp than the other frames show the same ground.

Colour heads are compared with each other and with PAN reduced to their pixels. A PAN head is
compared by how much detail of its own pixels goes with the detail that colour sees there: no other
head resolves as finely, but blur takes detail that the rest of the image has.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing.quality.common_windows import CommonWindows
from processing.quality.report import Figure
from processing.rig import Rig

Array = NDArray[Any]

CELLS: Final = 4
"""A frame is divided into so many cells each way; a region is two by two of them."""
MIN_WINDOWS: Final = 24
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


def local_blurs(ground: CommonWindows) -> tuple[LocalBlur, ...]:
    """The least sharp region of every frame that can be compared."""
    colour, pan = _colour_deficits(ground), _pan_deficits(ground)
    found = []
    for k, name in enumerate(ground.names):
        deficits = pan if ground.pan[k] else colour
        worst = _worst_region(ground.place[k], deficits[k])
        if worst is not None:
            found.append(LocalBlur(name, bool(ground.pan[k]), *worst))
    return tuple(found)


def local_blur_figures(rig: Rig, ground: CommonWindows | None) -> dict[str, Figure]:
    """The colour head and the PAN head with the least sharp region, in figures of the report.

    Of PAN only what the next frame does not have counts: grounds differ in how their detail goes on
    below the pixels of colour, and then in several frames.
    """
    blurs = () if ground is None else local_blurs(ground)
    figures: dict[str, Figure] = {}
    for kind, of_kind in (
        ("colour", [b for b in blurs if not b.pan]),
        ("pan", [b for b in blurs if b.pan]),
    ):
        ordered = sorted(of_kind, key=lambda b: -b.deficit)
        worst = ordered[0] if ordered else None
        usual = max(0.0, ordered[1].deficit) if kind == "pan" and len(ordered) > 1 else 0.0
        figures |= {
            f"{kind}_blur_sensor": None if worst is None else worst.sensor,
            f"{kind}_blur_deficit": None if worst is None else worst.deficit - usual,
            f"{kind}_blur_region": None if worst is None else _pixels(rig, worst),
        }
    return figures


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
    place: Array, deficits: Array
) -> tuple[float, tuple[float, float, float, float], Literal["columns", "rows"]] | None:
    """The largest median deficit of any region of a frame, in either direction."""
    worst = None
    inside = np.isfinite(place[:, 0])
    cell = np.floor(np.where(np.isfinite(place), place, 0.0) * CELLS)
    for left in range(CELLS - 1):
        for top in range(CELLS - 1):
            here = inside & (cell[:, 0] >= left) & (cell[:, 0] <= left + 1)
            here &= (cell[:, 1] >= top) & (cell[:, 1] <= top + 1)
            for k, along in enumerate(_AXES):
                values = deficits[here, k]
                values = values[np.isfinite(values)]
                if len(values) < MIN_WINDOWS:
                    continue
                deficit = float(np.median(values))
                if worst is None or deficit > worst[0]:
                    region = (left / CELLS, top / CELLS, (left + 2) / CELLS, (top + 2) / CELLS)
                    worst = (deficit, region, along)
    return worst


def _median(values: Array) -> Array:
    """Median along the first axis of what is there; NaN where nothing is."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    empty = ~np.isfinite(values).any(axis=0)
    median: Array = np.nanmedian(np.where(empty, 0.0, values), axis=0)
    return np.where(empty, np.nan, median)
