"""Which flight logs are final, and with what content: `log/seals.json`.

A log ends in the middle when the service is killed, so its end alone tells nothing. It is sealed
when the flight ends in good order or when the next run begins; what is cut off later is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from daemon.disk import durable
from daemon.disk.flight_log import logs_of
from daemon.disk.level0_folder import hash_file
from daemon.disk.mission import Mission
from daemon.disk.records import Fields, RecordError, canonical_bytes, parse_record

SEALS_FILE = "seals.json"
SEALS_FORMAT = 1


@dataclass(frozen=True)
class LogSeal:
    """Size and hash of a log that nothing is added to any more."""

    nbytes: int
    sha256: str


def seal_logs(mission: Mission) -> list[str]:
    """Seal every log that is not sealed yet; to be called while none is written.

    Returns:
        The names of those sealed now.

    Raises:
        OSError: the disk refused.
    """
    try:
        seals = dict(read_seals(mission))
    except RecordError:
        seals = {}  # a damaged list is made anew
    new = [path for path in logs_of(mission.log_dir) if path.name not in seals]
    if not new:
        return []
    for path in new:
        # A run that was killed leaves bytes that only the kernel has: a power cut after this would
        # take them from under their seal.
        durable.sync_file(path)
    seals |= {path.name: LogSeal(path.stat().st_size, hash_file(path)) for path in new}
    content = {
        "format": SEALS_FORMAT,
        "logs": {name: {"nbytes": s.nbytes, "sha256": s.sha256} for name, s in seals.items()},
    }
    durable.replace_file(mission.log_dir / SEALS_FILE, canonical_bytes(content))
    return [path.name for path in new]


def read_seals(mission: Mission) -> Mapping[str, LogSeal]:
    """Seals by the log's name; none where there is no list.

    Raises:
        RecordError: the list is damaged.
    """
    name = f"log/{SEALS_FILE}"
    try:
        content = parse_record((mission.log_dir / SEALS_FILE).read_bytes(), name)
    except FileNotFoundError:
        return {}
    problems: list[str] = []
    fields = Fields(content, "", name, problems)
    fields.integer("format")
    logs = fields.object("logs")
    seals = {}
    for log in logs.content if logs else {}:
        one = logs.object(log) if logs else None
        if one is not None:
            seals[log] = LogSeal(one.integer("nbytes"), one.sha256("sha256"))
    if problems:
        raise RecordError(problems)
    return seals


def check_logs(mission: Mission, step: Callable[[int], None]) -> list[str]:
    """One sentence for each sealed log that is not as it was; `step` is told bytes read."""
    try:
        seals = read_seals(mission)
    except RecordError as error:
        return list(error.problems)
    problems = []
    for name, seal in seals.items():
        path = mission.log_dir / name
        try:
            nbytes = path.stat().st_size
            if nbytes < seal.nbytes:
                problems.append(
                    f"log {name}: was truncated; {seal.nbytes - nbytes} bytes are missing"
                )
            elif nbytes > seal.nbytes or hash_file(path, step) != seal.sha256:
                problems.append(f"log {name}: was altered after it was sealed")
        except FileNotFoundError:
            problems.append(f"log {name}: is missing")
        except OSError as error:
            problems.append(f"log {name}: cannot be read ({error.strerror})")
    return problems
