"""One tone curve for a whole mission: linear signal to 8 bits, the same in every exposure.

The curve follows from histograms summed over all exposures, so that neighbouring images match;
where files come from and go to is the daemon's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

VALUE_COUNT: Final = 65536
LOW_PERCENT: Final = 0.1
HIGH_PERCENT: Final = 99.7
MIDDLE: Final = 0.40
"""Where the median of the mission lies in the finished picture, as a share of its range."""

_EXPONENTS: Final = (0.35, 1.0)
_PICTURE: Final[tuple[str, ...]] = ("red", "green", "blue")


@dataclass(frozen=True)
class ToneCurve:
    """8-bit value = 1 + 254 ((signal - low) / (high - low)) ^ exponent, clipped to 1 .. 255; 0 is
    no data.

    `low` and `high` are counts by band: what haze adds is taken away and white is what is bright,
    band by band; the exponent is one for all, so that grey stays grey.
    """

    low: Mapping[str, float]
    high: Mapping[str, float]
    exponent: float


def histogram(band: Array, scale: float = 1.0) -> Array:
    """How often each word occurs, (65536,) int64; no data (0) is not counted.

    Args:
        band: uint16.
        scale: multiplies the signal first, see `scaled_value_table`.
    """
    counts: Array = np.bincount(band.ravel(), minlength=VALUE_COUNT).astype(np.int64)
    counts[0] = 0
    if scale == 1.0:
        return counts
    moved = np.zeros(VALUE_COUNT, np.int64)
    np.add.at(moved, scaled_value_table(scale), counts)
    moved[0] = 0
    return moved


def scaled_value_table(scale: float) -> Array:
    """What each of the 65536 words becomes when signal is multiplied by `scale`: data stay data.

    Raises:
        ValueError: a scale that is not positive.
    """
    if not (math.isfinite(scale) and scale > 0.0):
        raise ValueError(f"scale is {scale}; signal is multiplied by a positive number")
    scaled_values: Array = np.clip(
        np.rint(np.arange(VALUE_COUNT) * scale), 1, VALUE_COUNT - 1
    ).astype(np.int64)
    scaled_values[0] = 0
    return scaled_values


def mission_curve(histograms: Mapping[str, Array]) -> ToneCurve:
    """The curve of a mission from its summed histograms, by band.

    Raises:
        ValueError: no band holds data.
    """
    low, high, middle = {}, {}, {}
    for band, counts in histograms.items():
        if not counts.any():
            continue
        low[band], middle[band], high[band] = (
            _percentile(counts, percent) for percent in (LOW_PERCENT, 50.0, HIGH_PERCENT)
        )
        high[band] = max(high[band], low[band] + 1.0)
    if not low:
        raise ValueError("no exposure holds colour; process the mission first")
    seen = [band for band in _PICTURE if band in low] or list(low)
    unit = float(np.mean([(middle[b] - low[b]) / (high[b] - low[b]) for b in seen]))
    unit = min(max(unit, 1e-3), 0.999)
    exponent = min(max(math.log(MIDDLE) / math.log(unit), _EXPONENTS[0]), _EXPONENTS[1])
    return ToneCurve(low, high, exponent)


def lookup_table(curve: ToneCurve, band: str, scale: float = 1.0) -> Array:
    """The 8-bit value of each word of a band, (65536,) uint8, for signal times `scale`."""
    scaled_values = scaled_value_table(scale).astype(np.float64)
    unit = (scaled_values - curve.low[band]) / (curve.high[band] - curve.low[band])
    table = np.rint(1.0 + 254.0 * np.clip(unit, 0.0, 1.0) ** curve.exponent).astype(np.uint8)
    table[0] = 0
    return np.asarray(table)


def curve_as_json(curve: ToneCurve) -> dict[str, Any]:
    """The curve as JSON-ready data."""
    return {"low": dict(curve.low), "high": dict(curve.high), "exponent": curve.exponent}


def _percentile(counts: Array, percent: float) -> float:
    total = np.cumsum(counts)
    return float(np.searchsorted(total, percent / 100.0 * total[-1]))
