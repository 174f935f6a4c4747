"""One of two disks is pulled under a flying service and comes back: nothing stored is lost."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of
from daemon.mission.store.level0_folder import read_sealed
from daemon.mission.verification.verification import verify
from processing.quality.report import Flag
from tests.system.demo_mission import ROOT

pytestmark = [pytest.mark.system, pytest.mark.trust, pytest.mark.timeout(400)]

PULLED_AFTER, RETURNED_AFTER = 3, 5
JOINED_WITHIN = 60
"""Exposures; the disk is brought up to date in about two where the machine is idle."""


def events_of(process: subprocess.Popen[str]) -> Iterator[dict[str, Any]]:
    assert process.stdout is not None
    for line in process.stdout:
        yield json.loads(line)


def test_a_pulled_disk_costs_no_exposure_and_is_brought_up_to_date_when_it_returns(
    tmp_path: Path, scenes: Path
) -> None:
    rig = "ultracam-l-mini"
    arguments = simulator_arguments(rig, tmp_path / "sim", seed=4, dc=0, displace=[])
    address = free_first_address()
    arguments += ["--first-address", address, "--exposures", "8", "--scene-cache", str(scenes)]
    emulator = Emulator([*arguments, "--still"])
    roots = {"root": tmp_path / "missions", "mirror": tmp_path / "mirror"}
    roots["mirror"].mkdir()
    config = tmp_path / "service.toml"
    text = service_toml(emulator.ready, root="missions", count=JOINED_WITHIN, end_when_done=True)
    config.write_text(text.replace("[mission]\n", '[mission]\nmirror = "mirror"\n'))
    program = [sys.executable, "-m", "tests.robustness.crash.service", str(config)]
    events: list[dict[str, Any]] = []
    process = subprocess.Popen(program, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    pulled, is_landing = tmp_path / "pulled", False
    try:
        for event in events_of(process):
            events.append(event)
            kind, number = event["event"], event.get("number")
            if kind == "stored" and number == PULLED_AFTER:
                roots["root"].rename(pulled)  # the disk that leads
            elif kind == "stored" and number == RETURNED_AFTER:
                pulled.rename(roots["root"])
            elif kind == "stored" and number > RETURNED_AFTER and len(event["disks"]) == 2:
                if not is_landing:
                    process.terminate()
                is_landing = True
        status = process.wait(60)
    finally:
        process.kill()
        emulator.end()
    kinds = [event["event"] for event in events]
    assert status == 0 and events[-1]["failure"] is None, events[-3:]
    assert kinds.count("disk-dropped") == 1 and kinds.count("disk-joined") == 2
    (dropped,) = (event for event in events if event["event"] == "disk-dropped")
    assert dropped["disk"] == "root" and dropped["in_use"] == ["mirror"] and dropped["fault"]
    assert "lost" not in kinds
    paths = [Path(event["path"]) for event in events if event["event"] == "mission"]
    assert [path.parent.name for path in paths] == ["missions", "mirror"]
    copies = [Mission.open(root / paths[0].name) for root in roots.values()]
    stored = {e["number"]: e["disks"] for e in events if e["event"] == "stored"}
    last = max(stored)
    assert kinds.count("stored") == last
    assert 1 in map(len, stored.values()) and len(stored[last]) == 2
    for copy in copies:
        assert copy.numbers() == list(range(1, last + 1))
        assert verify(copy).problems == ()
        assert Mission.current(copy.root) is None
        for number, disks in stored.items():
            record = read_sealed(copy.level0(number))
            assert record is not None and list(record.exposure.disks) == disks
            is_alone = bool(record.exposure.flags & Flag.NOT_MIRRORED)
            assert is_alone == (len(disks) == 1)
    logs = [[log.read_bytes() for log in logs_of(copy.log_dir)] for copy in copies]
    assert logs[0] == logs[1]
