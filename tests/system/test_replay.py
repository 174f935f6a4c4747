"""A flown mission replayed: what is recorded gives the same records and the same pixels again."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from tests.system.demo_mission import ROOT, DemoMission, syntopic

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

LINE_EXPOSURES = 40
"""So long are the lines of the long flight; between them it turns, exposing."""
IMAGES = ("pan.tif", "rgbn.tif", "geometry.npz", "quality.json")
LONG_RUN_S = 7000.0


def compared(output: dict[str, Any]) -> dict[str, tuple[int, int]]:
    return {row["what"]: (row["equal"], row["different"]) for row in output["compared"]}


def test_a_replay_gives_the_same_hashes_with_one_exposure_in_work_and_with_two(
    flown: DemoMission,
) -> None:
    done = syntopic("replay", str(flown.mission), "--only", "5", "--only", "6", "--json")
    output = json.loads(done.stdout)
    assert done.returncode == 0, output["sentences"][:5]
    found = compared(output)
    assert found["exposure records"] == (12, 0)
    assert found["seals"] == (12, 0)
    assert found["ledger"] == (1, 0)
    assert found["records of gnss"][0] > 100
    assert found["records of probes"][0] > 100
    for parallel in (1, 2):
        for file in ("pan.tif", "rgbn.tif", "geometry.npz", "quality.json"):
            assert found[f"{file}, {parallel} in work"] == (2, 0)
    assert sum(different for _, different in found.values()) == 0


def test_a_replay_finds_one_flipped_bit_of_the_receiver(flown: DemoMission, tmp_path: Path) -> None:
    mission = tmp_path / flown.mission.name
    mission.mkdir()
    shutil.copytree(flown.mission / "L0", mission / "L0", copy_function=os.link)
    for name in ("rig.toml", "service.toml", "mission.json"):
        shutil.copy(flown.mission / name, mission / name)
    shutil.copytree(flown.mission / "log", mission / "log")
    (log,) = (mission / "log").glob("*.mcap")
    data = bytearray(log.read_bytes())
    # A latitude in the middle of the flight: NAV-PVT, class 1, id 7, payload of 92 bytes.
    at = data.find(b"\xb5\x62\x01\x07\x5c\x00", len(data) // 2)
    assert at > 0
    data[at + 6 + 28] ^= 1
    log.chmod(0o644)
    log.write_bytes(data)
    done = syntopic("replay", str(mission), "--records-only", "--json")
    output = json.loads(done.stdout)
    assert done.returncode == 1
    # The message's checksum is wrong now, so the bytes no longer contain the reported value.
    assert compared(output)["records of gnss"][1] > 0
    assert output["sentences"]


def fly_long(folder: Path, count: int) -> Path:
    """The mission folder of so many exposures by the service as it flies, with its pipeline."""
    rig = "ultracam-l-mini"
    arguments = simulator_arguments(rig, folder / "sim", seed=5, dc=6, displace=[])
    address = free_first_address()
    line = str(min(count, LINE_EXPOSURES))
    emulator = Emulator([*arguments, "--first-address", address, "--exposures", line])
    try:
        config = folder / "service.toml"
        config.write_text(
            service_toml(emulator.ready, root="missions", count=count, end_when_done=True)
        )
        done = subprocess.run(
            [sys.executable, "-m", "daemon", "run", str(config), "--json-lines"],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
            timeout=LONG_RUN_S,
            check=True,
        )
    finally:
        emulator.end()
    events = [json.loads(line) for line in done.stdout.splitlines()]
    ledger = events[-1]["ledger"]
    assert ledger["balanced"] and ledger["triggers"]["triggers"] == count, ledger
    return Path(next(event["path"] for event in events if event["event"] == "mission"))


@pytest.mark.soak
@pytest.mark.timeout(7200)
def test_two_hundred_exposures_replayed_give_equal_hashes(tmp_path: Path) -> None:
    """About 13 GB; a busy machine may put images off or lose frames, and replays that as well."""
    count = 200
    mission = fly_long(tmp_path, count)
    image_count = len(list((mission / "L2").glob("[0-9]*")))
    done = syntopic("replay", str(mission), "--json", within_s=LONG_RUN_S)
    output = json.loads(done.stdout)
    print(json.dumps(output))
    found = compared(output)
    assert done.returncode == 0, output["sentences"][:5]
    assert found["exposure records"] == (count, 0) and found["ledger"] == (1, 0)
    for parallel in (1, 2):
        for file in IMAGES:
            assert found[f"{file}, {parallel} in work"] == (image_count, 0)
    assert image_count >= 0.9 * count
