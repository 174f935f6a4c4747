"""Calibration maps as fixed-point words of 8 or 16 bits: what the radiometric pass reads."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def fixed_point(
    values: Array, unit: float, kind: type[np.unsignedinteger[Any]] = np.uint16
) -> Array:
    """Round values to whole units.

    Args:
        values: any shape, in the unit of `unit`.
        unit: of a word.
        kind: type of the words; values beyond its range are cut off.

    Returns:
        Words of the same shape, contiguous.

    Example:
        >>> fixed_point(np.array([0.0, 0.26, 99.0]), 0.125, np.uint8)
        array([  0,   2, 255], dtype=uint8)
    """
    words: Array = np.clip(np.rint(np.asarray(values) / np.float32(unit)), 0, np.iinfo(kind).max)
    return np.ascontiguousarray(words.astype(kind))


def quantised(values: Array, good: Array, coarsest: float) -> tuple[Array, float, float]:
    """A map as words above its least value, in 8 bits where steps stay below the coarsest allowed.

    Half the bytes are half the time: the pass waits for memory. Words of defects, which are not
    read, are cut off to the range of good pixels.

    Args:
        values: the map, (h, w).
        good: False at defects, (h, w).
        coarsest: largest step allowed, in the unit of the map.

    Returns:
        The words, the least value, the unit of a word.

    Example:
        >>> words, least, unit = quantised(np.array([[1.0, 2.0]]), np.ones((1, 2), bool), 0.5)
        >>> words, least, round(unit * 255, 6)
        (array([[  0, 255]], dtype=uint8), 1.0, 1.0)
    """
    of_good = values[good] if good.any() else values
    least, most = float(np.min(of_good)), float(np.max(of_good))
    kind = np.uint8 if most - least <= coarsest * np.iinfo(np.uint8).max else np.uint16
    unit = max(most - least, 1e-6) / np.iinfo(kind).max
    return fixed_point(values - np.float32(least), unit, kind), least, unit
