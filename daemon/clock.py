"""GPS time on the host's monotonic clock, learned from event marks.

Navigation messages arrive 10 to 700 ms late and give only a coarse start; every matched event mark
is an exact pair. Between marks the model coasts, and its sigma grows.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass

COARSE_SIGMA_NS = 350_000_000
ARRIVAL_MIN_NS = 10_000_000
ARRIVAL_MAX_NS = 700_000_000
DRIFT_SIGMA = 20e-6
"""Standard deviation of a host clock's rate against GPS before anything is known of it."""
HUBER = 2.0
ROBUST_ITERATIONS = 5


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
        origin_mono_ns, origin_gps_ns, _ = self._pairs[-1]
        x = [float(mono - origin_mono_ns) for mono, _, _ in self._pairs]
        y = [float(gps - origin_gps_ns) - a for (_, gps, _), a in zip(self._pairs, x, strict=True)]
        sigma = [float(s) for _, _, s in self._pairs]
        away = float(mono_ns - origin_mono_ns)
        offset, drift, variance = _fit(x, y, sigma, away)
        gps_ns = origin_gps_ns + (mono_ns - origin_mono_ns) + round(offset + drift * away)
        return GpsEstimate(gps_ns, round(math.sqrt(variance)), False)


def _fit(
    x: list[float], y: list[float], sigma: list[float], away: float
) -> tuple[float, float, float]:
    """Offset and drift by weighted least squares, and the variance of the line at `away`.

    The drift has a prior, zero within what crystals do: two uncertain pairs close together must
    not turn the clock. Pairs far off the line lose their weight (Huber), and a spread wider than
    the stated sigmas widens the result.
    """
    weights = [1.0 / s**2 for s in sigma]
    offset = drift = 0.0
    q00 = q01 = q11 = 0.0
    scale = 1.0
    for _ in range(ROBUST_ITERATIONS):
        n00 = sum(weights)
        n01 = sum(w * a for w, a in zip(weights, x, strict=True))
        n11 = sum(w * a * a for w, a in zip(weights, x, strict=True)) + DRIFT_SIGMA**-2
        l0 = sum(w * b for w, b in zip(weights, y, strict=True))
        l1 = sum(w * a * b for w, a, b in zip(weights, x, y, strict=True))
        determinant = n00 * n11 - n01 * n01
        q00, q01, q11 = n11 / determinant, -n01 / determinant, n00 / determinant
        offset, drift = q00 * l0 + q01 * l1, q01 * l0 + q11 * l1
        off = [abs(b - offset - drift * a) / s for a, b, s in zip(x, y, sigma, strict=True)]
        weights = [min(1.0, HUBER / max(r, 1e-9)) / s**2 for r, s in zip(off, sigma, strict=True)]
        # 1.4826: from the median absolute deviation to a standard deviation.
        scale = max(1.0, 1.4826 * statistics.median(off)) if len(off) > 2 else 1.0
    return offset, drift, scale**2 * (q00 + 2 * away * q01 + away * away * q11)
