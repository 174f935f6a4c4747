"""The work of `syntopic pansharpen`: Level-3 of one exposure with the tones of its mission."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.mission.layout import Mission
from daemon.postflight.batch.capacity import PROCESS_NBYTES
from daemon.postflight.batch.executor import BatchTask
from daemon.products import level3
from daemon.products.level3 import MissionTones, PansharpenedExposure
from processing.rig import Rig, load_rig

PIXEL_NBYTES: Final = 14
"""Of one PAN pixel: PAN, four sharpened bands of 16 bits, and a copy of two of them in tiles."""


@dataclass(frozen=True)
class PansharpenWork:
    """What all exposures of a run have in common; it can be pickled."""

    mission: Path
    tones: MissionTones
    images: Sequence[str]
    depths: Sequence[int]
    threads: int = 1

    @property
    def memory_nbytes(self) -> int:
        image = load_rig(Mission(self.mission, self.mission.name).rig_path).virtual_image
        pixels = 0 if image is None else image.width_px * image.height_px
        return PROCESS_NBYTES + PIXEL_NBYTES * pixels

    def open(self) -> PansharpenAction:
        """Read the rig.

        Raises:
            MissionError: no mission in the folder.
            ValueError: a rig that cannot be read.
        """
        import cv2

        cv2.setNumThreads(self.threads)
        mission = Mission.open(self.mission, checks_subfolders=False)
        return PansharpenAction(self, mission, load_rig(mission.rig_path))


class PansharpenAction:
    """Writes Level-3 of one exposure at a time."""

    def __init__(self, work: PansharpenWork, mission: Mission, rig: Rig) -> None:
        self._work, self._mission, self._rig = work, mission, rig

    def clone(self) -> PansharpenAction:
        """The same: it has no buffers."""
        return self

    def __call__(self, task: BatchTask) -> tuple[PansharpenedExposure, float]:
        """The files that were written, and the seconds it took.

        Raises:
            Level3Error: Level-2 is missing or does not fit the rig.
            OSError: the disk refused.
        """
        work, started = self._work, time.monotonic()
        done = level3.pansharpen(
            self._mission,
            self._rig,
            task.number,
            work.tones,
            images=work.images,
            depths=work.depths,
            threads=work.threads,
        )
        return done, time.monotonic() - started
