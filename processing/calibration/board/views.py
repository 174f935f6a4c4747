"""Views of a board: where it was in front of a head, and which views are still missing.

Source: docs/explanation/mathematics/lens.md#calibration-from-a-board.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.initial_values import resect
from processing.geometry.lens import ideal_from_measured
from processing.geometry.placement import layer_mm_from_raw
from processing.matching.board_corners import BoardCorners
from processing.matching.calibration_board import CalibrationBoard
from processing.rig import Cone

Array = NDArray[np.float64]

MIN_VIEWS: Final = 10
TILT_DEG: Final = (15.0, 55.0)
SQUARE_ON_DEG: Final = 8.0
"""All views tilted by less than this are taken for perpendicular to the axis."""
DISTANCE_RATIO: Final = 1.25
_CELL_CORNERS: Final = 6
_ROWS: Final = ("upper", "middle", "lower")
_COLUMNS: Final = ("left", "middle", "right")
_SIDES: Final = ("right", "upper", "left", "lower")


@dataclass(frozen=True)
class BoardView:
    """One picture: which head, which instant, which corners."""

    head: str
    exposure: str
    corners: BoardCorners


@dataclass(frozen=True)
class ViewPose:
    """Where the board was: rotation (3, 3) and middle (3,), m, in the axes of the head.

    `tilt_deg` is between the board's normal and the optical axis, `towards_deg` the direction in
    the image, counter-clockwise from right, in which the edge of the board is farther away,
    `roll_deg` how far the board is turned counter-clockwise in the image.
    """

    rotation: Array
    place_m: Array

    @property
    def distance_m(self) -> float:
        """From the projection centre to the middle of the board along the axis."""
        return -float(self.place_m[2])

    @property
    def tilt_deg(self) -> float:
        """Between the normal of the board and the optical axis."""
        return math.degrees(math.acos(min(1.0, abs(float(self.rotation[2, 2])))))

    @property
    def towards_deg(self) -> float:
        """Direction in the image of the edge that is farther away."""
        return math.degrees(math.atan2(float(self.rotation[1, 2]), float(self.rotation[0, 2])))

    @property
    def roll_deg(self) -> float:
        """Rotation of the board in the image."""
        return math.degrees(math.atan2(float(self.rotation[1, 0]), float(self.rotation[0, 0])))


@dataclass(frozen=True)
class ViewCoverage:
    """What views of one head cover; `missing` are requests, in the order of their weight."""

    views: int
    corners: int
    cells: tuple[tuple[int, ...], ...]
    missing: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        """Whether nothing is asked for."""
        return not self.missing


def pose_of(cone: Cone, board: CalibrationBoard, corners: BoardCorners) -> ViewPose:
    """Orient a view by a resection with the lens of the rig file.

    Args:
        cone: with one sensor.
        board: as drawn.
        corners: of the picture.

    Returns:
        The pose of the board.

    Raises:
        ValueError: no resection.
    """
    ideal = ideal_from_measured(cone.lens, layer_mm_from_raw(cone.sensors[0], corners.px))
    station, rotation = resect(ideal, board.corners_m[corners.index], cone.lens.f_mm)
    return ViewPose(rotation.T, -rotation.T @ station)


def coverage_of(cone: Cone, views: Sequence[BoardView], poses: Sequence[ViewPose]) -> ViewCoverage:
    """What the views of a head cover, and what to take next.

    Args:
        cone: the head.
        views: its views.
        poses: of these views.

    Returns:
        Counts of corners in nine parts of the image, upper row first, and requests.
    """
    sensor = cone.sensors[0]
    cells = np.zeros((3, 3), np.int64)
    for view in views:
        share = view.corners.px / np.array([sensor.width_px, sensor.height_px])
        column, row = np.clip((share * 3).astype(int), 0, 2).T
        np.add.at(cells, (row, column), 1)
    missing = [*_missing_areas(cells), *_missing_tilts(poses), *_missing_rolls(poses)]
    distances = [pose.distance_m for pose in poses]
    if distances and max(distances) < DISTANCE_RATIO * min(distances):
        missing.append("another distance: bring the board a quarter nearer in some views")
    if len(views) < MIN_VIEWS:
        missing.append(f"more views: {len(views)} of {MIN_VIEWS} at least")
    corners = int(sum(len(view.corners.index) for view in views))
    return ViewCoverage(
        len(views), corners, tuple(tuple(int(n) for n in row) for row in cells), tuple(missing)
    )


def _missing_areas(cells: NDArray[np.int64]) -> list[str]:
    empty = [
        "the middle" if (i, j) == (1, 1) else f"the {_ROWS[i]} {_COLUMNS[j]}"
        for i, j in np.argwhere(cells < _CELL_CORNERS)
    ]
    return [f"corners in {' and '.join(empty)} of the image"] if empty else []


def _missing_tilts(poses: Sequence[ViewPose]) -> list[str]:
    low, high = TILT_DEG
    seen = {round(pose.towards_deg / 90.0) % 4 for pose in poses if low <= pose.tilt_deg <= high}
    missing = [side for k, side in enumerate(_SIDES) if k not in seen]
    if not missing:
        return []
    return [
        f"convergent views: tilt the {' and the '.join(missing)} edge of the board away from the "
        "head by 20 to 40 degrees"
    ]


def _missing_rolls(poses: Sequence[ViewPose]) -> list[str]:
    turned = {round(pose.roll_deg / 90.0) % 4 for pose in poses}
    missing = []
    if not turned & {1, 3}:
        missing.append("rolled views: turn the board or the head by 90 degrees")
    if not ({0, 2} <= turned or {1, 3} <= turned):
        missing.append("rolled views: turn the board or the head upside down")
    return missing


def same_views(
    board: CalibrationBoard, views: Sequence[BoardView], distance_px: float = 2.0
) -> list[tuple[int, int]]:
    """Pairs of views of one head that show the board in the same place.

    Args:
        board: as drawn.
        views: of one head.
        distance_px: mean distance of corners below which two views are one.

    Returns:
        Indices of a view and an earlier one.
    """
    count = len(board.corners_m)
    places = np.full((len(views), count, 2), np.nan)
    for k, view in enumerate(views):
        places[k, view.corners.index] = view.corners.px
    found = []
    for k in range(1, len(views)):
        apart = np.linalg.norm(places[:k] - places[k], axis=2)
        common = np.isfinite(apart).sum(axis=1)
        mean = np.nansum(apart, axis=1) / np.maximum(common, 1)
        same = np.flatnonzero((common >= 8) & (mean < distance_px))
        if len(same):
            found.append((k, int(same[0])))
    return found
