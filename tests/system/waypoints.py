"""An autopilot's mission of an emulated flight, and its expected result.

The exposures are ordered over MAVLink, waypoint by waypoint; how long they are is left to the
automatic.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from daemon.planning.model import LocalPlane, Point
from sim_hw.receivers.mavlink_mission import HEADER, LatLon, MissionAutopilot, read_mission
from sim_hw.world.flight import FlightPlan

WAYPOINTS = 4
STEP = 1.5
"""Between waypoints, of the way between exposures: a verdict is there before the next one."""
AHEAD_S = 5.0
DARK = 4.0
"""So much less light than planned are the heads set to at first."""
ACCEPTED = 0
FLOWN_WITHIN_S = 120.0
OFF_PLACE_M = 30.0
"""Half a second's flight, of an autopilot and a service on a busy machine; it is printed."""
BEFORE_M = 3.8
"""The emulated aircraft sways by up to this along its line, about the place at even speed."""
TARGET, FULL_SCALE_DN, BLACK_DN = 0.6, 4095.0, 64.0


def darkened(text: str) -> str:
    """A configuration whose heads expose too short, and may help themselves."""
    text = re.sub(
        r"exposure_time_us = ([\d.]+)", lambda m: f"exposure_time_us = {float(m[1]) / DARK}", text
    )
    return text + '\n[exposure]\ncontrol = "automatic"\nlock = "line"\n'


class Mission:
    """A mission over waypoints to the north, where the emulated aircraft flies."""

    def __init__(self, ready: Mapping[str, Any], port: int) -> None:
        self._started_ns = ready["mono_ns_at_line_start"]
        self._speed_mps = ready["plan"]["ground_speed_mps"]
        self._plane = LocalPlane(Point(FlightPlan.latitude_deg, FlightPlan.longitude_deg))
        first_m = self._north_m(time.monotonic_ns()) + AHEAD_S * self._speed_mps
        step_m = STEP * ready["plan"]["distance_m"]
        self.waypoints_m = [first_m + k * step_m for k in range(WAYPOINTS)]
        self.autopilot = MissionAutopilot(
            read_mission(self._text()), self._place, ("127.0.0.1", port)
        )

    def _north_m(self, mono_ns: int) -> float:
        return (mono_ns - self._started_ns) * 1e-9 * self._speed_mps

    def _place(self, mono_ns: int) -> LatLon:
        point = self._plane.place(0.0, self._north_m(mono_ns))
        return point.latitude_deg, point.longitude_deg

    def _text(self) -> str:
        rows: list[tuple[int, tuple[float, ...]]] = []
        for north_m in self.waypoints_m:
            point = self._plane.place(0.0, north_m)
            rows.append((16, (0, 0, 0, 0, point.latitude_deg, point.longitude_deg, 3000)))
            rows.append((2000, (0, 0, 1, 0, 0, 0, 0)))
        lines = [
            "\t".join([str(k), "0", "3", str(command), *map(repr, values), "1"])
            for k, (command, values) in enumerate(rows)
        ]
        return "\n".join([HEADER, *lines])

    def distance_m(self, records: list[dict[str, Any]]) -> list[float]:
        """How far behind its waypoint each exposure was made."""
        found = []
        for record, north_m in zip(records, self.waypoints_m, strict=True):
            where = record["navigation"]
            point = Point(where["latitude_deg"], where["longitude_deg"])
            found.append(self._plane.flat(point)[1] - north_m)
        return found


def fly_mission(ready: Mapping[str, Any], port: int, service: Any) -> None:
    """Fly the mission; every waypoint must have its exposure, and the light must have come."""
    mission = Mission(ready, port)
    mission.autopilot.start()
    try:
        for number in range(1, WAYPOINTS + 1):
            service.wait_for(
                lambda e, n=number: e["event"] == "processed" and e["number"] == n, FLOWN_WITHIN_S
            )
    finally:
        mission.autopilot.close()
    assert mission.autopilot.results == [ACCEPTED] * WAYPOINTS
    assert len(mission.autopilot.reached) == WAYPOINTS
    commands = [e for e in service.events if e["event"] == "command"]
    assert [(e["name"], e["by"]) for e in commands] == [("trigger", "mavlink 1/1")] * WAYPOINTS
    path = Path(next(e for e in service.events if e["event"] == "mission")["path"])
    folders = [path / f"L0/{number:06d}" for number in range(1, WAYPOINTS + 1)]
    records = [json.loads((folder / "exposure.json").read_text()) for folder in folders]
    distance_m = mission.distance_m(records)
    print(f"exposed behind the waypoints by {[round(m, 1) for m in distance_m]} m")
    assert min(distance_m) > -BEFORE_M and max(distance_m) < OFF_PLACE_M
    _check_brightness(folders, records, service.events)


def _check_brightness(
    folders: list[Path], records: list[dict[str, Any]], events: list[dict[str, Any]]
) -> None:
    """Exposure time, gain and TDI went through the heads' registers, and the pixels followed."""
    frames = [next(f for f in record["frames"] if f["sensor"] == "SU00") for record in records]
    light = [f["exposure_time_us"] * 10 ** (f["settings"]["Gain"] / 20) for f in frames]
    shifts = [f["settings"]["TdiShifts"] for f in frames]
    bright = [_brightness(folder / "SU00.tif") for folder in folders]
    print(f"light {[round(v) for v in light]} us, TDI {shifts}, {[round(b, 2) for b in bright]}")
    assert light[-1] > 1.8 * light[0]
    for k in range(1, len(frames)):
        log_ratio = math.log(bright[k] / bright[0]) - math.log(light[k] / light[0])
        assert abs(log_ratio) < 0.15, "the pixels have the light of the record"
    assert abs(math.log(bright[-1] / TARGET)) < abs(math.log(bright[0] / TARGET))
    settings_events = [
        e for e in events if e["event"] == "exposure-settings" and e["by"] == "automatic"
    ]
    assert settings_events and all(
        e["control"] == "automatic" and e["lock"] == "line" for e in settings_events
    )


def _brightness(path: Path) -> float:
    """The 99th percentile, as a share of the full scale above black."""
    level = float(np.percentile(tifffile.imread(path), 99.0))
    return (level - BLACK_DN) / (FULL_SCALE_DN - BLACK_DN)
