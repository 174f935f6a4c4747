"""The pipeline worker: Level-0 in, Level-2 products and a verdict out.

It reads an exposure from shared memory if its frames are still there, else from disk. It never
delays capture. Several exposures are processed at a time (`daemon.products.pipeline_pool`).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.store import level2, store
from daemon.mission.store.publication import StagedFolder
from daemon.onboard.capture.frame_ring import FrameRing
from daemon.onboard.service.messages import (
    BeginProcessing,
    FramesRead,
    Ping,
    Pong,
    Process,
    Processed,
    ProcessFailed,
    ProductsStaged,
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
from daemon.orientation.exterior_orientation import mount_of
from daemon.orientation.ground_model import ground_of
from daemon.planning.overlaps import Overlaps, OverlapShares, overlaps_of
from daemon.products.exposure_products import (
    ExposureProducts,
    FlightGeometry,
    make_products,
    report_unprocessed,
)
from daemon.products.pipeline_pool import PipelinePool
from daemon.products.processing_threads import configure_threads
from daemon.products.processor import Processor, build_processor
from processing.quality.report import Flag
from processing.rig import Rig, find_rig

FAILURES = (OSError, ValueError, ArithmeticError, np.linalg.LinAlgError)
"""Errors that cost an exposure its products; the frames are stored."""


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
    geometry = FlightGeometry(mount, settings.plan, ground_of(rig, mount, settings.plan))
    context = WorkerContext(link, rig, mission, geometry, rings, overlaps_of(mission, rig))
    link.send(WorkerReady(time.monotonic() - started))
    in_progress: set[Future[None]] = set()
    while not isinstance(message := link.receive(timeout_s=1.0), Stop):
        if isinstance(message, Ping):
            link.send(Pong({}))
        elif isinstance(message, Process):
            # Not in a thread of the pool: overlaps depend on the preceding exposures.
            overlap_shares = context.overlap_shares_of(message.exposure)
            in_progress.add(pool.submit(partial(context.process, message, overlap_shares)))
        elif isinstance(message, RecordFinalized):
            # In a thread of the pool: a slow disk must not delay the answer to a ping.
            in_progress.add(pool.submit(partial(_finalize, context, message)))
        elif isinstance(message, UseMission):
            context.mission = Mission(message.mission, message.mission.name)
        done = {future for future in in_progress if future.done()}
        in_progress -= done
        for future in done:
            future.result()  # an internal error ends the process; the service reports it
    pool.end()
    context.drop_staged()


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


def _finalize(context: WorkerContext, message: RecordFinalized, _processor: Processor) -> None:
    context.finalize(message)


@dataclass(frozen=True)
class _StagedProducts:
    """Products on disk without their final name, and the message that follows publication."""

    exposure: Exposure
    flags: Flag
    folder: StagedFolder
    done: Processed


@dataclass
class WorkerContext:
    """Shared state of the exposures in the pipeline.

    Products of an unsealed exposure are staged: on disk, without their final name. They occupy no
    processor. `mission` changes when another disk becomes the leading one; it is looked up at each
    read and write.
    """

    link: ServiceConnection
    rig: Rig
    mission: Mission
    geometry: FlightGeometry
    rings: tuple[FrameRing, ...]
    overlaps: Overlaps
    _staged: dict[int, _StagedProducts] = field(default_factory=dict)
    _finalized: dict[int, bool] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def finalize(self, finalized: RecordFinalized) -> None:
        """Publish or drop products that wait for their record, or that will be computed soon."""
        number, is_confirmed = finalized.number, finalized.is_confirmed
        with self._lock:
            staged = self._staged.pop(number, None)
            if staged is None:
                self._finalized[number] = is_confirmed
        if staged is not None:
            self._end(staged, is_confirmed=is_confirmed)

    def drop_staged(self) -> None:
        """At the end: remove products whose record is not sealed."""
        for staged in self._staged.values():
            staged.folder.close()

    def overlap_shares_of(self, exposure: Exposure) -> OverlapShares:
        """The overlaps of an exposure; call it in the order they were made."""
        self.overlaps.add(exposure)
        return self.overlaps.of(exposure.number)

    def process(
        self, message: Process, overlap_shares: OverlapShares, processor: Processor
    ) -> None:
        """Process one exposure; publish its products if its record is sealed, else stage them."""
        started = time.monotonic()
        exposure = message.exposure
        flags = Flag(0)
        try:
            if message.slots is None:
                flags |= Flag.PROCESSING_BEHIND
                frames = store.load_level0(self.mission.level0(exposure.number), self.rig)[0]
            else:
                frames = self._frames_in_memory(exposure, message.slots)
            products = self._compute_products(exposure, frames, flags, overlap_shares, processor)
            folder = StagedFolder(self.mission.level2(exposure.number))
            try:
                files = level2.write_files(folder.part, products.contents)
            except BaseException:
                folder.close()
                raise
        except FAILURES as error:
            self._report_failure(exposure, flags, error)
            return
        seconds = time.monotonic() - started
        done = Processed(exposure.number, products.report, files, seconds, products.histograms)
        staged = _StagedProducts(exposure, flags, folder, done)
        if message.is_sealed:
            self._end(staged, is_confirmed=True)
        else:
            self._stage(staged)

    def _stage(self, staged: _StagedProducts) -> None:
        number = staged.exposure.number
        with self._lock:
            is_confirmed = self._finalized.pop(number, None)
            if is_confirmed is None:
                self._staged[number] = staged
        if is_confirmed is None:
            self.link.send(ProductsStaged(number))
        else:
            self._end(staged, is_confirmed=is_confirmed)

    def _end(self, staged: _StagedProducts, *, is_confirmed: bool) -> None:
        with closing(staged.folder) as folder:
            if not is_confirmed:
                return
            try:
                if folder.final != self.mission.level2(staged.exposure.number):
                    raise OSError("the leading disk changed before its products were published")
                folder.publish()
            except OSError as error:
                self._report_failure(staged.exposure, staged.flags, error)
                return
        self.link.send(staged.done)

    def _report_failure(self, exposure: Exposure, flags: Flag, error: Exception) -> None:
        sentence = (
            f"exposure {exposure.number} was stored but not processed: {error}; "
            f"run syntopic process {self.mission.path} after landing"
        )
        report = report_unprocessed(self.rig, exposure, flags)
        self.link.send(ProcessFailed(exposure.number, sentence, report))

    def _compute_products(
        self,
        exposure: Exposure,
        frames: Mapping[str, NDArray[np.uint16]],
        flags: Flag,
        overlap_shares: OverlapShares,
        processor: Processor,
    ) -> ExposureProducts:
        """The products of an exposure; the verdict is sent before they are written."""
        products = make_products(
            processor,
            self.geometry,
            exposure,
            frames,
            flags,
            overlap_shares,
            frames_read=partial(self.link.send, FramesRead(exposure.number)),
        )
        self.link.send(VerdictReady(exposure.number, products.report))
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
