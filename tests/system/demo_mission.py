"""A flight that tests look at: flown once a session, with the command a user types."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.stopwatch import slowdown

ROOT = Path(__file__).parents[2]
FLIGHT_WITHIN_S = 300.0


@dataclass(frozen=True)
class DemoMission:
    """Output of `syntopic demo --json`, and the paths of its mission and truth."""

    summary: dict[str, Any]
    mission: Path
    truth: Path
    scenes: Path


def syntopic(
    *arguments: str, within_s: float = FLIGHT_WITHIN_S
) -> subprocess.CompletedProcess[str]:
    """Run the command and return what it printed."""
    return subprocess.run(
        [sys.executable, "-m", "daemon", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=within_s * slowdown(),
        check=False,
    )


def fly(out: Path, *options: str) -> DemoMission:
    """Fly the demonstration into a folder."""
    done = syntopic("demo", "--json", "--out", str(out), *options)
    assert done.returncode == 0, done.stderr[-3000:]
    summary = json.loads(done.stdout)
    mission = Path(summary["mission"])
    return DemoMission(summary, mission, mission.parents[1] / "sim" / "truth", out / "scenes")
