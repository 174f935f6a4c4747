"""The service killed at random instants of one running flight, over and over."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from tests.system.demo_mission import ROOT, syntopic
from tests.system.test_faults_in_flight import read_events

pytestmark = [pytest.mark.system, pytest.mark.timeout(400)]

EXPOSURES_PER_RUN = 1
RUN_LIMIT_S = 60.0


def kill_in_flight(
    folder: Path, scenes: Path, kills: int, seed: int, *, every: int, scene: int = 8
) -> dict[str, object]:
    """Kill a flight so often; every so many lives one lives until it has stored something.

    What was reported stored, sealed or triggered is compared with the disk at the end; the ledger
    and `syntopic verify` as well, and what the logs hold of every life is replayed. `scene` is how
    many exposures of ground the emulator builds, `scenes` where it keeps them.
    """
    rng = random.Random(seed)
    rig = "ultracam-l-mini"
    arguments = simulator_arguments(rig, folder / "sim", seed=4, dc=0, displace=[])
    address = free_first_address()
    arguments += ["--first-address", address, "--exposures", str(scene)]
    emulator = Emulator([*arguments, "--scene-cache", str(scenes), "--still"])
    config = folder / "service.toml"
    config.write_text(service_toml(emulator.ready, root="missions"))
    numbers_by_event: dict[str, set[int]] = {"triggered": set(), "stored": set(), "sealed": set()}
    missions: set[str] = set()
    in_flight = 0
    begun_s = time.monotonic()
    try:
        for run_number in range(1, kills + 1):
            is_long = run_number % every == 0
            in_flight += _run_and_kill(config, rng, numbers_by_event, missions, is_long=is_long)
        (mission,) = missions
        seconds = round(time.monotonic() - begun_s, 1)
        # Landing at once: recovery has the last word.
        last = _start(config)
        ended = {}
        for event in read_events(last):
            if event["event"] == "mission":
                last.send_signal(signal.SIGTERM)
            elif event["event"] == "ended":
                ended = event
        assert last.wait(30) == 0
    finally:
        emulator.end()
    assert ended["ledger"]["balanced"], ended["ledger"]["imbalances"]
    records = {
        record["number"]: record
        for path in Path(mission, "L0").glob("*/exposure.json")
        if (record := json.loads(path.read_text()))
    }
    present = {number for number, record in records.items() if record["frames"]}
    assert numbers_by_event["stored"] and numbers_by_event["stored"] <= present
    assert numbers_by_event["sealed"] <= records.keys()
    assert ended["ledger"]["triggers"]["triggers"] == len(records)
    verified = syntopic("verify", mission, "--json")
    assert verified.returncode == 0, verified.stdout
    replayed = syntopic("replay", mission, "--records-only", "--json")
    assert replayed.returncode == 0, replayed.stdout
    figures = {
        "kills": kills,
        "killed in flight": in_flight,
        "triggered": len(numbers_by_event["triggered"]),
        "stored": len(numbers_by_event["stored"]),
        "records": len(records),
        "kept": len(present),
        "seconds": seconds,
    }
    print(json.dumps(figures))
    return figures


def _run_and_kill(
    config: Path,
    rng: random.Random,
    numbers_by_event: dict[str, set[int]],
    missions: set[str],
    *,
    is_long: bool,
) -> bool:
    """One life; whether it had given a trigger when it was killed."""
    service = _start(config)
    killer = threading.Timer(
        RUN_LIMIT_S if is_long else rng.uniform(0.3, 2.0), service.send_signal, [signal.SIGKILL]
    )
    killer.start()
    stored = 0
    was_in_flight = False
    for event in read_events(service):
        kind = event["event"]
        if kind == "mission":
            missions.add(event["path"])
        elif kind in numbers_by_event:
            numbers_by_event[kind].add(event["number"])
            was_in_flight = True
            stored += kind == "stored"
        if is_long and stored == EXPOSURES_PER_RUN:
            killer.cancel()
            threading.Timer(rng.uniform(0.0, 0.3), service.send_signal, [signal.SIGKILL]).start()
            is_long = False
    killer.cancel()
    service.wait(10)
    return was_in_flight


def _start(config: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.robustness.crash.service", str(config)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def test_25_kills_lose_nothing_that_was_acknowledged(tmp_path: Path, scenes: Path) -> None:
    figures = kill_in_flight(tmp_path, scenes, 25, 1, every=4)
    assert figures["kills"] == 25 and int(str(figures["killed in flight"])) >= 6


@pytest.mark.soak
@pytest.mark.timeout(7200)
def test_500_kills_lose_nothing_that_was_acknowledged(tmp_path: Path, scenes: Path) -> None:
    figures = kill_in_flight(tmp_path, scenes, 500, 2, every=4, scene=40)
    assert figures["kills"] == 500 and int(str(figures["killed in flight"])) >= 100
