"""What of a mission was exposed before this process began, read from the mission folder.

A service that was killed goes on in the same mission, a watch process that died is started again;
whoever watches then is told of the whole flight all the same.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from daemon.errors import DaemonError
from daemon.mission.layout import Mission
from daemon.mission.records import RecordError
from daemon.onboard.monitoring.state import FlightState
from daemon.onboard.service.watching import summary
from daemon.orientation.exterior import exposure_of

READ_AT_ONCE = 50
Earlier = tuple[dict[str, Any], dict[str, Any] | None]
_log = logging.getLogger(__name__)


async def remember(state: FlightState, path: Path, gathered: Callable[[], None]) -> None:
    """Add what is sealed on disk to the state; it is read in a thread, some at a time.

    `gathered` is called after each part, before the state may forget any of it.
    """
    found = earlier_exposures(path)
    try:
        while part := await asyncio.to_thread(lambda: list(islice(found, READ_AT_ONCE))):
            for sealed, report in part:
                state.add_earlier(sealed, report)
            gathered()
    except (OSError, DaemonError) as error:
        _log.error("earlier exposures of %s cannot be told: %s", path, error)


def earlier_exposures(path: Path) -> Iterator[Earlier]:
    """The summary of each sealed exposure, and its quality report where it has one; by number.

    Raises:
        DaemonError: this is no mission folder.
        OSError: the disk refuses.
    """
    mission = Mission.open(path)
    for number in mission.numbers():
        try:
            exposure = exposure_of(mission, number)
        except RecordError:
            continue  # `syntopic verify` tells of it
        if exposure is not None:
            yield summary(exposure), _report(mission.level2(number) / "quality.json")


def _report(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None
