"""Verification in flight.

Run: `python -m tests.robustness.crash.verified_flight FOLDER VERIFICATIONS SEED`.

Real writer processes fly one mission after another as fast as they can; some are killed and go on
after recovery, the last of a mission lands. Meanwhile this process verifies the newest mission,
over and over: nothing that a flight does may look like damage.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

from daemon.mission.layout import CURRENT_FILE, Mission
from daemon.mission.store import durable
from daemon.mission.store.store import verify
from daemon.mission.verification.recovery import recover
from daemon.onboard.flight.arming import FILE, MissingPrerequisite, overrides_content
from daemon.onboard.flight.recovery_match import seal_from_log
from tests.daemon.small_camera import new_mission, small_rig
from tests.robustness.crash.scripted_flight import run_until_end

EXPOSURES_PER_RUN = 12
"""Few, so that the missions stay small and there are many beginnings and ends."""


@dataclass
class Verified:
    """How many verifications there were by state of the mission, and every problem they named."""

    states: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    exposures: int = 0

    def add(self, path: Path) -> None:
        """Verify a mission."""
        report = verify(Mission.open(path, checks_subfolders=False))
        self.states[report.state] += 1
        self.exposures += report.exposures
        self.problems += [f"{path.name}: {problem}" for problem in report.problems]


def verify_in_flight(root: Path, count: int, seed: int) -> Verified:
    """Verify missions being flown `count` times, and each once more after it has landed."""
    pilot = os.fork()
    if not pilot:
        os.setpgid(0, 0)
        try:
            _fly_endlessly(root, random.Random(seed))
        finally:
            os._exit(1)
    verified = Verified()
    try:
        newest: Path | None = None
        while verified.states["flown"] < count or verified.states["ended"] < 2:
            missions = _missions(root)
            if newest is not None and missions[-1] != newest:
                verified.add(newest)
            newest = missions[-1] if missions else None
            if newest is not None and (root / CURRENT_FILE).exists():
                verified.add(newest)
            assert os.waitpid(pilot, os.WNOHANG) == (0, 0), "the flight ended"
    finally:
        os.killpg(pilot, signal.SIGKILL)
        os.waitpid(pilot, 0)
    return verified


def _fly_endlessly(root: Path, rng: random.Random) -> None:
    parent = os.getppid()
    started_utc = datetime(2026, 11, 21, 10, 15, tzinfo=UTC)
    while os.getppid() == parent:
        started_utc += timedelta(seconds=1)  # so that ids are in order
        mission = new_mission(root, started_utc)
        for _ in range(rng.randrange(3)):
            writer_pid = _run_writer(mission, lands=False)
            time.sleep(rng.uniform(0.0, 0.3))
            note = overrides_content(
                mission.path, "test", [MissingPrerequisite("arming-time", "no time", "wait")]
            )
            durable.replace_file(mission.path / FILE, note)
            os.kill(writer_pid, signal.SIGKILL)
            os.waitpid(writer_pid, 0)
        assert os.waitpid(_run_writer(mission, lands=True), 0)[1] == 0
        mission.close()
        for older in _missions(root)[:-10]:
            _remove(older)


def _run_writer(mission: Mission, *, lands: bool) -> int:
    pid = os.fork()
    if pid:
        return pid
    with mission.held():
        first = recover(mission, seal_from_log(small_rig())).next_number
        acks = os.open(os.devnull, os.O_WRONLY)
        numbers = range(first, first + EXPOSURES_PER_RUN)
        run_until_end(mission, acks, numbers, lands=lands, durability="handed over")
    os._exit(0)


def _missions(root: Path) -> list[Path]:
    return sorted(path for path in root.glob("2*") if path.is_dir())


def _remove(mission: Path) -> None:
    """Out of sight first: a verification never looks at what is being removed."""
    hidden = mission.with_name(f".{mission.name}")
    mission.rename(hidden)
    shutil.rmtree(hidden)


def main() -> None:
    root = Path(sys.argv[1])
    root.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    verified = verify_in_flight(root, int(sys.argv[2]), int(sys.argv[3]))
    print(
        dict(verified.states), f"{verified.exposures} exposures, {time.monotonic() - started:.0f} s"
    )
    for problem, count in Counter(verified.problems).most_common(20):
        print(f"{count} x {problem}")
    print(f"{len(verified.problems)} false alarms")


if __name__ == "__main__":
    main()
