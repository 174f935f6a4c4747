"""When the next exposure is due: after a time, or after a way over ground.

Pure decisions on a clock handed in; firing itself is the business of the trigger device.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

from daemon.orientation.geodesy import east_north_m, place_at
from drivers.contract import NavSample
from processing.rig import Rig

NANOSECONDS = 1_000_000_000


class TriggerPolicy(Protocol):
    """When to expose; also `daemon.planning.steering.PlanTrigger`."""

    def due(self, now_ns: int, last_fired_ns: int | None, nav: NavSample | None) -> int | None: ...
    def fired(self, mono_ns: int, nav: NavSample | None) -> None: ...


class IntervalTrigger:
    """Every `interval_ns`, counted from the previous exposure."""

    def __init__(self, interval_ns: int) -> None:
        self.interval_ns = interval_ns

    def due(self, now_ns: int, last_fired_ns: int | None, nav: NavSample | None) -> int | None:
        """Host time of the next exposure."""
        return now_ns if last_fired_ns is None else last_fired_ns + self.interval_ns

    def fired(self, mono_ns: int, nav: NavSample | None) -> None:
        """Nothing to note."""


class DistanceTrigger:
    """Every `distance_m` over ground, predicted from the last position and velocity.

    Never faster than the camera: `min_interval_ns` is kept between two exposures.
    """

    def __init__(self, distance_m: float, min_interval_ns: int) -> None:
        self.distance_m = distance_m
        self.min_interval_ns = min_interval_ns
        self._origin: tuple[float, float] | None = None

    def due(self, now_ns: int, last_fired_ns: int | None, nav: NavSample | None) -> int | None:
        """Host time at which the distance will be flown; None without a position."""
        if nav is None or nav.position is None:
            return None
        if last_fired_ns is None or self._origin is None:
            return now_ns
        if nav.velocity_ned_mps is None:
            return None
        speed = math.hypot(*nav.velocity_ned_mps[:2])
        if speed < 1.0:
            return None
        flown_m = math.hypot(*east_north_m(self._origin, nav.position))
        left_ns = round((self.distance_m - flown_m) / speed * NANOSECONDS)
        return max(nav.mono_ns + left_ns, last_fired_ns + self.min_interval_ns)

    def fired(self, mono_ns: int, nav: NavSample | None) -> None:
        """Note where the exposure was, from the last position carried forward."""
        if nav is None or nav.position is None:
            return
        ahead_s = (mono_ns - nav.mono_ns) / NANOSECONDS
        velocity = nav.velocity_ned_mps or (0.0, 0.0, None)
        self._origin = place_at(nav.position, velocity[1] * ahead_s, velocity[0] * ahead_s)


def pulse_delays_ns(
    rig: Rig, ground_speed_mps: float, exposure_ns: Mapping[str, int]
) -> dict[str, int]:
    """Delay of every cone's pulse from firing, so that all see one place in mid-exposure.

    Mid-exposures lie at t_i = t_ref - (X_i - X_ref) / v (at one instant for a synchronous rig); a
    pulse starts an exposure, so it comes half of that cone's exposure time earlier. Shifted so
    that the earliest pulse is at zero.

    Args:
        rig: the rig.
        ground_speed_mps: speed over ground.
        exposure_ns: exposure time by cone.

    Raises:
        ValueError: the speed is not positive.
    """
    if rig.timing == "syntopic" and not ground_speed_mps > 0:
        raise ValueError(f"ground speed is {ground_speed_mps} m/s; syntopic exposure needs motion")
    lever_s_per_mm = 1e-3 / ground_speed_mps if rig.timing == "syntopic" else 0.0
    times_ns = {
        cone.name: -round(cone.position_mm[0] * lever_s_per_mm * NANOSECONDS)
        - exposure_ns[cone.name] // 2
        for cone in rig.cones
    }
    earliest = min(times_ns.values())
    return {name: time_ns - earliest for name, time_ns in times_ns.items()}
