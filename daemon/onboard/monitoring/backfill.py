"""Earlier exposures of a mission, read from the mission folder.

A service that was killed resumes the same mission, and a monitoring process that ended is started
again. Its clients then receive the complete flight.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from daemon import DaemonError
from daemon.mission.canonical_json import RecordError
from daemon.mission.layout import Mission
from daemon.mission.operator_decisions import read_decisions
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.service.monitoring_link import summary
from daemon.orientation.exterior_orientation import sealed_exposure

BATCH_SIZE = 50
SealedExposure = tuple[dict[str, Any], dict[str, Any] | None]
_log = logging.getLogger(__name__)


async def backfill_exposures(state: FlightState, path: Path, on_batch: Callable[[], None]) -> None:
    """Add what is sealed on disk to the state; it is read in a thread, some at a time.

    `gathered` is called after each part, before the state may forget any of it.
    """
    found = sealed_exposures(path)
    try:
        while part := await asyncio.to_thread(lambda: list(islice(found, BATCH_SIZE))):
            for sealed, report in part:
                state.add_sealed(sealed, report)
            on_batch()
        state.add_decisions(await asyncio.to_thread(read_decisions, path))
        on_batch()
    except (OSError, DaemonError) as error:
        _log.error("earlier exposures of %s could not be loaded: %s", path, error)


def sealed_exposures(path: Path) -> Iterator[SealedExposure]:
    """The summary of each sealed exposure, and its quality report where it has one; by number.

    Raises:
        DaemonError: this is no mission folder.
        OSError: the disk refuses.
    """
    mission = Mission.open(path)
    for number in mission.numbers():
        try:
            exposure = sealed_exposure(mission, number)
        except RecordError:
            continue  # `syntopic verify` reports it
        if exposure is not None:
            yield summary(exposure), _report(mission.level2(number) / "quality.json")


def _report(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None
