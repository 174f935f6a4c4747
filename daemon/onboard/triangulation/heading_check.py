"""Measured headings against the direction of flight: a swapped sign or another convention."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CRAB_DEG: Final = 30.0
"""A camera is mounted along the flight or across it; wind turns it by less than this."""


def headings_off(lines: Sequence[str], time_s: Array, position_m: Array, rotation: Array) -> Array:
    """Angles between the cameras and the direction of flight that no mounting explains.

    Args:
        lines: names of the lines, by image.
        time_s: (n,) since any fixed instant.
        position_m: (n, 3), z up.
        rotation: (n, 3, 3) object from camera.

    Returns:
        Shape (n,), deg. Off the nearest quarter turn where that is more than wind does; else from
        the quarter turn that most images have; zero where both fit, or a line has one image.
    """
    off = np.full(len(lines), np.nan)
    names: NDArray[Any] = np.array(lines)
    for name in dict.fromkeys(lines):
        own = np.flatnonzero(names == name)
        own = own[np.argsort(time_s[own])]
        if len(own) < 2:
            continue
        course = np.gradient(position_m[own, :2], axis=0)
        forward = rotation[own, :2, 1]
        turn = np.arctan2(forward[:, 0], forward[:, 1]) - np.arctan2(course[:, 0], course[:, 1])
        off[own] = np.degrees(turn)
    quarter = np.round(off / 90.0)
    beyond = off - 90.0 * quarter
    result = np.where(np.abs(beyond) > CRAB_DEG, beyond, 0.0)
    fits = np.abs(beyond) <= CRAB_DEG
    if fits.any():
        numbers = quarter[fits].astype(np.int64) % 4
        usual = int(np.argmax(np.bincount(numbers)))
        step = (numbers - usual + 2) % 4 - 2
        result[fits] = 90.0 * step
    return np.where(np.isfinite(off), result, 0.0)


def typical_off(off: Array) -> int:
    """The median of angles by size, deg."""
    return round(float(np.median(np.abs(off)))) if len(off) else 0
