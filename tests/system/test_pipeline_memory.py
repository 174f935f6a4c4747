"""The pipeline over many exposures: it takes its memory once and keeps to it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.memory import held_mib

pytestmark = [pytest.mark.soak, pytest.mark.timeout(3600)]

EXPOSURES = 200
WARM_UP_EXPOSURES = 20
GROWTH_LIMIT_MIB = 8.0


@pytest.mark.parametrize("parallel", [1, 2])
def test_memory_does_not_grow_over_two_hundred_exposures(tmp_path: Path, parallel: int) -> None:
    command = [
        sys.executable,
        "-m",
        "sim_hw.processes.exposures",
        "ultracam-x-mini",
        "--out",
        str(tmp_path),
    ]
    subprocess.run([*command, "--dc", "12"], check=True, timeout=300, stdout=subprocess.DEVNULL)
    seen = held_mib(tmp_path, EXPOSURES, parallel)
    print(
        f"PSS MiB: {seen[WARM_UP_EXPOSURES]:.1f} after {WARM_UP_EXPOSURES}, {seen[-1]:.1f} at the "
        "end"
    )
    assert max(seen[-20:]) - max(seen[:WARM_UP_EXPOSURES]) < GROWTH_LIMIT_MIB
