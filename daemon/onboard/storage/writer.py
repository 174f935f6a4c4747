"""The writer process: Level-0 frames, records, catalog and flight log go to disk here.

It answers *stored* only after the disk has the pixels, and never waits for anything but the disk.
A mission is on one disk, or on several with the same content (`daemon.mission.mirror.mirrored`).
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_seals import close_run, seal_logs
from daemon.mission.mirror.disk_rejoin import RejoinSettings
from daemon.mission.mirror.mirrored import DiskEvent, MirroredStorage
from daemon.mission.store.disk_identity import Disk
from daemon.mission.store.store import Level0Writer
from daemon.onboard.capture.frame_ring import FrameRing
from daemon.onboard.service.messages import (
    AcceptDisk,
    AppendToLog,
    DiskChanged,
    DiskStatus,
    DropDisk,
    EndMission,
    IndexProducts,
    Ping,
    Pong,
    ReleaseDisk,
    Seal,
    Sealed,
    ServiceEvent,
    Stop,
    Store,
    Stored,
    WriteFailed,
    WriteSmallFile,
)
from daemon.onboard.service.processes import ServiceConnection

CHECKS_PER_STALL = 8
"""Checks of a disk within the time after which it is dropped."""

LOG_SYNC_INTERVAL_S = 1.0
"""The flight log is on disk at most this much later than it was handed over (and the writer's
current frame, which may take as long as the disk does)."""


@dataclass(frozen=True)
class MirrorPlan:
    """The disks of a mirrored mission, the leading one first.

    `stall_s` is how long a disk may make no progress before it is dropped, `required_nbytes` what a
    disk needs free to be taken into use.
    """

    disks: tuple[Disk, ...]
    stall_s: float
    required_nbytes: int = 0
    poll_s: float = 5.0


class Storage(Protocol):
    """Where exposures and the flight log go."""

    @property
    def log(self) -> FlightLog: ...
    @property
    def unindexed(self) -> int: ...
    def write(
        self, capture: CaptureRecord, pixels: Mapping[str, NDArray[np.uint16]]
    ) -> tuple[tuple[FrameRecord, ...], tuple[str, ...]]: ...
    def seal(self, exposure: Exposure) -> str: ...
    def note_products(self, number: int, files: Mapping[str, int], verdict: str | None) -> None: ...
    def tick(self) -> None: ...
    def close(self) -> None: ...


def main(
    link: ServiceConnection,
    mission_path: Path,
    rings: tuple[FrameRing, ...],
    mirror: MirrorPlan | None = None,
) -> None:
    """Write until a stop message arrives."""
    mission = Mission.open(mission_path)
    memory = {ring.head: ring for ring in rings}
    if mirror is None:
        _Writer(link, OneDisk(mission), memory).run(LOG_SYNC_INTERVAL_S)
        return
    storage = MirroredStorage(
        mission.id,
        mirror.disks,
        stall_s=mirror.stall_s,
        rejoin=RejoinSettings(poll_s=mirror.poll_s, required_nbytes=mirror.required_nbytes),
        emit=lambda event: link.send(_changed(event)),
        simulated=mission.is_simulated,
    )
    _MirroredWriter(link, storage, memory).run(mirror.stall_s / CHECKS_PER_STALL)
    if storage.is_hanging:
        os._exit(0)  # the interpreter would wait for a thread that hangs in the kernel


class _Writer:
    """Executes the requests of the service in order."""

    def __init__(
        self, link: ServiceConnection, storage: Storage, memory: Mapping[str, FrameRing]
    ) -> None:
        self.link = link
        self.storage = storage
        self._memory = memory
        self._backlog = 0

    def run(self, wait_s: float) -> None:
        """Handle requests until a stop message arrives; `wait_s` is the time-out of each wait."""
        synced = time.monotonic()
        while not isinstance(request := self.link.receive(wait_s), Stop):
            self.handle(request)
            self.storage.tick()
            if (backlog := self.storage.unindexed) != self._backlog:
                self._backlog = backlog
                self.link.send(_index_event(backlog))
            if time.monotonic() - synced >= LOG_SYNC_INTERVAL_S:
                self.storage.log.sync()
                synced = time.monotonic()
        self.storage.close()

    def handle(self, request: object) -> None:
        """Execute one request and answer it."""
        if isinstance(request, Store):
            self.link.send(_store(self.storage, self._memory, request))
        elif isinstance(request, Seal):
            self.link.send(_seal(self.storage, request.exposure))
        elif isinstance(request, IndexProducts):
            # A refusal costs nothing: recovery finds the products when the service starts next.
            with suppress(OSError, DaemonError):
                self.storage.note_products(request.number, request.files, request.verdict)
        elif isinstance(request, AppendToLog):
            self.storage.log.write(request.message)
            if request.is_durable:
                self.storage.log.sync()
        elif isinstance(request, Ping):
            self.link.send(Pong({}))


class _MirroredWriter(_Writer):
    """The writer of two disks, with their own requests."""

    storage: MirroredStorage

    def handle(self, request: object) -> None:
        if isinstance(request, WriteSmallFile):
            self.storage.write_note(request.name, request.data)
        elif isinstance(request, EndMission):
            self.storage.end_mission()
        elif isinstance(request, DropDisk):
            self.storage.drop(request.disk, request.why)
        elif isinstance(request, ReleaseDisk):
            with suppress(DaemonError):  # it was dropped meanwhile
                self.storage.release(request.disk, "as commanded")
        elif isinstance(request, AcceptDisk):
            with suppress(DaemonError):  # it has joined meanwhile
                self.storage.accept(request.disk)
        else:
            super().handle(request)
            if isinstance(request, Ping):
                self.link.send(DiskStatus(self.storage.status))


def _changed(event: DiskEvent) -> DiskChanged:
    return DiskChanged(event.name, event.disk, event.sentence, event.in_use, event.dropped_count)


def _index_event(backlog: int) -> ServiceEvent:
    sentence = (
        f"index or chain.jsonl refused {backlog} changes; data are safe. Check the disk. Retrying"
        if backlog
        else "index and chain.jsonl are up to date again"
    )
    return ServiceEvent(
        {"event": "index", "fault": backlog > 0, "behind": backlog, "sentence": sentence}
    )


def _store(
    storage: Storage, memory: Mapping[str, FrameRing], request: Store
) -> Stored | WriteFailed:
    started = time.monotonic()
    pixels = {
        frame.sensor: memory[frame.sensor].frame(
            request.slots[frame.sensor], frame.height_px, frame.width_px
        )
        for frame in request.capture.frames
    }
    try:
        frames, disks = storage.write(request.capture, pixels)
    except (OSError, DaemonError) as error:
        sentence = f"exposure {request.capture.number} is not stored: {error}; check the disk"
        return WriteFailed(request.capture.number, sentence)
    return Stored(request.capture.number, frames, time.monotonic() - started, disks)


def _seal(storage: Storage, exposure: Exposure) -> Sealed | WriteFailed:
    try:
        return Sealed(exposure.number, storage.seal(exposure))
    except (OSError, DaemonError) as error:
        sentence = f"exposure {exposure.number} is not sealed: {error}; check the disk"
        return WriteFailed(exposure.number, sentence, is_transient=isinstance(error, OSError))


class OneDisk:
    """A mission on one disk, written in the calling thread."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._chain = mission.open_chain()
        self._writer = Level0Writer(mission, chain=self._chain)
        self._seal_logs()  # those of earlier runs; ours is not there yet
        self.log = FlightLog.create(mission.log_dir, simulated=mission.is_simulated)
        with suppress(OSError):  # recovery notes it if the disk refuses
            self._chain.log_begun(self.log.path.name)

    @property
    def unindexed(self) -> int:
        return self._writer.unindexed

    def write(
        self, capture: CaptureRecord, pixels: Mapping[str, NDArray[np.uint16]]
    ) -> tuple[tuple[FrameRecord, ...], tuple[str, ...]]:
        return self._writer.write(capture, pixels), ()

    def seal(self, exposure: Exposure) -> str:
        return self._writer.seal(exposure)

    def note_products(self, number: int, files: Mapping[str, int], verdict: str | None) -> None:
        self._writer.note_products(number, files, verdict)

    def tick(self) -> None:
        """Nothing to do: a single disk is awaited without a time-out."""

    def close(self) -> None:
        self.log.close()
        self._seal_logs()
        if not self._writer.unindexed:
            with suppress(OSError):  # `syntopic repair` closes it if the disk refuses
                close_run(self._mission, self._chain, "landing")
        self._writer.close()
        self._chain.close()

    def _seal_logs(self) -> None:
        # A disk that refuses costs only that a later damage is not seen; the next start seals them.
        with suppress(OSError):
            seal_logs(self._mission, self._chain)
