"""The pipeline over many exposures: it takes its memory once and keeps to it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from daemon import store
from daemon.conditions import conditions_of
from daemon.configuration import PlanSection
from daemon.mission import Mission
from processing.pipeline import Pipeline, Settings
from processing.quality import Flag
from processing.radiometry import load_radiometry
from processing.rig import load_rig

pytestmark = [pytest.mark.soak, pytest.mark.timeout(3600)]

EXPOSURES = 200
SETTLED_AFTER = 20
GROWTH_LIMIT_MIB = 8.0


def resident_mib() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    raise AssertionError("no VmRSS in /proc/self/status")


def test_memory_does_not_grow_over_two_hundred_exposures(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sim_hw.exposures", "ultracam-x-mini", "--out", str(tmp_path)]
    subprocess.run([*command, "--dc", "12"], check=True, timeout=300, stdout=subprocess.DEVNULL)
    mission = Mission.open(tmp_path / "mission")
    rig = load_rig(mission.rig_path)
    folder = tmp_path / "calibration" / "radiometry"
    radiometry = {s.name: load_radiometry(folder / f"{s.name}.npz") for s in rig.sensors}
    pipeline = Pipeline(rig, radiometry, Settings(geometry=False))
    stored, exposure = store.load_level0(mission.level0(1), rig)
    frames = {name: np.array(frame) for name, frame in stored.items()}
    conditions = conditions_of(exposure, rig, PlanSection(), Flag(0))
    seen = []
    for _ in range(EXPOSURES):
        pipeline.process(frames, conditions)
        seen.append(resident_mib())
    print(
        f"resident MiB: {seen[SETTLED_AFTER]:.1f} after {SETTLED_AFTER}, {seen[-1]:.1f} at the end"
    )
    assert max(seen[-20:]) - max(seen[:SETTLED_AFTER]) < GROWTH_LIMIT_MIB
