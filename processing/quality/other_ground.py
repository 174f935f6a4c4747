"""Regions of a frame that show other ground than the other heads: a part of another exposure.

A frame that is wrong as a whole, or of which hardly any tie point matches, is left to
`processing.matching.content_check`. Of a frame with a
foreign part most tie points match; in that part none do, although it has texture.

Source: docs/explanation/mathematics/quality.md#regions-of-other-ground.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, raw_from_vip_mm, vip_mm_from_raw
from processing.geometry.topology import colour_ratio, exact_colour_ratio
from processing.image.colour import BandRegistration, ColourSettings
from processing.image.rectification import rectify_to_sensor
from processing.matching.content_check import SUSPICIOUS_SHARE
from processing.matching.patches import INTERPOLATION, MARGIN_PX, match_patches
from processing.matching.texture import has_texture
from processing.matching.tie_point_search import TiePointSettings, usable_pixels
from processing.matching.tie_points import PAN_TO_COLOUR, TiePoints
from processing.quality.figures.image import OtherGroundFigures
from processing.rig import Rig, Sensor

Array = NDArray[Any]
Marks = NDArray[np.bool_]

CELLS: Final = 16
"""Cells of a frame along each side."""
REGION: Final = 3
"""Cells of a region along each side: a part of a quarter of the frame's width and height holds one,
wherever it lies."""
MIN_TEXTURED: Final = 8
"""Positions with texture that a region needs."""
MAX_RESEMBLING: Final = 0.2
"""Share of them that may resemble the other frame: of the same ground half and more do, of green
and near infrared as few as 0.17, which is why near infrared is not compared."""
NOT_COMPARED: Final = frozenset({"nir"})
MAX_CHECKED: Final = 100
"""Positions of a frame that are looked at again, at most: of many, evenly spread ones."""
MAX_SHEAR: Final = 0.01
"""A window cannot follow frames that differ by more than this in rotation or scale."""
MIN_BANDS: Final = 2
"""Frames whose comparison with green fails at one place: then green is wrong there."""


@dataclass(frozen=True)
class OtherGround:
    """A region of a frame, pixels, where so many positions have texture that matches nothing.

    `alternatives` are frames one of which is wrong instead.
    """

    sensor: str
    columns: tuple[int, int]
    rows: tuple[int, int]
    positions: int
    alternatives: tuple[str, ...] = ()


def other_ground_regions(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Array],
    tie_points: TiePoints,
    registrations: Sequence[BandRegistration],
    *,
    settings: TiePointSettings,
    colour: ColourSettings,
    explained: Collection[str] = (),
) -> tuple[OtherGround, ...]:
    """Look for regions of PAN frames, of green and of other bands that show other ground.

    Args:
        rig: the camera.
        placements: where tie points were sought, by sensor name.
        frames: Level-1 words by sensor name, (h, w) uint16.
        tie_points: what was matched there.
        registrations: of the bands against green.
        settings: of the tie points.
        colour: of the bands.
        explained: frames that are known to be wrong.

    Returns:
        Regions, one a frame, the largest first; none for a healthy exposure.
    """
    master = rig.colour_master_cone
    if master is None or explained:
        return ()
    green = rig.cone(master).sensors[0].name
    if green not in frames:
        return ()
    pan = list(_of_pan(rig, placements, frames, tie_points, settings))
    bands = list(_of_bands(rig, placements, frames, green, registrations, colour))
    compared = [r for r in registrations if r.registered and r.band not in NOT_COMPARED]
    if len(bands) >= MIN_BANDS or (bands and pan):
        # What several heads contradict is green.
        worst = max([*bands, *pan], key=lambda region: region.positions)
        others = () if len(bands) >= MIN_BANDS else (bands[0].sensor,)
        at = next((b for b in bands), worst)
        return (OtherGround(green, at.columns, at.rows, worst.positions, others),)
    if pan and not compared:
        pan = [
            OtherGround(r.sensor, r.columns, r.rows, r.positions, alternatives=(green,))
            for r in pan
        ]
    return tuple(sorted([*pan, *bands], key=lambda region: -region.positions))


def other_ground_figures(regions: Sequence[OtherGround]) -> OtherGroundFigures:
    """The largest region in figures of the quality report.

    Args:
        regions: of `other_ground_regions`.

    Returns:
        Empty without a region.
    """
    if not regions:
        return OtherGroundFigures()
    worst = regions[0]
    return OtherGroundFigures(
        other_ground_sensor=worst.sensor,
        other_ground_alternatives=tuple(
            dict.fromkeys([*worst.alternatives, *(r.sensor for r in regions[1:])])
        ),
        other_ground_first_column=worst.columns[0],
        other_ground_last_column=worst.columns[1],
        other_ground_first_row=worst.rows[0],
        other_ground_last_row=worst.rows[1],
        other_ground_positions=worst.positions,
    )


def _of_pan(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Array],
    tie_points: TiePoints,
    settings: TiePointSettings,
) -> Iterator[OtherGround]:
    """Regions of PAN frames against green."""
    step = colour_ratio(rig) or max(1, math.floor(exact_colour_ratio(rig) or 1.0))
    window_px, search_px = settings.window_pc_px, settings.search_pc_px
    for number, (name, green) in enumerate(tie_points.pairs):
        at_green = tie_points.unmatched_b[tie_points.unmatched_overlap == number]
        if len(at_green) < MIN_TEXTURED:
            continue
        own = (tie_points.overlap == number) & (tie_points.kind == PAN_TO_COLOUR)
        if np.count_nonzero(own) < SUSPICIOUS_SHARE * tie_points.attempted[number]:
            continue
        there = placements[green]
        at = raw_from_vip_mm(placements[name], vip_mm_from_raw(there, at_green.astype(np.float64)))
        matched, shape = tie_points.raw_a[own], frames[name].shape
        rows = _suspicious(at, matched, shape)
        if len(rows) < MIN_TEXTURED:
            continue
        at_green = at_green[rows]
        seen, at_seen = _as_green_sees(
            (placements[name], there), frames[name], (at_green, at[rows]), step, settings
        )
        found = _best(
            (seen, frames[green]),
            (at_seen, at_green),
            usable_pixels(there),
            (step, window_px, search_px),
        )
        resembling = (found[:, 7] > 0.0) & (found[:, 5] >= settings.min_correlation)
        raw = np.rint(at[rows]).astype(np.int64)
        textured = _textured(
            (
                (frames[green], rig.sensor(green), at_green, window_px),
                (frames[name], rig.sensor(name), raw, window_px * step),
            ),
            search_px,
        )
        yield from _region(name, shape, matched, at[rows], textured, resembling)


def _as_green_sees(
    placements: tuple[SensorPlacement, SensorPlacement],
    frame: Array,
    at: tuple[Array, Array],
    step: int,
    settings: TiePointSettings,
) -> tuple[Array, Array]:
    """A PAN frame in the geometry of green, and the first pixel of each position in it.

    `at` are the positions in green and in PAN. A frame that is only shifted and larger stays as it
    is.
    """
    own, green = placements
    middle = at[0].mean(axis=0)
    around = middle + np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
    there = raw_from_vip_mm(own, vip_mm_from_raw(green, around))
    linear = np.stack([there[1] - there[0], there[2] - there[0]]) / 100.0
    if np.abs(linear / step - np.eye(2)).max() < MAX_SHEAR:
        return frame, np.rint(at[1] - (step - 1) / 2.0).astype(np.int64)
    margin_px = settings.window_pc_px // 2 + MARGIN_PX + settings.search_pc_px + 1
    (left, top), (right, low) = at[0].min(axis=0), at[0].max(axis=0)
    region = (
        max(int(left) - margin_px, 0),
        min(int(right) + margin_px, green.sensor.width_px - 1),
        max(int(top) - margin_px, 0),
        min(int(low) + margin_px, green.sensor.height_px - 1),
    )
    seen = rectify_to_sensor(own, green, frame, region=region, step=step)
    return seen.pixels, seen.at(at[0])


def _of_bands(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Array],
    green: str,
    registrations: Sequence[BandRegistration],
    settings: ColourSettings,
) -> Iterator[OtherGround]:
    """Regions of bands against green."""
    for band in registrations:
        if (
            not band.registered
            or band.band in NOT_COMPARED
            or len(band.unmatched_at) < MIN_TEXTURED
        ):
            continue
        frame, there = frames[band.sensor], placements[band.sensor]
        at = raw_from_vip_mm(
            there, vip_mm_from_raw(placements[green], band.unmatched_at.astype(np.float64))
        )
        rows = _suspicious(at, band.matched_at, frame.shape)
        if len(rows) < MIN_TEXTURED:
            continue
        at_green, at_band = band.unmatched_at[rows], np.rint(at[rows]).astype(np.int64)
        found = _best(
            (frames[green], frame),
            (at_green, at_band),
            usable_pixels(there),
            (1, settings.window_px, settings.search_px),
        )
        resembling = (found[:, 7] > 0.0) & (found[:, 5] >= settings.min_correlation)
        textured = _textured(
            (
                (frames[green], rig.sensor(green), at_green, settings.window_px),
                (frame, there.sensor, at_band, settings.window_px),
            ),
            settings.search_px,
        )
        yield from _region(
            band.sensor, frame.shape, band.matched_at, at[rows], textured, resembling
        )


def _best(
    frames: tuple[Array, Array],
    at: tuple[Array, Array],
    limits: tuple[int, int, int, int],
    window: tuple[int, int, int],
) -> Array:
    """Rows of `match_patches` (n, 8) for positions in two frames.

    `window` is the ratio of the pixels, the side of the window and the reach of the search.
    """
    return np.asarray(
        match_patches(
            frames[0],
            frames[1],
            np.ascontiguousarray(at[0]),
            np.ascontiguousarray(at[1]),
            np.array(limits, dtype=np.int64),
            window[0],
            window[1] // 2,
            window[2],
            True,
            INTERPOLATION,
        )
    )


def _textured(windows: Sequence[tuple[Array, Sensor, Array, int]], search_px: int) -> Marks:
    """Which positions have texture and no bad pixel in every frame, each with places (n, 2) and a
    window.

    The border of a saturated cloud is texture, too, but nothing is matched there.
    """
    smallest = min(window_px for *_, window_px in windows)
    textured = np.ones(len(windows[0][2]), np.bool_)
    for frame, sensor, at, window_px in windows:
        reach_px = (smallest // 2 + MARGIN_PX + search_px) * window_px // smallest
        for row in np.flatnonzero(textured):
            column, line = (int(place) for place in at[row])
            around = frame[
                max(line - reach_px, 0) : line + reach_px + 1,
                max(column - reach_px, 0) : column + reach_px + 1,
            ]
            textured[row] = around.size > 0 and not ((around & 1) | (around == 0)).any()
        rows = np.flatnonzero(textured)
        textured[rows] = has_texture(frame, sensor, at[rows], window_px)
    return textured


def _suspicious(at: Array, matched: Array, shape: tuple[int, ...]) -> Array:
    """Rows of positions (n, 2) without a match in regions where hardly any match, at most
    `MAX_CHECKED`."""
    rows = np.flatnonzero(_in_suspicious(at, matched, shape))
    return rows[:: -(-len(rows) // MAX_CHECKED) or 1]


def _in_suspicious(at: Array, matched: Array, shape: tuple[int, ...]) -> Marks:
    """Which positions (n, 2) without a match lie in a region where hardly any match."""
    unmatched = _sums(at, shape, np.ones(len(at)))
    tried = unmatched + _sums(matched, shape, np.ones(len(matched)))
    few = (unmatched >= MIN_TEXTURED) & (tried - unmatched <= MAX_RESEMBLING * tried)
    inside = np.zeros(len(at), np.bool_)
    cell = _cells(at, shape)
    for row, column in zip(*np.nonzero(few), strict=True):
        off = cell - (column, row)
        inside |= ((off >= 0) & (off < REGION)).all(axis=1)
    return inside


def _region(
    name: str,
    shape: tuple[int, ...],
    matched: Array,
    at: Array,
    textured: Marks,
    resembling: Marks,
) -> Iterator[OtherGround]:
    """The extent of all regions with texture that resembles nothing, if there is one."""
    alike = _sums(matched, shape, np.ones(len(matched)))
    alike += _sums(at, shape, textured & resembling)
    tried = alike + _sums(at, shape, textured & ~resembling)
    wrong = (tried >= MIN_TEXTURED) & (alike <= MAX_RESEMBLING * tried)
    if not wrong.any():
        return
    rows, columns = np.nonzero(wrong)
    high, wide = shape[0] / CELLS, shape[1] / CELLS
    left, right = int(columns.min() * wide), int((columns.max() + REGION) * wide) - 1
    top, low = int(rows.min() * high), int((rows.max() + REGION) * high) - 1
    inside = (at >= (left, top)).all(axis=1) & (at <= (right, low)).all(axis=1)
    positions = int(np.count_nonzero(inside & textured & ~resembling))
    yield OtherGround(name, (left, right), (top, low), positions)


def _cells(at: Array, shape: tuple[int, ...]) -> Array:
    """Column and row of the cell of each position, (n, 2)."""
    cell = np.floor(np.nan_to_num(at, nan=-1.0) * CELLS / (shape[1], shape[0]))
    return np.asarray(np.clip(cell, -1, CELLS - 1), np.int64)


def _sums(at: Array, shape: tuple[int, ...], weight: Array) -> Array:
    """Sums of weights of positions (n, 2) over all regions of a frame, by row and column."""
    cell = _cells(at, shape)
    inside = (cell >= 0).all(axis=1)
    number = cell[inside, 1] * CELLS + cell[inside, 0]
    by_cell = np.bincount(number, weight[inside], CELLS**2)
    total = np.zeros((CELLS + 1, CELLS + 1))
    total[1:, 1:] = by_cell.reshape(CELLS, CELLS).cumsum(axis=0).cumsum(axis=1)
    return np.asarray(
        total[REGION:, REGION:]
        - total[:-REGION, REGION:]
        - total[REGION:, :-REGION]
        + total[:-REGION, :-REGION]
    )
