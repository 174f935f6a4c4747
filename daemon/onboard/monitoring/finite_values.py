"""JSON types without NaN and infinities, which no JSON text can hold, and places on the earth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any


def finite(value: Any) -> Any:
    """The same JSON types; a float that is not finite is None.

    Example:
        >>> finite({"sigma0_px": math.nan, "dc_k": [11.8, math.inf]})
        {'sigma0_px': None, 'dc_k': [11.8, None]}
    """
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    return value


def is_place(latitude_deg: object, longitude_deg: object) -> bool:
    """Whether two values are a latitude and a longitude, degrees; across the antimeridian too.

    Example:
        >>> [is_place(47.1, 15.4), is_place(47.1, 195.4), is_place(91.0, 0.0), is_place(None, 0.0)]
        [True, True, False, False]
    """
    if not isinstance(latitude_deg, float | int) or not isinstance(longitude_deg, float | int):
        return False
    return abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 360.0


def places_or_none(corners: Sequence[Sequence[float]] | None) -> list[list[float]] | None:
    """Corners (latitude, longitude), if all of them are places; else None.

    Example:
        >>> places_or_none([[47.0, 15.0], [47.0, math.nan]])
        >>> places_or_none([[47.0, 15.0]])
        [[47.0, 15.0]]
    """
    if not corners or not all(is_place(*corner) for corner in corners):
        return None
    return [list(corner) for corner in corners]
