"""The writer, killed at random instants.

Run: `python -m tests.robustness.crash.kill_writer FOLDER KILLS SEED`.

Each life is a fork of this process that recovers the mission and flies on until it is killed, in
recovery as well as in flight. Every acknowledgement is compared with the disk after every tenth
life, by recovery, hashes and chain.
"""

from __future__ import annotations

import json
import os
import random
import select
import signal
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from daemon.mission.layout import Mission
from tests.daemon.small_camera import new_mission
from tests.robustness.crash.invariants import Acknowledged, check_invariants
from tests.robustness.crash.scripted_flight import run_until_end

CHECK_EVERY = 10
RUNS_PER_MISSION = 50
RUN_LIMIT_S = 30.0
SHARE_KILLED_EARLY = 0.3
EARLY_S = 0.03
"""Of a life that is killed while it recovers, or soon after; recovery takes some 10 ms."""


@dataclass
class Figures:
    """The acknowledgements, and the findings."""

    kills: int = 0
    killed_in_recovery: int = 0
    missions: int = 0
    stored: int = 0
    sealed: int = 0
    exposures: int = 0
    discarded: int = 0
    wrong: list[str] = field(default_factory=list)


def kill(folder: Path, kills: int, seed: int) -> Figures:
    """Kill so often; findings are in `wrong`."""
    rng = random.Random(seed)
    figures = Figures()
    while figures.kills < kills:
        figures.missions += 1
        root = folder / str(figures.missions)
        mission = new_mission(root)
        acknowledged = Acknowledged(mission=mission.id)
        runs = min(RUNS_PER_MISSION, kills - figures.kills)
        for run_number in range(1, runs + 1):
            figures.killed_in_recovery += not _run_until_killed(mission, acknowledged, rng)
            figures.kills += 1
            if run_number % CHECK_EVERY == 0 or run_number == runs:
                try:
                    outcome = check_invariants(root, acknowledged, flies_on=False)
                except AssertionError as error:
                    figures.wrong.append(f"{mission.path}, life {run_number}: {error}")
                    break
        else:
            figures.exposures += outcome.exposures
            figures.discarded += outcome.discarded
        figures.stored += len(acknowledged.stored)
        figures.sealed += len(acknowledged.sealed)
    return figures


def _run_until_killed(mission: Mission, acknowledged: Acknowledged, rng: random.Random) -> bool:
    """One life; whether it came out of recovery before it was killed."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if not child:
        os.close(read_end)
        with mission.held():
            run_until_end(mission, write_end, None, lands=False, durability="handed over")
    os.close(write_end)
    try:
        lines = _read_some(read_end, rng)
        # Between two words anything is under way: files, folder, rename, commit, record.
        _spin(rng.uniform(0.0, 0.004))
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    lines += _read_rest(read_end)
    os.close(read_end)
    for line in lines.decode().splitlines():
        acknowledged.add_line(line)
    return b"flying 0\n" in lines


def _read_some(read_end: int, rng: random.Random) -> bytes:
    """Output of the process until a random number of lines or a random time has passed."""
    received = b""
    is_early = rng.random() < SHARE_KILLED_EARLY
    wanted = 0 if is_early else rng.randrange(1, 16)
    limit_s = rng.uniform(0.0, EARLY_S) if is_early else RUN_LIMIT_S
    end_s = time.monotonic() + limit_s
    while is_early or received.partition(b"flying 0\n")[2].count(b"\n") < wanted:
        left_s = end_s - time.monotonic()
        readable = select.select([read_end], [], [], max(0.0, left_s))[0]
        if not readable:
            assert is_early, "a life hangs"
            break
        chunk = os.read(read_end, 65536)
        assert chunk, "a life ended by itself"
        received += chunk
    return received


def _read_rest(read_end: int) -> bytes:
    received = b""
    while chunk := os.read(read_end, 65536):
        received += chunk
    return received


def _spin(seconds: float) -> None:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        pass


def main() -> None:
    folder, kills, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    begun_s = time.monotonic()
    figures = kill(folder, kills, seed)
    print(json.dumps(asdict(figures) | {"seconds": round(time.monotonic() - begun_s, 1)}))


if __name__ == "__main__":
    main()
