"""A disk that refuses or stalls in the middle of a flight, below everything that writes."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import mkdtemp

import pytest

from daemon.mission.layout import Mission
from daemon.mission.store import durable
from daemon.mission.store.level0_folder import read_sealed
from tests.robustness.crash.invariants import Acknowledged, check_invariants
from tests.robustness.crash.prefixes import ACKS, FLOWN, ROOT
from tests.robustness.crash.scripted_flight import REFUSING_DISK
from tests.robustness.crash.test_prefixes import MEMORY
from tests.robustness.crash.write_log import needs_strace, run_with_faults

pytestmark = needs_strace

EXPOSURES = 6

# The first calls of a thread are those that make the mission; from then on every so many fail.
FAULTS = {
    "frames and records are not synced": ["fsync:error=EIO:when=14+5"],
    "log and index are not synced": ["fdatasync:error=EIO:when=14+5"],
    "the disk is full for frames and records": ["writev:error=ENOSPC:when=5+3"],
    "the disk is full for the index": ["pwrite64:error=ENOSPC:when=60+11"],
    "the disk is full for the log": ["write:error=ENOSPC:when=16+3"],
    "names are refused": ["rename:error=EIO:when=5+3"],
    "everything now and then": [
        "fsync:error=EIO:when=16+11",
        "fdatasync:error=EIO:when=17+13",
        "writev:error=ENOSPC:when=7+7",
        "pwrite64:error=EIO:when=80+37",
        "write:error=EIO:when=20+11",
        "rename:error=ENOSPC:when=7+7",
    ],
}


@pytest.fixture
def folder() -> Iterator[Path]:
    created = Path(mkdtemp(prefix="syntopic-", dir=MEMORY if MEMORY.is_dir() else None))
    yield created
    durable.remove_tree(created)


def fly(folder: Path, faults: list[str], exposures: int) -> tuple[int, Acknowledged, Mission]:
    """How many calls failed, the acknowledgements, and the mission as it landed."""
    program = [sys.executable, "-m", "tests.robustness.crash.scripted_flight", str(folder / FLOWN)]
    command = [*program, str(folder / ACKS), str(exposures), REFUSING_DISK]
    count = run_with_faults(command, faults, folder / "trace", cwd=ROOT)
    acknowledged = Acknowledged()
    for line in (folder / ACKS).read_text().splitlines():
        acknowledged.add_line(line)
    (path,) = (folder / FLOWN).glob("2*")
    return count, acknowledged, Mission.open(path)


IN_CI = ("frames and records are not synced", "everything now and then")


@pytest.mark.parametrize(
    "fault", [pytest.param(f, marks=[] if f in IN_CI else pytest.mark.soak) for f in FAULTS]
)
def test_what_was_acknowledged_on_a_failing_disk_is_there(folder: Path, fault: str) -> None:
    count, acknowledged, mission = fly(folder, FAULTS[fault], EXPOSURES)
    assert count >= 4, "nothing failed"
    assert acknowledged.is_closed, "the flight did not go on to its end"
    states = {}
    for number in mission.numbers():
        record = read_sealed(mission.level0(number))
        states[number] = record.exposure.state if record else "not sealed"
    # Every trigger ends in one record; what was called lost is not on the disk as well.
    assert sorted(states) == list(range(1, 2 * EXPOSURES + 1))
    present = {number for number, state in states.items() if state in ("complete", "degraded")}
    assert present >= acknowledged.stored
    assert set(acknowledged.sealed) == set(states)
    check_invariants(folder / FLOWN, acknowledged, flies_on=True)
    print(json.dumps({"fault": fault, "failed": count, "kept": len(present), "of": len(states)}))


def test_a_disk_that_stalls_for_seconds_costs_time_and_nothing_else(folder: Path) -> None:
    faults = ["fsync:delay_enter=1500000:when=20+40", "fdatasync:delay_enter=1000000:when=15+40"]
    begun_s = time.monotonic()
    count, acknowledged, mission = fly(folder, faults, EXPOSURES)
    assert count >= 3 and time.monotonic() - begun_s > 3.0
    assert acknowledged.is_closed and len(mission.numbers()) == 2 * EXPOSURES
    triggered = set(range(1, 2 * EXPOSURES + 1))
    assert acknowledged.stored == {number for number in triggered if number % 4}
    check_invariants(folder / FLOWN, acknowledged, flies_on=True)
