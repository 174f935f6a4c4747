"""The writer process: Level-0 frames, records, catalog and flight log go to disk here.

It answers *stored* only after the disk has the pixels, and never waits for anything but the disk.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from daemon.disk.chain_file import ChainFile
from daemon.disk.flight_log import FlightLog
from daemon.disk.log_seals import close_run, seal_logs
from daemon.disk.mission import Mission
from daemon.disk.store import Level0Writer
from daemon.errors import DaemonError
from daemon.exposure import Exposure
from daemon.service.memory import FrameRing
from daemon.service.messages import (
    Log,
    NoteProducts,
    Ping,
    Pong,
    Seal,
    Sealed,
    Stop,
    Store,
    Stored,
    Told,
    WriteFailed,
)
from daemon.service.processes import Link

LOG_SYNC_INTERVAL_S = 1.0
"""The flight log is on disk at most this much later than it was handed over (and the writer's
current frame, which may take as long as the disk does)."""


def main(link: Link, mission_path: Path, rings: tuple[FrameRing, ...]) -> None:
    """Write until told to stop."""
    mission = Mission.open(mission_path)
    memory = {ring.head: ring for ring in rings}
    chain = mission.open_chain()
    writer = Level0Writer(mission, chain=chain)
    _seal_logs(mission, chain)  # those of earlier runs; ours is not there yet
    log = FlightLog.create(mission.log_dir, simulated=mission.is_simulated)
    with suppress(OSError):  # recovery notes it if the disk refuses
        chain.log_begun(log.path.name)
    synced = time.monotonic()
    refused = 0
    while not isinstance(order := link.receive(LOG_SYNC_INTERVAL_S), Stop):
        if isinstance(order, Store):
            link.send(_store(writer, memory, order))
        elif isinstance(order, Seal):
            link.send(_seal(writer, order.exposure))
        elif isinstance(order, NoteProducts):
            # A refusal costs nothing: recovery finds the products when the service starts next.
            with suppress(OSError, DaemonError):
                writer.note_products(order.number, order.files, order.verdict)
        elif isinstance(order, Log):
            log.write(order.message)
        elif isinstance(order, Ping):
            link.send(Pong({}))
        if (behind := writer.unindexed) != refused:
            refused = behind
            link.send(_told_of_index(behind))
        if time.monotonic() - synced >= LOG_SYNC_INTERVAL_S:
            log.sync()
            synced = time.monotonic()
    log.close()
    _seal_logs(mission, chain)
    if not writer.unindexed:
        with suppress(OSError):  # `syntopic repair` closes it if the disk refuses
            close_run(mission, chain, "landing")
    writer.close()
    chain.close()


def _seal_logs(mission: Mission, chain: ChainFile) -> None:
    # A disk that refuses costs only that a later damage is not seen; the next start seals them.
    with suppress(OSError):
        seal_logs(mission, chain)


def _told_of_index(behind: int) -> Told:
    sentence = (
        f"index or chain.jsonl refused {behind} changes; what they tell of is safe, and they are "
        "tried again; look at the disk"
        if behind
        else "index and chain.jsonl have taken what they had refused"
    )
    return Told({"event": "index", "fault": behind > 0, "behind": behind, "sentence": sentence})


def _store(
    writer: Level0Writer, memory: Mapping[str, FrameRing], order: Store
) -> Stored | WriteFailed:
    started = time.monotonic()
    pixels = {
        frame.sensor: memory[frame.sensor].frame(
            order.slots[frame.sensor], frame.height_px, frame.width_px
        )
        for frame in order.capture.frames
    }
    try:
        frames = writer.write(order.capture, pixels)
    except (OSError, DaemonError) as error:
        sentence = f"exposure {order.capture.number} is not stored: {error}; look at the disk"
        return WriteFailed(order.capture.number, sentence)
    return Stored(order.capture.number, frames, time.monotonic() - started)


def _seal(writer: Level0Writer, exposure: Exposure) -> Sealed | WriteFailed:
    try:
        return Sealed(exposure.number, writer.seal(exposure))
    except (OSError, DaemonError) as error:
        sentence = f"exposure {exposure.number} is not sealed: {error}; look at the disk"
        return WriteFailed(exposure.number, sentence, may_pass=isinstance(error, OSError))
