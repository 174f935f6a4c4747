"""Bands of the colour master frame without tie points, which are searched again farther away.

Lines that read-out shifts by more than the search range match nowhere: the frame fits everywhere
else, and the band leaves a gap between its tie points. A wider search finds them with their shift,
which `processing.mosaic.readout_slips` then measures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement
from processing.matching.tie_point_search import TiePointSettings
from processing.matching.tie_points import PAN_TO_COLOUR, TiePoints, match_tie_points
from processing.rig import Rig

Frame = NDArray[Any]

MIN_POINTS: Final = 200
"""Of the frame: with fewer, gaps between them are usual."""
MIN_GAP_PX: Final = 56.0
"""Between neighbouring tie points along one axis; three windows."""
MAX_END_SHARE: Final = 0.15
"""Of the frame's size, which may have no tie points at either end."""
WIDE_SEARCH_PC_PX: Final = 8
MIN_FILLED: Final = 12
"""Tie points that a wider search has to find in a gap."""

Gap = tuple[int, float, float]
"""Axis (0 along columns, 1 along rows), and the pixels between which there is no tie point."""


def colour_gaps(rig: Rig, tie_points: TiePoints) -> list[Gap]:
    """Bands of the colour master frame that hold no tie point.

    Args:
        rig: the camera.
        tie_points: what was matched.

    Returns:
        Axis and limits of each band; none where the frame has too few tie points.
    """
    if rig.colour_master_cone is None:
        return []
    sensor = rig.cone(rig.colour_master_cone).sensors[0]
    own = tie_points.raw_b[tie_points.kind == PAN_TO_COLOUR]
    if len(own) < MIN_POINTS:
        return []
    gaps: list[Gap] = []
    for axis, size in ((0, sensor.width_px), (1, sensor.height_px)):
        at = np.sort(own[:, axis])
        wide = np.flatnonzero(np.diff(at) > MIN_GAP_PX)
        gaps += [(axis, float(at[i]), float(at[i + 1])) for i in wide]
        if at[0] > MAX_END_SHARE * size:
            gaps.append((axis, 0.0, float(at[0])))
        if at[-1] < (1.0 - MAX_END_SHARE) * size:
            gaps.append((axis, float(at[-1]), float(size)))
    return gaps


def filled_gaps(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    tie_points: TiePoints,
    *,
    settings: TiePointSettings | None = None,
) -> TiePoints:
    """The tie points of a wider search, where that finds some in a gap; else those given.

    Args:
        rig: the camera.
        placements: predicted places, by sensor name.
        frames: Level-1 words by sensor name.
        tie_points: what was matched there.
        settings: those it was matched with; None takes the defaults.

    Returns:
        Either set of tie points as a whole.
    """
    settings = settings or TiePointSettings()
    gaps = colour_gaps(rig, tie_points)
    if not gaps or settings.search_pc_px >= WIDE_SEARCH_PC_PX:
        return tie_points
    wider = replace(settings, search_pc_px=WIDE_SEARCH_PC_PX)
    found = match_tie_points(rig, placements, frames, settings=wider)
    own = found.raw_b[found.kind == PAN_TO_COLOUR]
    for axis, first, last in gaps:
        inside = (own[:, axis] > first + 1.0) & (own[:, axis] < last - 1.0)
        if np.count_nonzero(inside) >= MIN_FILLED:
            return found
    return tie_points
