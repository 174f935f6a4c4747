"""Ground that the images of a block show, by adjusted orientations and the height of tie points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.pipelines.live_triangulation import LiveTriangulation

Array = NDArray[np.float64]

CELLS: Final = 48
"""Across the smaller side of an image on the ground."""
GRID_MAX: Final = 4000
"""Cells along a side; longer blocks have larger cells."""
POINTS_MIN: Final = 5
"""Tie points of an image that give the height of its ground; with fewer it is that of all."""
DEPRESSION_MIN: Final = 0.3
"""Sine of the angle below the horizon of each corner; an image that looks higher does not count."""


@dataclass(frozen=True)
class GroundCoverage:
    """Areas in m^2 that at least one, two and three images show, and images that do not count."""

    once_m2: float
    twice_m2: float
    thrice_m2: float
    left_out: int

    def as_json(self) -> dict[str, Any]:
        return vars(self)


def coverage_of(live: LiveTriangulation) -> GroundCoverage | None:
    """Coverage by the block as it was adjusted last; None before.

    Images that nothing ties are at their measured orientation.
    """
    numbers, xyz, _ = live.tied_points()
    if not len(numbers):
        return None
    height = np.full(live.block.points, np.nan)
    height[numbers] = xyz[:, 2]
    everywhere = float(np.median(xyz[:, 2]))
    footprints = []
    for k in range(len(live.images)):
        own = height[live.block.observed[k][0]]
        own = own[np.isfinite(own)]
        ground_m = float(np.median(own)) if len(own) >= POINTS_MIN else everywhere
        footprints.append(_footprint(live, k, ground_m))
    known = [one for one in footprints if one is not None]
    if not known:
        return GroundCoverage(0.0, 0.0, 0.0, len(footprints))
    every = np.concatenate(known)
    low, span = every.min(axis=0), float(np.ptp(every, axis=0).max())
    sides = [float(np.hypot(*(one[1] - one[0]))) for one in known]
    cell_m = max(min(sides) / CELLS, span / GRID_MAX)
    shape = np.ceil(np.ptp(every, axis=0) / cell_m).astype(int)[::-1] + 1
    count = np.zeros(shape, np.uint16)
    for one in known:
        # Centres of cells are integers.
        corners = (one - low) / cell_m - 0.5
        first = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
        last = np.ceil(corners.max(axis=0)).astype(int) + 1
        mask = np.zeros((last - first)[::-1], np.uint8)
        # Corners to a sixteenth of a cell.
        cv2.fillConvexPoly(mask, np.rint((corners - first) * 16.0).astype(np.int32), (1,), shift=4)
        window = count[first[1] : last[1], first[0] : last[0]]
        window += mask[: window.shape[0], : window.shape[1]]
    areas = [float((count >= n).sum()) * cell_m**2 for n in (1, 2, 3)]
    return GroundCoverage(areas[0], areas[1], areas[2], len(footprints) - len(known))


def _footprint(live: LiveTriangulation, k: int, ground_m: float) -> Array | None:
    """Corners of an image on level ground, (4, 2), m in the local frame; None near the horizon."""
    image, one = live.image, live.orientations[k]
    x = (image.width_px / 2.0) * image.pitch_mm
    y = (image.height_px / 2.0) * image.pitch_mm
    rays = np.array([[sx * x, sy * y, -image.f_mm] for sx, sy in _CORNERS]) @ one.rotation.T
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    above_m = float(one.position_m[2]) - ground_m
    if above_m <= 0.0 or (-rays[:, 2] < DEPRESSION_MIN).any():
        return None
    return np.asarray(one.position_m[:2] + rays[:, :2] * (above_m / -rays[:, 2])[:, None])


_CORNERS: Final = ((-1, -1), (1, -1), (1, 1), (-1, 1))
