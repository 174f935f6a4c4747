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
    """How often each word occurs; no data (0) is not counted.

    Args:
        band: words, any shape, uint16.
        scale: multiplies the signal first, see `scaled_value_table`.

    Returns:
        Shape (65536,), int64, index is the word.

    Raises:
        ValueError: a scale that is not positive.

    Example:
        >>> counts = histogram(np.array([[0, 7, 7, 9]], np.uint16))
        >>> int(counts[0]), int(counts[7]), int(counts.sum())
        (0, 2, 3)
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

    Args:
        scale: positive.

    Returns:
        Shape (65536,), int64, 1 to 65535 for data, 0 for no data.

    Raises:
        ValueError: a scale that is not positive.

    Example:
        >>> scaled_value_table(0.1)[[0, 1, 100, 65535]]
        array([   0,    1,   10, 6554])
    """
    if not (math.isfinite(scale) and scale > 0.0):
        raise ValueError(f"scale is {scale}; signal is multiplied by a positive number")
    scaled_values: Array = np.clip(
        np.rint(np.arange(VALUE_COUNT) * scale), 1, VALUE_COUNT - 1
    ).astype(np.int64)
    scaled_values[0] = 0
    return scaled_values


def mission_curve(histograms: Mapping[str, Array]) -> ToneCurve:
    """The curve of a mission from its summed histograms.

    Args:
        histograms: counts by band, shape (65536,) each; bands without data are left out.

    Returns:
        Limits of each band at 0.1 % and 99.7 %, and one exponent for all, 0.35 to 1.

    Raises:
        ValueError: no band holds data.

    Example:
        The median lies at 16 % of the range and shall lie at 40 %: 0.16^0.5 = 0.4.

        >>> counts = np.zeros(65536, np.int64)
        >>> counts[[1000, 1160, 2000]] = 10, 980, 10
        >>> curve = mission_curve({"green": counts})
        >>> curve.low["green"], curve.high["green"], round(curve.exponent, 6)
        (1000.0, 2000.0, 0.5)
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
    """The 8-bit value of each word of a band.

    Args:
        curve: of the mission; it has the band.
        band: name of the band.
        scale: multiplies the signal first, positive.

    Returns:
        Shape (65536,), uint8; 0 is no data.

    Raises:
        ValueError: a scale that is not positive.

    Example:
        >>> curve = ToneCurve({"green": 1000.0}, {"green": 3000.0}, exponent=0.5)
        >>> lookup_table(curve, "green")[[0, 500, 1500, 3000]]
        array([  0,   1, 128, 255], dtype=uint8)
    """
    scaled_values = scaled_value_table(scale).astype(np.float64)
    unit = (scaled_values - curve.low[band]) / (curve.high[band] - curve.low[band])
    table = np.rint(1.0 + 254.0 * np.clip(unit, 0.0, 1.0) ** curve.exponent).astype(np.uint8)
    table[0] = 0
    return np.asarray(table)


def curve_as_json(curve: ToneCurve) -> dict[str, Any]:
    """The curve as JSON-ready data.

    Args:
        curve: to be written.

    Returns:
        `low` and `high` by band, and `exponent`.
    """
    return {"low": dict(curve.low), "high": dict(curve.high), "exponent": curve.exponent}


def _percentile(counts: Array, percent: float) -> float:
    total = np.cumsum(counts)
    return float(np.searchsorted(total, percent / 100.0 * total[-1]))
