"""MAVLink commands as requests: the request, and the command of the service that executes it.

Numbers in, names out; authorization is in `daemon.onboard.monitoring.mavlink.camera`.
Source: the MAVLink camera protocol v2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

REQUESTS: Mapping[int, str | None] = {
    512: None,
    521: "CAMERA_INFORMATION",
    522: "CAMERA_SETTINGS",
    525: "STORAGE_INFORMATION",
    527: "CAMERA_CAPTURE_STATUS",
    2002: "CAMERA_IMAGE_CAPTURED",
}
BY_IDENTITY: Mapping[int | None, str] = {
    259: "CAMERA_INFORMATION",
    260: "CAMERA_SETTINGS",
    261: "STORAGE_INFORMATION",
    262: "CAMERA_CAPTURE_STATUS",
    263: "CAMERA_IMAGE_CAPTURED",
}
ACTIONS: Mapping[int, str] = {
    203: "once",
    206: "distance",
    214: "interval",
    530: "mode",
    2000: "capture",
    2001: "stop",
    2003: "control",
}


def service_command(action: str, message: Any) -> tuple[str, dict[str, Any]] | None:
    """The service's command for a MAVLink one; None if its parameters are invalid."""
    if action == "stop":
        return "stop", {}
    if action == "once":
        return "trigger", {}
    if action == "capture":
        count = as_integer(message.param3)
        interval_s = as_finite(message.param2)
        if count is None or count < 0:
            return None
        if count == 1:
            return "trigger", {}
        if interval_s is None or interval_s <= 0:
            return None
        return "interval", {"interval_s": interval_s, "count": count}
    if action == "distance":
        distance_m = as_finite(message.param1)
        if distance_m is None or distance_m < 0:
            return None
        return ("distance", {"distance_m": distance_m}) if distance_m > 0 else ("stop", {})
    if action == "interval":
        interval_ms = as_finite(message.param1)
        if interval_ms is None or interval_ms == 0:
            return None
        if interval_ms < 0:
            return "stop", {}
        return "interval", {"interval_s": interval_ms / 1000, "count": 0}
    enabled = as_integer(message.param1)  # 2003 DO_TRIGGER_CONTROL
    if enabled not in (0, 1):
        return None
    return ("start", {}) if enabled else ("stop", {})


def as_integer(value: float) -> int | None:
    """A parameter as an integer; None otherwise, such as NaN."""
    return int(value) if math.isfinite(value) and abs(value) < 2**31 else None


def as_finite(value: float) -> float | None:
    """A parameter as a number; None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None
