"""Which planned lines were flown, and which were left before their end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.orientation.geodesy import east_north_m
from daemon.planning.model import PlannedLine

Array = NDArray[np.float64]

_LATE_SHARE: Final = 0.5
"""Of the spacing of exposures: by less, an exposure is only early or late."""


def missing_at_ends(
    planned: Sequence[PlannedLine], lines: Sequence[str], places_deg: Array
) -> dict[str, int]:
    """Planned exposures before the first image and behind the last one of each line.

    Args:
        planned: lines of the plan.
        lines: id of the line of each image.
        places_deg: latitude and longitude of each image, (n, 2).

    Returns:
        Their number by line; only lines that miss some and have an image.
    """
    along = {one.id: _along_m(one, lines, places_deg) for one in planned}
    usual_m = _spacing_m(list(along.values()))
    missing = {}
    for one in planned:
        flown = along[one.id]
        if not len(flown):
            continue
        due = _due_m(one, one.distance_m or _spacing_m([flown]) or usual_m)
        late = _LATE_SHARE * (min(np.diff(due), default=0.0) if len(due) > 1 else np.inf)
        count = int(((due < flown.min() - late) | (due > flown.max() + late)).sum())
        if count:
            missing[one.id] = count
    return missing


def _along_m(one: PlannedLine, lines: Sequence[str], places_deg: Array) -> Array:
    """Distances of a line's images from its start, m."""
    east, north = east_north_m(one.start, one.end)
    length = float(np.hypot(east, north)) or 1.0
    own = [place for line, place in zip(lines, places_deg, strict=True) if line == one.id]
    ends = [east_north_m(one.start, (float(place[0]), float(place[1]))) for place in own]
    return np.array([(e * east + n * north) / length for e, n in ends])


def _spacing_m(flown: Sequence[Array]) -> float | None:
    """Median distance of neighbouring images; None where no line has two."""
    steps = [np.diff(np.sort(one)) for one in flown if len(one) > 1]
    return float(np.median(np.concatenate(steps))) if steps else None


def _due_m(one: PlannedLine, spacing_m: float | None) -> Array:
    """Planned places along a line, m; its ends where no spacing is known."""
    length = float(np.hypot(*east_north_m(one.start, one.end)))
    if one.at_m:
        return np.array(one.at_m)
    if not spacing_m or spacing_m <= 0.0:
        return np.array([0.0, length])
    return np.arange(int(length / spacing_m + 1e-6) + 1, dtype=np.float64) * spacing_m
