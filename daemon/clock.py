"""GPS time on the host's monotonic clock, learned from event marks.

Navigation messages arrive 10 to 700 ms late and give only a coarse start; every matched event mark
is an exact pair. Between marks the model coasts, and its sigma grows.
"""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass

COARSE_SIGMA_NS = 350_000_000
ARRIVAL_MIN_NS = 10_000_000
ARRIVAL_MAX_NS = 700_000_000
COAST_SIGMA_PPM = 1.0
"""How far a host's crystal may wander off the fitted rate while no mark comes."""


@dataclass(frozen=True)
class GpsEstimate:
    """A GPS time with its standard deviation; `is_coarse` until the first mark was matched."""

    gps_ns: int
    sigma_ns: int
    is_coarse: bool


class HostClock:
    """Affine model gps = mono + offset + drift, over the last pairs."""

    def __init__(self, memory: int = 32) -> None:
        self._pairs: deque[tuple[int, int, int]] = deque(maxlen=memory)
        self._least_lateness_ns: int | None = None

    def message_arrived(self, gps_ns: int, mono_ns: int) -> None:
        """Note a navigation message: it left at `gps_ns` and arrived, late, at `mono_ns`."""
        lateness = mono_ns - gps_ns
        if self._least_lateness_ns is None or lateness < self._least_lateness_ns:
            self._least_lateness_ns = lateness

    def mark_matched(self, gps_ns: int, mono_ns: int, sigma_ns: int) -> None:
        """Note an event mark of an instant whose host time is known to `sigma_ns`."""
        self._pairs.append((mono_ns, gps_ns, max(sigma_ns, 1)))

    def restart(self) -> None:
        """Forget everything: the receiver's time has stepped."""
        self._pairs.clear()
        self._least_lateness_ns = None

    def gps_at(self, mono_ns: int) -> GpsEstimate | None:
        """GPS time of a host instant, or None before the receiver has spoken."""
        if self._pairs:
            return self._from_pairs(mono_ns)
        if self._least_lateness_ns is None:
            return None
        centre = (ARRIVAL_MIN_NS + ARRIVAL_MAX_NS) // 2
        return GpsEstimate(mono_ns - self._least_lateness_ns + centre, COARSE_SIGMA_NS, True)

    def _from_pairs(self, mono_ns: int) -> GpsEstimate:
        origin = self._pairs[-1][0]
        offsets = [gps - mono for mono, gps, _ in self._pairs]
        base = offsets[-1]
        x = [float(mono - origin) for mono, _, _ in self._pairs]
        y = [float(offset - base) for offset in offsets]
        slope = _theil_slope(x, y)
        intercept = statistics.median(b - slope * a for a, b in zip(x, y, strict=True))
        away = float(mono_ns - origin)
        residuals = [abs(b - slope * a - intercept) for a, b in zip(x, y, strict=True)]
        pair_sigma = statistics.median(sigma for _, _, sigma in self._pairs)
        # 1.4826: from the median absolute deviation to a standard deviation.
        spread = 1.4826 * statistics.median(residuals) if len(residuals) > 2 else 0.0
        sigma = max(pair_sigma, spread) / min(len(x), 4) ** 0.5
        sigma += COAST_SIGMA_PPM * 1e-6 * abs(away)
        return GpsEstimate(mono_ns + base + round(intercept + slope * away), round(sigma), False)


def _theil_slope(x: list[float], y: list[float]) -> float:
    """Median of pairwise slopes: a single bad pair does not turn the clock."""
    slopes = [
        (y[j] - y[i]) / (x[j] - x[i])
        for i in range(len(x))
        for j in range(i + 1, len(x))
        if x[j] != x[i]
    ]
    return statistics.median(slopes) if len(x) >= 3 and slopes else 0.0
