"""The writer process: Level-0 frames, records, catalog and flight log go to disk here.

It answers *stored* only after the disk has the pixels, and never waits for anything but the disk.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from daemon.errors import DaemonError
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.mirror.mirrored import DiskEvent, MirroredStorage
from daemon.onboard.capture.memory import FrameRing
from daemon.onboard.service.messages import (
    AcceptDisk,
    DiskChanged,
    DiskStatus,
    DropDisk,
    EndMission,
    Log,
    NoteProducts,
    Ping,
    Pong,
    ReleaseDisk,
    Seal,
    Sealed,
    Stop,
    Store,
    Stored,
    Told,
    WriteFailed,
    WriteNote,
)
from daemon.onboard.service.processes import Link
from daemon.onboard.storage.storage import MirrorPlan, OneDisk, Storage, mirrored

LOOKS_PER_STALL = 8
"""How often a disk is looked at within the time after which it is dropped."""

LOG_SYNC_INTERVAL_S = 1.0
"""The flight log is on disk at most this much later than it was handed over (and the writer's
current frame, which may take as long as the disk does)."""


def main(
    link: Link,
    mission_path: Path,
    rings: tuple[FrameRing, ...],
    mirror: MirrorPlan | None = None,
) -> None:
    """Write until told to stop."""
    mission = Mission.open(mission_path)
    memory = {ring.head: ring for ring in rings}
    if mirror is None:
        _Writing(link, OneDisk(mission), memory).run(LOG_SYNC_INTERVAL_S)
        return
    storage = mirrored(mission, mirror, lambda event: link.send(_changed(event)))
    _MirroredWriting(link, storage, memory).run(mirror.stall_s / LOOKS_PER_STALL)
    if storage.is_hanging:
        os._exit(0)  # the interpreter would wait for a thread that hangs in the kernel


class _Writing:
    """Does what the service orders, one order after another."""

    def __init__(self, link: Link, storage: Storage, memory: Mapping[str, FrameRing]) -> None:
        self.link = link
        self.storage = storage
        self._memory = memory
        self._refused = 0

    def run(self, wait_s: float) -> None:
        """Work until told to stop, waiting so long for an order at a time."""
        synced = time.monotonic()
        while not isinstance(order := self.link.receive(wait_s), Stop):
            self.obey(order)
            self.storage.tick()
            if (behind := self.storage.unindexed) != self._refused:
                self._refused = behind
                self.link.send(_told_of_index(behind))
            if time.monotonic() - synced >= LOG_SYNC_INTERVAL_S:
                self.storage.log.sync()
                synced = time.monotonic()
        self.storage.close()

    def obey(self, order: object) -> None:
        """Do what one order says, and answer it."""
        if isinstance(order, Store):
            self.link.send(_store(self.storage, self._memory, order))
        elif isinstance(order, Seal):
            self.link.send(_seal(self.storage, order.exposure))
        elif isinstance(order, NoteProducts):
            # A refusal costs nothing: recovery finds the products when the service starts next.
            with suppress(OSError, DaemonError):
                self.storage.note_products(order.number, order.files, order.verdict)
        elif isinstance(order, Log):
            self.storage.log.write(order.message)
            if order.is_durable:
                self.storage.log.sync()
        elif isinstance(order, Ping):
            self.link.send(Pong({}))


class _MirroredWriting(_Writing):
    """The same on two disks, and what concerns the disks themselves."""

    storage: MirroredStorage

    def obey(self, order: object) -> None:
        if isinstance(order, WriteNote):
            self.storage.write_note(order.name, order.data)
        elif isinstance(order, EndMission):
            self.storage.end_mission()
        elif isinstance(order, DropDisk):
            self.storage.drop(order.disk, order.why)
        elif isinstance(order, ReleaseDisk):
            with suppress(DaemonError):  # it was dropped meanwhile
                self.storage.release(order.disk, "as commanded")
        elif isinstance(order, AcceptDisk):
            with suppress(DaemonError):  # it has joined meanwhile
                self.storage.accept(order.disk)
        else:
            super().obey(order)
            if isinstance(order, Ping):
                self.link.send(DiskStatus(self.storage.status))


def _changed(event: DiskEvent) -> DiskChanged:
    return DiskChanged(event.name, event.disk, event.sentence, event.in_use, event.dropped_count)


def _told_of_index(behind: int) -> Told:
    sentence = (
        f"index or chain.jsonl refused {behind} changes; what they tell of is safe, and they are "
        "tried again; look at the disk"
        if behind
        else "index and chain.jsonl have taken what they had refused"
    )
    return Told({"event": "index", "fault": behind > 0, "behind": behind, "sentence": sentence})


def _store(storage: Storage, memory: Mapping[str, FrameRing], order: Store) -> Stored | WriteFailed:
    started = time.monotonic()
    pixels = {
        frame.sensor: memory[frame.sensor].frame(
            order.slots[frame.sensor], frame.height_px, frame.width_px
        )
        for frame in order.capture.frames
    }
    try:
        frames, disks = storage.write(order.capture, pixels)
    except (OSError, DaemonError) as error:
        sentence = f"exposure {order.capture.number} is not stored: {error}; look at the disk"
        return WriteFailed(order.capture.number, sentence)
    return Stored(order.capture.number, frames, time.monotonic() - started, disks)


def _seal(storage: Storage, exposure: Exposure) -> Sealed | WriteFailed:
    try:
        return Sealed(exposure.number, storage.seal(exposure))
    except (OSError, DaemonError) as error:
        sentence = f"exposure {exposure.number} is not sealed: {error}; look at the disk"
        return WriteFailed(exposure.number, sentence, may_pass=isinstance(error, OSError))
