"""Number of exposures that fit on the disk, the time they last, and the low-space warning.

It only measures. The line stops by it (`daemon.onboard.service.flight_line`); the service reports
it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from daemon.configuration.model import LimitsSection
from daemon.mission.store import durable

LEVEL2_SHARE = 2
"""Products take about as much room as frames; one more share for the log and the index."""

RATE_EXPOSURES = 9
"""Exposures over which the current rate is taken, their intervals one fewer."""


@dataclass(frozen=True)
class DiskCapacity:
    """Free space of the disk above the reserve.

    `seconds` at the current rate; None where there is none yet. `is_low` is the warning, `is_full`
    the stop: no exposure is begun that might not fit. `free_nbytes` is free above the reserve,
    `exposure_nbytes` the size of one exposure with its products.
    """

    exposures: int
    seconds: float | None
    is_low: bool
    free_nbytes: int = 0
    exposure_nbytes: int = 0

    @property
    def is_full(self) -> bool:
        return self.exposures == 0


def needed_nbytes(exposure_nbytes: int) -> int:
    """Size of an exposure on the disk, its products included."""
    return max(1, (1 + LEVEL2_SHARE) * exposure_nbytes)


class DiskSpaceMonitor:
    """Looks after the disk of a mission.

    Args:
        limits: the reserve, and from how many exposures on it warns.
        exposure_nbytes: the frames of one exposure.
        path: on the disk.
        free_bytes: queries the disk; replaced in tests.
    """

    def __init__(
        self,
        limits: LimitsSection,
        exposure_nbytes: int,
        path: Path,
        free_bytes: Callable[[Path], int] = durable.free_bytes,
    ) -> None:
        self._limits = limits
        self._needed_nbytes = needed_nbytes(exposure_nbytes)
        self._path = path
        self._free_bytes = free_bytes
        self._exposed_ns: deque[int] = deque(maxlen=RATE_EXPOSURES)
        self._was_low = False

    def add_exposure(self, mono_ns: int) -> None:
        """An exposure was ordered: the rate follows the last few."""
        self._exposed_ns.append(mono_ns)

    def check(self) -> DiskCapacity:
        """Ask the disk."""
        free_nbytes = self._free_bytes(self._path) - self._limits.disk_reserve_bytes
        exposures = max(0, free_nbytes // self._needed_nbytes)
        interval_s = self._interval_s()
        seconds = None if interval_s is None else exposures * interval_s
        is_low = exposures < self._limits.disk_warn_exposures
        return DiskCapacity(exposures, seconds, is_low, max(0, free_nbytes), self._needed_nbytes)

    def warning(self) -> str | None:
        """Message to the crew when free space has just become low; None at any other time."""
        capacity = self.check()
        is_first_warning = capacity.is_low and not self._was_low
        self._was_low = capacity.is_low
        if not is_first_warning:
            return None
        time_left = (
            "" if capacity.seconds is None else f", {capacity.seconds / 60:.0f} min at this rate"
        )
        return (
            f"the disk is low: room for {capacity.exposures} exposures{time_left}; finish this "
            f"line and change the disk, or free {self._path}"
        )

    def _interval_s(self) -> float | None:
        if len(self._exposed_ns) < 2:
            return None
        span_ns = self._exposed_ns[-1] - self._exposed_ns[0]
        return span_ns / (len(self._exposed_ns) - 1) * 1e-9
