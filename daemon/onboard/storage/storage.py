"""Storage of the writer process: one disk, or several with the same content.

`MirrorPlan` describes a mission on several disks; `daemon.mission.mirror.mirrored` keeps them
identical.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_seals import close_run, seal_logs
from daemon.mission.mirror.disk_rejoin import RejoinSettings
from daemon.mission.mirror.mirrored import DiskEvent, MirroredStorage
from daemon.mission.store.disk_identity import Disk
from daemon.mission.store.store import Level0Writer


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


def mirrored(
    mission: Mission, plan: MirrorPlan, emit: Callable[[DiskEvent], None]
) -> MirroredStorage:
    """Open a mission that is there on the first disk of the plan."""
    return MirroredStorage(
        mission.id,
        plan.disks,
        stall_s=plan.stall_s,
        rejoin=RejoinSettings(poll_s=plan.poll_s, required_nbytes=plan.required_nbytes),
        emit=emit,
        simulated=mission.is_simulated,
    )
