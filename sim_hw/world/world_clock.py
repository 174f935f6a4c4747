"""The clocks of the emulated world: GPS time, the host's monotonic clock and each device's own.

GPS time is what the world is simulated in; the monotonic clock is when things happen on the wire.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

LEAP_SECONDS = 18
"""GPS minus UTC since 2017-01-01, the last leap second announced (IERS Bulletin C)."""

GPS_EPOCH_UNIX_S = 315_964_800
"""1980-01-06T00:00:00 UTC, when GPS and UTC agreed, in POSIX seconds."""

NS_PER_S = 1_000_000_000
NS_PER_WEEK = 7 * 86_400 * NS_PER_S

_PARTS_PER_PPM = 1_000_000


@dataclass(frozen=True)
class WorldClock:
    """GPS time of the simulated world against CLOCK_MONOTONIC of this host; both run at one rate.

    `gps_ns` counts from the GPS epoch, `mono_ns` is `time.monotonic_ns()`.
    """

    gps_ns_at_start: int
    mono_ns_at_start: int

    @classmethod
    def from_wall_clock(cls) -> WorldClock:
        """A world whose GPS time is this machine's wall clock: right week, right second."""
        mono_ns = time.monotonic_ns()
        return cls(gps_ns_from_unix_ns(time.time_ns()), mono_ns)

    def gps_ns(self, mono_ns: int) -> int:
        return self.gps_ns_at_start + (mono_ns - self.mono_ns_at_start)

    def mono_ns(self, gps_ns: int) -> int:
        return self.mono_ns_at_start + (gps_ns - self.gps_ns_at_start)


@dataclass(frozen=True)
class FreeRunningClock:
    """A device's free-running clock: device = offset + mono * (1 + drift), in ns.

    Computed in integers, so that a long uptime loses no digits; `drift_ppm` is resolved to 1e-12.
    """

    offset_ns: int = 0
    drift_ppm: float = 0.0

    def device_ns(self, mono_ns: int) -> int:
        parts = round(self.drift_ppm * _PARTS_PER_PPM)
        return self.offset_ns + mono_ns + mono_ns * parts // (_PARTS_PER_PPM * _PARTS_PER_PPM)


def gps_ns_from_unix_ns(unix_ns: int, leap_seconds: int = LEAP_SECONDS) -> int:
    """GPS time of a POSIX (UTC) instant, ns."""
    return unix_ns + (leap_seconds - GPS_EPOCH_UNIX_S) * NS_PER_S


def unix_ns_from_gps_ns(gps_ns: int, leap_seconds: int = LEAP_SECONDS) -> int:
    """POSIX (UTC) time of a GPS instant, ns."""
    return gps_ns - (leap_seconds - GPS_EPOCH_UNIX_S) * NS_PER_S


def gps_week_and_tow_ns(gps_ns: int) -> tuple[int, int]:
    """Full week number (never rolled over) and time of week, ns."""
    return divmod(gps_ns, NS_PER_WEEK)
