"""The disk fills under a flying service and is freed again: it stays alive, and goes on."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from tests.robustness.crash.test_full_disk import NAMESPACE, needs_namespace
from tests.system.demo_mission import ROOT

pytestmark = [pytest.mark.system, pytest.mark.timeout(400)]


@needs_namespace
def test_a_full_disk_costs_exposures_and_never_the_service(tmp_path: Path, scenes: Path) -> None:
    rig = "ultracam-l-mini"
    arguments = simulator_arguments(rig, tmp_path / "sim", seed=4, dc=0, displace=[])
    address = free_first_address()
    arguments += ["--first-address", address, "--exposures", "8", "--scene-cache", str(scenes)]
    emulator = Emulator([*arguments, "--still"])
    config = tmp_path / "service.toml"
    disk = tmp_path / "missions"
    disk.mkdir()
    # No reserve: the guard would stop the flight long before anything is refused.
    text = service_toml(emulator.ready, root="missions")
    config.write_text(f"{text}\n[limits]\ndisk_reserve_bytes = 0\n")
    program = [
        sys.executable,
        "-m",
        "tests.robustness.crash.service_on_full_disk",
        str(config),
        str(disk),
    ]
    try:
        done = subprocess.run(
            [*NAMESPACE, *program], cwd=ROOT, capture_output=True, text=True, timeout=300
        )
    finally:
        emulator.end()
    assert done.returncode == 0, done.stderr[-3000:]
    print(done.stdout)
    output = json.loads(done.stdout)
    assert output["was_freed"] and output["status"] == 0 and output["failure"] is None
    assert output["events"]["not-written"] >= 1 and output["events"]["disk"] >= 1
    counts = output["triggers"]
    assert output["balanced"] and counts["open"] == 0 and counts["lost"] >= 1
    # Each trigger has its record, each stored exposure its frames, and nothing is half there.
    assert output["problems"] == []
    assert output["exposures"] == counts["triggers"]
    assert len(output["stored"]) == counts["complete"] + counts["degraded"] >= 4
