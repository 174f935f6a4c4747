"""Long runs, for `make soak`: the service killed again and again at random instants."""

from __future__ import annotations

import json
import random
import signal
import threading
from pathlib import Path

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from tests.system.demo_mission import syntopic
from tests.system.test_faults_in_flight import read_events, start

pytestmark = [pytest.mark.soak, pytest.mark.timeout(7200)]

KILLS = 20
LONGEST_RUN_S = 30.0


def test_twenty_kills_at_random_instants_lose_nothing_that_was_reported_stored(
    tmp_path: Path,
) -> None:
    rng = random.Random(11)
    arguments = simulator_arguments("ultracam-x-mini", tmp_path / "sim", seed=4, dc=0, displace=[])
    address = free_first_address()
    emulator = Emulator([*arguments, "--first-address", address, "--exposures", "60"])
    config = tmp_path / "service.toml"
    stored: set[int] = set()
    missions: set[str] = set()
    try:
        config.write_text(service_toml(emulator.ready, root="missions"))
        for _ in range(KILLS):
            service = start(config)
            killer = threading.Timer(
                rng.uniform(1.0, LONGEST_RUN_S), service.send_signal, [signal.SIGKILL]
            )
            killer.start()
            for event in read_events(service):
                if event["event"] == "mission":
                    missions.add(event["path"])
                elif event["event"] == "stored":
                    stored.add(event["number"])
            service.wait(10)
        (mission,) = missions
        config.write_text(
            service_toml(emulator.ready, root="missions", count=1, end_when_done=True)
        )
        last = start(config)
        events = list(read_events(last))
        assert last.wait(30) == 0
    finally:
        emulator.end()
    (ended,) = [event for event in events if event["event"] == "ended"]
    assert ended["ledger"]["balanced"], ended["ledger"]["imbalances"]
    present = {int(path.name) for path in Path(mission, "L0").glob("[0-9]*")}
    assert stored and stored <= present
    verified = syntopic("verify", mission, "--json")
    assert verified.returncode == 0, verified.stdout
    print(json.dumps({"kills": KILLS, "stored": len(stored), "kept": len(present)}))
