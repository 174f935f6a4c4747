"""Search positions of tie points: feature-rich positions, and their prediction in the other sensor.

What is found there is matched in `processing.matching.tie_points`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, raw_from_vip_mm, vip_mm_from_raw
from processing.geometry.topology import (
    Overlap,
    Rectangle,
    colour_coverage,
    colour_ratio,
    overlaps,
)
from processing.matching.patches import MARGIN_PX, select_features
from processing.radiometry.level1 import SATURATED_BIT
from processing.rig import Rig

Array = NDArray[np.float64]
Frame = NDArray[Any]

PAN_TO_PAN: Final = 0
PAN_TO_COLOUR: Final = 1

# A translation cannot follow frames that differ by more than this in rotation or scale.
_MAX_SHEAR: Final = 0.01


@dataclass(frozen=True)
class TiePointSettings:
    """Number of points, search parameters, and limits of a match.

    Window and search of P/C are in pixels of the colour master, of P/P in PAN pixels; so are the
    sigmas. `floor_sigma_px` is the error besides noise: rotation within the patch, interpolation.
    Where an area is too small for the requested number, windows still do not overlap. An overlap
    has `points_per_supported_overlap` where both sensors have `supporting_points` P/C points: then
    more P/P points hardly improve the mosaic.
    """

    points_per_overlap: int = 850
    points_per_supported_overlap: int = 425
    supporting_points: int = 950
    points_per_sensor: int = 1900
    window_pp_px: int = 19
    window_pc_px: int = 15
    search_pp_px: int = 6
    search_pc_px: int = 3
    min_correlation: float = 0.6
    min_peak_margin: float = 0.05
    floor_sigma_px: float = 0.002
    max_sigma_pp_px: float = 0.3
    max_sigma_pc_px: float = 0.2


@dataclass(frozen=True)
class PairSearch:
    """Positions of one pair of frames, ready for the kernel.

    Where the frames differ by more than a shift, `region` (first and last column, first and last
    row of b) is what has to be seen of a as b would see it, each pixel divided by `step`; `at_a`
    does not count then. `expected_b` (n, 2) is where b sees the centre of a's box, before rounding.
    """

    pair: tuple[str, str]
    kind: int
    at_a: NDArray[np.int64]
    at_b: NDArray[np.int64]
    expected_b: Array
    step: int = 1
    region: tuple[int, int, int, int] | None = None


def usable_pixels(placement: SensorPlacement) -> tuple[int, int, int, int]:
    """Fully exposed part of a frame, without the TDI rows.

    Args:
        placement: sensor and TDI shifts.

    Returns:
        First and last column, first and last row.
    """
    sensor, n = placement.sensor, placement.tdi_shifts
    first_row = n if sensor.tdi_row_sign > 0 else 0
    last_row = sensor.height_px - 1 - (0 if sensor.tdi_row_sign > 0 else n)
    return 0, sensor.width_px - 1, first_row, last_row


def pan_searches(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    settings: TiePointSettings,
    *,
    supported: Collection[str] = (),
) -> list[PairSearch]:
    """Search positions of the overlaps of PAN sensors.

    Args:
        rig: the camera.
        placements: predictions by sensor name.
        frames: Level-1 frames by sensor name, (h, w).
        settings: number of points and windows.
        supported: sensors with `supporting_points` P/C points, by name.

    Returns:
        One for each overlap of the rig, in its order; without positions where a frame is missing.
    """
    half = settings.window_pp_px // 2
    margin_px = half + MARGIN_PX + 1
    result = []
    for overlap in overlaps(rig):
        a, b = overlap.sensor_a, overlap.sensor_b
        at_a = at_b = np.empty((0, 2), dtype=np.int64)
        expected = np.empty((0, 2))
        region = None
        both = a in supported and b in supported
        wanted = settings.points_per_supported_overlap if both else settings.points_per_overlap
        if (
            a in frames
            and b in frames
            and not _differ_by_shift_only(placements[a], placements[b], overlap.rectangle)
        ):
            at_b, region = _seen_searches(placements, frames, overlap, settings, wanted)
            at_a, expected = at_b, at_b.astype(np.float64)
        elif a in frames and b in frames:
            area = _shrunk(
                _raw_areas(placements[a], [overlap.rectangle])[0],
                usable_pixels(placements[a]),
                margin_px,
            )
            cells = _cells(area, wanted, settings.window_pp_px + 3)
            at_a = _features(frames[a], cells, half, settings.window_pp_px)
            predicted = raw_from_vip_mm(
                placements[b], vip_mm_from_raw(placements[a], at_a.astype(np.float64))
            )
            keep = _within(predicted, usable_pixels(placements[b]), margin_px)
            at_a, expected = at_a[keep], predicted[keep]
            at_b = np.rint(expected).astype(np.int64)
        result.append(PairSearch((a, b), PAN_TO_PAN, at_a, at_b, expected, region=region))
    return result


def overlap_pixels(
    placement: SensorPlacement, seen: Sequence[Overlap]
) -> list[tuple[int, int, int, int]]:
    """Usable pixels of a sensor in overlaps.

    Args:
        placement: of the sensor.
        seen: overlaps of this sensor.

    Returns:
        First and last column, first and last row by overlap.
    """
    usable = usable_pixels(placement)
    areas = _raw_areas(placement, [overlap.rectangle for overlap in seen])
    return [_shrunk(area, usable, 0) for area in areas]


def _seen_searches(
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    overlap: Overlap,
    settings: TiePointSettings,
    wanted: int,
) -> tuple[NDArray[np.int64], tuple[int, int, int, int] | None]:
    """Positions in b where a sees the same, and the region of b that holds their windows."""
    margin_px = settings.window_pp_px // 2 + MARGIN_PX + 1
    a, b = placements[overlap.sensor_a], placements[overlap.sensor_b]
    area = _shrunk(_raw_areas(b, [overlap.rectangle])[0], usable_pixels(b), margin_px)
    cells = _cells(area, wanted, settings.window_pp_px + 3)
    at_b = _features(
        frames[overlap.sensor_b], cells, settings.window_pp_px // 2, settings.window_pp_px
    )
    in_a = raw_from_vip_mm(a, vip_mm_from_raw(b, at_b.astype(np.float64)))
    at_b = at_b[_within(in_a, usable_pixels(a), 2 * margin_px)]
    return at_b, _region_around(at_b, b, margin_px)


def _region_around(
    at_b: NDArray[np.int64], b: SensorPlacement, margin_px: int
) -> tuple[int, int, int, int] | None:
    """First and last column and row of b that windows at these positions need."""
    if not len(at_b):
        return None
    (left, top), (right, low) = at_b.min(axis=0) - margin_px, at_b.max(axis=0) + margin_px
    return (
        max(int(left), 0),
        min(int(right), b.sensor.width_px - 1),
        max(int(top), 0),
        min(int(low), b.sensor.height_px - 1),
    )


def colour_searches(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    settings: TiePointSettings,
    ratio: float,
) -> list[PairSearch]:
    """One grid over the colour master; each of its positions goes to one PAN sensor.

    Where two PAN sensors see the position they take turns: a colour patch used twice would make two
    observations of one.

    Args:
        rig: the camera.
        placements: predictions by sensor name.
        frames: Level-1 frames by sensor name, (h, w).
        settings: number of points and windows.
        ratio: PAN pixels per colour pixel.

    Returns:
        One for each PAN sensor that the colour master covers; empty without a colour master.
    """
    coverage = colour_coverage(rig)
    if not coverage or rig.colour_master_cone is None:
        return []
    colour = rig.cone(rig.colour_master_cone).sensors[0].name
    half = settings.window_pc_px // 2
    margin_px = half + MARGIN_PX + 1
    present = [name for name in coverage if name in frames]
    empty = np.empty((0, 2), dtype=np.int64)
    whole_ratio = colour_ratio(rig)
    step = whole_ratio or max(1, math.floor(ratio))
    attempted = {
        name: PairSearch((name, colour), PAN_TO_COLOUR, empty, empty, np.empty((0, 2)))
        for name in coverage
    }
    if colour in frames and present:
        union = Rectangle(
            min(coverage[name].x_min_mm for name in coverage),
            min(coverage[name].y_min_mm for name in coverage),
            max(coverage[name].x_max_mm for name in coverage),
            max(coverage[name].y_max_mm for name in coverage),
        )
        area = _shrunk(
            _raw_areas(placements[colour], [union])[0], usable_pixels(placements[colour]), margin_px
        )
        wanted_count = settings.points_per_sensor * len(coverage)
        cells = _cells(area, wanted_count, settings.window_pc_px + 1)
        at_colour = _features(frames[colour], cells, half, settings.window_pc_px)
        xy = vip_mm_from_raw(placements[colour], at_colour.astype(np.float64))
        # Boxes of ratio x ratio pixels around the prediction, and the search on top.
        reach = math.ceil(ratio * (margin_px + 1))
        predicted, is_visible = {}, np.zeros((len(at_colour), len(present)), dtype=np.bool_)
        for i, name in enumerate(present):
            place = coverage[name]
            near = Rectangle(
                place.x_min_mm - 0.5,
                place.y_min_mm - 0.5,
                place.x_max_mm + 0.5,
                place.y_max_mm + 0.5,
            ).contains(xy)
            predicted[name] = np.full((len(xy), 2), np.nan)
            predicted[name][near] = raw_from_vip_mm(placements[name], xy[near])
            is_visible[:, i] = _within(predicted[name], usable_pixels(placements[name]), reach)
        start_index = np.arange(len(at_colour))
        chosen = _round_robin(is_visible, start_index)
        for i, name in enumerate(present):
            mine = chosen == i
            if not mine.any():
                continue
            attempted[name] = colour_search(
                (name, colour),
                placements,
                coverage[name],
                predicted[name][mine],
                at_colour[mine],
                ratio=whole_ratio,
                step=step,
                margin_px=margin_px,
            )
    return list(attempted.values())


def colour_search(
    pair: tuple[str, str],
    placements: Mapping[str, SensorPlacement],
    seen: Rectangle,
    at_pan: Array,
    at_colour: NDArray[np.int64],
    *,
    ratio: int | None,
    step: int,
    margin_px: int,
) -> PairSearch:
    """The search of one PAN frame in the colour master, from positions in both.

    Args:
        pair: PAN sensor and colour master.
        placements: predictions by sensor name.
        seen: what the PAN sensor covers of the virtual image, mm.
        at_pan: positions in the PAN frame (n, 2), px.
        at_colour: the same in the colour master.
        ratio: whole number of PAN pixels per colour pixel; None where it is none.
        step: PAN pixels of a side that make one of those compared.
        margin_px: colour pixels that a window needs around its centre.

    Returns:
        Boxes of PAN pixels where the frames differ by hardly more than a shift and the ratio, else
        the region of the colour master as which the PAN frame has to be seen.
    """
    pan, there = placements[pair[0]], placements[pair[1]]
    if not ratio or not _differ_by_shift_only(pan, there, seen, ratio=ratio):
        region = _region_around(at_colour, there, margin_px + 1)
        expected = at_colour.astype(np.float64)
        return PairSearch(pair, PAN_TO_COLOUR, at_colour, at_colour, expected, step, region)
    first = np.rint(at_pan - (ratio - 1) / 2.0).astype(np.int64)
    centre = np.asarray(first + (ratio - 1) / 2.0, np.float64)
    expected = raw_from_vip_mm(there, vip_mm_from_raw(pan, centre))
    at_b = np.rint(expected).astype(np.int64)
    return PairSearch(pair, PAN_TO_COLOUR, first, at_b, expected, step)


def saturated_window_fraction(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    pair: tuple[str, str],
    *,
    settings: TiePointSettings | None = None,
) -> float | None:
    """Share of the windows side by side in an overlap that saturation makes useless for matching.

    Args:
        rig: the camera.
        placements: predicted places, by sensor name.
        frames: Level-1 words by sensor name.
        pair: two PAN sensors that overlap.
        settings: None takes the defaults.

    Returns:
        The share in the frame with more saturation; None where the pair has no overlap or no frame.
    """
    size = (settings or TiePointSettings()).window_pp_px
    shares = []
    for overlap in overlaps(rig):
        if (overlap.sensor_a, overlap.sensor_b) != pair:
            continue
        for name in pair:
            area = _raw_areas(placements[name], [overlap.rectangle])[0]
            left, right, top, low = _shrunk(area, usable_pixels(placements[name]), 0)
            columns, rows = (right + 1 - left) // size, (low + 1 - top) // size
            if name in frames and columns > 0 and rows > 0:
                window_pixels = frames[name][top : top + rows * size, left : left + columns * size]
                full = (window_pixels & SATURATED_BIT).reshape(rows, size, columns, size)
                shares.append(float(np.mean(full.any(axis=(1, 3)))))
    return max(shares, default=None)


def _round_robin(
    is_visible: NDArray[np.bool_], start_index: NDArray[np.int64]
) -> NDArray[np.int64]:
    """For each row the column to use among those that are True, in turn; -1 where none is."""
    count = is_visible.sum(axis=1)
    rank = np.where(count > 0, start_index % np.maximum(count, 1), -1)
    order = np.cumsum(is_visible, axis=1) - 1
    hit = is_visible & (order == rank[:, None])
    return np.where(hit.any(axis=1), hit.argmax(axis=1), -1)


def _raw_areas(
    placement: SensorPlacement, rectangles: Sequence[Rectangle]
) -> list[tuple[float, float, float, float]]:
    """First and last column, first and last row of VIP rectangles in a sensor's raw frame."""
    corners = [
        [(x, y) for y in (r.y_min_mm, r.y_max_mm) for x in (r.x_min_mm, r.x_max_mm)]
        for r in rectangles
    ]
    raw = raw_from_vip_mm(placement, np.reshape(corners, (-1, 2))).reshape(-1, 4, 2)
    low, high = raw.min(axis=1), raw.max(axis=1)
    return [
        (float(a[0]), float(b[0]), float(a[1]), float(b[1])) for a, b in zip(low, high, strict=True)
    ]


def _shrunk(
    area: tuple[float, float, float, float], usable: tuple[int, int, int, int], margin_px: int
) -> tuple[int, int, int, int]:
    """Area of window centres: `room` pixels inside of the usable area."""
    return (
        max(math.ceil(area[0]), usable[0] + margin_px),
        min(math.floor(area[1]), usable[1] - margin_px),
        max(math.ceil(area[2]), usable[2] + margin_px),
        min(math.floor(area[3]), usable[3] - margin_px),
    )


def _cells(
    area: tuple[int, int, int, int], wanted_count: int, min_spacing: int
) -> NDArray[np.int64]:
    """An even grid over the area; (n, 4) first and last column, first and last row of each cell."""
    width, height = area[1] - area[0] + 1, area[3] - area[2] + 1
    if width <= 0 or height <= 0:
        return np.empty((0, 4), dtype=np.int64)
    spacing = max(float(min_spacing), math.sqrt(width * height / wanted_count))
    columns, rows = max(1, int(width / spacing)), max(1, int(height / spacing))
    edge_c = area[0] + np.linspace(0, width, columns + 1)
    edge_r = area[2] + np.linspace(0, height, rows + 1)
    left, top = np.meshgrid(edge_c[:-1], edge_r[:-1])
    right, bottom = np.meshgrid(edge_c[1:], edge_r[1:])
    return np.stack(
        [
            np.ceil(left).ravel(),
            np.ceil(right).ravel() - 1,
            np.ceil(top).ravel(),
            np.ceil(bottom).ravel() - 1,
        ],
        axis=1,
    ).astype(np.int64)


def _features(frame: Frame, cells: NDArray[np.int64], half: int, window: int) -> NDArray[np.int64]:
    """The best position of each cell, so far from the cell's edge that windows never overlap."""
    if not len(cells):
        return np.empty((0, 2), dtype=np.int64)
    inner = cells.copy()
    for first, last in ((0, 1), (2, 3)):
        slack = cells[:, last] - cells[:, first] + 1 - window
        trim = np.where(slack >= 0, window, cells[:, last] - cells[:, first])
        inner[:, first] = cells[:, first] + trim // 2
        inner[:, last] = cells[:, last] - (trim - trim // 2) + (slack >= 0)
        inner[:, last] = np.maximum(inner[:, last], inner[:, first])
    best = select_features(frame, inner, half, 2, frame.dtype == np.uint16)
    return np.asarray(best[best[:, 2] > 0.0, :2], dtype=np.int64)


def _within(raw: Array, usable: tuple[int, int, int, int], margin_px: int) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (raw[:, 0] >= usable[0] + margin_px)
            & (raw[:, 0] <= usable[1] - margin_px)
            & (raw[:, 1] >= usable[2] + margin_px)
            & (raw[:, 1] <= usable[3] - margin_px)
        )


def _differ_by_shift_only(
    a: SensorPlacement, b: SensorPlacement, rectangle: Rectangle, *, ratio: int = 1
) -> bool:
    """Whether raw frames a and b differ by hardly more than a shift (and the scale `ratio`)."""
    centre = np.array([[rectangle.x_min_mm + rectangle.x_max_mm, 0.0]]) / 2.0
    centre[0, 1] = (rectangle.y_min_mm + rectangle.y_max_mm) / 2.0
    middle = raw_from_vip_mm(a, centre)
    around = middle + np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
    there = raw_from_vip_mm(b, vip_mm_from_raw(a, around))
    linear = np.stack([there[1] - there[0], there[2] - there[0]]) / 100.0 * ratio
    return bool(np.abs(linear - np.eye(2)).max() < _MAX_SHEAR)
