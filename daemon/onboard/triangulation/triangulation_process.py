"""The process of the live triangulation: below capture and pipeline, and dispensable.

It runs with the lowest priority and limited memory. It reads what is on disk, so that one started
again takes in the exposures so far. Errors end it; the service reports that and starts it again.
"""

from __future__ import annotations

import math
import os
import queue
import resource
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from daemon import DaemonError
from daemon.configuration.model import TriangulationSection
from daemon.mission.layout import Mission
from daemon.onboard.live_orthomosaic.live_orthomosaic import warm_up
from daemon.onboard.live_orthomosaic.mission_map import MissionMap
from daemon.onboard.service.messages import (
    FinishTriangulation,
    Ping,
    Pong,
    ServiceEvent,
    Stop,
    TriangulateExposure,
    TriangulationFinished,
    UseMission,
)
from daemon.onboard.service.processes import ServiceConnection
from daemon.onboard.triangulation.findings import CUT_OFF, NOT_SEALED
from daemon.onboard.triangulation.live_record import summary_json, write_live
from daemon.onboard.triangulation.mission_triangulation import (
    ExposureTriangulated,
    MissionTriangulation,
)
from daemon.orientation.exterior_orientation import sealed_exposure
from daemon.orientation.navigation_sigmas import navigation_sigmas
from daemon.products.processing_threads import configure_threads
from processing.pipelines.live_triangulation import LiveSettings

NICENESS: Final = 19
OOM_SCORE: Final = 1000
"""Of 1000: the kernel ends this process before any other of the service."""
ADDING_SHARE: Final = 0.5
"""Of the time for landing in which exposures are still added; the rest is for the adjustment."""
_WAIT_S: Final = 1.0


@dataclass
class _Landing:
    """Until when exposures are added, monotonic; without a landing, for ever."""

    until_s: float = math.inf

    @property
    def is_over(self) -> bool:
        return time.monotonic() > self.until_s


def main(link: ServiceConnection, mission: Path, section: TriangulationSection) -> None:
    """Triangulate exposures until a stop message arrives."""
    lower_priority(section.memory_max_mb)
    configure_threads()
    tasks: queue.Queue[object] = queue.Queue()
    landing = _Landing()
    thread = threading.Thread(
        target=lambda: _Work(link, mission, section, tasks, landing).run(),
        name="triangulation",
        daemon=True,
    )
    thread.start()
    # Pings are answered here: an adjustment takes seconds, on a busy machine minutes.
    while not isinstance(message := link.receive(timeout_s=_WAIT_S), Stop):
        if not thread.is_alive():
            sys.exit(1)  # its trace is printed; the service starts the process again
        if isinstance(message, Ping):
            link.send(Pong({}))
        elif message is not None:
            if isinstance(message, FinishTriangulation):
                landing.until_s = time.monotonic() + ADDING_SHARE * section.landing_timeout_s
            tasks.put(message)


def lower_priority(memory_max_mb: int) -> None:
    """Run when nothing else wants the processor, in limited memory; what the machine refuses is
    skipped."""
    with suppress(OSError):
        os.nice(NICENESS)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE), "ascii")
    limit = memory_max_mb * 1_000_000
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


class _Work:
    def __init__(
        self,
        link: ServiceConnection,
        mission: Path,
        section: TriangulationSection,
        tasks: queue.Queue[object],
        landing: _Landing,
    ) -> None:
        self._link, self._tasks, self._landing = link, tasks, landing
        folder = Mission(mission, mission.name)
        settings = LiveSettings(images_max=section.exposures_max)
        sigmas = navigation_sigmas(section)
        self._map: MissionMap | None = None
        try:
            self._done: MissionTriangulation | None = MissionTriangulation(
                folder, settings, sigmas, control=section.control_points
            )
        except (OSError, DaemonError) as error:
            self._done = None
            self._failed(str(error))
            return
        if section.orthomosaic:
            warm_up()
            self._map = MissionMap(
                self._done, lambda event: self._link.send(ServiceEvent(event)),
                section.orthomosaic_gsd_m, self._report,
            )  # fmt: skip

    def run(self) -> None:
        if self._done is not None:
            mission = self._done.mission
            for number in mission.numbers():
                if (mission.level2(number) / "pan.tif").exists():
                    self._triangulate(self._done, number)
        while True:
            task = self._tasks.get()
            if isinstance(task, UseMission) and self._done is not None:
                self._done.mission = Mission(task.mission, task.mission.name)
                if self._map is not None:
                    self._map.use_mission()
            elif isinstance(task, TriangulateExposure) and self._done is not None:
                self._triangulate(self._done, task.number)
            elif isinstance(task, FinishTriangulation):
                self._finish()

    def _triangulate(self, done: MissionTriangulation, number: int) -> None:
        if self._landing.is_over:
            if not done.has(number):
                done.skipped.setdefault(number, CUT_OFF)
            return
        try:
            exposure = sealed_exposure(done.mission, number)
        except (OSError, DaemonError, ValueError) as error:
            done.skipped[number] = f"its record cannot be read ({error})"
            return
        if exposure is None:
            done.skipped[number] = NOT_SEALED
            return
        blocks = done.block_count
        one = done.add(exposure)
        if done.block_count != blocks:
            if self._map is not None:
                self._map.block_adjusted()
            self._write(done)
            self._emit("triangulation", **summary_json(done))
        self._emit_exposure(one)

    def _emit_exposure(self, one: ExposureTriangulated) -> None:
        content: dict[str, Any] = {
            "number": one.number,
            "reason": one.reason,
            "behind": self._tasks.qsize(),
            "seconds": round(one.seconds, 3),
        }
        if one.orientation is not None:
            sigma = one.orientation.covariance.diagonal() ** 0.5
            content |= {
                "source": one.orientation.source,
                "tie_points": one.orientation.ties,
                "sigma_m": [round(float(v), 4) for v in sigma[:3]],
            }
        self._emit("triangulated", **content)

    def _finish(self) -> None:
        begun = time.monotonic()
        written = False
        if self._done is not None:
            for number in [n for n, why in self._done.skipped.items() if why == NOT_SEALED]:
                self._triangulate(self._done, number)
            self._done.land()
            written = self._write(self._done)
            self._emit("triangulation", **summary_json(self._done))
            if self._map is not None:
                written &= self._map.deliver()
        self._link.send(TriangulationFinished(time.monotonic() - begun, written))

    def _write(self, done: MissionTriangulation) -> bool:
        try:
            write_live(done)
        except (OSError, ValueError) as error:
            self._failed(f"its files cannot be written: {error}")
            return False
        return True

    def _failed(self, why: str) -> None:
        sentence = (
            f"The live triangulation failed: {why}. Capture goes on. Run `syntopic triangulate "
            "MISSION --live` after landing."
        )
        self._report(sentence)

    def _report(self, sentence: str) -> None:
        self._emit("triangulation-failed", fault=True, sentence=sentence)

    def _emit(self, event: str, **content: Any) -> None:
        self._link.send(ServiceEvent({"event": event, **content}))
