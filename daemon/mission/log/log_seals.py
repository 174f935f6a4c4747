"""Which flight logs are final, and with what content; and the line that ends a run.

A log ends in the middle when the service is killed, so its end alone proves nothing. It is sealed
in `chain.jsonl` when the flight ends normally or when the next run begins; what is cut off
later is noticed. Missions of format 1 were sealed in `log/seals.json`, which is still read.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing

from pydantic import BaseModel

from daemon.mission.canonical_json import RecordError, parse_record, plain_name
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of
from daemon.mission.operator_decisions import DECISIONS_FILE
from daemon.mission.record_types import Count, read_record
from daemon.mission.store import durable
from daemon.mission.store.level0_folder import hash_file
from daemon.mission.verification.chain_file import ChainFile, LogSeal

SEALS_FILE = "seals.json"
CHANGING_FILES = ("overrides.json", DECISIONS_FILE)
"""Files that a running service may still replace; the closing line has their hashes."""


def seal_logs(mission: Mission, chain: ChainFile | None = None) -> list[str]:
    """Seal every log that is not sealed yet; to be called while none is written.

    Args:
        mission: it must be held by the caller.
        chain: its chain file; opened here if omitted.

    Returns:
        The names of those sealed now.

    Raises:
        OSError: the disk refused.
    """
    if chain is None:
        with closing(mission.open_chain()) as chain:
            return seal_logs(mission, chain)
    try:
        earlier = read_seals(mission)
    except RecordError:
        earlier = {}
    new = [
        path
        for path in logs_of(mission.log_dir)
        if path.name not in chain.sealed_logs and plain_name(path.name)
    ]
    for path in new:
        # A run that was killed leaves bytes that only the kernel has: a power cut after this would
        # take them from under their seal.
        durable.sync_file(path)
        seal = earlier.get(path.name) or LogSeal(path.stat().st_size, hash_file(path))
        chain.log_begun(path.name)
        chain.log_sealed(path.name, seal)
    return [path.name for path in new if path.name not in earlier]


def close_run(mission: Mission, chain: ChainFile, by: str) -> bool:
    """Write the closing line, after everything else of a run.

    Args:
        mission: it must be held by the caller.
        chain: its chain file.
        by: "landing" or "repair".

    Returns:
        Whether it was needed.

    Raises:
        OSError: the disk refused.
    """
    present = [name for name in CHANGING_FILES if (mission.path / name).is_file()]
    return chain.close_run(by, {name: hash_file(mission.path / name) for name in present})


class _SealList(BaseModel):
    format: Count
    logs: dict[str, LogSeal] = {}


def read_seals(mission: Mission) -> Mapping[str, LogSeal]:
    """Seals of a mission of format 1 by the log's name; none where there is no list.

    Raises:
        RecordError: the list is damaged.
    """
    name = f"log/{SEALS_FILE}"
    try:
        content = parse_record((mission.log_dir / SEALS_FILE).read_bytes(), name)
    except FileNotFoundError:
        return {}
    return read_record(_SealList, content, name).logs
