"""Tie points that others of their pair confirm, where a pair has few.

Under a cloud or over water a handful of windows finds something similar elsewhere. Data snooping
compares points with each other: a frame that rests on one point goes where that point puts it, and
the covariance takes the match for as good as any. Such pairs are left out before the adjustment.

Source: docs/explanation/mathematics/mosaicking.md#weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement, vip_mm_from_raw
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.rig import Rig

FEW: Final = 12
"""Points of a pair, from which on data snooping shows which are wrong."""
CONFIRMED: Final = 5
"""Points that have to agree where there are few."""
AGREE_PX: Final[Mapping[int, float]] = {PAN_TO_PAN: 1.0, PAN_TO_COLOUR: 2.0}
"""From the pair's median, by kind; a turned frame is found off by less over an overlap."""


def unconfirmed(
    rig: Rig, start: Mapping[str, SensorPlacement], tie_points: TiePoints
) -> NDArray[np.bool_]:
    """Mark points of pairs with few points that too few others agree with.

    Args:
        rig: the camera.
        start: calibration + TDM, by sensor name.
        tie_points: n matched points.

    Returns:
        True for such points, (n,).
    """
    marked = np.zeros(len(tie_points), np.bool_)
    for number, (a, b) in enumerate(tie_points.pairs):
        rows = np.flatnonzero(tie_points.overlap == number)
        if not 0 < len(rows) < FEW:
            continue
        off_mm = vip_mm_from_raw(start[a], tie_points.raw_a[rows])
        off_mm = off_mm - vip_mm_from_raw(start[b], tie_points.raw_b[rows])
        off_px = (off_mm - np.median(off_mm, axis=0)) / rig.sensor(a).pitch_mm
        agree = (np.abs(off_px) <= AGREE_PX[int(tie_points.kind[rows[0]])]).all(axis=1)
        marked[rows] = ~agree if np.count_nonzero(agree) >= CONFIRMED else True
    return marked
