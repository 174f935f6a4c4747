"""The clocks of devices on the host's monotonic clock, from readings over round trips.

Heads are latched, autopilots asked by TIMESYNC: both answer within a round trip of unknown halves.
The shortest round trips are the most accurate, so only they are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from daemon.onboard.timing.clock_model import ClockModel, Pair
from daemon.onboard.timing.gps_clock import RoundTrips
from drivers.contract import ClockReading

GROUP: Final = 4
"""Of this many successive readings the one with the shortest round trip is kept."""
BACKWARDS_NS: Final = 1_000_000_000
"""A device clock that decreases by more than this was restarted."""
LATCH_GRID_NS: Final = 1_000
"""Smallest sigma of a latch, whatever its round trip."""


@dataclass(frozen=True)
class HostInstant:
    """An instant of a device on the host's clock, and its standard deviation."""

    mono_ns: int
    sigma_ns: int


class DeviceClockEstimator:
    """One device's clock. A pure model: it reads no clock itself."""

    def __init__(self) -> None:
        self._model = ClockModel()
        self._round_trips = RoundTrips()
        self._group: list[ClockReading] = []
        self._newest_ns: int | None = None
        self._newest_mono_ns = 0
        self.restarts = 0

    @property
    def steps(self) -> int:
        """How often the clock was found to have stepped or restarted."""
        return self._model.steps + self.restarts

    def read(self, reading: ClockReading) -> None:
        """Note a reading; a repetition of the last one is ignored."""
        newest_ns = self._newest_ns
        if newest_ns is not None:
            if reading.device_ns == newest_ns or reading.mono_ns <= self._newest_mono_ns:
                return
            if reading.device_ns < newest_ns - BACKWARDS_NS:
                self._restart()
        self._newest_ns, self._newest_mono_ns = reading.device_ns, reading.mono_ns
        self._round_trips.add(reading.half_width_ns)
        self._group.append(reading)
        if len(self._group) < GROUP and len(self._model) >= GROUP:
            return
        best = min(self._group, key=lambda each: each.half_width_ns)
        self._group.clear()
        sigma_ns = self._round_trips.sigma_ns(best.half_width_ns)
        self._model.add(Pair(best.device_ns, best.mono_ns, max(sigma_ns, LATCH_GRID_NS / 2)))

    def at(self, device_ns: int) -> HostInstant | None:
        """Host time of a device's instant; None before the first reading.

        The common asymmetry of all round trips is part of the sigma.
        """
        estimate = self._model.at(device_ns)
        if estimate is None:
            return None
        systematic_ns = self._round_trips.systematic_ns
        return HostInstant(estimate.to_ns, round((estimate.sigma_ns**2 + systematic_ns**2) ** 0.5))

    def _restart(self) -> None:
        self.restarts += 1
        self._model.clear()
        self._group.clear()


class DeviceClocks:
    """The clocks of all devices that were ever read, by name."""

    def __init__(self) -> None:
        self._clocks: dict[str, DeviceClockEstimator] = {}

    def read(self, reading: ClockReading) -> None:
        """Note a reading of a device."""
        self._clocks.setdefault(reading.device, DeviceClockEstimator()).read(reading)

    def at(self, device: str, device_ns: int) -> HostInstant | None:
        """Host time of a device's instant; None for a device that was never read."""
        clock = self._clocks.get(device)
        return None if clock is None else clock.at(device_ns)

    def steps(self) -> dict[str, int]:
        """How often each clock stepped or restarted."""
        return {name: clock.steps for name, clock in self._clocks.items()}
