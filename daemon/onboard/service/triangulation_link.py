"""The service's side of the live triangulation: exposures to its process, which may die.

Nothing waits for the process in flight. Numbers of exposures that do not fit into its connection
are retained and sent later.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Final

from daemon.configuration.model import TriangulationSection
from daemon.onboard.service.message_dispatcher import Handlers
from daemon.onboard.service.messages import (
    EmitEvent,
    FinishTriangulation,
    TriangulateExposure,
    TriangulationFinished,
    UseMission,
)
from daemon.onboard.service.supervisor import Supervisor
from daemon.onboard.triangulation.exposure_ranges import ranges
from daemon.products.processing_threads import thread_counts

TARGET: Final = "daemon.onboard.triangulation.triangulation_process:main"
RESTARTS_MAX: Final = 3
RESTART_S: Final = 5.0
RETRY_S: Final = 0.2


class TriangulationLink:
    """Starts the process, if it is configured, and passes exposures with products to it.

    Args:
        supervisor: of the service's processes.
        section: its configuration.
        emit: emits an event.
    """

    name: ClassVar = "triangulation"

    def __init__(
        self, supervisor: Supervisor, section: TriangulationSection, emit: EmitEvent
    ) -> None:
        self._supervisor = supervisor
        self._section = section
        self._emit = emit
        self._mission: Path | None = None
        self._pending: deque[object] = deque()
        self._processed: dict[int, None] = {}
        self._triangulated: set[int] = set()
        self._finished = asyncio.Event()
        self.restarts = 0
        self.is_running = False
        self._is_written = False
        self._has_landed = False

    @property
    def handlers(self) -> Handlers:
        return {TriangulationFinished: self._on_finished}

    def start(self, mission: Path) -> None:
        """Start the process for a mission; nothing if it is switched off."""
        self._mission = mission
        if not self._section.enabled:
            return
        arguments = (mission, self._section)
        self._pending.clear()  # a process that starts reads from disk what was so far
        self._supervisor.spawn(self.name, TARGET, arguments, thread_counts(1))
        self.is_running = True

    def note(self, event: Mapping[str, Any]) -> None:
        """Pass on the exposure that an event of the service reports products of."""
        if not self.is_running:
            return
        if event.get("event") == "processed":
            number = int(event["number"])
            self._processed[number] = None
            self._pending.append(TriangulateExposure(number))
        elif event.get("event") == "triangulated":
            self._triangulated.add(int(event["number"]))
        self.send_pending()

    def use_mission(self, mission: Path) -> None:
        """Another disk is the leading one."""
        self._mission = mission
        if self.is_running:
            self._pending.append(UseMission(mission))
            self.send_pending()

    def send_pending(self) -> None:
        """Send what was retained, as far as it does not block."""
        while self._pending and self._supervisor.try_send(self.name, self._pending[0]):
            self._pending.popleft()

    def died(self) -> None:
        """The process ended by itself: it is started again, a limited number of times."""
        self.is_running = False
        self._finished.set()
        self.restarts += 1
        is_last = self.restarts > RESTARTS_MAX
        what = (
            "It is not started again."
            if is_last
            else f"It is started again in {RESTART_S:g} s and takes in all exposures."
        )
        self._emit(
            "triangulation-failed",
            fault=True,
            sentence=f"The process of the live triangulation ended. Capture goes on. {what} Run "
            "`syntopic triangulate MISSION --live` after landing.",
        )
        if not is_last:
            asyncio.get_running_loop().call_later(RESTART_S, self._start_again)

    async def land(self, *, adjusts: bool = True) -> bool:
        """Have the block adjusted a last time, wait for it, and end the process.

        Args:
            adjusts: false ends the process at once.

        Returns:
            Whether its files are complete; also true if it is switched off.
        """
        if not self._section.enabled:
            return True
        is_done = await self._finish() if adjusts else False
        if adjusts and not is_done:
            self._emit(
                "triangulation-failed",
                fault=True,
                sentence="The live triangulation was not complete "
                f"{self._section.landing_timeout_s:g} s after landing{self._left_out()}. Run "
                "`syntopic triangulate MISSION --live`.",
            )
        self._has_landed, self.is_running = True, False
        await self._supervisor.end((self.name,))
        return is_done

    async def _finish(self) -> bool:
        """Wait for the last adjustment, at most `landing_timeout_s`."""
        if not self.is_running:
            return False
        self._finished.clear()
        self._pending.append(FinishTriangulation())
        try:
            async with asyncio.timeout(self._section.landing_timeout_s):
                while not self._finished.is_set():
                    self.send_pending()
                    await _until_set(self._finished, RETRY_S)
        except TimeoutError:
            return False
        return self.is_running and self._is_written

    def _left_out(self) -> str:
        """Exposures with products that the process did not report, as text."""
        left = [number for number in self._processed if number not in self._triangulated]
        return f"; exposures {ranges(left)} are not in its orientations" if left else ""

    def _on_finished(self, done: TriangulationFinished) -> None:
        self._is_written = done.is_written
        self._finished.set()

    def _start_again(self) -> None:
        if self._mission is not None and not self._has_landed:
            self.start(self._mission)


async def _until_set(event: asyncio.Event, seconds: float) -> None:
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return
