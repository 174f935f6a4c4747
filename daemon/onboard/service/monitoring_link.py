"""The service's side of monitoring: events to the watch process, which may die without harm.

Events are buffered and finally dropped; the service never waits. What watchers see and how commands
come in is in `daemon.onboard.monitoring`.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from daemon.mission.exposure import Exposure, TemperatureRecord, navigation_to_json
from daemon.mission.store.disk_space import DiskCapacity
from daemon.onboard.flight.fault_latches import DELIVERING, FIXED, SEARCHING, UNAVAILABLE
from daemon.onboard.service.guidance_feed import GuidanceFeed
from daemon.onboard.service.messages import Answer, ServiceEvent
from daemon.onboard.service.startup import ProcessPlan
from daemon.onboard.service.supervisor import PAGE, Supervisor
from daemon.onboard.timing.gps_clock import GpsEstimate
from drivers.contract import NavSample

_LOG = logging.getLogger(__name__)
NAME = PAGE
RESTART_S = 3.0
"""How long after its death the process is started again."""
BACKLOG_MAX = 1000
"""Events kept for a process that is busy, as it is while it starts; the oldest are dropped."""


class MonitoringLink:
    """Sends events to the watch process, if there is one.

    Events that do not fit into the socket are buffered and sent before the next one, at the latest
    with the status of every second. `dropped` counts those that were never sent.
    """

    def __init__(self, supervisor: Supervisor, plan: ProcessPlan | None) -> None:
        self._supervisor = supervisor
        self._plan = plan
        self._persistent: dict[str, Mapping[str, Any]] = {}
        self.faults: Callable[[], Sequence[Mapping[str, Any]]] = tuple
        """Events that report previous faults to a restarted process."""
        self._backlog: deque[ServiceEvent] = deque()
        self.dropped = 0
        self.restarts = 0

    def start(self) -> None:
        if self._plan is not None:
            self._supervisor.spawn(*self._plan)
            for event in list(self._persistent.values()):
                self.emit(event)
            for event in self.faults():
                self.emit(event)

    def emit(self, event: Mapping[str, Any]) -> None:
        """Send an event. Persistent events (mission, devices, counters, exposure settings,
        actions after landing) are sent again to a restarted process."""
        key = _persistent_key(event)
        if key is not None:
            self._persistent[key] = event
        if self._plan is None:
            return
        self._backlog.append(ServiceEvent(event))
        if len(self._backlog) > BACKLOG_MAX:
            self._backlog.popleft()
            self.dropped += 1
        while self._backlog and self._try_send(self._backlog[0]):
            self._backlog.popleft()

    def emit_latest(self, event: Mapping[str, Any]) -> None:
        """Send an event that the next one replaces; it is dropped where others wait."""
        if self._plan is not None and not self._backlog:
            self._try_send(ServiceEvent(event))

    def _try_send(self, message: ServiceEvent) -> bool:
        try:
            return self._supervisor.try_send(NAME, message)
        except ValueError as error:
            self.dropped += 1
            _LOG.warning("event %s is not shown to watchers: %s", message.event.get("event"), error)
            return True

    def answer(self, answer: Answer) -> None:
        self._supervisor.try_send(NAME, answer)

    def died(self) -> None:
        """Restart the process after `RESTART_S`; the flight continues."""
        self.restarts += 1
        self._backlog.clear()
        asyncio.get_running_loop().call_later(RESTART_S, self.start)


_STATES = DELIVERING | UNAVAILABLE | {SEARCHING, FIXED}
"""Device events that state a new state of the device."""


def _persistent_key(event: Mapping[str, Any]) -> str | None:
    """Key of a persistent event, None for others; a later event of the same key replaces it."""
    kind = event.get("event")
    if kind in ("mission", "exposure-settings", "counters", "landing"):
        return str(kind)
    if kind == "landing-action":
        return f"{kind} {event.get('action')}"
    if kind == "bound" or (kind == "device" and event.get("name") in _STATES):
        return f"{kind} {event.get('device')}"
    return None


def status_event(
    *,
    phase: str,
    ledger: Mapping[str, Any],
    disk: DiskCapacity,
    exposures_planned: int | None,
    position: NavSample | None,
    temperatures_c: Mapping[str, float | None],
    time_now: GpsEstimate | None,
    queue: int,
    missing: Sequence[str],
    disks: Sequence[Mapping[str, Any]] = (),
    absent: Sequence[str] = (),
    guidance: GuidanceFeed | None = None,
) -> dict[str, Any]:
    """The state of the flight that is sent every second, as plain JSON types.

    Args:
        disk: free space of the mission's disk.
        exposures_planned: exposures that are still planned; None without a planned number.
        time_now: GPS time at this moment, or None before it is known.
        queue: exposures waiting for the pipeline.
        missing: the missing prerequisites, with their actions.
        disks: those of a mirrored mission.
        absent: absent devices and data, as text.
        guidance: lines and deviations of a flight with a plan.
    """
    now_ns = time.monotonic_ns()
    where = None
    if position is not None:
        where = {
            "receiver": position.receiver,
            "latitude_deg": position.latitude_deg,
            "longitude_deg": position.longitude_deg,
            "height_m": position.height_m,
            "velocity_ned_mps": position.velocity_ned_mps and list(position.velocity_ned_mps),
            "heading_rad": position.heading_rad,
            "fix": position.fix,
            "satellites": position.satellites,
            "age_s": round((now_ns - position.mono_ns) * 1e-9, 3),
        }
    return {
        "event": "status",
        "mono_ns": str(now_ns),
        "phase": phase,
        "ledger": {key: value for key, value in ledger.items() if key != "heads"},
        "exposures_left": disk.exposures,
        "exposures_planned": exposures_planned,
        "disk_free_bytes": disk.free_nbytes,
        "disk_seconds": None if disk.seconds is None else round(disk.seconds, 1),
        "exposure_bytes": disk.exposure_nbytes,
        "is_disk_low": disk.is_low,
        "position": where,
        "temperatures_c": dict(temperatures_c),
        "clock_sigma_ns": None if time_now is None else time_now.sigma_ns,
        "gps_ns": None if time_now is None else str(time_now.gps_ns),
        "clock_source": None if time_now is None else time_now.source,
        "in_holdover": time_now is not None and time_now.in_holdover,
        "clock_coasting_s": None if time_now is None else round(time_now.coasting_ns * 1e-9, 1),
        "queue": queue,
        "missing": list(missing),
        **({"disks": [dict(disk) for disk in disks]} if disks else {}),
        "absent": list(absent),
        **_guidance_status(guidance),
    }


def _guidance_status(guidance: GuidanceFeed | None) -> dict[str, Any]:
    if guidance is None:
        return {}
    return {"lines": guidance.lines, "deviations": guidance.deviations}


def present_temperatures_c(
    readings: Iterable[TemperatureRecord], max_age_s: float
) -> dict[str, float | None]:
    """By probe; None where the last reading is too old to be shown as the present one."""
    return {t.probe: t.value_c if t.age_ns * 1e-9 <= max_age_s else None for t in readings}


def summary(exposure: Exposure) -> dict[str, Any]:
    """Content of the event of a sealed exposure, as plain JSON types."""
    navigation = exposure.navigation
    return {
        "number": exposure.number,
        "state": exposure.state,
        "frames": len(exposure.frames),
        "missing": [sensor for sensor, _ in exposure.missing],
        "mark_gps_ns": None if exposure.mark_gps_ns is None else str(exposure.mark_gps_ns),
        "mark_sigma_ns": exposure.mark_sigma_ns,
        "mark_source": exposure.mark_source,
        "temperatures_c": {t.probe: t.value_c for t in exposure.temperatures},
        "height_m": navigation.height_m if navigation else None,
        "navigation": navigation_to_json(navigation) if navigation else None,
        "line": exposure.line_id,
        "strip": exposure.strip_id,
    }
