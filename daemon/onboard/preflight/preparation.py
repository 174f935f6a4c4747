"""From the start of the service to its mission: prerequisites, the worker, and the mission itself.

A start is refused before a new mission exists. `syntopic check` checks the same prerequisites and
builds the same worker (`daemon.onboard.preflight.system_check`).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from pathlib import Path

from daemon.configuration.model import Configuration
from daemon.mission.layout import Mission
from daemon.mission.mirror.mirror_startup import (
    FoundDisks,
    begin_mirrored,
    disks_of,
    interrupted_mission,
    resume_mirrored,
)
from daemon.onboard.preflight.check_results import CheckOutcome
from daemon.onboard.preflight.prerequisites import (
    CHECKS_AFTER_RESTART,
    CHECKS_AT_START,
    prerequisites,
)
from daemon.onboard.preflight.resumption import resume
from daemon.onboard.service.message_dispatcher import Handlers
from daemon.onboard.service.messages import EmitEvent, WorkerBuilt, WorkerRefused
from daemon.onboard.service.startup import create_mission
from processing.rig import Rig


class Preparation:
    """Preparation of the mission.

    `rig` is the rig in use: that of the mission if one is resumed. `interrupted` is the mission to
    resume. `disks` are those of a mirrored mission. `is_built` is true once the worker has its
    pipeline.

    Args:
        configuration: the active configuration.
        rig: the rig that it names.
        config_path: its file.
        emit: emits events.
        fail: called with the reason if the service cannot start.
    """

    def __init__(
        self,
        configuration: Configuration,
        rig: Rig,
        config_path: Path,
        emit: EmitEvent,
        fail: Callable[[str], None],
    ) -> None:
        self._configuration = configuration
        self._config_path = config_path
        self._emit = emit
        self._fail = fail
        self.rig = rig
        self.interrupted: Mission | None = None
        self.disks: FoundDisks | None = None
        self.is_built = False

    async def check(self) -> bool:
        """Check the prerequisites and look for a mission to resume; False if the start is refused.

        Raises:
            MissionError: the marker of the mission being flown is damaged.
            OSError: no disk of a mirrored configuration can be used.
        """
        self.disks = await asyncio.to_thread(disks_of, self._configuration)
        if self.disks is None:
            self.interrupted = interrupted_mission(self._configuration)
        else:
            self.interrupted = self.disks.mission
        checks = CHECKS_AT_START if self.interrupted is None else CHECKS_AFTER_RESTART
        results = await asyncio.to_thread(prerequisites, self._configuration, self.rig, checks)
        for result in results:
            if result.outcome is CheckOutcome.FAIL and not result.is_blocking:
                item, sentence = f"{result.kind} {result.name}", result.sentence
                self._emit("prerequisite", fault=True, item=item, sentence=sentence)
        refusals = [result.sentence for result in results if result.is_blocking]
        for refusal in refusals:
            self._fail(refusal)
        return not refusals and (self.interrupted is None or self._resume(self.interrupted))

    def mission(self) -> Mission | None:
        """The mission that is resumed, else a new one; None where the disk refuses it."""
        create = partial(create_mission, self._configuration, self.rig, self._config_path)
        try:
            if self.disks is not None:
                is_new = self.interrupted is None
                found = self.disks
                self.disks = begin_mirrored(found, create) if is_new else resume_mirrored(found)
                return self.disks.mission
            return create() if self.interrupted is None else self.interrupted
        except OSError as error:
            root = self._configuration.mission.root
            self._fail(f"no mission can be begun in {root} ({error}); check the disk")
            return None

    def _resume(self, mission: Mission) -> bool:
        """Fly on with the rig that the mission's exposures were made with."""
        resumption = resume(mission, self._configuration, self.rig, self._config_path)
        if resumption.refusal:
            self._fail(resumption.refusal)
            return False
        self.rig = resumption.rig
        differences = list(resumption.differences)
        self._emit("resumed", sentence=resumption.sentence, differences=differences)
        return True

    def _on_built(self, _built: WorkerBuilt) -> None:
        self.is_built = True

    def _on_refused(self, refused: WorkerRefused) -> None:
        self._fail(refused.sentence)

    @property
    def handlers(self) -> Handlers:
        """The messages of the worker before the flight."""
        return {WorkerBuilt: self._on_built, WorkerRefused: self._on_refused}
