"""Tie points: the same ground in two sensors, PAN to PAN and PAN to the colour master.

They are matched here, in Level-1 frames of raw geometry, where
`processing.matching.tie_point_search` seeks them and as `processing.matching.two_stage` does; what
the points are good for is in `processing.mosaic.free_mosaic`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import SensorPlacement
from processing.geometry.topology import exact_colour_ratio
from processing.image.rectification import rectify_to_sensor
from processing.matching.tie_point_search import (
    PAN_TO_COLOUR,
    PAN_TO_PAN,
    PairSearch,
    TiePointSettings,
    colour_searches,
    pan_searches,
    usable_pixels,
)
from processing.matching.two_stage import MatchLimits, Positions, match_and_mark
from processing.rig import Rig

__all__ = ["PAN_TO_COLOUR", "PAN_TO_PAN", "TiePointSettings", "TiePoints", "match_tie_points"]

Array = NDArray[np.float64]
Frame = NDArray[Any]


@dataclass(frozen=True)
class TiePoints:
    """Matched points of one exposure, as columns of n rows.

    `sensor_a`, `sensor_b` index `names`; `raw_a`, `raw_b` are (column, row) of the same ground.
    `sigma_px` is the predicted standard deviation of one coordinate of their difference, in PAN
    pixels. `kind` is PAN_TO_PAN or PAN_TO_COLOUR (then b is the colour master). `overlap` indexes
    `pairs`, the searched pairs of sensors; `attempted` counts the positions tried. Those of the
    colour master that did not match are at `unmatched_b` (m, 2), of the pair `unmatched_overlap`.
    """

    names: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    attempted: tuple[int, ...]
    sensor_a: NDArray[np.int64]
    sensor_b: NDArray[np.int64]
    raw_a: Array
    raw_b: Array
    sigma_px: Array
    correlation: Array
    kind: NDArray[np.int64]
    overlap: NDArray[np.int64]
    unmatched_b: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    unmatched_overlap: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.sigma_px)

    def only(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> TiePoints:
        """The points of some rows; `pairs` and `attempted` stay.

        Args:
            keep: True for rows that stay, (n,), or their numbers.

        Returns:
            A copy with those rows.
        """
        columns = ("sensor_a", "sensor_b", "raw_a", "raw_b", "sigma_px", "correlation", "kind")
        selected = {name: getattr(self, name)[keep] for name in (*columns, "overlap")}
        return replace(self, **selected)

    def joined(self, others: TiePoints) -> TiePoints:
        """These points and others of the same names and pairs.

        Args:
            others: points that follow.

        Returns:
            A copy with the rows of both.
        """
        columns = ("sensor_a", "sensor_b", "raw_a", "raw_b", "sigma_px", "correlation", "kind")
        both: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), getattr(others, name)])
            for name in (*columns, "overlap")
        }
        return replace(self, **both)

    def counts(self) -> dict[tuple[str, str], int]:
        """Count the points of each searched pair of sensors.

        Returns:
            Points by pair, zero where a pair has none.
        """
        found = np.bincount(self.overlap, minlength=len(self.pairs))
        return {pair: int(found[i]) for i, pair in enumerate(self.pairs)}


def match_tie_points(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    *,
    settings: TiePointSettings | None = None,
) -> TiePoints:
    """Find the tie points of one exposure.

    Args:
        rig: the camera.
        placements: predicted places (calibration + TDM), by sensor name.
        frames: Level-1 frames by sensor name, (h, w), all uint16 words or all float32. A missing
            frame has no points.
        settings: None takes the defaults.

    Returns:
        The accepted matches, pair by pair in the order of the rig's overlaps, then P/C by sensor.

    Raises:
        ValueError: a frame of the wrong shape or type.

    Source: docs/explanation/mathematics/matching.md#standard-deviation-of-a-match.
    """
    settings = settings or TiePointSettings()
    _check_frames(rig, frames)
    ratio = exact_colour_ratio(rig) or 1.0
    coloured = colour_searches(rig, placements, frames, settings, ratio)
    to_colour = [match_pair(search, placements, frames, settings) for search in coloured]
    # Sensors that P/C points tie need few P/P points; the others have nothing else.
    supported = {
        search.pair[0]
        for search, (_, reached) in zip(coloured, to_colour, strict=True)
        if np.count_nonzero(reached) >= settings.supporting_points
    }
    to_pan = pan_searches(rig, placements, frames, settings, supported=supported)
    searches = to_pan + coloured
    matches = [match_pair(search, placements, frames, settings) for search in to_pan] + to_colour
    names = tuple(sensor.name for sensor in rig.sensors)
    index = {name: i for i, name in enumerate(names)}
    rows = []
    unmatched, unmatched_overlap = [np.zeros((0, 2), np.int64)], [np.zeros(0, np.int64)]
    for number, (search, (found, reached)) in enumerate(zip(searches, matches, strict=True)):
        a, b = search.pair
        if search.kind == PAN_TO_COLOUR:
            unmatched.append(search.at_b[~reached])
            unmatched_overlap.append(np.full(len(unmatched[-1]), number))
        columns = np.empty((len(found), 10))
        columns[:, 0], columns[:, 1] = index[a], index[b]
        columns[:, 2:6] = found[:, :4]
        unit = 1.0 if search.kind == PAN_TO_PAN else ratio
        columns[:, 6] = np.hypot(found[:, 4], settings.floor_sigma_px) * unit
        columns[:, 7] = found[:, 5]
        columns[:, 8], columns[:, 9] = search.kind, number
        rows.append(columns)
    table = np.concatenate(rows) if rows else np.empty((0, 10))
    return TiePoints(
        names=names,
        pairs=tuple(search.pair for search in searches),
        attempted=tuple(len(search.at_a) for search in searches),
        sensor_a=table[:, 0].astype(np.int64),
        sensor_b=table[:, 1].astype(np.int64),
        raw_a=table[:, 2:4].copy(),
        raw_b=table[:, 4:6].copy(),
        sigma_px=table[:, 6].copy(),
        correlation=table[:, 7].copy(),
        kind=table[:, 8].astype(np.int64),
        overlap=table[:, 9].astype(np.int64),
        unmatched_b=np.concatenate(unmatched),
        unmatched_overlap=np.concatenate(unmatched_overlap),
    )


def match_pair(
    search: PairSearch,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, Frame],
    settings: TiePointSettings,
) -> tuple[Array, NDArray[np.bool_]]:
    """Match the positions of one pair of frames.

    Args:
        search: the positions.
        placements: predicted places, by sensor name.
        frames: Level-1 frames by sensor name.
        settings: windows and limits.

    Returns:
        The accepted rows of `match_patches`, in raw pixels, and which positions they are.
    """
    a, b = search.pair
    to_pan = search.kind == PAN_TO_PAN
    if not len(search.at_a):
        return np.empty((0, 8)), np.zeros(0, np.bool_)
    frame_a, at_a, seen = frames[a], search.at_a, None
    if search.region is not None:
        seen = rectify_to_sensor(
            placements[a], placements[b], frame_a, region=search.region, step=search.step
        )
        frame_a, at_a = seen.pixels, seen.at(search.at_b)
    result, reached = match_and_mark(
        frame_a,
        frames[b],
        Positions(at_a, search.at_b, search.expected_b),
        np.array(usable_pixels(placements[b]), dtype=np.int64),
        ratio=search.step,
        window_px=settings.window_pp_px if to_pan else settings.window_pc_px,
        search_px=settings.search_pp_px if to_pan else settings.search_pc_px,
        limits=MatchLimits(
            settings.max_sigma_pp_px if to_pan else settings.max_sigma_pc_px,
            settings.min_correlation,
            settings.min_peak_margin,
        ),
    )
    found = result[reached]
    if seen is not None:
        found[:, :2] = seen.raw_a(found[:, :2])
    return found, reached


def _check_frames(rig: Rig, frames: Mapping[str, Frame]) -> None:
    types = {frame.dtype for frame in frames.values()}
    if len(types) > 1 or not types <= {np.dtype(np.uint16), np.dtype(np.float32)}:
        found = ", ".join(sorted(str(t) for t in types))
        raise ValueError(f"frames are of {found}; give them all as uint16 or all as float32")
    for name, frame in frames.items():
        sensor = rig.sensor(name)
        if frame.shape != (sensor.height_px, sensor.width_px):
            raise ValueError(
                f"frame {name} is {frame.shape}; its sensor is "
                f"({sensor.height_px}, {sensor.width_px})"
            )
