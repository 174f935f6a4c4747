"""Tie points with the colour master along the ends of PAN frames.

The windows of the regular search leave strips at the first and last rows and columns of a frame
almost without points. Lines that read-out shifts there would be seen by nothing. These points are
there to be searched for such lines (`processing.mosaic.stitching`); nothing is adjusted with them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, raw_from_vip_mm, vip_mm_from_raw
from processing.geometry.topology import colour_coverage, colour_ratio, exact_colour_ratio
from processing.matching.patches import MARGIN_PX
from processing.matching.tie_point_search import TiePointSettings, colour_search, usable_pixels
from processing.matching.tie_points import PAN_TO_COLOUR, TiePoints, match_pair
from processing.rig import Rig

Array = NDArray[np.float64]
Frame = NDArray[Any]

END_PX: Final = 36
"""Strip at an end of a frame, PAN pixels."""
MIN_POINTS: Final = 28
"""Regular tie points of a strip, with which a shift of it is found: four bins."""
POINTS: Final = 35
"""Positions along one end."""
WINDOW_PX: Final = 9
"""Colour pixels; smaller than that of regular points, which reaches out of such a strip."""
_OFFSETS: Final = 3
_MARGIN_PX: Final = WINDOW_PX // 2 + MARGIN_PX + 1


def match_frame_ends(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    tie_points: TiePoints,
    *,
    settings: TiePointSettings | None = None,
) -> TiePoints:
    """Match positions along the ends of PAN frames where regular tie points are few.

    Args:
        rig: the camera.
        placements: predicted places, by sensor name.
        frames: Level-1 frames by sensor name.
        tie_points: the regular ones.
        settings: those they were matched with; None takes the defaults.

    Returns:
        The additional points alone, of the same names and pairs.
    """
    settings = replace(settings or TiePointSettings(), window_pc_px=WINDOW_PX)
    table = [np.empty((0, 9))]
    master = None if rig.colour_master_cone is None else rig.cone(rig.colour_master_cone)
    colour = "" if master is None else master.sensors[0].name
    whole, ratio = colour_ratio(rig), exact_colour_ratio(rig) or 1.0
    for name, seen in colour_coverage(rig).items() if colour in frames and whole else ():
        if name not in frames:
            continue
        at_pan, at_colour = _positions(placements[name], placements[colour], tie_points, ratio)
        search = colour_search(
            (name, colour),
            placements,
            seen,
            at_pan,
            at_colour,
            ratio=whole,
            step=whole or 1,
            margin_px=_MARGIN_PX,
        )
        if search.region is not None:
            continue  # Converging heads overlap so widely that their ends are in other frames.
        found, _ = match_pair(search, placements, frames, settings)
        rows = np.empty((len(found), 9))
        rows[:, :2] = [tie_points.names.index(sensor) for sensor in (name, colour)]
        rows[:, 2:6], rows[:, 7] = found[:, :4], found[:, 5]
        rows[:, 6] = np.hypot(found[:, 4], settings.floor_sigma_px) * ratio
        rows[:, 8] = tie_points.pairs.index((name, colour))
        table.append(rows)
    every = np.concatenate(table)
    return replace(
        tie_points.only(np.zeros(len(tie_points), np.bool_)),
        sensor_a=every[:, 0].astype(np.int64),
        sensor_b=every[:, 1].astype(np.int64),
        raw_a=every[:, 2:4].copy(),
        raw_b=every[:, 4:6].copy(),
        sigma_px=every[:, 6].copy(),
        correlation=every[:, 7].copy(),
        kind=np.full(len(every), PAN_TO_COLOUR),
        overlap=every[:, 8].astype(np.int64),
    )


def _positions(
    pan: SensorPlacement, there: SensorPlacement, tie_points: TiePoints, ratio: float
) -> tuple[Array, NDArray[np.int64]]:
    """Positions (n, 2) along the ends with few tie points, in the PAN frame and the colour master.

    Where an end lies at that of the colour master, they lie farther inside.
    """
    number = tie_points.names.index(pan.sensor.name)
    first, second = tie_points.sensor_a == number, tie_points.sensor_b == number
    own = np.concatenate([tie_points.raw_a[first], tie_points.raw_b[second]])
    left, right, top, low = usable_pixels(pan)
    reach = math.ceil(ratio * (_MARGIN_PX + 1))
    offsets = reach + 2.0 * math.ceil(ratio) * np.arange(_OFFSETS)
    lines = []
    for axis, limits, across in ((0, (left, right), (top, low)), (1, (top, low), (left, right))):
        for end, inwards in zip(limits, (1.0, -1.0), strict=True):
            if np.count_nonzero(np.abs(own[:, axis] - end) < END_PX) >= MIN_POINTS:
                continue
            line = np.empty((_OFFSETS, POINTS, 2))
            line[..., axis] = end + inwards * offsets[:, None]
            line[..., 1 - axis] = np.linspace(across[0] + reach, across[1] - reach, POINTS)
            lines.append(line)
    if not lines:
        return np.empty((0, 2)), np.empty((0, 2), np.int64)
    at = np.stack(lines)
    in_colour = raw_from_vip_mm(there, vip_mm_from_raw(pan, at.reshape(-1, 2))).reshape(at.shape)
    inside = _inside(in_colour, usable_pixels(there))
    # Of each end the outermost line that the colour master sees most of.
    seen = 2 * np.count_nonzero(inside, axis=2) >= POINTS
    outermost = seen & (np.cumsum(seen, axis=1) == 1)
    chosen = inside & outermost[..., None]
    return at[chosen], np.rint(in_colour[chosen]).astype(np.int64)


def _inside(raw: Array, usable: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """Places (..., 2) around which a frame has a window."""
    low = np.array([usable[0], usable[2]]) + _MARGIN_PX
    high = np.array([usable[1], usable[3]]) - _MARGIN_PX
    with np.errstate(invalid="ignore"):
        return np.asarray(((raw >= low) & (raw <= high)).all(axis=-1))
