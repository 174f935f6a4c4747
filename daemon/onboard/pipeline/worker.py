"""The pipeline worker: Level-0 in, Level-2 products and a verdict out.

It reads an exposure from shared memory while it is still there, else from disk; it never makes the
capture wait. A few exposures are in work at a time (`daemon.onboard.pipeline.lanes`).
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.configuration.model import MountSection, PlanSection
from daemon.errors import DaemonError
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.store import level2, store
from daemon.onboard.capture.memory import FrameRing
from daemon.onboard.pipeline.lanes import Lanes
from daemon.onboard.service.messages import (
    Begin,
    FramesRead,
    Judged,
    Ping,
    Pong,
    Process,
    Processed,
    ProcessFailed,
    Settled,
    Stop,
    UseMission,
    WorkerBuilt,
    WorkerReady,
    WorkerRefused,
    WorkerSettings,
)
from daemon.onboard.service.processes import Link
from daemon.orientation.exterior import exposures_of, mount_of
from daemon.orientation.ground import Ground, ground_of
from daemon.planning.overlaps import Overlaps, Surroundings
from daemon.products.conditions import capture_flags, conditions_of
from daemon.products.processor import Processor, build_processor, histograms_of, make_products
from daemon.products.reports import Made
from processing.quality.judgement import judge
from processing.quality.report import Flag, as_json
from processing.rig import Rig, find_rig

SWITCH_INTERVAL_S = 0.001
"""How long one thread may hold the interpreter while another waits to enter a kernel."""
SETTLED_WITHIN_S = 3600.0
"""A disk that refuses a record is asked again and again; its products wait as long as that."""


def main(link: Link, settings: WorkerSettings, rings: tuple[FrameRing, ...]) -> None:
    """Process until told to stop."""
    started = time.monotonic()
    settle_threads()
    try:
        processor = build(settings)
    except (OSError, ValueError, ArithmeticError, MemoryError, DaemonError) as error:
        link.send(WorkerRefused(f"no images can be made with this configuration: {error}"))
        return
    link.send(WorkerBuilt())
    begin = _wait_for_begin(link)
    if begin is None:
        return
    processor.warm_up()
    if begin.mission is None:
        link.send(WorkerReady(time.monotonic() - started))
        _wait_for_begin(link)
        return
    rig, mission = processor.rig, Mission.open(begin.mission)
    lanes = Lanes[Processor](processor, settings.processing.exposures_in_work)
    mount, _ = mount_of(mission)
    plan = settings.plan
    overlaps, ground = overlaps_of(mission, rig), ground_of(rig, mount, plan)
    desk = _Desk(link, rig, mission, mount, plan, rings, overlaps, ground)
    link.send(WorkerReady(time.monotonic() - started))
    in_work: set[Future[None]] = set()
    while not isinstance(order := link.receive(timeout_s=1.0), Stop):
        if isinstance(order, Ping):
            link.send(Pong({}))
        elif isinstance(order, Process):
            # Here and not in a lane: the overlaps of one exposure follow from those before it.
            surroundings = desk.surroundings_of(order.exposure)
            desk.begin(order)
            in_work.add(lanes.submit(partial(desk.process, order, surroundings)))
        elif isinstance(order, Settled):
            desk.settle(order)
        elif isinstance(order, UseMission):
            desk.mission = Mission(order.mission, order.mission.name)
        done = {future for future in in_work if future.done()}
        in_work -= done
        for future in done:
            future.result()  # a fault of our own ends the process, and the service says so
    desk.settle_all()
    lanes.end()


def build(settings: WorkerSettings) -> Processor:
    """The pipeline of a configuration, with its calibrations.

    Raises:
        OSError, ValueError, DaemonError: it cannot be built; the sentence says why.
    """
    rig = find_rig(settings.rig)
    return build_processor(rig, settings.processing, settings.radiometry, settings.plan_file)


def _wait_for_begin(link: Link) -> Begin | None:
    """The order to begin; None where the service ends before."""
    while not isinstance(order := link.receive(timeout_s=1.0), Stop):
        if isinstance(order, Begin):
            return order
        if isinstance(order, Ping):
            link.send(Pong({}))
    return None


def settle_threads() -> None:
    """Let threads take turns, and sleep where they wait; call it before the first kernel runs.

    OpenMP's threads spin by default, which takes the core from the exposure beside them.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def overlaps_of(mission: Mission, rig: Rig) -> Overlaps:
    """The footprints of what has been flown of a mission, as far as its records can be read."""
    mount, plan = mount_of(mission)
    overlaps = Overlaps(rig, mount, plan.ground_height_m)
    # Verification names what cannot be read; no flight is given up for an overlap.
    for exposure in exposures_of(mission).results.values():
        overlaps.add(exposure)
    return overlaps


def process_exposure(
    processor: Processor,
    mission: Mission,
    mount: MountSection,
    plan: PlanSection,
    exposure: Exposure,
    frames: Mapping[str, NDArray[np.uint16]],
    flags: Flag = Flag(0),  # noqa: B008 - an immutable value
    *,
    surroundings: Surroundings | None = None,
    ground: Ground | None = None,
    frames_read: Callable[[], None] | None = None,
) -> tuple[dict[str, Any], Mapping[str, int]]:
    """Make the images of one exposure and write its Level-2 folder.

    Returns:
        The content of quality.json, and the files written with their sizes in bytes.
    """
    conditions = conditions_of(exposure, processor.rig, plan, flags, surroundings, ground=ground)
    report, contents = make_products(
        processor, mount, plan, exposure, frames, conditions, frames_read=frames_read
    )
    return report, level2.write_folder(mission.level2(exposure.number), contents)


def report_unprocessed(rig: Rig, exposure: Exposure, flags: Flag) -> dict[str, Any]:
    """The quality report of an exposure that has no image: what capture knows of it."""
    known = capture_flags(exposure, rig) | flags | Flag.NOT_PROCESSED
    if exposure.simulated:
        known |= Flag.SIMULATED
    missing = [sensor for sensor, _ in exposure.missing]
    report = as_json(judge({}, capture_flags=known, missing_sensors=missing))
    return {**report, "exposure": exposure.number}


@dataclass
class _Desk:
    """What every exposure needs on its way through a lane.

    `mission` changes where another disk leads; each exposure asks for it when it reads or writes.
    """

    link: Link
    rig: Rig
    mission: Mission
    mount: MountSection
    plan: PlanSection
    rings: tuple[FrameRing, ...]
    overlaps: Overlaps
    ground: Ground | None
    unsettled: dict[int, SimpleQueue[tuple[Exposure, Surroundings] | None]] = field(
        default_factory=dict
    )

    def begin(self, order: Process) -> None:
        """An exposure goes into a lane; one that is not sealed yet will be heard of again."""
        if not order.is_sealed:
            self.unsettled[order.exposure.number] = SimpleQueue()

    def settle(self, settled: Settled) -> None:
        """The record of an exposure in work is final, or will never be."""
        if (outcome := self.unsettled.get(settled.number)) is None:
            return  # it could not be processed, and said so
        record = settled.exposure
        outcome.put(None if record is None else (record, self.surroundings_of(record)))

    def settle_all(self) -> None:
        """The end: what is not sealed by now is not waited for."""
        for outcome in list(self.unsettled.values()):
            outcome.put(None)

    def surroundings_of(self, exposure: Exposure) -> Surroundings:
        """The overlaps of an exposure; call it in the order they were made."""
        self.overlaps.add(exposure)
        return self.overlaps.of(exposure.number)

    def process(self, order: Process, surroundings: Surroundings, lane: Processor) -> None:
        """Process one exposure and say what became of it."""
        started = time.monotonic()
        exposure = order.exposure
        flags = Flag(0)
        try:
            if order.slots is None:
                flags |= Flag.PROCESSING_BEHIND
                frames = store.load_level0(self.mission.level0(exposure.number), self.rig)[0]
            else:
                frames = self._frames_in_memory(exposure, order.slots)
            histograms = histograms_of(self.rig, frames)
            made = self._make(order.exposure, frames, flags, surroundings, lane)
            if not order.is_sealed:
                waits_since = time.monotonic()
                settled = self.unsettled[exposure.number].get(timeout=SETTLED_WITHIN_S)
                started += time.monotonic() - waits_since
                if settled is None:
                    return
                if settled[0] != exposure:
                    # Its mark was another's: what was told is told anew.
                    exposure = settled[0]
                    frames = store.load_level0(self.mission.level0(exposure.number), self.rig)[0]
                    made = self._make(exposure, frames, flags, settled[1], lane)
            report, contents = made
            files = level2.write_folder(self.mission.level2(exposure.number), contents)
        except (OSError, ValueError, ArithmeticError, np.linalg.LinAlgError, Empty) as error:
            sentence = (
                f"exposure {exposure.number} was stored but not processed: {error}; "
                f"run syntopic process {self.mission.path} after landing"
            )
            report = report_unprocessed(self.rig, exposure, flags)
            self.link.send(ProcessFailed(exposure.number, sentence, report))
            return
        finally:
            self.unsettled.pop(exposure.number, None)
        seconds = time.monotonic() - started
        self.link.send(Processed(exposure.number, report, files, seconds, histograms))

    def _make(
        self,
        exposure: Exposure,
        frames: Mapping[str, NDArray[np.uint16]],
        flags: Flag,
        surroundings: Surroundings,
        lane: Processor,
    ) -> Made:
        """The products of an exposure; its verdict is told before they are written."""
        conditions = conditions_of(
            exposure, self.rig, self.plan, flags, surroundings, ground=self.ground
        )
        made = make_products(
            lane,
            self.mount,
            self.plan,
            exposure,
            frames,
            conditions,
            frames_read=partial(self.link.send, FramesRead(exposure.number)),
        )
        self.link.send(Judged(exposure.number, made[0]))
        return made

    def _frames_in_memory(
        self, exposure: Exposure, slots: Mapping[str, int]
    ) -> dict[str, NDArray[np.uint16]]:
        memory = {ring.head: ring for ring in self.rings}
        return {
            frame.sensor: memory[frame.sensor].frame(
                slots[frame.sensor], frame.height_px, frame.width_px
            )
            for frame in exposure.frames
        }
