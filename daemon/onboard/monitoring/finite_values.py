"""JSON types without NaN and infinities, which no JSON text can hold and no browser reads."""

from __future__ import annotations

import math
from collections.abc import Mapping
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
