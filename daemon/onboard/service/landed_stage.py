"""The time between the end of a flight and the end of the service: actions on the closed mission.

Verification, copy and report run one at a time in a process of their own. Commands and results are
appended to a file in the root of missions, since the flight log is closed.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Final

from daemon.mission.landing_messages import LandingProgress, LandingResult
from daemon.mission.log.log_records import lenient_json_bytes
from daemon.onboard.service.message_dispatcher import Handlers
from daemon.onboard.service.messages import EmitEvent
from daemon.onboard.service.notify import Notifier
from daemon.onboard.service.poweroff import poweroff_problem, request_poweroff
from daemon.onboard.service.supervisor import Supervisor
from daemon.products.processing_threads import thread_counts

JOB: Final = "landing-job"
TARGET: Final = "daemon.postflight.landing_job:main"
AUDIT_FILE: Final = "landing-audit.jsonl"
ACTIONS: Final = ("verify", "copy", "report", "shutdown")
TICK_S: Final = 1.0


class LandedStage:
    """Actions after landing.

    Args:
        supervisor: of the service's processes.
        folders: folders of other disks that a mission may be copied into.
        emit: emits an event.
        notifier: feeds the watchdog of systemd.
    """

    name: ClassVar = JOB

    def __init__(
        self,
        supervisor: Supervisor,
        folders: Sequence[Path],
        emit: EmitEvent,
        notifier: Notifier,
    ) -> None:
        self._notifier = notifier
        self._supervisor = supervisor
        self._folders = {str(folder): folder for folder in folders}
        self._emit = emit
        self._mission: Path | None = None
        self._running: dict[str, Any] | None = None
        self._leaving = asyncio.Event()
        self.is_wanted = False
        """Whether the service stays after landing."""

    @property
    def handlers(self) -> Handlers:
        return {LandingProgress: self._on_progress, LandingResult: self._on_result}

    @property
    def is_entered(self) -> bool:
        """Whether the flight has ended and the service waits for actions."""
        return self._mission is not None

    @property
    def running(self) -> str:
        """The action in progress; empty if there is none."""
        return "" if self._running is None else str(self._running["action"])

    async def stay(
        self,
        mission: Path,
        status: Callable[[], Mapping[str, Any]],
        show: Callable[[Mapping[str, Any]], None],
    ) -> None:
        """Carry out actions until `leave` is called.

        Args:
            mission: the closed mission.
            status: returns the state of the flight.
            show: sends it to watchers, every second.
        """
        self._mission = mission
        self._leaving.clear()
        self._emit(
            "landing",
            folders=list(self._folders),
            poweroff=poweroff_problem(),
            log=str(mission.parent / AUDIT_FILE),
        )
        while not self._leaving.is_set():
            self._notifier.watchdog()
            self._notifier.status("landed; the mission is closed")
            self._supervisor.ping()
            show(status())
            with suppress(TimeoutError):
                async with asyncio.timeout(TICK_S):
                    await self._leaving.wait()
        await self._supervisor.end((JOB,))

    def leave(self) -> None:
        """End the stage; a copy in progress is continued when it is requested again."""
        self.is_wanted = False
        self._leaving.set()

    def request(self, action: str, folder: str | None, by: str) -> str | None:
        """Start an action, or return the reason for its refusal.

        Args:
            action: one of `ACTIONS`.
            folder: one of the configured folders, for `copy`; may be omitted if there is one.
            by: the author.
        """
        if self._mission is None:
            return "the flight has not ended; land first"
        if self._running is not None:
            return f"{self.running} runs, started by {self._running['by']}; wait for its end"
        if action == "shutdown":
            refusal = request_poweroff()
            if refusal is None:
                self._emit_action("shutdown", "done", by, sentence="the computer shuts down")
            return refusal
        target = None
        if action == "copy":
            target, refusal = self._target_of(folder, self._mission)
            if refusal is not None:
                return refusal
        self._running = {"action": action, "by": by}
        self._emit_action(action, "running", by)
        arguments = (action, self._mission, target)
        self._supervisor.spawn(JOB, TARGET, arguments, thread_counts(1))
        return None

    def audit(self, content: Mapping[str, Any]) -> None:
        """Append an entry to the file of commands after landing; it is on the disk at once."""
        if self._mission is None:
            return
        entry = {"utc": datetime.now(UTC).isoformat(), "mission": self._mission.name, **content}
        try:
            with (self._mission.parent / AUDIT_FILE).open("ab") as file:
                file.write(lenient_json_bytes(entry))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            self._emit("disk", fault=True, sentence=f"the command is not recorded: {error}")

    def died(self) -> None:
        """The process of an action ended; without a result the action failed.

        Only now may the next one begin: its process takes the place of this one.
        """
        if self._running is None:
            return
        action, by = self.running, self._running["by"]
        sentence = "the process of the action ended without a result; request it again"
        result = self._running.get("result") or LandingResult(action, False, sentence)
        self._running = None
        state = "done" if result.is_done else "failed"
        self._emit_action(action, state, by, sentence=result.sentence)
        self.audit({"action": action, "state": state, "sentence": result.sentence})

    def _target_of(self, name: str | None, mission: Path) -> tuple[Path | None, str | None]:
        if not self._folders:
            return None, "no folder to copy into is configured ([landing] copy_to)"
        if name is None and len(self._folders) > 1:
            return None, f"copy needs folder, one of {', '.join(self._folders)}"
        folder = self._folders.get(name if name is not None else next(iter(self._folders)))
        if folder is None:
            return None, f"{name} is none of the configured folders: {', '.join(self._folders)}"
        try:
            is_other_disk = folder.is_dir() and folder.stat().st_dev != mission.stat().st_dev
        except OSError as error:
            return None, f"{folder} cannot be read ({error.strerror})"
        if not is_other_disk:
            return None, f"no other disk is mounted at {folder}; mount it and copy again"
        return folder, None

    def _on_progress(self, progress: LandingProgress) -> None:
        if self._running is not None:
            numbers = {"done_bytes": progress.done, "total_bytes": progress.total}
            self._emit_action(progress.action, "running", self._running["by"], **numbers)

    def _on_result(self, result: LandingResult) -> None:
        if self._running is not None:
            self._running["result"] = result

    def _emit_action(self, action: str, state: str, by: str, **content: Any) -> None:
        self._emit("landing-action", action=action, state=state, by=by, **content)
