"""The shortest time between the exposures of a configuration."""

from __future__ import annotations

from daemon.configuration.model import Configuration
from processing.rig import Rig


def exposure_interval_s(configuration: Configuration, rig: Rig) -> float:
    """The shortest time between exposures that the trigger asks for, at the planned speed."""
    trigger = configuration.trigger
    interval_s = trigger.interval_s
    if trigger.distance_m is not None:
        interval_s = trigger.distance_m / configuration.plan.ground_speed_mps
    return max(interval_s, rig.frame_interval_s)
