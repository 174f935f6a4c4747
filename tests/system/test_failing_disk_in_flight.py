"""The disk refuses and stalls in flight: the service survives and keeps acknowledged data."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from daemon.mission.layout import Mission
from daemon.mission.store.level0_folder import read_sealed
from daemon.mission.verification.verification import verify
from tests.robustness.crash.write_log import needs_strace, run_with_faults
from tests.system.demo_mission import ROOT

pytestmark = [
    pytest.mark.system,
    pytest.mark.timeout(400),
    needs_strace,
]

EXPOSURES = 7
REFUSED = ("fsync", "pwrite64")
COUNTED_EVENTS = ("stored", "sealed", "lost")

# Calls are counted in each thread for itself. The mission is made and opened with the first of
# them; the last exposures find a disk that is well again.
FAULTS = (
    "fsync:error=EIO:when=14..17",  # frames and records
    "pwrite64:error=EIO:when=60..63",  # the index
    "fdatasync:delay_enter=2500000:when=6..7",  # the log
    "writev:delay_enter=2500000:when=3",  # frames
)


def test_a_disk_that_refuses_and_stalls_costs_exposures_and_never_the_service(
    tmp_path: Path, scenes: Path
) -> None:
    rig = "ultracam-l-mini"
    arguments = simulator_arguments(rig, tmp_path / "sim", seed=4, dc=0, displace=[])
    address = free_first_address()
    arguments += ["--first-address", address, "--exposures", "8", "--scene-cache", str(scenes)]
    emulator = Emulator([*arguments, "--still"])
    config = tmp_path / "service.toml"
    config.write_text(
        service_toml(emulator.ready, root="missions", count=EXPOSURES, end_when_done=True)
    )
    program = [sys.executable, "-m", "tests.robustness.crash.service", str(config)]
    stdout, trace = tmp_path / "events", tmp_path / "trace"
    try:
        run_with_faults(program, FAULTS, trace, cwd=ROOT, stdout=stdout)
    finally:
        emulator.end()
    calls = trace.read_text().splitlines()
    refused = {name: sum(name in call and "INJECTED" in call for call in calls) for name in REFUSED}
    stalled = sum("DELAYED" in call for call in calls)
    assert min(refused.values()) >= 3 and stalled >= 3, "the disk was well"
    events = [json.loads(line) for line in stdout.read_text().splitlines()]
    kinds = [event["event"] for event in events]
    last_refusal = max(i for i, kind in enumerate(kinds) if kind == "not-written")
    assert "stored" in kinds[last_refusal:], "storing does not go on when the disk is well again"
    assert "index" in kinds
    ended = events[-1]
    counts = ended["ledger"]["triggers"]
    assert ended["event"] == "ended" and ended["failure"] is None
    assert ended["ledger"]["balanced"] and counts["open"] == 0
    assert counts["triggers"] == EXPOSURES
    # Every acknowledgement holds, and each trigger has its record.
    mission = Mission.open(Path(next(e["path"] for e in events if e["event"] == "mission")))
    found = {number: read_sealed(mission.level0(number)) for number in mission.numbers()}
    present = {number for number, record in found.items() if record and record.exposure.frames}
    numbers_by_event = {
        kind: {e["number"] for e in events if e["event"] == kind} for kind in COUNTED_EVENTS
    }
    assert (
        numbers_by_event["stored"] == present
        and len(present) == counts["complete"] + counts["degraded"]
    )
    assert numbers_by_event["sealed"] == numbers_by_event["stored"]
    assert (
        numbers_by_event["sealed"] | numbers_by_event["lost"]
        == set(found)
        == set(range(1, EXPOSURES + 1))
    )
    assert verify(mission).problems == ()
    print(json.dumps({"refused": refused, "stalled": stalled, "kept": len(present), **counts}))
