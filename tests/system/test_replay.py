"""A flown mission replayed: what is recorded gives the same records and the same pixels again."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.system.flown import Flown, syntopic

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]


def compared(told: dict[str, Any]) -> dict[str, tuple[int, int]]:
    return {row["what"]: (row["equal"], row["different"]) for row in told["compared"]}


def test_a_replay_gives_the_same_hashes_with_one_exposure_in_work_and_with_two(
    flown: Flown,
) -> None:
    done = syntopic("replay", str(flown.mission), "--only", "5", "--only", "6", "--json")
    told = json.loads(done.stdout)
    assert done.returncode == 0, told["sentences"][:5]
    found = compared(told)
    assert found["exposure records"] == (12, 0)
    assert found["seals"] == (12, 0)
    assert found["ledger"] == (1, 0)
    assert found["records of gnss"][0] > 100
    assert found["records of probes"][0] > 100
    for lanes in (1, 2):
        for file in ("pan.tif", "rgbn.tif", "geometry.npz", "quality.json"):
            assert found[f"{file}, {lanes} in work"] == (2, 0)
    assert sum(different for _, different in found.values()) == 0


def test_a_replay_finds_one_flipped_bit_in_what_the_receiver_said(
    flown: Flown, tmp_path: Path
) -> None:
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
    told = json.loads(done.stdout)
    assert done.returncode == 1
    # The message's checksum is wrong now, so what was told then is not in the bytes any more.
    assert compared(told)["records of gnss"][1] > 0
    assert told["sentences"]
