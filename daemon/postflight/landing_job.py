"""Verification, copy or report of a closed mission, in a process of the service.

The service names this module; it does not import it. A killed copy is continued by the next one.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from daemon import DaemonError
from daemon.mission.landing_messages import LandingProgress, LandingResult
from daemon.mission.layout import Mission

PROGRESS_EVERY_S = 0.5
POLL_S = 60.0
PROBLEMS_SHOWN = 3


class JobLink(Protocol):
    """Connection to the service."""

    def send(self, message: object) -> None: ...
    def receive(self, timeout_s: float) -> object | None: ...


def main(link: JobLink, action: str, mission: Path, folder: Path | None) -> None:
    """Carry out an action and send its progress and its result.

    Args:
        link: connection to the service; any message of the service ends the process.
        action: `verify`, `copy` or `report`.
        mission: the closed mission.
        folder: target of a copy.
    """
    threading.Thread(target=_end_on_message, args=(link,), daemon=True).start()
    report_progress = _throttled(link, action)
    try:
        result = run_action(action, mission, folder, report_progress)
    except (DaemonError, OSError) as error:
        result = LandingResult(action, False, str(error))
    link.send(result)


def run_action(
    action: str, mission: Path, folder: Path | None, progress: Callable[[int, int], None]
) -> LandingResult:
    """Carry out an action.

    Args:
        action: `verify`, `copy` or `report`.
        mission: the mission.
        folder: target of a copy.
        progress: called with bytes done and bytes in total.

    Returns:
        The result, as a sentence.

    Raises:
        DaemonError: the mission or the target permits no such action.
        OSError: a disk refused.
    """
    if action == "verify":
        return _verified(Mission.open(mission, checks_subfolders=False), progress)
    if action == "copy" and folder is not None:
        return _copied(Mission.open(mission), folder, progress)
    return _reported(Mission.open(mission))


def _verified(mission: Mission, progress: Callable[[int, int], None]) -> LandingResult:
    from daemon.mission.store import store

    report = store.verify(mission, progress)
    counts = f"{report.exposures} exposures and {report.frames} frames are verified"
    if not report.problems:
        return LandingResult("verify", True, f"{counts}; nothing is wrong")
    listed = "; ".join(report.problems[:PROBLEMS_SHOWN])
    more = len(report.problems) - PROBLEMS_SHOWN
    rest = f"; {more} more: run syntopic verify {mission.path}" if more > 0 else ""
    return LandingResult("verify", False, f"{counts}; {listed}{rest}")


def _copied(mission: Mission, folder: Path, progress: Callable[[int, int], None]) -> LandingResult:
    from daemon.mission.transfer.transfer import transfer

    report = transfer(mission, folder, progress=progress)
    sentence = (
        f"{report.copied} files copied, {report.already_present} identical files unchanged, "
        f"{report.nbytes / 1e9:.2f} GB in all; {report.verified.exposures} exposures and "
        f"{report.verified.frames} frames verified in {report.target}"
    )
    return LandingResult("copy", True, sentence)


def _reported(mission: Mission) -> LandingResult:
    from daemon.postflight.mission_report import write_report

    with mission.held():
        written = write_report(mission.path)
    if not written.failures:
        return LandingResult("report", True, f"the report is {written.path}")
    unread = len(written.failures)
    sentence = (
        f"the report is {written.path}; {unread} files could not be read and are listed in it"
    )
    return LandingResult("report", False, sentence)


def _throttled(link: JobLink, action: str) -> Callable[[int, int], None]:
    last_s = -PROGRESS_EVERY_S

    def report(done: int, total: int) -> None:
        nonlocal last_s
        now_s = time.monotonic()
        if now_s - last_s >= PROGRESS_EVERY_S:
            last_s = now_s
            link.send(LandingProgress(action, done, total))

    return report


def _end_on_message(link: JobLink) -> None:
    """End the process when the service asks for it; the service being gone ends it, too."""
    while link.receive(POLL_S) is None:
        pass
    os._exit(1)
