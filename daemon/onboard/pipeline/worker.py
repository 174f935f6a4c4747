"""The pipeline worker: Level-0 in, Level-2 products and a verdict out.

It reads an exposure from shared memory if its frames are still there, else from disk. It never
delays capture. Several exposures are processed at a time (`daemon.onboard.pipeline.pipeline_pool`).
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
from daemon.onboard.capture.frame_ring import FrameRing
from daemon.onboard.pipeline.pipeline_pool import PipelinePool
from daemon.onboard.service.messages import (
    BeginProcessing,
    FramesRead,
    Ping,
    Pong,
    Process,
    Processed,
    ProcessFailed,
    RecordFinalized,
    Stop,
    UseMission,
    VerdictReady,
    WorkerBuilt,
    WorkerReady,
    WorkerRefused,
    WorkerSettings,
)
from daemon.onboard.service.processes import ServiceConnection
from daemon.orientation.exterior_orientation import mount_of, sealed_exposures
from daemon.orientation.ground_model import GroundModel, ground_of
from daemon.planning.overlaps import Overlaps, OverlapShares
from daemon.products.exposure_conditions import capture_flags, conditions_of
from daemon.products.processor import Processor, build_processor, histograms_of, make_products
from daemon.products.product_files import ProductFiles
from processing.quality.evaluation import evaluate
from processing.quality.report import Flag, as_json
from processing.rig import Rig, find_rig

SWITCH_INTERVAL_S = 0.001
"""How long one thread may hold the interpreter while another waits to enter a kernel."""
FINALIZE_TIMEOUT_S = 3600.0
"""How long products wait for a record that the disk refuses; the writer retries it."""


def main(link: ServiceConnection, settings: WorkerSettings, rings: tuple[FrameRing, ...]) -> None:
    """Process exposures until a stop message arrives."""
    started = time.monotonic()
    configure_threads()
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
    pool = PipelinePool[Processor](processor, settings.processing.parallel_exposures)
    mount, _ = mount_of(mission)
    plan = settings.plan
    overlaps, ground = overlaps_of(mission, rig), ground_of(rig, mount, plan)
    context = WorkerContext(link, rig, mission, mount, plan, rings, overlaps, ground)
    link.send(WorkerReady(time.monotonic() - started))
    in_progress: set[Future[None]] = set()
    while not isinstance(message := link.receive(timeout_s=1.0), Stop):
        if isinstance(message, Ping):
            link.send(Pong({}))
        elif isinstance(message, Process):
            # Not in a thread of the pool: overlaps depend on the preceding exposures.
            overlap_shares = context.overlap_shares_of(message.exposure)
            context.begin(message)
            in_progress.add(pool.submit(partial(context.process, message, overlap_shares)))
        elif isinstance(message, RecordFinalized):
            context.finalize(message)
        elif isinstance(message, UseMission):
            context.mission = Mission(message.mission, message.mission.name)
        done = {future for future in in_progress if future.done()}
        in_progress -= done
        for future in done:
            future.result()  # an internal error ends the process; the service reports it
    context.abandon_pending()
    pool.end()


def build(settings: WorkerSettings) -> Processor:
    """The pipeline of a configuration, with its calibrations.

    Raises:
        OSError, ValueError, DaemonError: it cannot be built; the message states why.
    """
    rig = find_rig(settings.rig)
    return build_processor(rig, settings.processing, settings.radiometry, settings.plan_file)


def _wait_for_begin(link: ServiceConnection) -> BeginProcessing | None:
    """The message to begin; None if the service ends first."""
    while not isinstance(message := link.receive(timeout_s=1.0), Stop):
        if isinstance(message, BeginProcessing):
            return message
        if isinstance(message, Ping):
            link.send(Pong({}))
    return None


def configure_threads() -> None:
    """Let threads take turns, and sleep where they wait; call it before the first kernel runs.

    OpenMP's threads spin by default, which takes the core from the exposures processed in parallel.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def overlaps_of(mission: Mission, rig: Rig) -> Overlaps:
    """The footprints of what has been flown of a mission, as far as its records can be read."""
    mount, plan = mount_of(mission)
    overlaps = Overlaps(rig, mount, plan.ground_height_m)
    # Verification names what cannot be read; no flight is given up for an overlap.
    for exposure in sealed_exposures(mission).results.values():
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
    overlap_shares: OverlapShares | None = None,
    ground: GroundModel | None = None,
    frames_read: Callable[[], None] | None = None,
) -> tuple[dict[str, Any], Mapping[str, int]]:
    """Make the images of one exposure and write its Level-2 folder.

    Returns:
        The content of quality.json, and the files written with their sizes in bytes.
    """
    conditions = conditions_of(exposure, processor.rig, plan, flags, overlap_shares, ground=ground)
    report, contents = make_products(
        processor, mount, plan, exposure, frames, conditions, frames_read=frames_read
    )
    return report, level2.write_folder(mission.level2(exposure.number), contents)


def report_unprocessed(rig: Rig, exposure: Exposure, flags: Flag) -> dict[str, Any]:
    """The quality report of an exposure that has no image: what capture knows of it."""
    known_flags = capture_flags(exposure, rig) | flags | Flag.NOT_PROCESSED
    if exposure.simulated:
        known_flags |= Flag.SIMULATED
    missing = [sensor for sensor, _ in exposure.missing]
    report = as_json(evaluate({}, capture_flags=known_flags, missing_sensors=missing))
    return {**report, "exposure": exposure.number}


@dataclass
class WorkerContext:
    """Shared state of the exposures in the pipeline.

    `mission` changes when another disk becomes the leading one; it is looked up at each read and
    write.
    """

    link: ServiceConnection
    rig: Rig
    mission: Mission
    mount: MountSection
    plan: PlanSection
    rings: tuple[FrameRing, ...]
    overlaps: Overlaps
    ground: GroundModel | None
    provisional_records: dict[int, SimpleQueue[tuple[Exposure, OverlapShares] | None]] = field(
        default_factory=dict
    )

    def begin(self, message: Process) -> None:
        """Begin an exposure; for an unsealed one a `RecordFinalized` follows."""
        if not message.is_sealed:
            self.provisional_records[message.exposure.number] = SimpleQueue()

    def finalize(self, finalized: RecordFinalized) -> None:
        """Pass on the final record of an exposure in progress, or None if there is none."""
        if (outcome := self.provisional_records.get(finalized.number)) is None:
            return  # it could not be processed, which was reported
        record = finalized.exposure
        outcome.put(None if record is None else (record, self.overlap_shares_of(record)))

    def abandon_pending(self) -> None:
        """At the end: do not wait for records that are not sealed."""
        for outcome in list(self.provisional_records.values()):
            outcome.put(None)

    def overlap_shares_of(self, exposure: Exposure) -> OverlapShares:
        """The overlaps of an exposure; call it in the order they were made."""
        self.overlaps.add(exposure)
        return self.overlaps.of(exposure.number)

    def process(
        self, message: Process, overlap_shares: OverlapShares, processor: Processor
    ) -> None:
        """Process one exposure and send the result."""
        started = time.monotonic()
        exposure = message.exposure
        flags = Flag(0)
        try:
            if message.slots is None:
                flags |= Flag.PROCESSING_BEHIND
                frames = store.load_level0(self.mission.level0(exposure.number), self.rig)[0]
            else:
                frames = self._frames_in_memory(exposure, message.slots)
            histograms = histograms_of(self.rig, frames)
            products = self._compute_products(
                message.exposure, frames, flags, overlap_shares, processor
            )
            if not message.is_sealed:
                wait_started = time.monotonic()
                finalized = self.provisional_records[exposure.number].get(
                    timeout=FINALIZE_TIMEOUT_S
                )
                started += time.monotonic() - wait_started
                if finalized is None:
                    return
                if finalized[0] != exposure:
                    # Its mark was reassigned: compute and report the products again.
                    exposure = finalized[0]
                    frames = store.load_level0(self.mission.level0(exposure.number), self.rig)[0]
                    products = self._compute_products(
                        exposure, frames, flags, finalized[1], processor
                    )
            report, contents = products
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
            self.provisional_records.pop(exposure.number, None)
        seconds = time.monotonic() - started
        self.link.send(Processed(exposure.number, report, files, seconds, histograms))

    def _compute_products(
        self,
        exposure: Exposure,
        frames: Mapping[str, NDArray[np.uint16]],
        flags: Flag,
        overlap_shares: OverlapShares,
        processor: Processor,
    ) -> ProductFiles:
        """The products of an exposure; the verdict is sent before they are written."""
        conditions = conditions_of(
            exposure, self.rig, self.plan, flags, overlap_shares, ground=self.ground
        )
        products = make_products(
            processor,
            self.mount,
            self.plan,
            exposure,
            frames,
            conditions,
            frames_read=partial(self.link.send, FramesRead(exposure.number)),
        )
        self.link.send(VerdictReady(exposure.number, products[0]))
        return products

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
