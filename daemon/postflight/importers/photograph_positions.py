"""Positions of photographs that cannot be those of one block, found before they are used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

Place = tuple[float, float, float]
"""Latitude, longitude, deg, and height, m; the height may be NaN."""
Array = NDArray[np.float64]

BLOCK_KM_MAX: Final = 100.0
"""Distance from the middle of the positions beyond which one is not of the same block."""
HEIGHT_M: Final = (-500.0, 20_000.0)
"""Heights that a camera on an aircraft may have."""
SAME_WITHIN_M: Final = 0.1
_EARTH_M: Final = 6_371_000.0


def implausible_positions(places: Sequence[Place | None]) -> dict[int, str]:
    """What is wrong with a position, by its index: no aircraft's height, or far from the others.

    Example:
        >>> implausible_positions([(47.0, 15.0, 500.0), (47.0, 15.0, 1e6), (47.0, 15.0, 510.0)])
        {1: 'its height in EXIF is 1e+06 m; -500 to 20000 m are possible'}
    """
    low, high = HEIGHT_M
    found = {
        k: f"its height in EXIF is {place[2]:g} m; {low:g} to {high:g} m are possible"
        for k, place in enumerate(places)
        if place is not None and math.isfinite(place[2]) and not low <= place[2] <= high
    }
    rest = [(k, place) for k, place in enumerate(places) if place is not None and k not in found]
    if not rest:
        return found
    on_earth = _on_earth([place for _, place in rest])
    middle = np.median(on_earth, axis=0)
    for (k, _), away_m in zip(rest, np.linalg.norm(on_earth - middle, axis=1), strict=True):
        if away_m > BLOCK_KM_MAX * 1e3:
            found[k] = (
                f"its position in EXIF is {away_m / 1e3:.0f} km from the middle of all positions; "
                f"a block is within {BLOCK_KM_MAX:g} km"
            )
    return found


def same_place(places: Sequence[Place | None]) -> str:
    """A caution where all positions are one; empty where they are not."""
    placed = [place for place in places if place is not None]
    if len(placed) < 2:
        return ""
    heights = np.array([place[2] for place in placed])
    spread = np.ptp(_on_earth(placed), axis=0).max()
    rise = np.ptp(heights) if np.isfinite(heights).all() else 0.0
    if max(float(spread), float(rise)) > SAME_WITHIN_M:
        return ""
    latitude, longitude, _ = placed[0]
    return (
        f"All {len(placed)} positions of EXIF are the same, {latitude:.6f}, {longitude:.6f}: they "
        "give a block neither scale nor direction. Give control (--points), or photographs with "
        "the positions of their exposures."
    )


def _on_earth(places: Sequence[Place]) -> Array:
    """Points on a sphere, (n, 3), m."""
    latitude, longitude = np.radians(np.array([place[:2] for place in places]).T)
    return _EARTH_M * np.column_stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ]
    )
