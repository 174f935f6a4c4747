"""GPS time of an autopilot's own clock, which counts from its start.

SYSTEM_TIME tells both UTC, to the microsecond, and the time since start, cut to the millisecond:
each message bounds their difference to a millisecond, and several of them bound it closer.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from drivers.gps_time import GPS_EPOCH_DAY, SECOND_NS
from drivers.leap_seconds import leap_seconds_at

UNIX_EPOCH_DAY: Final = 719_163
"""1970-01-01 as `datetime.date.toordinal` counts."""
GPS_EPOCH_UNIX_NS: Final = (GPS_EPOCH_DAY - UNIX_EPOCH_DAY) * 86_400 * SECOND_NS
UNIX_FROM_US: Final = 1_000_000_000_000_000
"""A later microsecond is of UTC (September 2001), an earlier one counts from the start."""
MS_NS: Final = 1_000_000
KEPT: Final = 16
KEPT_FOR_NS: Final = 60 * SECOND_NS
DRIFT_PPM: Final = 50
"""By which the autopilot's clock may run off UTC between two messages."""


class BootClock:
    """The difference between UTC and the time since start, bounded by what was told."""

    def __init__(self) -> None:
        self.steps = 0
        """How often a message contradicted those before: a restart, or a step of UTC."""
        self.leap_seconds: int | None = None
        self._bounds: deque[tuple[int, int, int]] = deque(maxlen=KEPT)
        self._offset_ns: int | None = None
        self._half_width_ns = 0

    def tell(self, unix_us: int, boot_ms: int) -> None:
        """A SYSTEM_TIME came; without UTC (before the first fix) it says nothing."""
        if unix_us < UNIX_FROM_US:
            return
        boot_ns, unix_ns = boot_ms * MS_NS, unix_us * 1000
        # Both are cut: the start was up to a millisecond later, UTC up to a microsecond.
        bounds = (boot_ns, unix_ns - boot_ns - MS_NS, unix_ns - boot_ns + 1000)
        has_restarted = bool(self._bounds) and boot_ns < self._bounds[-1][0]
        self._bounds.append(bounds)
        low, high = self._common(boot_ns)
        if has_restarted or low > high:
            self.steps += 1
            self._bounds.clear()
            self._bounds.append(bounds)
            low, high = self._common(boot_ns)
        self._offset_ns = (low + high) // 2
        self._half_width_ns = (high - low) // 2
        self.leap_seconds = leap_seconds_at(unix_ns - GPS_EPOCH_UNIX_NS)

    def gps_ns(self, boot_ns: int) -> int | None:
        """GPS time of an instant of the autopilot's clock; None before UTC is known."""
        return None if self._offset_ns is None else self.gps_of_unix_ns(boot_ns + self._offset_ns)

    def gps_of_unix_ns(self, unix_ns: int) -> int:
        """GPS time of a UTC instant."""
        utc_ns = unix_ns - GPS_EPOCH_UNIX_NS
        return utc_ns + leap_seconds_at(utc_ns) * SECOND_NS

    def gps_of_us(self, microseconds: int) -> int | None:
        """GPS time of a stamp that is either of UTC or counts from the start."""
        if microseconds >= UNIX_FROM_US:
            return self.gps_of_unix_ns(microseconds * 1000)
        return self.gps_ns(microseconds * 1000)

    @property
    def sigma_ns(self) -> int:
        """Standard deviation of the difference, equally likely within its bounds."""
        return round(self._half_width_ns / math.sqrt(3))

    def _common(self, now_ns: int) -> tuple[int, int]:
        """What all messages allow; older ones allow more, by what the clock may have drifted."""
        low, high = self._bounds[-1][1:]
        for boot_ns, lower, upper in self._bounds:
            age_ns = abs(now_ns - boot_ns)
            if age_ns > KEPT_FOR_NS:
                continue
            slack_ns = age_ns * DRIFT_PPM // 1_000_000
            low, high = max(low, lower - slack_ns), min(high, upper + slack_ns)
        return low, high
